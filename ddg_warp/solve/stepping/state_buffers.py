"""State buffers at fixed addresses for graph capture, with copy-on-write for states that the caller still holds."""

import sys
from dataclasses import fields, replace

import warp as wp

from ddg_warp.model.state import State


class StateBuffer:
    """State memory at a fixed address, and the `State` that users get of it.

    Before the memory is overwritten, `vacate` counts references to this state. A state that the caller keeps receives a copy, while the
    memory stays in the buffer. A caller who keeps bare arrays (or views) keeps the memory itself, and the buffer allocates another.

    Attributes:
        own: state with which steps are captured.
        state: state for users: separate arrays over the same memory, to count references.
    """

    def __init__(self, model):
        self._model = model
        self._allocate()

    def _allocate(self) -> None:
        self.own = self._model.empty_state()
        *groups, coupled, grips = (
            part and _mapped(part, lambda array: array[:] if array.size else array)
            for part in (*self.own.groups, self.own.coupled, self.own.grips)
        )
        self.state = State(self._model, groups, coupled, grips=grips)
        self._watch()

    def _watch(self) -> None:
        """Record the reference counts without callers."""
        self._handles, self._memory = _objects(self.state)
        self._known = _references(self._handles), _references(self._memory)

    def vacate(self) -> bool:
        """Detach the state or memory that callers keep; return True if the memory is new."""
        handles, memory = self._known
        if _references(self._memory) != memory:
            self._allocate()
            return True
        if _references(self._handles) != handles:
            self.state = _departed(self.state)
            self._watch()
        return False


def _departed(kept: State) -> State:
    """Give a kept state new arrays; return a state with the original ones."""
    state = kept.copy()
    for theirs, ours in zip(kept.parts().values(), state.parts().values(), strict=True):
        new = dict(vars(ours))
        vars(ours).update(vars(theirs))
        vars(theirs).update(new)
    return state


def _objects(state: State) -> tuple[tuple, tuple]:
    """Return the objects of a state with replaceable arrays, and its arrays and lists of arrays."""
    parts = list(state.parts().values())
    lists = [value for part in parts for value in vars(part).values() if not isinstance(value, wp.array)]
    return (state, state.groups, *parts), (*lists, *(array for part in parts for array in part.arrays().values()))


def _references(objects: tuple) -> tuple[int, ...]:
    return tuple(map(sys.getrefcount, objects))


def _mapped(part, change):
    """Return a component of a state with every array changed."""

    def changed(value):
        if isinstance(value, list):
            return [change(array) for array in value]
        if isinstance(value, dict):
            return {key: change(array) for key, array in value.items()}
        return change(value)

    return replace(part, **{field.name: changed(getattr(part, field.name)) for field in fields(part)})

"""States that captured steps write into, and what keeps them from changing under whoever holds one."""

import sys
from dataclasses import fields, replace

import warp as wp

from ddg_warp.model.state import State


class Buffer:
    """Memory of a state at a fixed place, and the `State` that a user gets of it.

    Before the memory is written again, `vacate` asks whether anybody but the buffer refers to this state: a state that is held takes
    a copy with it, and the memory stays here. Whoever holds bare arrays of it (or a view of one) keeps the memory itself.

    Attributes:
        own: what steps are captured with.
        state: what is handed out: arrays of its own over the same memory, so that references to them tell who looks at it.
    """

    def __init__(self, model):
        self._model = model
        self._allocate()

    def _allocate(self) -> None:
        self.own = self._model.empty_state()
        *groups, net, grips = (
            part and _mapped(part, lambda array: array[:] if array.size else array)
            for part in (*self.own.groups, self.own.net, self.own.grips)
        )
        self.state = State(self._model, groups, net, grips=grips)
        self._watch()

    def _watch(self) -> None:
        """Note how often everything is referred to while nobody holds it."""
        self._handles, self._memory = _objects(self.state)
        self._known = _references(self._handles), _references(self._memory)

    def vacate(self) -> bool:
        """Leave what others hold to them; whether the memory has gone with it, and this is another."""
        handles, memory = self._known
        if _references(self._memory) != memory:
            self._allocate()
            return True
        if _references(self._handles) != handles:
            self.state = _departed(self.state)
            self._watch()
        return False


def _departed(held: State) -> State:
    """Gives a state that is held arrays of its own; a state with those that it had."""
    state = held.copy()
    for theirs, ours in zip(held.parts().values(), state.parts().values(), strict=True):
        new = dict(vars(ours))
        vars(ours).update(vars(theirs))
        vars(theirs).update(new)
    return state


def _objects(state: State) -> tuple[tuple, tuple]:
    """A state with its parts, which can be given other arrays; and its arrays and lists of them, which can not."""
    parts = list(state.parts().values())
    lists = [value for part in parts for value in vars(part).values() if not isinstance(value, wp.array)]
    return (state, state.groups, *parts), (*lists, *(array for part in parts for array in part.arrays().values()))


def _references(objects: tuple) -> tuple[int, ...]:
    return tuple(map(sys.getrefcount, objects))


def _mapped(part, change):
    """A part of a state with every array changed."""

    def changed(value):
        if isinstance(value, list):
            return [change(array) for array in value]
        if isinstance(value, dict):
            return {key: change(array) for key, array in value.items()}
        return change(value)

    return replace(part, **{field.name: changed(getattr(part, field.name)) for field in fields(part)})

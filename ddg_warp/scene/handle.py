"""Handles: indices of the objects of a scene that know their kind and name."""

from collections.abc import Iterator, Sequence
from typing import overload

import numpy as np
import numpy.typing as npt

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.typing import Integers

ROD, SHELL, OBSTACLE, SUPPORT, LOAD = "rod", "shell", "obstacle", "support", "load"
BODY = "body"
BODY_JOINT = "body joint"
SHELL_SUPPORT, RING_SUPPORT = "shell support", "ring support"
AXISYMMETRIC = "shell of revolution"


class Handle(int):
    """Index of a rod, shell, body, support, load or obstacle of a scene, with kind and name.

    Attributes:
        kind: "rod", "shell", "shell of revolution", "body", "obstacle", "support", "shell support", "ring support", "load", ...; the
            index counts the objects of one kind.
        name: as given to the scene, "" without.
    """

    kind: str
    name: str

    def __new__(cls, index: int, kind: str, name: str = "") -> "Handle":
        """Return a handle of the object `index` of a kind."""
        result = super().__new__(cls, index)
        result.kind, result.name = kind, name
        return result

    def __getnewargs__(self) -> tuple:
        return int(self), self.kind, self.name

    def __repr__(self) -> str:
        return f"<{self.kind} {int(self)}{self.name and f' {self.name!r}'}>"

    __str__ = int.__repr__


class Handles(Sequence[Handle]):
    """Handles of consecutive rods, made one at a time when needed."""

    def __init__(self, indices: range, name: str):
        self._indices, self._name = indices, name

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, item: int) -> Handle: ...

    @overload
    def __getitem__(self, item: slice) -> "Handles": ...

    def __getitem__(self, item: int | slice) -> "Handle | Handles":
        chosen = self._indices[item]
        return Handles(chosen, self._name) if isinstance(chosen, range) else Handle(chosen, ROD, self._name)

    def __iter__(self) -> Iterator[Handle]:
        return (Handle(index, ROD, self._name) for index in self._indices)

    def __contains__(self, item: object) -> bool:
        return item in self._indices

    def __array__(self, dtype: "npt.DTypeLike | None" = None, copy: bool | None = None) -> Integers:
        indices = self._indices
        return np.arange(indices.start, indices.stop, indices.step, dtype=dtype)

    def __eq__(self, sequence: object) -> bool:
        return list(self._indices) == list(sequence) if isinstance(sequence, Sequence) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._indices)

    def __repr__(self) -> str:
        return f"<rods {self._indices.start} to {self._indices.stop - 1} {self._name!r}>"


def need(kind: str, value) -> None:
    """Refuse a handle of another kind."""
    values = value if isinstance(value, list | tuple) else (value,)
    for each in values:
        if isinstance(each, Handle) and each.kind != kind:
            raise SceneError(f"{each!r} is no {kind}; give a {kind}")


def named(kind: str, item: int | str, names: Sequence[str]) -> Handle:
    """Return the handle of one object from a name, an index or a handle.

    Args:
        kind: of the object.
        item: name, index or handle.
        names: of all objects of this kind.

    Raises:
        SceneError: there is no such object, or several have the name.
    """
    if isinstance(item, str):
        chosen = np.flatnonzero(np.asarray(names, object) == item)
        if not chosen.size:
            available = {name for name in names if name}
            end = argument_checks.meant(item, available) if available else f"; no {kind} has a name"
            raise SceneError(f"no {kind} is named {item!r}{end}")
        if chosen.size > 1:
            raise SceneError(
                f"{chosen.size} {kind}s are named {item!r}, {', '.join(map(str, chosen[:3]))}{', ...' * (chosen.size > 3)}; "
                "give one by its handle or index"
            )
        item = int(chosen[0])
    need(kind, item)
    index = argument_checks.index(kind, item)
    if not 0 <= index < len(names):
        raise SceneError(f"{kind} {index} does not exist; there are {len(names)}")
    return Handle(index, kind, names[index])

"""Prescribed motion of supports: rigid motions that count their turns, and displacements node by node."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError, SolverError

LOOKS = 64  # times at which a translation is asked for what it moves
JUMP = 0.25  # part of its change over a step that a motion makes at one instant, from which it is a jump


def _still(t: float) -> tuple[float, float, float]:
    return (0.0, 0.0, 0.0)


def _unturned(t: float) -> float:
    return 0.0


@arguments.called
@dataclass(frozen=True)
class Motion:
    """A rigid motion of supports: rotation about an axis through `pivot`, then translation.

    A point X of the rest state is at pivot + R(angle(t)) (X - pivot) + translation(t). The angle is cumulative: it counts turns
    past 2 pi, however far it goes in a step, so that an end can be wound up. In statics t is the load parameter.

    Both are zero at t = 0: supports start where they are at rest. Functions of time are the same in all worlds of a model; what is to
    move in each for itself, or is decided from step to step, is held by a `Grip`.

    Attributes:
        translation: t -> displacement (3,) [m]; or (n, 3), one for each node that `fix` names (of one rod after the other), or each
            vertex that `hold` does, in that order.
        angle: t -> cumulative angle about `axis` [rad].
        axis: direction of the rotation (3,), any length.
        pivot: a point on the axis (3,) [m].
    """

    translation: Callable[[float], tuple] = _still
    angle: Callable[[float], float] = _unturned
    axis: tuple = (0.0, 0.0, 1.0)
    pivot: tuple = (0.0, 0.0, 0.0)
    count: int | None = field(init=False, default=None, repr=False, compare=False)  # of nodes, one displacement each
    unit: np.ndarray = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        for name in ("translation", "angle"):
            function = getattr(self, name)
            if not callable(function):
                raise SceneError(f"Motion: {name} is {function!r}; give a function of the time, such as lambda t: ...")
        object.__setattr__(self, "pivot", arguments.vector("Motion: pivot", self.pivot))
        object.__setattr__(self, "unit", arguments.direction("Motion: axis", self.axis))
        shift = arguments.value_at("Motion: translation", self.translation, 0.0, 3, error=SceneError)
        arguments.value_at("Motion: angle", self.angle, 0.0, error=SceneError)
        object.__setattr__(self, "count", len(shift) if shift.ndim == 2 else None)

    @property
    def turns(self) -> bool:
        """Whether it was given an angle."""
        return self.angle is not _unturned

    @property
    def shifts(self) -> bool:
        """Return True if it was given a translation."""
        return self.translation is not _still

    @property
    def planar(self) -> bool:
        """Whether what lies in the plane of x and z turns within it."""
        return not self.turns or (self.axis[0] == 0.0 and self.axis[2] == 0.0)

    def moves(self, duration: float) -> np.ndarray:
        """Which components of a point it moves (3,), as far as its translation tells at some times until `duration`."""
        about = np.abs(self.unit) < 1.0 if self.turns else np.zeros(3, bool)
        times = duration * (np.arange(LOOKS) + 1.0) / LOOKS
        return about | np.any([(self.shift(t) != 0.0).any(0) for t in times], axis=0)

    def shift(self, t: float) -> np.ndarray:
        """Translations at t, (1, 3) or (n, 3) [m].

        Raises:
            SolverError: they are not finite, or not as many as at t = 0.
        """
        value = arguments.value_at("the motion's translation", self.translation, t, 3)
        if (len(value) if value.ndim == 2 else None) != self.count:
            raise SolverError(
                f"the motion's translation has shape {value.shape} at t = {t:g}, another one than at t = 0; keep its shape",
                outcome=arguments.PRESCRIBED,
            )
        return np.atleast_2d(value)

    def turned(self, t: float) -> float:
        """Cumulative angle at t [rad].

        Raises:
            SolverError: it is not finite.
        """
        return float(arguments.value_at("the motion's angle", self.angle, t))

    def pose(self, t0: float, t1: float, start: float = 0.0, part: float = 1.0) -> np.ndarray:
        """What the device needs of a step: turn (3), rotation at its start (9), pivot (3), translations (3, 3) in a row.

        From t0 to t1 is a `part` of the step, from its fraction `start` on, and goes on alike over the whole. One row, or one for each
        node.
        """
        a0, a1 = self.turned(t0), self.turned(t1)
        first, last = self.shift(t0), self.shift(t1)
        if part < 1.0:
            a0, a1 = a0 - start * (a1 - a0) / part, a1 + (1.0 - start - part) * (a1 - a0) / part
            rate = (last - first) / part
            first, last = first - start * rate, last + (1.0 - start - part) * rate
        same = np.concatenate([self.unit * (a1 - a0), self.rotation(a0).ravel(), self.pivot])
        return np.column_stack([np.tile(same, (len(first), 1)), first, last])

    def jump(self, t0: float, t1: float) -> float | None:
        """A time between t0 and t1 at which the motion jumps, found by halving where it changes most; None where it does not."""

        def at(t):
            return np.append(self.shift(t).ravel(), self.turned(t))

        low, high = at(t0), at(t1)
        whole = np.abs(high - low).max()
        while t1 - t0 > 64.0 * np.spacing(max(abs(t0), abs(t1))):
            middle = 0.5 * (t0 + t1)
            here = at(middle)
            if np.abs(here - low).max() >= np.abs(high - here).max():
                t1, high = middle, here
            else:
                t0, low = middle, here
        return t1 if np.abs(high - low).max() > JUMP * whole > 0.0 else None

    def rotation(self, angle: float) -> np.ndarray:
        """Rotation matrix about the axis (Rodrigues)."""
        k = self.unit
        cross = np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])
        return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)

    def place(self, t: float, points: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Where points of the rest state (n, 3) are at t [m]; `rows` are those of their translations where each has its own."""
        turned = (points - self.pivot) @ self.rotation(self.turned(t)).T
        return turned + self.pivot + self.shift(t)[slice(None) if self.count is None else rows]

    def turn(self, t: float, vectors: np.ndarray) -> np.ndarray:
        """Where vectors of the rest state (n, 3) point at t."""
        return vectors @ self.rotation(self.turned(t)).T

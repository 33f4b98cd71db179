"""Prescribed motion of supports: rigid motions with cumulative angle, and displacements by node."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.typing import Amplitude, Bools, Floats, Integers, Numbers, Vector

LOOKS = 64  # times at which a translation is sampled for moving components
JUMP = 0.25  # least jump at one instant, over the change of a motion in a step


def _still(t: float) -> tuple[float, float, float]:
    return (0.0, 0.0, 0.0)


def _unturned(t: float) -> float:
    return 0.0


@argument_checks.called
@dataclass(frozen=True)
class Motion:
    """Rigid motion of supports: rotation about an axis through `pivot`, then translation.

    A point X of the rest state moves to pivot + R(angle(t)) (X - pivot) + translation(t). The angle is cumulative and may exceed
    2 pi, also within a step, so that an end can be wound up. In statics t is the load parameter.

    Both are zero at t = 0: supports start at rest. Functions of time are the same in all worlds of a model. For motions that differ
    between worlds, or are decided step by step, use a `Grip`.

    Attributes:
        translation: t -> displacement (3,) [m]; or (n, 3), one for each node of `fix` (rod after rod) or vertex of `hold`, in order.
        angle: t -> cumulative angle about `axis` [rad].
        axis: direction of the rotation (3,), any length.
        pivot: a point on the axis (3,) [m].
    """

    translation: Callable[[float], Numbers] = _still
    angle: Amplitude = _unturned
    axis: Vector = (0.0, 0.0, 1.0)
    pivot: Vector = (0.0, 0.0, 0.0)
    count: int | None = field(
        init=False, default=None, repr=False, compare=False
    )  # number of nodes with one displacement each
    unit: Floats = field(init=False, repr=False, compare=False)

    by_rod = False

    def __post_init__(self):
        for name in ("translation", "angle"):
            function = getattr(self, name)
            if not callable(function):
                raise SceneError(f"Motion: {name} is {function!r}; give a function of the time, such as lambda t: ...")
        object.__setattr__(self, "pivot", argument_checks.vector("Motion: pivot", self.pivot))
        object.__setattr__(self, "unit", argument_checks.direction("Motion: axis", self.axis))
        shift = argument_checks.value_at("Motion: translation", self.translation, 0.0, 3, error=SceneError)
        argument_checks.value_at("Motion: angle", self.angle, 0.0, error=SceneError)
        object.__setattr__(self, "count", len(shift) if shift.ndim == 2 else None)

    @property
    def turns(self) -> bool:
        """True for a motion with an angle."""
        return self.angle is not _unturned

    @property
    def shifts(self) -> bool:
        """True for a motion with a translation."""
        return self.translation is not _still

    @property
    def planar(self) -> bool:
        """True for a rotation that keeps the plane of x and z."""
        return not self.turns or (self.axis[0] == 0.0 and self.axis[2] == 0.0)

    def moves(self, duration: float) -> Bools:
        """Return the moving components of a point (3,), from samples of the translation until `duration`."""
        about = np.abs(self.unit) < 1.0 if self.turns else np.zeros(3, bool)
        times = duration * (np.arange(LOOKS) + 1.0) / LOOKS
        return about | np.any([(self.shift(t) != 0.0).any(0) for t in times], axis=0)

    def shift(self, t: float) -> Floats:
        """Return translations at t, (1, 3) or (n, 3) [m].

        Raises:
            SolverError: translations are not finite, or differ in shape from t = 0.
        """
        value = argument_checks.value_at("the motion's translation", self.translation, t, 3)
        if (len(value) if value.ndim == 2 else None) != self.count:
            raise SolverError(
                f"the motion's translation has shape {value.shape} at t = {t:g}, another one than at t = 0; keep its shape",
                outcome=argument_checks.PRESCRIBED,
            )
        return np.atleast_2d(value)

    def turned(self, t: float) -> float:
        """Return the cumulative angle at t [rad].

        Raises:
            SolverError: the angle is not finite.
        """
        return float(argument_checks.value_at("the motion's angle", self.angle, t))

    def pose(self, t0: float, t1: float, start: float = 0.0, part: float = 1.0) -> Floats:
        """Return rows for the device: rotation vector (3), rotation at the start (9), pivot (3), translations (3, 3).

        The interval from t0 to t1 is the fraction `part` of the step after the fraction `start`, extrapolated to the whole step. One
        row, or one for each node.
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
        """Return the time of a jump between t0 and t1, by bisection of the largest change; None without a jump."""

        def values_at(t):
            return np.append(self.shift(t).ravel(), self.turned(t))

        low, high = values_at(t0), values_at(t1)
        whole = np.abs(high - low).max()
        while t1 - t0 > 64.0 * np.spacing(max(abs(t0), abs(t1))):
            middle = 0.5 * (t0 + t1)
            value = values_at(middle)
            if np.abs(value - low).max() >= np.abs(high - value).max():
                t1, high = middle, value
            else:
                t0, low = middle, value
        return t1 if np.abs(high - low).max() > JUMP * whole > 0.0 else None

    def rotation(self, angle: float) -> Floats:
        """Return the rotation matrix about the axis (Rodrigues)."""
        k = self.unit
        cross = np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])
        return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)

    def place(self, t: float, points: Floats, rows: Integers | slice = slice(None)) -> Floats:
        """Return points of the rest state (n, 3) moved to t [m]; `rows` select translations given by node."""
        turned = (points - self.pivot) @ self.rotation(self.turned(t)).T
        return turned + self.pivot + self.shift(t)[slice(None) if self.count is None else rows]

    def turn(self, t: float, vectors: Floats) -> Floats:
        """Return vectors of the rest state (n, 3) rotated to t."""
        return vectors @ self.rotation(self.turned(t)).T

"""Prescribed motion of supports: rigid motions that count their turns."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np


def _still(t: float) -> tuple[float, float, float]:
    return (0.0, 0.0, 0.0)


def _unturned(t: float) -> float:
    return 0.0


@dataclass(frozen=True)
class Motion:
    """A rigid motion of supports: rotation about an axis through `pivot`, then translation.

    A point X of the rest state is at pivot + R(angle(t)) (X - pivot) + translation(t). The angle is cumulative: it counts turns
    past 2 pi, however far it goes in a step, so that an end can be wound up. In statics t is the load parameter.

    Attributes:
        translation: t -> displacement (3,) [m].
        angle: t -> cumulative angle about `axis` [rad].
        axis: direction of the rotation (3,), any length.
        pivot: a point on the axis (3,) [m].
    """

    translation: Callable[[float], tuple] = _still
    angle: Callable[[float], float] = _unturned
    axis: tuple = (0.0, 0.0, 1.0)
    pivot: tuple = (0.0, 0.0, 0.0)
    _unit: np.ndarray = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        axis = np.asarray(self.axis, float)
        length = np.linalg.norm(axis)
        if not (axis.shape == (3,) and np.isfinite(length) and length > 0.0):
            raise ValueError(f"Motion: axis {self.axis} is no direction; give three numbers, not all zero")
        object.__setattr__(self, "_unit", axis / length)

    @property
    def turns(self) -> bool:
        """Whether it was given an angle."""
        return self.angle is not _unturned

    @property
    def planar(self) -> bool:
        """Whether what lies in the plane of x and z turns within it."""
        return not self.turns or (self.axis[0] == 0.0 and self.axis[2] == 0.0)

    def pose(self, t0: float, t1: float) -> np.ndarray:
        """What the device needs of a step from t0 to t1: turn (3), rotation at t0 (9), pivot (3), translations (3, 3)."""
        a0, a1 = float(self.angle(t0)), float(self.angle(t1))
        return np.concatenate(
            [
                self._unit * (a1 - a0),
                self.rotation(a0).ravel(),
                self.pivot,
                np.asarray(self.translation(t0), float),
                np.asarray(self.translation(t1), float),
            ]
        )

    def rotation(self, angle: float) -> np.ndarray:
        """Rotation matrix about the axis (Rodrigues)."""
        k = self._unit
        cross = np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])
        return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)

    def place(self, t: float, points: np.ndarray) -> np.ndarray:
        """Where points of the rest state (n, 3) are at t [m]."""
        turned = (points - self.pivot) @ self.rotation(float(self.angle(t))).T
        return turned + self.pivot + np.asarray(self.translation(t), float)

    def turn(self, t: float, vectors: np.ndarray) -> np.ndarray:
        """Where vectors of the rest state (n, 3) point at t."""
        return vectors @ self.rotation(float(self.angle(t))).T

    def director_angle(self, t0: float, t1: float, rest: np.ndarray, frame: np.ndarray, edge: np.ndarray, angle: float):
        """Angle at t1 of the director `rest` (3,) of the rest state, from an edge's transported reference director [rad].

        Args:
            frame: lagged director and tangent of the edge (6,); edge: its present vector (3,) [m].
            angle: the angle at t0, whose branch is kept.
        """
        t = edge / np.linalg.norm(edge)
        u0, t_old = frame[:3], frame[3:]
        b = np.cross(t_old, t)
        c = t_old @ t
        u = u0 * c + np.cross(b, u0) + b * (b @ u0) / (1.0 + c)
        a0, a1 = float(self.angle(t0)), float(self.angle(t1))
        d = self.rotation(a1) @ rest
        new = np.arctan2(np.cross(u, d) @ t, u @ d)
        expected = angle + (self._unit @ t) * (a1 - a0)
        return new - 2.0 * np.pi * np.round((new - expected) / (2.0 * np.pi))

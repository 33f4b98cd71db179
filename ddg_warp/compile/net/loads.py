"""Loads of a net on the host: dead ones that change, and those that follow what they act on, with their derivatives."""

from dataclasses import dataclass

import numpy as np

from ddg_warp.compile.chains import TimedLoad
from ddg_warp.compile.couples import couple_derivatives, couple_forces


@dataclass
class NetLoad:
    """A load that changes: forces (B, 3) [N] (or a moment in component 0 of an angle's block) on blocks."""

    blocks: np.ndarray
    force: np.ndarray
    amplitude: object

    at = TimedLoad.at


@dataclass
class NetPressure:
    """Pressure [Pa] on triangles of nodes (T, 3) that follows them; amplitude or None."""

    places: np.ndarray
    pressure: np.ndarray
    amplitude: object

    at = TimedLoad.at

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Forces (T, 3, 3) [N] on the corners, at x (T, 3, 3)."""
        area = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        return np.repeat((self.pressure / 6.0)[:, None, None] * area[:, None], 3, axis=1)

    def derivative(self, x: np.ndarray) -> np.ndarray:
        """Derivative of the forces (T, 3, 3, 3, 3) [N/m]: d/dx_j of (x1 - x0) x (x2 - x0) is the edge opposite to j, crossed."""
        edges = np.stack([x[:, (j + 2) % 3] - x[:, (j + 1) % 3] for j in range(3)], 1)
        block = (self.pressure / 6.0)[:, None, None, None] * np.moveaxis(_cross(edges), 1, 2)
        return np.repeat(block[:, None], 3, axis=1)


@dataclass
class NetCouple:
    """A couple (3,) [N m] on rod edges: first node, second node and, with twist, angle of each (C, 3 or 2); amplitude or None.

    `length` is that of the rod [m], which makes the couple comparable with forces.
    """

    places: np.ndarray
    couple: np.ndarray
    amplitude: object
    length: float

    at = TimedLoad.at

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Forces (C, 3 or 2, 3) [N], with the moment in component 0 of the angle, at x (C, 3 or 2, 3)."""
        pair, about = couple_forces(x[:, 1] - x[:, 0], self.couple)
        moment = np.outer(about, [1.0, 0.0, 0.0])
        return np.stack([-pair, pair, moment], 1)[:, : self.places.shape[1]]

    def derivative(self, x: np.ndarray) -> np.ndarray:
        """Derivative of the forces (C, m, 3, m, 3), m = 3 or 2."""
        pair, about = couple_derivatives(x[:, 1] - x[:, 0], self.couple)
        result = np.zeros((len(x), 3, 3, 3, 3))
        for node, sign in ((0, -1.0), (1, 1.0)):
            result[:, 0, :, node] = -sign * pair
            result[:, 1, :, node] = sign * pair
            result[:, 2, 0, node] = sign * about
        m = self.places.shape[1]
        return result[:, :m, :, :m]


@dataclass
class NetEdgeCouple:
    """Couples about boundary edges of a shell: places (C, 4) of the edge as its triangle runs it, the corner opposite, the angle.

    `moment` (C,) [N m] by the right hand about the edge, `sign` (C,) that of the angle; amplitude or None. The normal at the edge spins
    with its triangle and by the angle, hence the forces M / h along the normal on the corner at the height h, in balance with those at
    the ends, and the moment M on the angle. `length` is the extent of the shell [m], which makes couples comparable with forces.
    """

    places: np.ndarray
    moment: np.ndarray
    sign: np.ndarray
    amplitude: object
    length: float

    at = TimedLoad.at

    @property
    def values(self) -> np.ndarray:
        """What the device needs (C, 3): moment, moment on the angle, nothing."""
        return np.column_stack([self.moment, self.sign * self.moment, 0.0 * self.moment])

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Forces (C, 4, 3) [N], the moment in component 0 of the angle, at x (C, 4, 3)."""
        e, a = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
        w = np.cross(e, a)
        lift = (self.moment * np.linalg.norm(e, axis=1) / _dot(w, w))[:, None] * w
        s = (_dot(a, e) / _dot(e, e))[:, None]
        about = np.outer(self.sign * self.moment, [1.0, 0.0, 0.0])
        return np.stack([(s - 1.0) * lift, -s * lift, lift, about], 1)

    def derivative(self, x: np.ndarray) -> np.ndarray:
        """Derivative of the forces (C, 4, 3, 4, 3)."""
        e, a = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
        w, length, one = np.cross(e, a), np.linalg.norm(e, axis=1), np.eye(3)
        square = _dot(w, w)
        lift = (self.moment * length / square)[:, None] * w
        s = _dot(a, e) / length**2
        along = (self.moment * length / square)[:, None, None] * (
            one - 2.0 * w[:, :, None] * w[:, None] / square[:, None, None]
        )
        lift_e = -along @ _cross(a) + lift[:, :, None] * (e / length[:, None] ** 2)[:, None]
        lift_a = along @ _cross(e)
        s_e, s_a = (a - 2.0 * s[:, None] * e) / length[:, None] ** 2, e / length[:, None] ** 2
        result = np.zeros((len(x), 4, 3, 4, 3))
        for node, weight, slope in ((0, s - 1.0, 1.0), (1, -s, -1.0), (2, 1.0 + 0.0 * s, 0.0)):
            by_e, by_a = (
                weight[:, None, None] * part + slope * lift[:, :, None] * ds[:, None]
                for part, ds in ((lift_e, s_e), (lift_a, s_a))
            )
            result[:, node, :, 1], result[:, node, :, 2] = by_e, by_a
            result[:, node, :, 0] = -by_e - by_a
        return result


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products along the last axis."""
    return np.sum(a * b, -1)


def _cross(e: np.ndarray) -> np.ndarray:
    """Matrices of e x (..., 3, 3)."""
    return np.swapaxes(np.cross(e[..., None, :], np.eye(3)), -1, -2)

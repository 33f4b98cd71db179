"""Dead and follower loads on the dof blocks of a storage, with load stiffness.

A follower load has the dof blocks `places` (E, m) of its elements. At their points x (E, m, 3) it returns `forces` (E, m, 3) [N], with
moments in component 0 of angles, and their `derivative` (E, m, 3, m, 3). Symmetry is a property of the sum: pressure is conservative
on a closed surface, not on each triangle. `kernel` names the device counterpart, which reads three `values` (E, 3) an element.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ddg_warp.scene.field import Field


class Load:
    """Load scaled by an `amplitude`, a function of time or None."""

    amplitude: Callable[[float], float] | None

    def sizes(self, x: np.ndarray) -> np.ndarray:
        """Return the contribution of forces at points x (E, m, 3) to the load scale (E, m) [N]."""
        return np.abs(self.forces(x)).sum(-1)

    def at(self, t: float, otherwise: float) -> float:
        """Return the amplitude at time t, or `otherwise` without one.

        Raises:
            SolverError: the amplitude is not finite; names the function and the time.
        """
        return float(Field("the amplitude", 1.0 if self.amplitude is None else self.amplitude).at(t, otherwise))


@dataclass
class DeadLoad(Load):
    """Dead forces (n, 3) [N] on nodes, moments [N m] in component 0 of angles, at dof blocks `places` (n,)."""

    places: np.ndarray
    force: np.ndarray
    amplitude: Callable[[float], float] | None = None


@dataclass
class Pressure(Load):
    """Follower pressure [Pa] on triangles of nodes (T, 3)."""

    places: np.ndarray
    pressure: np.ndarray
    amplitude: Callable[[float], float] | None = None

    kernel = "press"

    @property
    def values(self) -> np.ndarray:
        return np.outer(self.pressure, [1.0, 0.0, 0.0])

    def forces(self, x: np.ndarray) -> np.ndarray:
        area = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        return np.repeat((self.pressure / 6.0)[:, None, None] * area[:, None], 3, axis=1)

    def derivative(self, x: np.ndarray) -> np.ndarray:
        """Return the load stiffness: d/dx_j of (x1 - x0) x (x2 - x0) is the cross matrix of the edge opposite to j."""
        edges = np.stack([x[:, (j + 2) % 3] - x[:, (j + 1) % 3] for j in range(3)], 1)
        block = (self.pressure / 6.0)[:, None, None, None] * np.moveaxis(_cross(edges), 1, 2)
        return np.repeat(block[:, None], 3, axis=1)


@dataclass
class Couple(Load):
    """Couple M (3,) [N m] with an axis fixed in space on rod edges: both nodes and, with twist, the angle (C, 3 or 2).

    On an edge e it is the force M x e / |e|^2 on the second node, the opposite force on the first, and the moment M . t about the edge.
    Its load scale is a force at the end of the rod (`length` (C,) [m]), independent of the edge length.
    """

    places: np.ndarray
    length: np.ndarray
    couple: np.ndarray
    amplitude: Callable[[float], float] | None = None

    kernel = "twist"

    @property
    def values(self) -> np.ndarray:
        return np.tile(self.couple, (len(self.places), 1))

    def sizes(self, x: np.ndarray) -> np.ndarray:
        return _first(np.abs(self.couple).sum() / self.length, self.places)

    def forces(self, x: np.ndarray) -> np.ndarray:
        e = x[:, 1] - x[:, 0]
        square = _dot(e, e)[:, None]
        pair, about = np.cross(self.couple, e) / square, e @ self.couple / np.sqrt(square[:, 0])
        return np.stack([-pair, pair, np.outer(about, [1.0, 0.0, 0.0])], 1)[:, : self.places.shape[1]]

    def derivative(self, x: np.ndarray) -> np.ndarray:
        """Return the load stiffness, symmetric only in the plane."""
        e, cross = x[:, 1] - x[:, 0], _cross(self.couple)
        square = _dot(e, e)[:, None, None]
        pair = (cross - 2.0 * (e @ cross.T)[:, :, None] * e[:, None] / square) / square
        about = (self.couple - e * ((e @ self.couple)[:, None] / square[:, 0])) / np.sqrt(square[:, 0])
        result = np.zeros((len(x), 3, 3, 3, 3))
        for node, sign in ((0, -1.0), (1, 1.0)):
            result[:, 0, :, node] = -sign * pair
            result[:, 1, :, node] = sign * pair
            result[:, 2, 0, node] = sign * about
        m = self.places.shape[1]
        return result[:, :m, :, :m]


@dataclass
class EdgeCouple(Load):
    """Couples about boundary edges of a shell, on both edge nodes, the opposite corner and the angle (C, 4).

    Edges are oriented as in their triangle. `moment` (C,) [N m] is right-handed about the edge, `sign` (C,) is the sign of the angle.
    The normal at the edge rotates with the triangle and by the angle. Hence the moment M acts on the angle, and the force M / h along
    the normal on the corner at height h, balanced at the edge nodes. The load scale is the moment over the `length` of the shell [m].
    """

    places: np.ndarray
    moment: np.ndarray
    sign: np.ndarray
    length: float
    amplitude: Callable[[float], float] | None = None

    kernel = "bend"

    @property
    def values(self) -> np.ndarray:
        return np.column_stack([self.moment, self.sign * self.moment, 0.0 * self.moment])

    def sizes(self, x: np.ndarray) -> np.ndarray:
        return _first(np.abs(self.moment) / self.length, self.places)

    def forces(self, x: np.ndarray) -> np.ndarray:
        e, a = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
        w = np.cross(e, a)
        lift = (self.moment * np.linalg.norm(e, axis=1) / _dot(w, w))[:, None] * w
        s = (_dot(a, e) / _dot(e, e))[:, None]
        about = np.outer(self.sign * self.moment, [1.0, 0.0, 0.0])
        return np.stack([(s - 1.0) * lift, -s * lift, lift, about], 1)

    def derivative(self, x: np.ndarray) -> np.ndarray:
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


def accumulate(total: np.ndarray, places: np.ndarray, values: np.ndarray) -> None:
    """Add values (n, 3) to the rows `places` of a total (P, 3); rows may repeat. NumPy is fast at this in one dimension."""
    np.add.at(total.reshape(-1), (3 * places[..., None] + np.arange(3)).ravel(), values.ravel())


def _first(sizes: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return zeros (E, m) with the sizes (E,) of elements in column 0."""
    result = np.zeros(places.shape)
    result[:, 0] = sizes
    return result


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return scalar products along the last axis."""
    return np.sum(a * b, -1)


def _cross(e: np.ndarray) -> np.ndarray:
    """Return the cross-product matrices of e (..., 3, 3)."""
    return np.swapaxes(np.cross(e[..., None, :], np.eye(3)), -1, -2)

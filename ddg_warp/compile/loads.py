"""Loads on the places of a storage: dead ones, and those that follow what they act on, with their derivatives.

What follows has `places` (E, m) of its elements and gives, at their points x (E, m, 3), `forces` (E, m, 3) [N], moments in component 0
of angles, and their `derivative` (E, m, 3, m, 3). Whether that is symmetric is seen of all together: pressure is conservative on a
closed surface, not on each of its triangles. `kernel` names what does the same on a device, from three `values` (E, 3) an element.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ddg_warp import arguments


class Load:
    """A load that an `amplitude`, a function of the time or None, multiplies."""

    amplitude: Callable[[float], float] | None

    def sizes(self, x: np.ndarray) -> np.ndarray:
        """How much the forces at points x (E, m, 3) count among those that residuals are compared with (E, m) [N]."""
        return np.abs(self.forces(x)).sum(-1)

    def at(self, t: float, otherwise: float) -> float:
        """Its amplitude at t, or `otherwise` if it has none.

        Raises:
            SolverError: the amplitude is not finite; names the function and the time.
        """
        return otherwise if self.amplitude is None else float(arguments.value_at("the amplitude", self.amplitude, t))


@dataclass
class DeadLoad(Load):
    """Forces (n, 3) [N] on nodes, moments [N m] in component 0 of angles, at places (n,)."""

    places: np.ndarray
    force: np.ndarray
    amplitude: Callable[[float], float] | None = None


@dataclass
class Pressure(Load):
    """Pressure [Pa] on triangles of nodes (T, 3) that follows them."""

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
        """d/dx_j of (x1 - x0) x (x2 - x0) is the edge opposite to j, crossed."""
        edges = np.stack([x[:, (j + 2) % 3] - x[:, (j + 1) % 3] for j in range(3)], 1)
        block = (self.pressure / 6.0)[:, None, None, None] * np.moveaxis(_cross(edges), 1, 2)
        return np.repeat(block[:, None], 3, axis=1)


@dataclass
class Couple(Load):
    """A couple M (3,) [N m], its axis fixed in space, on rod edges: first node, second node and, with twist, angle (C, 3 or 2).

    On an edge e it is the force M x e / |e|^2 on the second node, the opposite one on the first, and the moment M . t about it. It
    counts as a force at the end of its rod (`length` (C,) [m]), however short its edge is.
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
        """Symmetric only in the plane."""
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
    """Couples about boundary edges of a shell: places (C, 4) of the edge as its triangle runs it, the corner opposite, the angle.

    `moment` (C,) [N m] by the right hand about the edge, `sign` (C,) that of the angle. The normal at the edge spins with its triangle
    and by the angle, hence the forces M / h along the normal on the corner at the height h, in balance with those at the ends, and the
    moment M on the angle. They count as forces over the `length` of the shell [m].
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
    """Add values (n, 3) to the rows `places` of a total (P, 3); a row may come twice. NumPy is fast at this in one dimension."""
    np.add.at(total.reshape(-1), (3 * places[..., None] + np.arange(3)).ravel(), values.ravel())


def _first(sizes: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Sizes (E,) of elements at the first of their places (E, m)."""
    result = np.zeros(places.shape)
    result[:, 0] = sizes
    return result


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products along the last axis."""
    return np.sum(a * b, -1)


def _cross(e: np.ndarray) -> np.ndarray:
    """Matrices of e x (..., 3, 3)."""
    return np.swapaxes(np.cross(e[..., None, :], np.eye(3)), -1, -2)

"""Loads of a net on the host: dead ones that change, and those that follow what they act on, with their derivatives."""

from dataclasses import dataclass

import numpy as np

from ddg_warp.chains import TimedLoad
from ddg_warp.couples import couple_derivatives, couple_forces


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


def _cross(e: np.ndarray) -> np.ndarray:
    """Matrices of e x (..., 3, 3)."""
    return np.swapaxes(np.cross(e[..., None, :], np.eye(3)), -1, -2)

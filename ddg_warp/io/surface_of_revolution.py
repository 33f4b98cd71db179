"""Surfaces of revolution about the z axis, from the meridians of axisymmetric shells."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.io.paths import CurveError
from ddg_warp.io.shapes import Curves, Shapes, Surfaces


class Revolution:
    """Surfaces swept by curves in the plane of x and z around the z axis.

    Args:
        curves: Open curves, such as a trajectory's.
        points: Points of the curves at some time [m], shape (P, 3); points on the axis are poles.
        sides: Corners of each ring, three at least.

    Attributes:
        shapes: The surfaces as `CollisionMesh`, for writers.
    """

    def __init__(self, curves: Curves, points: np.ndarray, sides: int):
        if not isinstance(points, np.ndarray) or points.shape != (len(curves.radius), 3):
            raise CurveError(
                f"revolution: points are no array ({len(curves.radius)}, 3) of the points of its curves; give those"
            )
        sides = argument_checks.count("revolution: sides", sides, 3)
        self._angle = 2.0 * np.pi * np.arange(sides) / sides
        starts = np.concatenate([[0], np.cumsum(curves.counts)])
        triangles = [self._strips(np.arange(a, b), points) for a, b in pairwise(starts)]
        radius = np.repeat(curves.radius, sides)
        every = np.concatenate(triangles)
        first = np.cumsum([0] + [len(part) for part in triangles[:-1]])
        surfaces = Surfaces(every, first, np.asarray(curves.names), 2.0 * radius[every].mean(1))
        none = np.zeros(0, int)
        no_curves = Curves(none, none.astype(bool), np.zeros(0), np.zeros(0, object), none)
        self.shapes = Shapes(no_curves, none, surfaces, sides * starts[-1], 1)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return points of the surfaces (P sides, 3), ring after ring, from points of the curves (P, 3)."""
        x, _, z = points[:, :, None].transpose(1, 0, 2)
        cos, sin = np.cos(self._angle), np.sin(self._angle)
        return np.stack([x * cos, x * sin, z + 0.0 * cos], axis=-1).reshape(-1, 3)

    def _strips(self, rows: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return two triangles for each side of each edge, one at poles; normals to the left of the curve."""
        sides = len(self._angle)
        corner = rows[:-1, None] * sides + np.arange(sides)
        next_corner = rows[:-1, None] * sides + (np.arange(sides) + 1) % sides
        lower = np.stack([corner, corner + sides, next_corner + sides], -1)
        upper = np.stack([corner, next_corner + sides, next_corner], -1)
        off = points[rows, 0] != 0.0
        return np.concatenate([lower[off[1:]].reshape(-1, 3), upper[off[:-1]].reshape(-1, 3)])

"""Obstacles as surfaces, for writers and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from types import SimpleNamespace

import numpy as np

from ddg_warp.geometry import meshes, polyline
from ddg_warp.geometry.operators import face_normals, vertex_normals
from ddg_warp.io.shapes import Curves
from ddg_warp.io.surface_of_revolution import Revolution
from ddg_warp.scene.obstacles import BALL, CAPSULE, MESH, PLANE
from ddg_warp.typing import Bools, Floats, Integers, Names

BEYOND = 0.25  # margin of displayed planes around all other objects, over their size
CELLS = 12  # along each side of a plane
DIVISIONS = 3  # subdivisions of an icosahedron for a ball
AROUND, ALONG = 32, 8  # corners around a capsule, and edges from the pole of an end to the side
SHARP = np.cos(np.radians(35.0))  # cosine between a triangle and the vertex normal above which shading is smooth


@dataclass(frozen=True)
class Obstacles:
    """Obstacles and rigid bodies of a model as surfaces that follow nodes; see `model.obstacles`.

    A plane has three nodes, its point and two more 1 m away along in-plane directions, and is shown as a rectangle. A ball has its
    center, a capsule both ends of its axis, a mesh its vertices, shown without thickness.

    Attributes:
        names, kinds: Name and kind of each obstacle, shape (K,), str; kinds as in `scene.obstacles`.
        radius: Radius of each [m], shape (K,).
        counts: Number of nodes of each, shape (K,), int.
        moved: Whether an obstacle moves, shape (K,), bool.
        rest: Nodes of all obstacles at rest [m], shape (N, 3).
        spans: Displayed range of planes along both directions [m], shape (K, 4); 0 for other kinds.
        sizes: Number of triangles of each mesh, shape (K,), int; 0 for other kinds.
        triangles: Triangles of all meshes, nodes counted from the first of each mesh, shape (T, 3), int.
    """

    names: Names
    kinds: Names
    radius: Floats
    counts: Integers
    moved: Bools
    rest: Floats
    spans: Floats
    sizes: Integers
    triangles: Integers

    @classmethod
    def of(cls, obstacles: list[tuple], points: np.ndarray) -> Obstacles:
        """Return obstacles as surfaces, with planes displayed around all other objects.

        Args:
            obstacles: (shape, name, whether it moves) each.
            points: Positions of rods and shells [m], shape (P, 3).
        """
        shapes, names, moved = zip(*obstacles, strict=True)
        surroundings = np.concatenate([points, *(_box(shape) for shape in shapes if shape.kind != PLANE)])
        solid = [shape.cells if shape.kind == MESH else np.zeros((0, 3), int) for shape in shapes]
        return cls(
            names=np.array(names, object),
            kinds=np.array([shape.kind for shape in shapes], object),
            radius=np.array([shape.radius for shape in shapes], float),
            counts=np.array([len(shape.points) for shape in shapes]),
            moved=np.array(moved),
            rest=np.concatenate([shape.points for shape in shapes]),
            spans=np.array(
                [_span(shape.points, surroundings) if shape.kind == PLANE else np.zeros(4) for shape in shapes]
            ),
            sizes=np.array([len(cells) for cells in solid]),
            triangles=np.concatenate(solid),
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def moving(self) -> np.ndarray:
        """Mask of nodes of moving obstacles, shape (N,), bool."""
        return np.repeat(self.moved, self.counts)

    def rows(self, k: int) -> slice:
        """Return the nodes of an obstacle among all moving nodes."""
        first = int(self.counts[:k][self.moved[:k]].sum())
        return slice(first, first + int(self.counts[k]))

    def cells(self, k: int) -> np.ndarray:
        """Return triangles of an obstacle among its `points`, shape (t, 3), counter-clockwise seen from outside."""
        kind = self.kinds[k]
        if kind == PLANE:
            return _square()[1]
        if kind == BALL:
            return _ball()[1]
        if kind == CAPSULE:
            return _capsule()[2]
        return self._meshes[k][1]

    def points(self, k: int, nodes: np.ndarray | None = None) -> np.ndarray:
        """Return points of an obstacle's surface [m], shape (p, 3), for its nodes (n, 3) [m]; by default at rest."""
        kind = self.kinds[k]
        nodes = self.nodes(k) if nodes is None else np.asarray(nodes, float)
        if kind == PLANE:
            (low, high, left, right), unit_square = self.spans[k], _square()[0][:, :2]
            return nodes[0] + ([low, left] + unit_square * [high - low, right - left]) @ (nodes[1:] - nodes[0])
        if kind == BALL:
            return nodes[0] + self.radius[k] * _ball()[0]
        if kind == CAPSULE:
            return self._around(k, nodes)
        return nodes[self._meshes[k][0]]

    def surface(self, moved: np.ndarray | None = None, chosen=None) -> tuple[np.ndarray, np.ndarray]:
        """Return points [m], (p, 3), and triangles, (t, 3), of the chosen obstacles (K,) bool, by default of all.

        Args:
            moved: Nodes of all moving obstacles [m], shape (M, 3), in one world; by default at rest.
        """
        points, cells, count = [np.zeros((0, 3))], [np.zeros((0, 3), int)], 0
        for k in np.flatnonzero(np.ones(len(self), bool) if chosen is None else chosen):
            nodes = moved[self.rows(k)] if moved is not None and self.moved[k] else None
            points.append(self.points(k, nodes))
            cells.append(self.cells(k) + count)
            count += len(points[-1])
        return np.concatenate(points), np.concatenate(cells)

    def nodes(self, k: int) -> np.ndarray:
        """Return the nodes of an obstacle at rest [m], shape (n, 3)."""
        first = int(self.counts[:k].sum())
        return self.rest[first : first + int(self.counts[k])]

    @cached_property
    def _meshes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Displayed nodes and triangles of each mesh; with sharp edges every triangle has its own corners."""
        parts = []
        for k, triangles in enumerate(np.split(self.triangles, np.cumsum(self.sizes)[:-1])):
            if not len(triangles):
                parts.append((triangles.ravel(), triangles))
                continue
            surface, rest = SimpleNamespace(triangles=triangles), self.nodes(k)
            cosine = np.einsum("tci,ti->tc", vertex_normals(surface, rest)[triangles], face_normals(surface, rest))
            sharp = (cosine < SHARP).any()
            each = np.arange(triangles.size).reshape(-1, 3)
            parts.append((triangles.ravel(), each) if sharp else (np.arange(len(rest)), triangles))
        return parts

    def _around(self, k: int, ends: np.ndarray) -> np.ndarray:
        """Return points of a capsule, rotated by parallel transport of its axis from rest."""
        rest_axis, axis = (polyline.unit((line[1] - line[0])[None]) for line in (self.nodes(k), ends))
        first = polyline.unit(np.cross(rest_axis, np.eye(3)[np.argmin(np.abs(rest_axis))]))
        first = polyline.transport(first, rest_axis, axis) if polyline.dot(rest_axis, axis)[0] > -1.0 + 1e-9 else first
        frame = np.concatenate([first, np.cross(axis, first), axis])
        directions, second, _ = _capsule()
        return ends[second.astype(int)] + self.radius[k] * directions @ frame


@cache
def _square() -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles of a square of side 1, small enough for depth sorting in pictures."""
    return meshes.rectangle(CELLS, CELLS)


@cache
def _ball() -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles of a ball of radius 1."""
    return meshes.sphere(DIVISIONS)


@cache
def _capsule() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return directions from the ends of a capsule along z (p, 3), mask of the second end (p,), and triangles."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 2 * ALONG + 1)
    angle = np.concatenate([angle[: ALONG + 1], angle[ALONG:]])
    meridian = np.column_stack([np.cos(angle), 0.0 * angle, np.sin(angle)])
    meridian[[0, -1], 0] = 0.0  # poles
    second = np.arange(len(angle)) > ALONG
    one = np.array([len(angle)])
    curves = Curves(one, one < 0, np.zeros(len(angle)), np.array(["capsule"]), 0 * one)
    body = Revolution(curves, meridian, AROUND)
    return body.points(meridian), np.repeat(second, AROUND), body.shapes.surfaces.triangles[:, ::-1]


def _box(shape) -> np.ndarray:
    """Return both corners of the bounding box of a shape [m]."""
    return np.array([shape.points.min(0) - shape.radius, shape.points.max(0) + shape.radius])


def _span(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the displayed range of a plane along both directions [m]: the range of the points plus a margin."""
    along = (points - nodes[0]) @ (nodes[1:] - nodes[0]).T
    low, high = along.min(0), along.max(0)
    beyond = BEYOND * np.ptp(points, axis=0).max()
    return np.array([low[0] - beyond, high[0] + beyond, low[1] - beyond, high[1] + beyond])

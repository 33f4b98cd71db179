"""Animated meshes: triangles with vertices sampled over time, as moving obstacles and as surfaces that rods grow from."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.scene.frame_motion import FrameMotion, nearest_rotations
from ddg_warp.scene.obstacles import Mesh
from ddg_warp.scene.prescribed_motion import Motion
from ddg_warp.typing import Floats, Integers, Numbers

NEAREST = 16  # triangles by centroid among which the nearest one is sought first
CHUNK = 2**14  # queries at a time


@dataclass(frozen=True, eq=False)
class AnimatedMesh:
    """Triangle mesh with vertices at several times, linear in between and constant before and after.

        skin = ddg.usd.read_animated_mesh("shot.usda", "/head/mesh")
        scene.clamp(rods, motion=skin.bind(roots))
        scene.add_obstacle(skin.obstacle(), motion=skin.motion(), name="skin")

    Attributes:
        times: of the samples (F,) [s], increasing; positions at t = 0 are the rest state.
        points: vertices (F, P, 3) [m].
        triangles: corners (T, 3).
        name: of the mesh.
        unread: content of the file that is not read, with reasons.
    """

    times: Numbers
    points: Numbers
    triangles: Numbers
    name: str = "mesh"
    unread: list[str] = field(default_factory=list)

    def __post_init__(self):
        times = argument_checks.array("AnimatedMesh: times", self.times, "give (frames,) [s]")
        points = argument_checks.array("AnimatedMesh: points", self.points, "give (frames, points, 3) [m]")
        if times.ndim != 1 or points.ndim != 3 or points.shape[::2] != (len(times), 3) or not len(times):
            raise SceneError(
                f"AnimatedMesh: times have shape {times.shape} and points {points.shape}; give (frames,) and (frames, points, 3)"
            )
        for frame in np.flatnonzero(~np.isfinite(points).all((1, 2)))[:1]:
            raise SceneError(
                f"AnimatedMesh: points of frame {frame} are not finite; correct the frame, or leave it out"
            )
        if not (np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
            raise SceneError("AnimatedMesh: times do not increase; give each frame a later time than the one before")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "triangles", argument_checks.triangles("AnimatedMesh: triangles", self.triangles))

    def at(self, t: float) -> Floats:
        """Return the vertices at t (P, 3) [m]."""
        after = int(np.clip(np.searchsorted(self.times, t, side="right"), 1, max(len(self.times) - 1, 1)))
        if len(self.times) == 1:
            return self.points[0]
        start, end = self.times[after - 1 : after + 1]
        weight = np.clip((t - start) / (end - start), 0.0, 1.0)
        return (1.0 - weight) * self.points[after - 1] + weight * self.points[after]

    @cached_property
    def rest(self) -> Floats:
        """Vertices at t = 0 (P, 3) [m]."""
        return self.at(0.0)

    def obstacle(self, radius: float = 0.0) -> Mesh:
        """Return the mesh at t = 0 with half a thickness [m], for `Scene.add_obstacle`."""
        return Mesh(self.rest, self.triangles, radius)

    def motion(self) -> Motion | None:
        """Return the motion of the vertices, for `Scene.add_obstacle`; None for a mesh that stays."""
        if (self.points == self.rest).all():
            return None
        return Motion(translation=lambda t: self.at(t) - self.rest)

    def bind(self, roots: Numbers) -> FrameMotion:
        """Return the motion of roots (n, 3) [m] with the surface, for `Scene.clamp` of the rods that grow from it.

        A root is bound to the nearest triangle at t = 0. It moves with the nearest point of the triangle, by barycentric weights, and
        keeps its distance from this point, which may lie on either side. It rotates with the triangle: by the polar factor of the map
        of sides and normal.
        """
        roots = argument_checks.array("AnimatedMesh.bind: roots", roots, "give (rods, 3) [m]")
        if roots.ndim != 2 or roots.shape[1] != 3 or not np.isfinite(roots).all():
            raise SceneError(f"AnimatedMesh.bind: roots have shape {roots.shape}; give finite ones (rods, 3) [m]")
        return FrameMotion(roots, SurfaceFrames(self, roots))


class SurfaceFrames:
    """Frames of roots on an animated mesh as a function of time, for `FrameMotion`.

    Attributes:
        triangle: nearest triangle of each root (n,).
        weights: barycentric weights of its nearest point (n, 3).
        distance: of the root from this point [m] (n,).
    """

    def __init__(self, mesh: AnimatedMesh, roots: Floats):
        self._mesh, self._roots = mesh, roots
        self.triangle, self.weights = nearest_on_triangles(mesh.rest, mesh.triangles, roots)
        self._corners = mesh.triangles[self.triangle]
        self._offset = roots - np.einsum("nc,ncd->nd", self.weights, mesh.rest[self._corners])
        self._inverse = np.linalg.inv(_frames(mesh.rest[self._corners]))
        self.distance = np.linalg.norm(self._offset, axis=1)

    def __call__(self, t: float) -> tuple[Floats, Floats]:
        """Return translations (n, 3) [m] and rotations (n, 3, 3) from rest."""
        corners = self._mesh.at(t)[self._corners]
        rotation = nearest_rotations(_frames(corners) @ self._inverse)
        base = np.einsum("nc,ncd->nd", self.weights, corners)
        return base + np.einsum("nij,nj->ni", rotation, self._offset) - self._roots, rotation


def nearest_on_triangles(
    points: Floats, triangles: Integers, queries: Floats, within: float = np.inf
) -> tuple[Integers, Floats]:
    """Return the triangle nearest to each query (n, 3), (n,), and barycentric weights of the nearest point (n, 3).

    Farther than `within` [m] it is the nearest of a few triangles by centroid.

    Source: C. Ericson, Real-Time Collision Detection, 2005, section 5.1.5.
    """
    from scipy.spatial import cKDTree

    corners = points[triangles]
    centroids = corners.mean(1)
    reach = np.linalg.norm(corners - centroids[:, None], axis=2).max()
    tree, count = cKDTree(centroids), min(NEAREST, len(triangles))
    index, weights = np.empty(len(queries), int), np.empty((len(queries), 3))
    for rows in np.array_split(np.arange(len(queries)), max(1, -(-len(queries) // CHUNK))):
        away, near = (each.reshape(len(rows), count) for each in tree.query(queries[rows], count))
        index[rows], weights[rows], distance = _nearest_of(corners, near, queries[rows])
        unsure = (away[:, -1] - reach < distance) & (distance < within) & (count < len(triangles))
        for k, least in zip(rows[unsure], distance[unsure], strict=True):
            candidates = np.array(tree.query_ball_point(queries[k], least + reach))
            index[k : k + 1], weights[k : k + 1], _ = _nearest_of(corners, candidates[None], queries[k : k + 1])
    return index, weights


def _nearest_of(corners: Floats, candidates: Integers, queries: Floats) -> tuple[Integers, Floats, Floats]:
    """Return the nearest triangle of candidates (n, m), weights of the nearest point (n, 3) and the distance (n,)."""
    a, b, c = np.moveaxis(corners[candidates], 2, 0)
    p = queries[:, None]
    best = np.full(candidates.shape, np.inf)
    weights = np.zeros((*candidates.shape, 3))

    def consider(w: Floats, valid: np.ndarray) -> None:
        point = w[..., :1] * a + w[..., 1:2] * b + w[..., 2:] * c
        distance = np.where(valid, np.linalg.norm(p - point, axis=-1), np.inf)
        better = distance < best
        best[better], weights[better] = distance[better], w[better]

    u, v, q = b - a, c - a, p - a
    uu, uv, vv, qu, qv = ((x * y).sum(-1) for x, y in ((u, u), (u, v), (v, v), (q, u), (q, v)))
    area = uu * vv - uv * uv
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (vv * qu - uv * qv) / area, (uu * qv - uv * qu) / area
    inside = np.nan_to_num(np.stack([1.0 - s - t, s, t], -1), nan=-1.0)
    consider(inside, (inside >= 0.0).all(-1))
    for i, (start, end) in enumerate(((a, b), (b, c), (c, a))):
        side = end - start
        length = np.maximum((side * side).sum(-1), np.finfo(float).tiny)
        along = np.clip(((p - start) * side).sum(-1) / length, 0.0, 1.0)
        w = np.zeros_like(weights)
        w[..., i], w[..., (i + 1) % 3] = 1.0 - along, along
        consider(w, np.ones(candidates.shape, bool))
    rows, nearest = np.arange(len(queries)), best.argmin(1)
    return candidates[rows, nearest], weights[rows, nearest], best[rows, nearest]


def _frames(corners: Floats) -> Floats:
    """Return matrices (n, 3, 3) with two sides and the unit normal of triangles (n, 3, 3) as columns."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([first, second, normal], 2)

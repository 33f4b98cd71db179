"""Obstacles: kinematic rigid colliders of a scene, fixed or moving."""

from dataclasses import dataclass, field

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.prescribed_motion import Motion
from ddg_warp.typing import Floats, Integers, Numbers, Vector

PLANE, BALL, CAPSULE, MESH = "plane", "ball", "capsule", "mesh"


@argument_checks.called
@dataclass(frozen=True)
class Plane:
    """Half-space behind the plane through `point` with outward `normal`."""

    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    points: Floats = field(init=False, repr=False, compare=False)

    kind, radius, cells = PLANE, 0.0, np.array([[0, 1, 2]])

    def __post_init__(self):
        point = np.array(argument_checks.vector("Plane: point", self.point))
        normal = argument_checks.direction("Plane: normal", self.normal)
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        # three points, for rigid motions
        object.__setattr__(self, "points", np.stack([point, point + first, point + np.cross(normal, first)]))


@argument_checks.called
@dataclass(frozen=True)
class Sphere:
    """Ball of a `radius` [m] about `center` [m]."""

    center: Vector
    radius: float

    kind, cells = BALL, np.array([[0]])

    def __post_init__(self):
        argument_checks.vector("Sphere: center", self.center)
        argument_checks.positive("Sphere: radius", self.radius, "m")

    @property
    def points(self) -> Floats:
        """Center as an array (1, 3)."""
        return np.array([self.center], float)


@argument_checks.called
@dataclass(frozen=True)
class Capsule:
    """Points within a `radius` [m] of the segment from `start` to `end` [m]."""

    start: Vector
    end: Vector
    radius: float

    kind, cells = CAPSULE, np.array([[0, 1]])

    def __post_init__(self):
        for name in ("start", "end"):
            argument_checks.vector(f"Capsule: {name}", getattr(self, name))
        argument_checks.positive("Capsule: radius", self.radius, "m")
        if np.array_equal(self.start, self.end):
            raise SceneError("Capsule: start and end are one point; use Sphere(center, radius)")

    @property
    def points(self) -> Floats:
        """End points of the axis (2, 3)."""
        return np.array([self.start, self.end], float)


@argument_checks.called
@dataclass(frozen=True)
class Mesh:
    """Triangle mesh with contact on both sides, open or closed.

    Attributes:
        points: vertices (P, 3) [m]; or the result of `read_mesh`, instead of points and cells.
        cells: corners of the triangles (T, 3).
        radius: half the thickness of the surface [m].
    """

    points: Numbers | tuple[Floats, Integers, str]
    cells: Numbers | None = None
    radius: float = 0.0

    kind = MESH

    def __post_init__(self):
        if isinstance(self.points, tuple) and len(self.points) == 3 and isinstance(self.points[2], str):
            for name, value in zip(("points", "cells"), self.points[:2], strict=True):
                object.__setattr__(self, name, value)
        if self.cells is None:
            raise SceneError(
                "Mesh: there are no triangles; give points (points, 3) and cells (T, 3), or what read_mesh returns"
            )
        points = argument_checks.array("Mesh: points", self.points, "give (points, 3) [m]").copy()
        cells = argument_checks.triangles("Mesh: triangles", self.cells)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise SceneError(f"Mesh: points have shape {points.shape}; they are finite, (points, 3) [m]")
        argument_checks.sized("Mesh: points", points, "vertex")
        for triangle in np.flatnonzero(((cells < 0) | (cells >= len(points))).any(1))[:1]:
            raise SceneError(
                f"Mesh: triangle {triangle} has corners {cells[triangle]}; vertices are 0 to {len(points) - 1}"
            )
        argument_checks.number("Mesh: radius", self.radius, "a length, zero or more [m]", lambda v: v >= 0.0)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "cells", cells)


CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def Box(center: Vector, half: Vector, rotation: Numbers | None = None, radius: float = 0.0) -> Mesh:
    """Return a box about `center` [m] with half lengths `half` (3,) [m], a `rotation` (3, 3), rounded by `radius` [m].

    The rounding is added outside. As a rigid body the box has mass and inertia of the sharp box.
    """
    center, half = (np.array(argument_checks.vector(f"Box: {n}", v)) for n, v in (("center", center), ("half", half)))
    if not (half > 0.0).all():
        raise SceneError(f"Box: half = {half}; half lengths are positive [m]")
    turn = np.eye(3) if rotation is None else argument_checks.broadcast("Box: rotation", rotation, (3, 3), own=2)
    if not (np.allclose(turn @ turn.T, np.eye(3), atol=1e-9) and np.linalg.det(turn) > 0.0):
        raise SceneError(f"Box: rotation = {argument_checks.shown(rotation)} is no rotation matrix (3, 3)")
    cells = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])
    return Mesh(center + (CORNERS * half) @ turn.T, cells, radius)


@dataclass(frozen=True)
class Obstacle:
    """Obstacle with shape and motion: see `Scene.add_obstacle`."""

    shape: Plane | Sphere | Capsule | Mesh
    motion: Motion | Grip | None
    name: str

    call, components = "add_obstacle", "xyz"  # interface of supports

    @property
    def spins(self) -> bool:
        """True for a rounded obstacle that rotates: its surface may move although its points are fixed."""
        return self.shape.radius > 0.0 and self.motion is not None and self.motion.turns

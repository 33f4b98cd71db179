"""USD prims of rigid bodies: an Xform with sampled poses, and constant shapes below."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdPhysics

from ddg_warp.geometry.operators import vertex_normals
from ddg_warp.io.bodies import Bodies
from ddg_warp.io.colors import OBSTACLE
from ddg_warp.io.obstacles import Obstacles
from ddg_warp.io.usd_materials import bind_preview_surface
from ddg_warp.io.usd_pose import DOUBLE, PoseOps, quaternion
from ddg_warp.io.usd_prims import HEADER, Frame, define_mesh, vectors
from ddg_warp.scene.obstacles import BALL, CAPSULE


class BodyPrim:
    """Rigid body, an Xform at its centre of mass with mass and inertia of UsdPhysics.

    A ball is a Sphere, a capsule a Capsule, and any other shape a Mesh, shown without thickness.

    Args:
        stage: Stage of the new prim.
        path: Path of the new prim.
        bodies: All rigid bodies.
        number: Index of this body.
        obstacles: Obstacles and shapes of rigid bodies.
        world: World of its poses.
    """

    def __init__(self, stage: Usd.Stage, path: str, bodies: Bodies, number: int, obstacles: Obstacles, world: int):
        self._row = world * len(bodies) + number
        self.unsaved = 0
        """Upper bound of the size of unsaved values [bytes]."""
        body = UsdGeom.Xform.Define(stage, path)
        self._pose = PoseOps(body)
        UsdPhysics.RigidBodyAPI.Apply(body.GetPrim()).CreateKinematicEnabledAttr(True)
        mass = UsdPhysics.MassAPI.Apply(body.GetPrim())
        mass.CreateMassAttr(float(bodies.mass[number]))
        mass.CreateCenterOfMassAttr(Gf.Vec3f(*map(float, bodies.center[number] - bodies.origin[number])))
        mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*map(float, bodies.moments[number])))
        mass.CreatePrincipalAxesAttr(Gf.Quatf(quaternion(bodies.axes[number])))
        bind_preview_surface(stage, body.GetPrim(), np.array(OBSTACLE))
        first = len(obstacles) - int(bodies.shapes[number:].sum()) if bodies.shapes[number] else 0
        for k in range(first, first + int(bodies.shapes[number])):
            shape = _define_shape(stage, f"{path}/shape_{k - first + 1}", obstacles, k, bodies.origin[number])
            shape.CreateDisplayColorAttr(vectors([OBSTACLE]))

    def write(self, code: Usd.TimeCode, frame: Frame) -> None:
        """Write the pose of one frame."""
        pose = np.asarray(frame.body_poses[self._row], float)
        self.unsaved += self._pose.write(code, pose[:, :3], pose[:, 3]) + 4 * HEADER


def _define_shape(stage: Usd.Stage, path: str, obstacles: Obstacles, k: int, origin: np.ndarray) -> UsdGeom.Gprim:
    """Define the prim of a shape at rest, relative to an origin (3,) [m]."""
    if obstacles.kinds[k] not in (BALL, CAPSULE):
        points, surface = obstacles.points(k) - origin, SimpleNamespace(triangles=obstacles.cells(k))
        shape = define_mesh(stage, path, np.full(len(surface.triangles), 3), surface.triangles.ravel(), True)
        shape.CreatePointsAttr(vectors(points))
        shape.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(vectors(points)))
        shape.CreateNormalsAttr(vectors(vertex_normals(surface, points)))
        shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        return shape
    nodes = obstacles.nodes(k) - origin
    kind = UsdGeom.Sphere if obstacles.kinds[k] == BALL else UsdGeom.Capsule
    shape = kind.Define(stage, path)
    shape.CreateRadiusAttr(float(obstacles.radius[k]))
    shape.AddTranslateOp().Set(Gf.Vec3d(*map(float, nodes.mean(0))))
    if kind is UsdGeom.Capsule:
        axis = (nodes[1] - nodes[0]) * (1.0 if nodes[1, 2] >= nodes[0, 2] else -1.0)  # upwards
        length = float(np.linalg.norm(axis))
        x, y, z = map(float, axis / length)
        shape.CreateAxisAttr(UsdGeom.Tokens.z)
        shape.CreateHeightAttr(length)
        shape.AddOrientOp(DOUBLE).Set(Gf.Quatd(1.0 + z, -y, x, 0.0).GetNormalized())  # from the z axis
    shape.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(shape, Usd.TimeCode.Default()))
    return shape

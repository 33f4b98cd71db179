"""USD prims of contact: obstacles as a Mesh of triangles, contacts as Points."""

from __future__ import annotations

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ddg_warp.geometry.operators import vertex_normals
from ddg_warp.io.colors import CONTACT, OBSTACLE
from ddg_warp.io.contact_records import ContactScales
from ddg_warp.io.obstacles import Obstacles
from ddg_warp.io.usd_pose import PoseOps, rigid_motion
from ddg_warp.io.usd_prims import HEADER, Frame, PointsPrim, define_mesh, floats, vectors

RIGID = 1e-6  # deviation from a rigid motion, over the size of an obstacle


class ObstaclePrim(PointsPrim):
    """Obstacle as a Mesh; a moving one has constant points about their mean, and a transform for each frame.

    The transform is the nearest rigid motion. An obstacle that deforms has samples of points in addition.

    Args:
        stage: Stage of the new prim.
        path: Path of the new prim.
        obstacles: All obstacles.
        number: Index of this obstacle.
        world: World of its nodes.
    """

    def __init__(self, stage: Usd.Stage, path: str, obstacles: Obstacles, number: int, world: int = 0):
        self._obstacles, self._number = obstacles, number
        self.triangles = obstacles.cells(number)  # read by `vertex_normals`
        mesh = define_mesh(stage, path, np.full(len(self.triangles), 3), self.triangles.ravel(), double_sided=True)
        nodes = obstacles.rows(number)
        rows = np.arange(nodes.start, nodes.stop) + world * np.count_nonzero(obstacles.moving)
        super().__init__(mesh, rows, np.array(OBSTACLE), None)
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        self._points, self._pose, self._rigid = obstacles.points(number), None, True
        self._last = Usd.TimeCode.Default()
        if obstacles.moved[number]:
            self._points, self._pose = self._points - self._points.mean(0), PoseOps(mesh)
        self._place(Usd.TimeCode.Default(), self._points)

    def write(self, code: Usd.TimeCode, frame: Frame) -> None:
        if self._pose is None:
            return
        points = self._obstacles.points(self._number, frame.obstacles[self._rows])
        rotation, centre, deviation = rigid_motion(self._points, points)
        self.unsaved += self._pose.write(code, rotation, centre) + 4 * HEADER
        if self._rigid and deviation > RIGID * np.ptp(self._points, axis=0).max():
            self._rigid = False
            if not self._last.IsDefault():
                self._place(self._last, self._points)  # the first sample holds for all times before
        if not self._rigid:
            self._place(code, (points - centre) @ rotation)
        self._last = code

    def _place(self, code: Usd.TimeCode, points: np.ndarray) -> None:
        shown = vectors(points)
        self._sample(self._prim.GetPointsAttr(), shown, code)
        self._sample(self._prim.GetExtentAttr(), self._extent(shown), code)
        self._sample(self._prim.GetNormalsAttr(), vectors(vertex_normals(self, points)), code)


class ContactsPrim(PointsPrim):
    """Contacts as Points of widths by force, with forces and gaps as primvars.

    Args:
        stage: Stage of the new prim.
        path: Path of the new prim.
        contact_scales: Names and typical scales of contact.
    """

    def __init__(self, stage: Usd.Stage, path: str, contact_scales: ContactScales):
        self._contact_scales = contact_scales
        prim = UsdGeom.Points.Define(stage, path)
        super().__init__(prim, np.zeros(0, int), np.array(CONTACT), None)
        prim.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
        kinds = {name: Sdf.ValueTypeNames.Vector3fArray for name in ("force", "friction")}
        kinds |= {"gap": Sdf.ValueTypeNames.FloatArray}
        vertex = UsdGeom.Tokens.vertex
        self._values = [self._primvars.CreatePrimvar(name, kind, vertex) for name, kind in kinds.items()]

    def write(self, code: Usd.TimeCode, frame: Frame) -> None:
        contacts = frame.contacts
        points, widths = vectors(contacts.point), floats(self._contact_scales.widths(contacts.force))
        prim = UsdGeom.Points(self._prim)
        extent = UsdGeom.Points.ComputeExtent(points, widths) if len(contacts) else vectors(np.zeros((2, 3)))
        force, friction, gap = self._values
        for attribute, value in (
            (prim.GetPointsAttr(), points),
            (prim.GetWidthsAttr(), widths),
            (prim.GetExtentAttr(), extent),
            (force.GetAttr(), vectors(contacts.force)),
            (friction.GetAttr(), vectors(contacts.friction)),
            (gap.GetAttr(), floats(contacts.gap)),
        ):
            self._sample(attribute, value, code)

"""USD prims of contact: obstacles as a Mesh of triangles, what touches as Points."""

from __future__ import annotations

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ddg_warp.geometry.operators import vertex_normals
from ddg_warp.io.colors import CONTACT, OBSTACLE
from ddg_warp.io.contacts import Touching
from ddg_warp.io.obstacles import Obstacles
from ddg_warp.io.usd_prims import Frame, PointsPrim, define_mesh, floats, vectors


class ObstaclePrim(PointsPrim):
    """An obstacle as a Mesh, of one sample where nothing moves it.

    Args:
        stage: Where to define it.
        path: Path of the new prim.
        obstacles: All obstacles.
        number: Of this one.
        world: Of which it follows the nodes.
    """

    def __init__(self, stage: Usd.Stage, path: str, obstacles: Obstacles, number: int, world: int = 0):
        self._obstacles, self._number = obstacles, number
        self.triangles = obstacles.cells(number)  # what `vertex_normals` asks of a surface
        mesh = define_mesh(stage, path, np.full(len(self.triangles), 3), self.triangles.ravel(), double_sided=True)
        own = obstacles.rows(number)
        rows = np.arange(own.start, own.stop) + world * np.count_nonzero(obstacles.moving)
        super().__init__(mesh, rows, np.array(OBSTACLE), None)
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if not obstacles.moved[number]:
            self._place(Usd.TimeCode.Default(), obstacles.points(number))

    def write(self, code: Usd.TimeCode, frame: Frame) -> None:
        if self._obstacles.moved[self._number]:
            self._place(code, self._obstacles.points(self._number, frame.obstacles[self._rows]))

    def _place(self, code: Usd.TimeCode, points: np.ndarray) -> None:
        shown = vectors(points)
        self._sample(self._prim.GetPointsAttr(), shown, code)
        self._sample(self._prim.GetExtentAttr(), self._extent(shown), code)
        self._sample(self._prim.GetNormalsAttr(), vectors(vertex_normals(self, points)), code)


class ContactsPrim(PointsPrim):
    """What touches, as Points as wide as the force says, with the forces and gaps themselves as primvars.

    Args:
        stage: Where to define it.
        path: Path of the new prim.
        touching: What recordings of contact need to know.
    """

    def __init__(self, stage: Usd.Stage, path: str, touching: Touching):
        self._touching = touching
        prim = UsdGeom.Points.Define(stage, path)
        super().__init__(prim, np.zeros(0, int), np.array(CONTACT), None)
        prim.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
        kinds = {name: Sdf.ValueTypeNames.Vector3fArray for name in ("force", "friction")}
        kinds |= {"gap": Sdf.ValueTypeNames.FloatArray}
        vertex = UsdGeom.Tokens.vertex
        self._values = [self._primvars.CreatePrimvar(name, kind, vertex) for name, kind in kinds.items()]

    def write(self, code: Usd.TimeCode, frame: Frame) -> None:
        found = frame.contacts
        points, widths = vectors(found.point), floats(self._touching.widths(found.force))
        prim = UsdGeom.Points(self._prim)
        extent = UsdGeom.Points.ComputeExtent(points, widths) if len(found) else vectors(np.zeros((2, 3)))
        force, friction, gap = self._values
        for attribute, value in (
            (prim.GetPointsAttr(), points),
            (prim.GetWidthsAttr(), widths),
            (prim.GetExtentAttr(), extent),
            (force.GetAttr(), vectors(found.force)),
            (friction.GetAttr(), vectors(found.friction)),
            (gap.GetAttr(), floats(found.gap)),
        ):
            self._sample(attribute, value, code)

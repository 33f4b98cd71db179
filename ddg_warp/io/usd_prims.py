"""USD prims with sampled points: rods as BasisCurves or as a Mesh of tubes, surfaces as a Mesh of triangles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, Vt

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.geometry.operators import vertex_normals
from ddg_warp.io.colors import on_scale
from ddg_warp.io.contact_records import Contacts
from ddg_warp.io.rod_tubes import SIDES, tube_faces, tube_points
from ddg_warp.io.shapes import Curves, Surfaces
from ddg_warp.io.usd_materials import bind_preview_surface
from ddg_warp.io.usd_texture import write_texture

HEADER = 64  # largest overhead of a value in a file [bytes]


@dataclass(frozen=True)
class ColorBy:
    """Scalar shown by color, with its values at both ends of the scale.

    Raises:
        SceneError: The ends are no finite numbers, or not in order.
    """

    name: str
    low: float
    high: float

    def __post_init__(self):
        low, high = (argument_checks.number(f"color_by: {end} end", getattr(self, end)) for end in ("low", "high"))
        if not isinstance(self.name, str) or low >= high:
            raise SceneError(f"color_by = {(self.name, low, high)}; give a name, and a low end below the high end")


@dataclass(frozen=True)
class Frame:
    """Data of one time sample: points (P, 3) [m], velocities (P, 3) [m/s] or None, scalars by name.

    Nodes of moving obstacles (worlds M, 3) [m], contacts, and poses of rigid bodies (worlds N, 3, 4) may be None.
    """

    points: np.ndarray
    velocities: np.ndarray | None
    at_points: Mapping[str, np.ndarray]
    at_triangles: Mapping[str, np.ndarray]
    obstacles: np.ndarray | None = None
    contacts: Contacts | None = None
    body_poses: np.ndarray | None = None


class PointsPrim:
    """Prim of some of the points of a frame.

    Args:
        prim: The prim, without samples.
        rows: Rows of its points in a frame, shape (p,).
        color: One RGB, or one for each point, shape (p, 3).
        color_by: Scalar that gives the color in frames that have it.
    """

    def __init__(self, prim: UsdGeom.PointBased, rows: np.ndarray, color: np.ndarray, color_by: ColorBy | None):
        self._prim, self._rows, self._color_by = prim, rows, color_by
        self.unsaved = 0
        """Upper bound of the size of unsaved values [bytes]."""
        self._begun: set[str] = set()
        self._primvars = UsdGeom.PrimvarsAPI(prim)
        uniform = color.ndim == 1
        kind = UsdGeom.Tokens.constant if uniform else UsdGeom.Tokens.vertex
        self._color = self._primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, kind)
        self._color.Set(vectors([color] if uniform else self._at_vertices(color)))
        bind_preview_surface(prim.GetPrim().GetStage(), prim.GetPrim(), color)

    def write(self, code: Usd.TimeCode, frame: Frame) -> None:
        """Write the samples of one frame."""
        shown = vectors(self._vertices(np.asarray(frame.points, dtype=np.float64)[self._rows]))
        self._sample(self._prim.GetPointsAttr(), shown, code)
        self._sample(self._prim.GetExtentAttr(), self._extent(shown), code)
        if frame.velocities is not None:
            velocities = self._at_vertices(np.asarray(frame.velocities)[self._rows])
            self._sample(self._prim.GetVelocitiesAttr(), vectors(velocities), code)
        for name, values in frame.at_points.items():
            mine = self._at_vertices(np.asarray(values)[self._rows])
            if mine.ndim == 1:
                self._write_scalar(code, name, mine, UsdGeom.Tokens.vertex)
            else:
                primvar = self._primvars.CreatePrimvar(name, Sdf.ValueTypeNames.Vector3fArray, UsdGeom.Tokens.vertex)
                self._sample(primvar.GetAttr(), vectors(mine), code)

    def _write_scalar(self, code: Usd.TimeCode, name: str, values: np.ndarray, kind: str) -> None:
        primvar = self._primvars.CreatePrimvar(name, Sdf.ValueTypeNames.FloatArray, kind)
        self._sample(primvar.GetAttr(), floats(values), code)
        if self._color_by is not None and name == self._color_by.name:
            self._color.SetInterpolation(kind)
            colors = on_scale(values, self._color_by.low, self._color_by.high)
            self._sample(self._color.GetAttr(), vectors(colors), code)

    def _sample(self, attribute: Usd.Attribute, value, code: Usd.TimeCode) -> None:
        """Set the value of an attribute at a time; the first is the default, too, for programs that read no samples."""
        for time in {code, Usd.TimeCode.Default()} if attribute.GetName() not in self._begun else (code,):
            attribute.Set(value, time)
            self.unsaved += memoryview(value).nbytes + HEADER
        self._begun.add(attribute.GetName())

    def _vertices(self, points: np.ndarray) -> np.ndarray:
        return points

    def _at_vertices(self, values: np.ndarray) -> np.ndarray:
        """Return values at the vertices from values at the points."""
        return values

    def _extent(self, vertices: Vt.Vec3fArray) -> Vt.Vec3fArray:
        return UsdGeom.PointBased.ComputeExtent(vertices)


class CurvesPrim(PointsPrim):
    """Rods as one BasisCurves prim.

    Args:
        stage: Stage of the new prim.
        path: Path of the new prim.
        curves: The rods, all closed or all open.
        rows, color, color_by: See `PointsPrim`.
    """

    def __init__(self, stage: Usd.Stage, path: str, curves: Curves, rows, color, color_by):
        self._curves = curves
        super().__init__(self._define(stage, path), rows, color, color_by)
        radius = floats(self._at_vertices(curves.radius))
        self._primvars.CreatePrimvar("radius", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex).Set(radius)

    def add_attributes(self, attributes: Mapping[str, np.ndarray]) -> None:
        """Store values of each rod, (R,), numbers or texts, as uniform primvars."""
        for name, values in attributes.items():
            kind, make = KINDS[values.dtype.kind if values.dtype.kind in KINDS else "U"]
            primvar = self._primvars.CreatePrimvar(Tf.MakeValidIdentifier(name), kind, UsdGeom.Tokens.uniform)
            primvar.Set(make(self._at_faces(values)))

    def _at_faces(self, values: np.ndarray) -> np.ndarray:
        """Return values of the uniform elements of the prim, here curves, from values of the rods."""
        return values

    def _define(self, stage: Usd.Stage, path: str) -> UsdGeom.PointBased:
        curves = UsdGeom.BasisCurves.Define(stage, path)
        curves.CreateTypeAttr(UsdGeom.Tokens.linear)
        curves.CreateWrapAttr(UsdGeom.Tokens.periodic if self._curves.closed[0] else UsdGeom.Tokens.nonperiodic)
        curves.CreateCurveVertexCountsAttr(_ints(self._curves.counts))
        widths = 2.0 * self._curves.radius
        uniform = np.ptp(widths) == 0.0
        self._widths = floats(widths[:1] if uniform else widths)
        curves.CreateWidthsAttr(self._widths)
        curves.SetWidthsInterpolation(UsdGeom.Tokens.constant if uniform else UsdGeom.Tokens.vertex)
        return curves

    def _extent(self, vertices: Vt.Vec3fArray) -> Vt.Vec3fArray:
        return UsdGeom.Curves.ComputeExtent(vertices, self._widths)


class TubesPrim(CurvesPrim):
    """Rods as one Mesh of tubes, with velocities of the centreline."""

    def _define(self, stage: Usd.Stage, path: str) -> UsdGeom.PointBased:
        sizes, indices = tube_faces(self._curves.counts, self._curves.closed)
        return define_mesh(stage, path, sizes, indices, double_sided=False)

    def _at_faces(self, values: np.ndarray) -> np.ndarray:
        sizes, indices = tube_faces(self._curves.counts, self._curves.closed)
        first = indices[np.cumsum(sizes) - sizes] // SIDES  # point of the first ring of the face
        return values[np.repeat(np.arange(len(values)), self._curves.counts)[first]]

    def _vertices(self, points: np.ndarray) -> np.ndarray:
        return tube_points(points, self._curves.counts, self._curves.closed, self._curves.radius)

    def _at_vertices(self, values: np.ndarray) -> np.ndarray:
        return np.repeat(values, SIDES, axis=0)

    def _extent(self, vertices: Vt.Vec3fArray) -> Vt.Vec3fArray:
        return UsdGeom.PointBased.ComputeExtent(vertices)


class SurfacePrim(PointsPrim):
    """Surface as a double-sided Mesh of triangles, with a normal at each vertex.

    Args:
        stage: Stage of the new prim.
        path: Path of the new prim.
        surfaces: All surfaces.
        part: Triangles of this surface.
        color, color_by: See `PointsPrim`.
    """

    def __init__(self, stage: Usd.Stage, path: str, surfaces: Surfaces, part: slice, color, color_by):
        rows, local = np.unique(surfaces.triangles[part], return_inverse=True)
        self.triangles = local.reshape(-1, 3)  # read by `vertex_normals`
        self._part = part
        mesh = define_mesh(stage, path, np.full(len(self.triangles), 3), self.triangles.ravel(), double_sided=True)
        super().__init__(mesh, rows, color, color_by)
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        thickness = surfaces.thickness[part]
        uniform = np.ptp(thickness) == 0.0
        kind = UsdGeom.Tokens.constant if uniform else UsdGeom.Tokens.uniform
        primvar = self._primvars.CreatePrimvar("thickness", Sdf.ValueTypeNames.FloatArray, kind)
        primvar.Set(floats(thickness[:1] if uniform else thickness))
        if surfaces.uv is not None and np.isfinite(surfaces.uv[part]).all():
            write_texture(mesh, surfaces.uv[part])

    def write(self, code: Usd.TimeCode, frame: Frame) -> None:
        super().write(code, frame)
        points = np.asarray(frame.points, dtype=np.float64)[self._rows]
        self._sample(self._prim.GetNormalsAttr(), vectors(vertex_normals(self, points)), code)
        for name, values in frame.at_triangles.items():
            self._write_scalar(code, name, np.asarray(values)[self._part], UsdGeom.Tokens.uniform)


def define_mesh(stage: Usd.Stage, path: str, sizes: np.ndarray, indices: np.ndarray, double_sided: bool):
    """Define a Mesh without points, with faces of `sizes` corners at `indices`, not subdivided."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateFaceVertexCountsAttr(_ints(sizes))
    mesh.CreateFaceVertexIndicesAttr(_ints(indices))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(double_sided)
    return mesh


def vectors(values) -> Vt.Vec3fArray:
    """Return vectors (n, 3) as a USD array."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32).reshape(-1, 3))


def floats(values) -> Vt.FloatArray:
    """Return numbers (n,) as a USD array."""
    return Vt.FloatArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def _ints(values) -> Vt.IntArray:
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, dtype=np.int32))


def _texts(values) -> Vt.StringArray:
    return Vt.StringArray([str(value) for value in values])


KINDS = {
    "i": (Sdf.ValueTypeNames.IntArray, _ints),
    "u": (Sdf.ValueTypeNames.IntArray, _ints),
    "f": (Sdf.ValueTypeNames.FloatArray, floats),
    "U": (Sdf.ValueTypeNames.StringArray, _texts),
}
"""Primvar type and conversion by kind of NumPy array; texts for all other kinds."""

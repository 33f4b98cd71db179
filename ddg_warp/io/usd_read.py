"""Curves and meshes from USD files, in metres with z up: transforms, metersPerUnit and upAxis are applied.

Every BasisCurves prim becomes a `CurveSet`; of a file with several meshes one is chosen by its path.
Attributes are taken at the default time, or at their first sample where they have no default. Widths are diameters;
under a transform that scales, they scale by the cube root of its volume change. A cubic curve is replaced by the
polyline through its knots: its vertices (Catmull-Rom), every third vertex (Bezier), or (p0 + 4 p1 + p2)/6 (B-spline);
resample it more finely before if that is too coarse.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Tf, Usd, UsdGeom

from ddg_warp.io import CurveError, CurveSet, MeshError, checked_curves, existing
from ddg_warp.io.mesh_read import triangulated

Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
BEZIER_STEP = 3
MESHES_LISTED = 5
DRAWN = ("displayColor", "displayOpacity", "widths", "normals", "radius")


def read_curves(path, prim: str | None = None) -> list[CurveSet]:
    """The curves of a USD file, one set for each BasisCurves prim, in metres with z up.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        prim: Path of the prim to read, with all below it; by default the whole file.
    """
    path = existing(path)
    with _opened(path, CurveError) as stage:
        curves = _shapes(stage, path, prim, UsdGeom.BasisCurves, CurveError)
        if not curves:
            raise CurveError(
                f"{path}: there are no BasisCurves{f' below {prim}' if prim else ''}; export curves, not meshes"
            )
        return [_read_prim(each, path) for each in curves]


def read_mesh_prim(path, prim: str | None = None) -> tuple[np.ndarray, np.ndarray, str]:
    """The mesh of a USD file, in metres with z up: (points (P, 3), triangles (T, 3), name of the prim).

    Polygons are cut as `triangulated` does; holes are left out. A subdivision surface is taken as its control mesh. Triangles run
    counter-clockwise as seen from outside, also where the file says leftHanded or a transform mirrors.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        prim: Path of the Mesh prim, or of one above it; needed where the file has several meshes.
    """
    path = existing(path)
    with _opened(path, MeshError) as stage:
        meshes = _shapes(stage, path, prim, UsdGeom.Mesh, MeshError)
        if len(meshes) != 1:
            listed = ", ".join(str(mesh.GetPath()) for mesh in meshes[:MESHES_LISTED]) or "none"
            raise MeshError(f"{path}: there are {len(meshes)} meshes to read ({listed}); give prim= the path of one")
        (mesh,) = meshes
        where = f"{path}, {mesh.GetPath()}"
        points, time = _points(mesh, where, MeshError)
        counts = np.array(_value(mesh.GetFaceVertexCountsAttr(), time) or [], dtype=int)
        indices = np.array(_value(mesh.GetFaceVertexIndicesAttr(), time) or [], dtype=int)
        holes = np.array(_value(mesh.GetHoleIndicesAttr(), time) or [], dtype=int)
        triangles, face = triangulated(points, counts, indices, where)
        triangles = triangles[~np.isin(face, holes)]
        to_world, _ = _placement(mesh, time)
        left_handed = mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        if left_handed != (np.linalg.det(to_world[:3, :3]) < 0.0):
            triangles = triangles[:, [0, 2, 1]]
        return points @ to_world[:3, :3] + to_world[3, :3], triangles, mesh.GetPrim().GetName()


@contextmanager
def _opened(path: Path, error: type[ValueError]) -> Iterator[Usd.Stage]:
    """The stage of a file, whose prims live no longer than it; what USD says of a damaged one becomes an `error`."""
    try:
        yield Usd.Stage.Open(str(path))
    except Tf.ErrorException as reason:
        said = " ".join(str(reason).split()).rpartition(" : ")[2].strip("'")
        raise error(f"{path}: this is no USD file, or it is cut short or damaged ({said}); export it again") from reason


def _shapes(stage: Usd.Stage, path: Path, prim: str | None, kind: type, error: type[ValueError]) -> list:
    """All prims of a kind in a file, or below the prim at a path."""
    root = stage.GetPrimAtPath(prim) if prim else stage.GetPseudoRoot()
    if not root:
        raise error(f"{path}: there is no prim {prim}; `usdtree {path}` lists them")
    within = Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
    return [kind(each) for each in within if each.IsA(kind)]


def _points(shape: UsdGeom.PointBased, where: str, error: type[ValueError]) -> tuple[np.ndarray, Usd.TimeCode]:
    """(points in the prim's units, shape (P, 3); the time at which other attributes are taken)."""
    attribute = shape.GetPointsAttr()
    if not attribute.HasValue():
        raise error(f"{where}: there are no points; export the prim with its points")
    # EarliestTime means the first sample of an attribute, and its default where it has no samples.
    time = Usd.TimeCode.EarliestTime() if attribute.Get() is not None else Usd.TimeCode(attribute.GetTimeSamples()[0])
    return np.array(_value(attribute, time), dtype=np.float64).reshape(-1, 3), time


def _read_prim(curves: UsdGeom.BasisCurves, path: Path) -> CurveSet:
    name = str(curves.GetPath())
    points, time = _points(curves, f"{path}, {name}", CurveError)
    counts = np.array(_value(curves.GetCurveVertexCountsAttr(), time) or [], dtype=int)
    closed = curves.GetWrapAttr().Get() == UsdGeom.Tokens.periodic
    checked_curves(points, counts, closed, None, name, str(path))
    knots = _knots(curves, counts, closed, f"{path}, {name}")
    knot_counts = np.array([len(each) for each in knots])
    widths = _widths(curves, time, knots, knot_counts, f"{path}, {name}")
    to_world, scale = _placement(curves, time)
    points = np.concatenate([_blend(each, points) for each in knots]) @ to_world[:3, :3] + to_world[3, :3]
    radius = None if widths is None else 0.5 * scale * widths
    return replace(
        checked_curves(points, knot_counts, closed, radius, name, str(path)),
        attributes=_attributes(curves, time, len(counts)),
    )


def _attributes(curves: UsdGeom.BasisCurves, time: Usd.TimeCode, count: int) -> dict[str, np.ndarray]:
    """Primvars with one value a curve, or one for all, by name: numbers and texts; what is drawn is left out."""
    found = {}
    for primvar in UsdGeom.PrimvarsAPI(curves).GetPrimvarsWithValues():
        name, value = primvar.GetPrimvarName(), primvar.ComputeFlattened(time)
        if name in DRAWN or value is None:
            continue
        values = np.array(value).reshape(-1) if np.ndim(value) < 2 else np.zeros(0)
        if primvar.GetInterpolation() == UsdGeom.Tokens.constant and len(values) == 1:
            values = np.repeat(values, count)
        if primvar.GetInterpolation() in (UsdGeom.Tokens.uniform, UsdGeom.Tokens.constant) and len(values) == count:
            found[name] = values
    return found


def _value(attribute: Usd.Attribute, time: Usd.TimeCode):
    """The default value, or that at `time` where there is none."""
    default = attribute.Get()
    return attribute.Get(time) if default is None else default


def _placement(shape: UsdGeom.PointBased, time: Usd.TimeCode) -> tuple[np.ndarray, float]:
    """(matrix for row vectors to metres with z up, shape (4, 4); its mean scale)."""
    stage = shape.GetPrim().GetStage()
    matrix = np.array(shape.ComputeLocalToWorldTransform(time)) * UsdGeom.GetStageMetersPerUnit(stage)
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y:
        matrix[:, :3] = matrix[:, :3] @ Y_UP_TO_Z_UP.T
    return matrix, abs(np.linalg.det(matrix[:3, :3])) ** (1.0 / 3.0)


def _knots(curves: UsdGeom.BasisCurves, counts: np.ndarray, closed: bool, where: str) -> list[np.ndarray]:
    """For each curve the vertices that its knots are blended from, shape (knots, 3), see `_blend`."""
    starts = np.cumsum(counts) - counts
    if curves.GetTypeAttr().Get() == UsdGeom.Tokens.linear:
        return [
            np.repeat(first + np.arange(count), 3).reshape(-1, 3) for first, count in zip(starts, counts, strict=True)
        ]
    basis, wrap = curves.GetBasisAttr().Get(), curves.GetWrapAttr().Get()
    local = [_cubic_knots(basis, wrap, count) for count in counts]
    for curve, knots in enumerate(local):
        if len(knots) < 2 + closed:
            raise CurveError(
                f"{where}: curve {curve} is a cubic {basis} of {counts[curve]} vertices, too few; resample it"
            )
    return [first + knots for first, knots in zip(starts, local, strict=True)]


def _cubic_knots(basis: str, wrap: str, count: int) -> np.ndarray:
    """Vertices before, at and after each knot of a cubic curve, shape (knots, 3); three times the same to keep it."""
    vertex = np.arange(count)
    if basis == UsdGeom.Tokens.bezier:
        return np.repeat(vertex[::BEZIER_STEP], 3).reshape(-1, 3)
    neighbours = np.stack([vertex - 1, vertex, vertex + 1], axis=1)
    if basis == UsdGeom.Tokens.catmullRom:
        neighbours = np.repeat(vertex, 3).reshape(-1, 3)
    if wrap == UsdGeom.Tokens.periodic:
        return neighbours % count
    if wrap == UsdGeom.Tokens.pinned:  # the curve begins and ends at its first and last vertex
        neighbours[[0, -1]] = [[0], [count - 1]]
        return neighbours
    return neighbours[1:-1]


def _blend(knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values at the knots of a curve; the weights of a B-spline leave three equal vertices as they are."""
    before, at, after = (values[knots[:, k]] for k in range(3))
    return (before + 4.0 * at + after) / 6.0


def _widths(curves, time, knots: list[np.ndarray], knot_counts: np.ndarray, where: str) -> np.ndarray | None:
    """Width at each knot, in the prim's units, shape (knots of all curves,); None where the prim has no widths."""
    primvar = UsdGeom.PrimvarsAPI(curves).GetPrimvar("widths")  # takes precedence over the attribute
    if primvar.HasValue():
        value, kind = primvar.ComputeFlattened(time), primvar.GetInterpolation()
    else:
        value, kind = _value(curves.GetWidthsAttr(), time), curves.GetWidthsInterpolation()
    if not value:
        return None
    widths = np.array(value, dtype=np.float64)
    if kind == UsdGeom.Tokens.constant or len(widths) == 1:
        return np.full(knot_counts.sum(), widths[0])
    vertex_count = sum(_value(curves.GetCurveVertexCountsAttr(), time))
    expected = {UsdGeom.Tokens.uniform: len(knots), UsdGeom.Tokens.varying: knot_counts.sum()}.get(kind, vertex_count)
    if len(widths) != expected:
        raise CurveError(
            f"{where}: there are {len(widths)} widths, but `{kind}` interpolation takes {expected}; fix either"
        )
    if kind == UsdGeom.Tokens.uniform:
        return np.repeat(widths, knot_counts)
    return widths if kind == UsdGeom.Tokens.varying else np.concatenate([_blend(each, widths) for each in knots])

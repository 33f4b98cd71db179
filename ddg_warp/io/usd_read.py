"""Reader of curves and meshes in USD files, in metres with z up, with transforms, metersPerUnit and upAxis applied.

Every BasisCurves prim becomes a `CurveSet`; in a file with several meshes one is selected by path. Other curves (NURBS) are
reported, and instances of a PointInstancer refused. Attributes are read at the default time, or at the first sample without a
default. Widths are diameters; a scaling transform multiplies them by the cube root of its determinant. A cubic curve becomes a
polyline through points on the curve, see `read_curves`.
Layers, references and payloads are followed within the folder of a file, and outside it only with permission.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Ar, Sdf, Tf, Usd, UsdGeom

from ddg_warp import argument_checks
from ddg_warp.errors import SceneWarning
from ddg_warp.io import cubic
from ddg_warp.io.axes import Y_UP_TO_Z_UP
from ddg_warp.io.curves import CurveSet, checked_curves
from ddg_warp.io.faces import corners_of, triangulated
from ddg_warp.io.file_mesh import FileMesh
from ddg_warp.io.paths import CurveError, MeshError, existing
from ddg_warp.io.usd_texture import corner_texture, unread_of_mesh
from ddg_warp.typing import FilePath

LISTED = 5  # prims in a message
SHORT = 0.01  # largest relative length error of a polyline without a warning
FINER = 4  # points of the reference polyline for lengths, over points of the polyline
INSTANCES = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
DRAWN = ("displayColor", "displayOpacity", "widths", "normals", "radius")


def read_curves(path: FilePath, prim: str | None = None, samples: int = 1, outside: bool = False) -> list[CurveSet]:
    """Return the curves of a USD file, one set for each BasisCurves prim, in metres with z up.

    Warns (`SceneWarning`) of curves other than BasisCurves, of missing referenced files, and of cubic curves with polylines more than
    1 % too short.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        prim: Path of the prim to read, with all below it; by default the whole file.
        samples: Points of each segment of a cubic curve. 1 gives its knots: vertices (Catmull-Rom), every third vertex (Bezier), or
            (p0 + 4 p1 + p2) / 6 (B-spline). Lengths converge with the square of `samples`.
        outside: Whether layers, references and payloads outside the folder of the file may be opened.

    Raises:
        CurveError: The file has no curves to read, or a curve that no rod can be built from; names prim and curve.
    """
    path, samples = existing(path), argument_checks.count("read_curves: samples", samples)
    with opened(path, CurveError, outside) as stage:
        curves, unread = shapes_below(stage, path, prim, UsdGeom.BasisCurves, CurveError)
        unread = [each for each in unread if each.IsA(UsdGeom.Curves)]
        if not curves:
            contents = f"; it holds {_listed(unread)}" if unread else ""
            raise CurveError(
                f"{path}: there are no BasisCurves{f' below {prim}' if prim else ''}{contents}; export curves as BasisCurves, not "
                "meshes or NURBS"
            )
        if unread:
            _warn(f"{path}: {_listed(unread)} {'is' if len(unread) == 1 else 'are'} not read; export BasisCurves")
        return [_read_prim(each, path, samples) for each in curves]


def read_mesh_prim(path, prim: str | None = None, outside: bool = False) -> FileMesh:
    """Return the mesh of a USD file, in metres with z up, named as the prim, with texture coordinates (`primvars:st`).

    Polygons are cut by `triangulated`; holes are left out. A subdivision surface is read as its control mesh. Triangles run
    counter-clockwise seen from outside, also for leftHanded meshes and mirroring transforms.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        prim: Path of the Mesh prim, or of an ancestor; needed if the file has several meshes.
        outside: Whether layers, references and payloads outside the folder of the file may be opened.

    Raises:
        MeshError: The file has no mesh to read, or a bad one; names prim and face.
    """
    path = existing(path)
    with opened(path, MeshError, outside) as stage:
        mesh, unread = mesh_below(stage, path, prim)
        where = f"{path}, {mesh.GetPath()}"
        points, time = _points(mesh, where, MeshError)
        counts = whole_numbers(mesh.GetFaceVertexCountsAttr(), time)
        indices = whole_numbers(mesh.GetFaceVertexIndicesAttr(), time)
        holes = whole_numbers(mesh.GetHoleIndicesAttr(), time)
        triangles, face = triangulated(points, counts, indices, where)
        solid = ~np.isin(face, holes)
        triangles, corners = triangles[solid], corners_of(triangles, face, counts, indices)[solid]
        texture, unread = corner_texture(mesh, time, indices)
        to_world, _ = placement(mesh, time, where, MeshError)
        if is_reversed(mesh, to_world):
            triangles, corners = triangles[:, [0, 2, 1]], corners[:, [0, 2, 1]]
        points = points @ to_world[:3, :3] + to_world[3, :3]
        uv, name = None if texture is None else texture[corners], mesh.GetPrim().GetName()
        return FileMesh(points, triangles, name, uv=uv, unread=unread + unread_of_mesh(mesh, holes))


@contextmanager
def opened(path: Path, error: type[ValueError], outside: bool) -> Iterator[Usd.Stage]:
    """Open the stage of a file, and raise an `error` for USD errors of a damaged file.

    Prims are valid while the stage is open.

    Args:
        path: The file.
        error: Class of the error.
        outside: Whether layers outside the folder of the file may be opened.
    """
    argument_checks.flag("outside", outside)
    try:
        layers = _layers(path, error, outside)
        stage = Usd.Stage.Open(layers[0])
        for layer in stage.GetUsedLayers():  # variables in asset paths may select layers
            _refuse_outside(path, layer.realPath, error, outside)
        yield stage
    except Tf.ErrorException as reason:
        said = " ".join(str(reason).split()).rpartition(" : ")[2].strip("'")
        raise error(f"{path}: this is no USD file, or it is cut short or damaged ({said}); export it again") from reason
    except (CurveError, MeshError):
        raise
    except (TypeError, ValueError, OverflowError) as reason:
        raise error(f"{path}: values are of another kind than USD gives them ({reason}); export it again") from reason


def _layers(path: Path, error: type[ValueError], outside: bool) -> list[Sdf.Layer]:
    """Return all layers that compose a file, the root first; each path is checked before the layer is opened."""
    layers, visited = [Sdf.Layer.FindOrOpen(str(path))], set()
    for layer in layers:
        for asset in layer.GetCompositionAssetDependencies():
            name = layer.ComputeAbsolutePath(Sdf.Layer.SplitIdentifier(asset)[0])
            location = Ar.GetResolver().Resolve(name).GetPathString()
            if not location:
                _warn(f"{path}: @{asset}@, to which the file refers, is missing; put it there, or flatten the stage")
            elif location not in visited:
                _refuse_outside(path, location, error, outside)
                visited.add(location)
                layers.append(Sdf.Layer.FindOrOpen(location))
    return layers


def _refuse_outside(path: Path, target: str, error: type[ValueError], outside: bool) -> None:
    """Refuse a layer outside the folder of a file without permission."""
    if outside or not target:
        return
    if Ar.IsPackageRelativePath(target):
        target = Ar.SplitPackageRelativePathOuter(target)[0]
    folders = (path.parent.resolve(), path.resolve().parent)
    if not any(Path(target).resolve().is_relative_to(folder) for folder in folders):
        raise error(
            f"{path}: the file refers to {target}, out of its folder; flatten the stage, or allow it by outside=True where you trust it"
        )


def shapes_below(
    stage: Usd.Stage, path: Path, prim: str | None, kind: type, error: type[ValueError]
) -> tuple[list, list]:
    """Return (prims of a kind in a file or below the prim at a path, all other geometric prims)."""
    if prim is not None and not (isinstance(prim, str) and Sdf.Path.IsValidPathString(prim)[0]):
        raise error(f"{path}: prim = {prim!r} is no path of a prim; give one such as '/World/Hair'")
    root = stage.GetPrimAtPath(prim) if prim else stage.GetPseudoRoot()
    if not root:
        raise error(f"{path}: there is no prim {prim}; `usdtree {path}` lists them")
    within = list(Usd.PrimRange(root, INSTANCES))
    for instancer in (UsdGeom.PointInstancer(each) for each in within if each.IsA(UsdGeom.PointInstancer)):
        for target in instancer.GetPrototypesRel().GetTargets():
            prototype = stage.GetPrimAtPath(target)
            for each in Usd.PrimRange(prototype, Usd.PrimAllPrimsPredicate) if prototype else ():
                if each.IsA(kind):
                    raise error(
                        f"{path}: {instancer.GetPath()} is a PointInstancer, whose instances of {each.GetPath()} are not read; make "
                        f"them prims of their own, or read the prototype alone by prim='{target}'"
                    )
    for each in [stage.GetPrimAtPath(prefix) for prefix in root.GetPath().GetPrefixes()] + within:
        if each.HasAuthoredMetadata("clips"):
            raise error(f"{path}: {each.GetPath()} takes values from other files (clips); flatten the stage")
    matching = [each for each in within if each.IsA(kind)]
    remaining = [each for each in within if each.IsA(UsdGeom.Gprim) and not each.IsA(kind)]
    return [kind(each) for each in matching], remaining


def _listed(prims: list[Usd.Prim]) -> str:
    """Return the first few prims by path and type, as text."""
    shown = [f"{each.GetPath()} ({each.GetTypeName()})" for each in prims[:LISTED]]
    return ", ".join(shown + (["..."] if len(prims) > LISTED else []))


def _warn(text: str) -> None:
    warnings.warn(text, SceneWarning, stacklevel=5)


def _points(shape: UsdGeom.PointBased, where: str, error: type[ValueError]) -> tuple[np.ndarray, Usd.TimeCode]:
    """Return (points in the prim's units (P, 3), time at which other attributes are read)."""
    attribute = shape.GetPointsAttr()
    if not attribute.HasValue():
        raise error(f"{where}: there are no points; export the prim with its points")
    # EarliestTime means the first sample of an attribute, or the default without samples.
    time = Usd.TimeCode.EarliestTime() if attribute.Get() is not None else Usd.TimeCode(attribute.GetTimeSamples()[0])
    points = np.array(_value(attribute, time), dtype=np.float64)
    if points.size and (points.ndim != 2 or points.shape[1] != 3):
        raise error(f"{where}: the points have shape {points.shape}; export them as point3f[]")
    return points.reshape(-1, 3), time


def _read_prim(curves: UsdGeom.BasisCurves, path: Path, samples: int) -> CurveSet:
    name = str(curves.GetPath())
    where = f"{path}, {name}"
    points, time = _points(curves, where, CurveError)
    counts = whole_numbers(curves.GetCurveVertexCountsAttr(), time)
    closed = curves.GetWrapAttr().Get() == UsdGeom.Tokens.periodic
    checked_curves(points, counts, closed, None, name, str(path))
    to_world, scale = placement(curves, time, where, CurveError)
    sampled = _sampled(curves, counts, points, samples, where)
    widths = _widths(curves, time, sampled, len(points), where)
    points = sampled.blend(points) @ to_world[:3, :3] + to_world[3, :3]
    radius = None if widths is None else 0.5 * scale * widths
    return replace(
        checked_curves(points, sampled.counts, closed, radius, name, str(path)),
        attributes=_attributes(curves, time, len(counts)),
    )


def _attributes(curves: UsdGeom.BasisCurves, time: Usd.TimeCode, count: int) -> dict[str, np.ndarray]:
    """Return primvars with one value a curve, or one for all, by name: numbers and texts, except display attributes."""
    attributes = {}
    for primvar in UsdGeom.PrimvarsAPI(curves).GetPrimvarsWithValues():
        name, value = primvar.GetPrimvarName(), primvar.ComputeFlattened(time)
        if name in DRAWN or value is None:
            continue
        values = np.array(value).reshape(-1) if np.ndim(value) < 2 else np.zeros(0)
        if primvar.GetInterpolation() == UsdGeom.Tokens.constant and len(values) == 1:
            values = np.repeat(values, count)
        if primvar.GetInterpolation() in (UsdGeom.Tokens.uniform, UsdGeom.Tokens.constant) and len(values) == count:
            attributes[name] = values
    return attributes


def _value(attribute: Usd.Attribute, time: Usd.TimeCode):
    """Return the default value, or the value at `time` without a default."""
    default = attribute.Get()
    return attribute.Get(time) if default is None else default


def whole_numbers(attribute: Usd.Attribute, time: Usd.TimeCode) -> np.ndarray:
    """Return the whole numbers of an attribute; empty without a value.

    Raises:
        ValueError: The attribute is no array of whole numbers.
    """
    values = np.array(_value(attribute, time) or np.zeros(0, int))
    if values.dtype.kind not in "iu" or values.ndim != 1:
        raise ValueError(f"{attribute.GetPath()} is {attribute.GetTypeName()}, not int[]")
    return values.astype(int)


def mesh_below(stage: Usd.Stage, path: Path, prim: str | None) -> tuple[UsdGeom.Mesh, list[str]]:
    """Return the only mesh at or below a prim, and shapes that are no meshes.

    Raises:
        MeshError: There is none, or there are several; lists shapes.
    """
    meshes, unread = shapes_below(stage, path, prim, UsdGeom.Mesh, MeshError)
    if len(meshes) != 1:
        place = "there" if prim is None else f"at {prim}"
        contents = f", but {_listed(unread)}" if unread and not meshes else ""
        listed = f" ({', '.join(str(mesh.GetPath()) for mesh in meshes[:LISTED])})" if meshes else ""
        raise MeshError(
            f"{path}: {place} are {len(meshes)} meshes to read{listed}{contents}; give the path of one mesh"
        )
    return meshes[0], unread


def is_reversed(mesh: UsdGeom.Mesh, to_world: np.ndarray) -> bool:
    """Return True if faces have to be reversed, by their orientation and a mirroring transform (4, 4)."""
    left_handed = mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
    return left_handed != (np.linalg.det(to_world[:3, :3]) < 0.0)


def placement(
    shape: UsdGeom.PointBased, time: Usd.TimeCode, where: str, error: type[ValueError]
) -> tuple[np.ndarray, float]:
    """Return (matrix for row vectors to metres with z up (4, 4), its mean scale)."""
    stage = shape.GetPrim().GetStage()
    unit, up = UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)
    if not 0.0 < unit < np.inf:
        raise error(f"{where}: metersPerUnit of the file is {unit}; set it to the length of its unit [m], such as 0.01")
    matrix = np.array(shape.ComputeLocalToWorldTransform(time))
    matrix[:, :3] *= unit
    volume = abs(np.linalg.det(matrix[:3, :3])) if np.isfinite(matrix).all() else np.nan
    if not 0.0 < volume < np.inf:
        raise error(f"{where}: its transforms scale volumes by {volume}; correct those that scale, or metersPerUnit")
    if up == UsdGeom.Tokens.y:
        matrix[:, :3] = matrix[:, :3] @ Y_UP_TO_Z_UP.T
    return matrix, volume ** (1.0 / 3.0)


def splines(curves: UsdGeom.BasisCurves, counts: np.ndarray, where: str) -> tuple[str, str, str]:
    """Return type, basis and wrap of curves of `counts` vertices; curves of one vertex are left to the caller.

    Raises:
        CurveError: An unknown basis, or a cubic curve whose vertices fit no segments; names the curve.
    """
    kind, basis, wrap = (each.Get() for each in (curves.GetTypeAttr(), curves.GetBasisAttr(), curves.GetWrapAttr()))
    if kind == UsdGeom.Tokens.linear:
        return kind, basis, wrap
    if kind != UsdGeom.Tokens.cubic or basis not in cubic.BASES:
        raise CurveError(
            f"{where}: the curves are of type {kind!r} and basis {basis!r}; export linear ones, or cubic ones of a basis of "
            f"{', '.join(cubic.BASES)}"
        )
    for count in np.unique(counts[counts > 1]):
        if not cubic.segments(basis, wrap, int(count)):
            allowed = [str(n) for n in range(2, 16) if cubic.segments(basis, wrap, n)][:3]
            raise CurveError(
                f"{where}: curve {np.argmax(counts == count)} is a cubic {basis} ({wrap}) of {count} vertices; such curves have "
                f"{', '.join(allowed)}, ...: resample it"
            )
    return kind, basis, wrap


def _sampled(
    curves: UsdGeom.BasisCurves, counts: np.ndarray, points: np.ndarray, samples: int, where: str
) -> cubic.Sampled:
    """Return points of each curve as weights of vertices; warn of polylines that are too short."""
    kind, basis, wrap = splines(curves, counts, where)
    if kind == UsdGeom.Tokens.linear:
        return cubic.linear(counts)
    sampling = cubic.sampled(basis, wrap, counts, samples)
    finer = cubic.sampled(basis, wrap, counts, FINER * samples)
    closed = wrap == UsdGeom.Tokens.periodic
    with np.errstate(all="ignore"):
        short = 1.0 - _lengths(sampling, points, closed) / _lengths(finer, points, closed)
    short = np.nan_to_num(short)
    if (worst := short.max()) > SHORT:
        _warn(
            f"{where}: the polyline of curve {np.argmax(short)} is {100.0 * worst:.2g} % shorter than its cubic {basis}; read more "
            f"points on it by read_curves(path, samples={int(np.ceil(samples * np.sqrt(worst / SHORT)))})"
        )
    return sampling


def _lengths(curves: cubic.Sampled, points: np.ndarray, closed: bool) -> np.ndarray:
    """Return the lengths of polylines through points on curves, shape (R,)."""
    points_on_curves, first = curves.blend(points), np.cumsum(curves.counts) - curves.counts
    steps = np.linalg.norm(np.roll(points_on_curves, -1, axis=0) - points_on_curves, axis=1)
    last = first + curves.counts - 1
    steps[last] = np.linalg.norm(points_on_curves[first] - points_on_curves[last], axis=1) if closed else 0.0
    return np.add.reduceat(steps, first)


def _widths(
    curves: UsdGeom.BasisCurves, time: Usd.TimeCode, sampled: cubic.Sampled, vertex_count: int, where: str
) -> np.ndarray | None:
    """Return the width at each point of all curves, in the prim's units, shape (P,); None without widths."""
    primvar = UsdGeom.PrimvarsAPI(curves).GetPrimvar("widths")  # takes precedence over the attribute
    if primvar.HasValue():
        value, kind = primvar.ComputeFlattened(time), primvar.GetInterpolation()
    else:
        value, kind = _value(curves.GetWidthsAttr(), time), curves.GetWidthsInterpolation()
    if not value:
        return None
    widths = np.array(value, dtype=np.float64)
    if kind == UsdGeom.Tokens.constant or len(widths) == 1:
        return np.full(sampled.counts.sum(), widths[0])
    each = {UsdGeom.Tokens.uniform: len(sampled.counts), UsdGeom.Tokens.varying: sampled.knot_counts.sum()}
    expected = each.get(kind, vertex_count)
    if len(widths) != expected:
        raise CurveError(
            f"{where}: there are {len(widths)} widths, but `{kind}` interpolation takes {expected}; fix either"
        )
    if kind == UsdGeom.Tokens.uniform:
        return np.repeat(widths, sampled.counts)
    return sampled.between_knots(widths) if kind == UsdGeom.Tokens.varying else sampled.blend(widths)

"""Reader of grooms: all that a BasisCurves prim holds, as strands in metres with z up, and as it is in the file.

A strand has nodes by one of three rules (`samples` of `open_groom`), each with its distance from the curve in `Groom.error`.
Interpolating points, the default, are as many as the vertices, so that `GroomLayer` finds the vertices of simulated strands exactly.
Linear curves have their vertices as nodes. Instances of the scene graph are expanded; curves of a PointInstancer are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdShade

from ddg_warp import argument_checks
from ddg_warp.io import cubic
from ddg_warp.io.curves import CurveSet, checked_curves
from ddg_warp.io.paths import CurveError, existing
from ddg_warp.io.usd_read import FINER, opened, placement, shapes_below, splines
from ddg_warp.scene.frame_motion import FrameMotion, nearest_rotations
from ddg_warp.typing import Array, Bools, FilePath, Floats, Integers, Names

FLOOR = 0.1  # least radius of a node over the largest of its strand
SAMPLINGS = ("interpolating", "vertices")
IDS = ("groom_id", "hair_id", "id", "ids")
GROUPS = ("groom_group_id", "groom_group_name", "group", "group_id")
GUIDES = ("groom_guide", "guide")
# attributes that are read, or that the layer writes
GEOMETRY = {"points", "curveVertexCounts", "widths", "extent", "type", "basis", "wrap", "orientation", "doubleSided"}
GEOMETRY |= {"purpose", "visibility", "xformOpOrder"}


@dataclass(frozen=True, eq=False)
class Primvar:
    """Primvar of curves.

    Attributes:
        values: Values (n, ...), or (n, element_size, ...) for an element size above 1.
        interpolation: "constant", "uniform", "varying" or "vertex".
        element_size: Number of values of an element.
    """

    values: Array
    interpolation: str
    element_size: int = 1


@dataclass(frozen=True, eq=False)
class GroomPrim:
    """BasisCurves prim with the content of the file.

    Attributes:
        path: Path of the prim.
        type, basis, wrap: Kind of the curves, such as "cubic", "bspline" and "pinned".
        counts: Vertices of all curves, shape (C,).
        vertices: Vertices of all curves in the prim's own space and units, shape (V, 3).
        curves: Indices of the curves that are read, shape (R,), all but curves of one vertex.
        primvars: Primvars by name, inherited ones included.
        widths: Diameters in the prim's units; None without.
        purpose, visible, material: Purpose, visibility, and path of the bound material or "".
        instances: Paths of the scene graph instances that hold the prim, from the outermost.
        sampled: Nodes of the curves that are read, as weights of their vertices.
    """

    path: str
    type: str
    basis: str
    wrap: str
    counts: Integers
    vertices: Floats
    curves: Integers
    primvars: dict[str, Primvar]
    widths: Primvar | None
    purpose: str
    visible: bool
    material: str
    instances: tuple[str, ...]
    sampled: cubic.Sampled

    def __repr__(self) -> str:
        kind = f"{self.type} {self.basis}".strip()
        return f"<GroomPrim {self.path} of {len(self.counts)} curves, {kind}, primvars: {', '.join(self.primvars) or 'none'}>"

    @property
    def closed(self) -> bool:
        """True for periodic curves."""
        return self.wrap == UsdGeom.Tokens.periodic

    @cached_property
    def read(self) -> Bools:
        """Mask of the vertices of curves that are read, shape (V,)."""
        return np.repeat(np.isin(np.arange(len(self.counts)), self.curves), self.counts)

    def sizes(self) -> dict[str, int]:
        """Return the number of values that each interpolation takes."""
        skipped = self.counts.sum() - self.counts[self.curves].sum()
        varying = int(self.sampled.knot_counts.sum() + skipped)
        return {"constant": 1, "uniform": len(self.counts), "varying": varying, "vertex": len(self.vertices)}

    def at_nodes(self, primvar: Primvar) -> Array:
        """Return the values of a primvar at the nodes of strands, shape (P, ...); whole numbers and texts are not blended."""
        values, kind = primvar.values, primvar.interpolation
        if kind == UsdGeom.Tokens.constant:
            return np.broadcast_to(values[0], (self.sampled.counts.sum(), *values.shape[1:]))
        if kind == UsdGeom.Tokens.uniform:
            return np.repeat(values[self.curves], self.sampled.counts, axis=0)
        blended = values.dtype.kind == "f"
        if kind == UsdGeom.Tokens.vertex:
            values, sampled = values[self.read], self.sampled
            nearest = np.take_along_axis(sampled.vertices, sampled.weights.argmax(1)[:, None], 1)[:, 0]
            return sampled.blend(values) if blended else values[nearest]
        knots = self.counts.copy()
        knots[self.curves] = self.sampled.knot_counts
        values = values[np.repeat(np.isin(np.arange(len(knots)), self.curves), knots)]
        if not blended:
            return values[
                self.sampled.knots[np.arange(len(self.sampled.shares)), np.rint(self.sampled.shares).astype(int)]
            ]
        shares = self.sampled.shares.reshape(-1, *[1] * (values.ndim - 1))
        before, after = (values[knots] for knots in self.sampled.knots.T)
        return (1.0 - shares) * before + shares * after


@dataclass(frozen=True, eq=False)
class Groom:
    """Strands of one or several BasisCurves prims, in metres with z up, at the first time code.

    Strands of all prims follow one after the other, in the order of the file.

    Attributes:
        path, outside: The file, and whether it may refer to others out of its folder.
        prims: The prims as they are in the file.
        samples: Rule of the nodes, see `open_groom`.
        points: Nodes [m], shape (P, 3).
        counts: Nodes of each strand, shape (R,).
        radius: Radius at each node [m], shape (P,); None without widths.
        error: Upper bound of the distance of each curve from its polyline [m], shape (R,). It is zero for linear curves.
        start, end, rate: First and last time code, and time codes per second. The file has the up axis `up` and `unit` metres per
            unit.
        unread: Content of the file that is not read, with reasons, one sentence each.
    """

    path: Path
    outside: bool
    prims: list[GroomPrim]
    samples: str | int
    points: Floats
    radius: Floats | None
    error: Floats
    start: float
    end: float
    rate: float
    up: str
    unit: float
    unread: list[str] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"<Groom of {len(self.counts)} strands of {len(self.points)} nodes in {', '.join(p.path for p in self.prims)}>"

    @cached_property
    def counts(self) -> Integers:
        """Nodes of each strand, shape (R,)."""
        return np.concatenate([prim.sampled.counts for prim in self.prims])

    @property
    def closed(self) -> Bools:
        """Mask of closed strands, shape (R,)."""
        return np.repeat([prim.closed for prim in self.prims], [len(prim.curves) for prim in self.prims])

    @property
    def names(self) -> Names:
        """Name of the prim of each strand, shape (R,)."""
        names = [prim.path.rpartition("/")[2] for prim in self.prims]
        return np.repeat(names, [len(prim.curves) for prim in self.prims])

    @property
    def ids(self) -> Array:
        """Id of each strand, shape (R,): the primvar of `IDS` that the file has, or the index."""
        name = self._first_of(IDS)
        return self.of_strands(name) if name else np.arange(len(self.counts))

    @property
    def groups(self) -> Array:
        """Group of each strand, shape (R,): the primvar of `GROUPS` that the file has, or the name of the prim."""
        name = self._first_of(GROUPS)
        return self.of_strands(name) if name else self.names

    @property
    def guides(self) -> Bools:
        """Mask of guides, shape (R,), by a primvar of `GUIDES`, or of prims of purpose "guide"."""
        name = self._first_of(GUIDES)
        if name:
            return self.of_strands(name).astype(bool)
        guides = [prim.purpose == UsdGeom.Tokens.guide for prim in self.prims]
        return np.repeat(guides, [len(prim.curves) for prim in self.prims])

    @property
    def duration(self) -> float:
        """Time from the first time code to the last [s]."""
        return (self.end - self.start) / self.rate

    def rods(self) -> list[Floats]:
        """Return the nodes of each strand [m], each of shape (n, 3)."""
        return np.split(self.points, np.cumsum(self.counts)[:-1])

    def curves(self) -> CurveSet:
        """Return the strands as a `CurveSet`, with values of strands as attributes."""
        names = set.intersection(*({n for n, v in p.primvars.items() if _is_of_strands(v)} for p in self.prims))
        attributes = {name: self.of_strands(name) for name in sorted(names)}
        where = self.prims[0].path
        return CurveSet(self.points, self.counts, self.closed, self.radius, where, attributes)

    def of_strands(self, name: str) -> Array:
        """Return a uniform or constant primvar of all strands, shape (R, ...).

        Raises:
            CurveError: A prim lacks it, or its interpolation is varying or vertex.
        """
        result = []
        for prim, primvar in self._each(name):
            if not _is_of_strands(primvar):
                raise CurveError(
                    f"{self.path}, {prim.path}: primvar {name!r} is {primvar.interpolation}; give one of strands, uniform or constant"
                )
            uniform = primvar.interpolation == UsdGeom.Tokens.uniform
            rows = prim.curves if uniform else np.zeros(len(prim.curves), int)
            result.append(primvar.values[rows])
        return np.concatenate(result)

    def at_nodes(self, name: str) -> Array:
        """Return a primvar at all nodes, shape (P, ...), of any interpolation.

        Raises:
            CurveError: A prim lacks it.
        """
        return np.concatenate([prim.at_nodes(primvar) for prim, primvar in self._each(name)])

    def _each(self, name: str) -> Iterator[tuple[GroomPrim, Primvar]]:
        for prim in self.prims:
            if name not in prim.primvars:
                raise CurveError(
                    f"{self.path}, {prim.path}: there is no primvar {name!r}; it has {', '.join(sorted(prim.primvars)) or 'none'}"
                )
            yield prim, prim.primvars[name]

    def _first_of(self, names: tuple[str, ...]) -> str:
        """Return the first of some names that is a primvar of strands in all prims, or ""."""
        for name in names:
            if all(name in prim.primvars and _is_of_strands(prim.primvars[name]) for prim in self.prims):
                return name
        return ""


def open_groom(
    path: FilePath, prim: str | None = None, *, samples: str | int = "interpolating", outside: bool = False
) -> Groom:
    """Read the curves of a prim, or of all prims below it, at the first time code of the stage.

    Invisible prims and prims of purpose "guide" or "proxy" are read if `prim` names them, and listed as unread otherwise. Curves of
    one vertex are skipped. Radii below a tenth of the largest of their strand are raised to it.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        prim: Path of a BasisCurves prim or of an ancestor; by default the whole file.
        samples: Nodes of cubic curves. With "interpolating" a curve has as many points as vertices, from which `GroomLayer` finds
            the vertices exactly. With "vertices" nodes are the control polygon, off the curve. A number gives as many points in each
            segment; then vertices are fitted by least squares.
        outside: Whether layers, references and payloads outside the folder of the file may be opened.

    Raises:
        CurveError: There are no curves to read, or one that no rod can be built from; names prim and curve.
    """
    path = existing(path)
    if not (isinstance(samples, str) and samples in SAMPLINGS):
        if isinstance(samples, str):
            raise CurveError(
                f"open_groom: samples is {samples!r}; give one of {', '.join(SAMPLINGS)}, or a number of points"
            )
        samples = argument_checks.count("open_groom: samples", samples)
    with opened(path, CurveError, outside) as stage:
        matching, remaining = shapes_below(stage, path, prim, UsdGeom.BasisCurves, CurveError)
        unread = [f"{each.GetPath()} is a {each.GetTypeName()}, no BasisCurves" for each in remaining]
        chosen = []
        for curves in matching:
            reason = _left_out(curves)
            if reason and str(curves.GetPath()) != prim:
                unread.append(f"{curves.GetPath()} {reason}; name it by prim to read it")
            else:
                chosen.append(curves)
        if not chosen:
            listed = f" ({'; '.join(unread[:5])})" if unread else ""
            raise CurveError(f"{path}: there are no BasisCurves to read{f' below {prim}' if prim else ''}{listed}")
        start, end = _range(stage, chosen)
        reader = _Reader(path, start, samples, unread)
        prims = [reader.read(curves) for curves in chosen]
        radius = [node_radius for *_, node_radius, _ in prims]
        if any(each is None for each in radius) and any(each is not None for each in radius):
            lacking = prims[[each is None for each in radius].index(True)][0].path
            raise CurveError(f"{path}, {lacking}: there are no widths, and others have; give it widths")
        return Groom(
            path,
            outside,
            [each for each, *_ in prims],
            samples,
            np.concatenate([points for _, points, *_ in prims]),
            None if radius[0] is None else np.concatenate(radius),
            np.concatenate([error for *_, error in prims]),
            start,
            end,
            stage.GetTimeCodesPerSecond(),
            str(UsdGeom.GetStageUpAxis(stage)),
            UsdGeom.GetStageMetersPerUnit(stage),
            unread,
        )


class _Reader:
    """Reader of the prims of a groom at one time code, which lists unread content."""

    def __init__(self, path: Path, code: float, samples: str | int, unread: list[str]):
        self._path, self._code, self._samples, self._unread = path, Usd.TimeCode(code), samples, unread
        # points of a segment, for errors
        self._fine = FINER * (cubic.BEZIER_STEP if isinstance(samples, str) else samples)

    def read(self, curves: UsdGeom.BasisCurves) -> tuple:
        """Return (prim, nodes [m], radius or None, error [m])."""
        name = str(curves.GetPath())
        where = f"{self._path}, {name}"
        counts, vertices = self._vertices(curves, where)
        kind, basis, wrap = splines(curves, counts, where)
        kept = np.flatnonzero(counts > 1)
        if len(kept) < len(counts):
            first = int(np.argmax(counts < 2))
            self._say(
                name,
                f"{len(counts) - len(kept)} curves of less than 2 vertices are skipped, the first is curve {first}",
            )
        if not len(kept):
            raise CurveError(f"{where}: no curve has 2 vertices; export curves, not points")
        sampled = self._sampled(kind, basis, wrap, counts[kept])
        prim = GroomPrim(
            name,
            *(str(each) for each in (kind, basis, wrap)),
            counts,
            vertices,
            kept,
            {},
            None,
            str(curves.ComputePurpose()),
            curves.ComputeVisibility(self._code) != UsdGeom.Tokens.invisible,
            _material(curves),
            _instances(curves.GetPrim()),
            sampled,
        )
        to_world, scale = placement(curves, self._code, where, CurveError)
        placed = vertices[prim.read] @ to_world[:3, :3] + to_world[3, :3]
        points = sampled.blend(placed)
        prim = replace(prim, primvars=self._primvars(curves, prim))
        prim = replace(prim, widths=self._widths(curves, prim, where))
        radius = None if prim.widths is None else self._radius(prim, 0.5 * scale, where)
        checked_curves(points, sampled.counts, prim.closed, radius, name, str(self._path))
        self._list_rest(curves, name)
        return prim, points, radius, self._errors(kind, basis, wrap, counts[kept], placed)

    def _say(self, name: str, text: str) -> None:
        self._unread.append(f"{name}: {text}")

    def _vertices(self, curves: UsdGeom.BasisCurves, where: str) -> tuple[np.ndarray, np.ndarray]:
        counts = np.array(curves.GetCurveVertexCountsAttr().Get(self._code) or [], int)
        vertices = np.array(curves.GetPointsAttr().Get(self._code) or [], np.float64).reshape(-1, 3)
        if not len(counts) or not len(vertices):
            codes = [c for c in curves.GetPointsAttr().GetTimeSamples() if len(curves.GetPointsAttr().Get(c) or [])]
            remedy = (
                f"set startTimeCode to {codes[0]:g}, the first with points" if codes else "export it with its curves"
            )
            raise CurveError(f"{where}: there is not a single curve at time code {self._code}; {remedy}")
        if counts.sum() != len(vertices):
            raise CurveError(
                f"{where}: the curves' vertex counts sum to {counts.sum()}, but there are {len(vertices)} points at time code "
                f"{self._code}; write the counts and the points of the same frame"
            )
        return counts, vertices

    def _sampled(self, kind: str, basis: str, wrap: str, counts: np.ndarray) -> cubic.Sampled:
        if kind == UsdGeom.Tokens.linear:
            return cubic.linear(counts)
        if self._samples == "vertices":
            return cubic.polygons(basis, wrap, counts)
        return cubic.sampled(basis, wrap, counts, None if isinstance(self._samples, str) else self._samples)

    def _errors(self, kind: str, basis: str, wrap: str, counts: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Return upper bounds of distances between curves and polylines (R,) [m], at equal parameters of both."""
        result, first = np.zeros(len(counts)), np.cumsum(counts) - counts
        if kind == UsdGeom.Tokens.linear:
            return result
        for count in np.unique(counts):
            one, rows = np.array([count]), np.flatnonzero(counts == count)
            nodes, fine = self._sampled(kind, basis, wrap, one), cubic.sampled(basis, wrap, one, self._fine)
            along, corners = nodes.parameters(), np.eye(len(nodes.shares))
            if wrap == UsdGeom.Tokens.periodic:
                along, corners = np.append(along, nodes.knot_counts[0]), np.concatenate([corners, corners[:1]])
            chords = np.stack([np.interp(fine.parameters(), along, corner) for corner in corners.T], 1)
            off = fine.matrix().toarray() - chords @ nodes.matrix().toarray()
            mine = vertices[first[rows][:, None] + np.arange(count)]
            result[rows] = np.sqrt(np.square(off @ mine).sum(2).max(1))
        return result

    def _primvars(self, curves: UsdGeom.BasisCurves, prim: GroomPrim) -> dict[str, Primvar]:
        result, sizes = {}, prim.sizes()
        for primvar in UsdGeom.PrimvarsAPI(curves).FindPrimvarsWithInheritance():
            name, value = str(primvar.GetPrimvarName()), primvar.ComputeFlattened(self._code)
            if value is None:
                continue
            kind, size = str(primvar.GetInterpolation()), int(primvar.GetElementSize())
            values = np.array(value)
            values = values.reshape(1) if values.ndim == 0 else values
            if values.dtype.kind not in "biufU":
                self._say(prim.path, f"primvar {name!r} of {primvar.GetTypeName()} holds neither numbers nor texts")
            elif kind not in sizes or not (len(values) == size * sizes[kind] or kind == "constant"):
                expected = f"{sizes[kind]} elements of {size}" if kind in sizes else "none of curves"
                self._say(
                    prim.path, f"primvar {name!r} has {len(values)} values; {kind} interpolation takes {expected}"
                )
            elif kind == "constant" and len(values) != size:
                result[name] = Primvar(values[None], kind, len(values))
            else:
                result[name] = Primvar(values.reshape(-1, size, *values.shape[1:]) if size > 1 else values, kind, size)
        return result

    def _widths(self, curves: UsdGeom.BasisCurves, prim: GroomPrim, where: str) -> Primvar | None:
        if "widths" in prim.primvars:  # takes precedence over the attribute
            return prim.primvars["widths"]
        value = curves.GetWidthsAttr().Get(self._code)
        if not value:
            self._say(prim.path, "there are no widths")
            return None
        values, kind, sizes = np.array(value, np.float64), str(curves.GetWidthsInterpolation()), prim.sizes()
        kind = "constant" if len(values) == 1 else kind
        if len(values) != sizes.get(kind):
            raise CurveError(
                f"{where}: there are {len(values)} widths, but {kind} interpolation takes {sizes.get(kind)}; fix either"
            )
        return Primvar(values, kind)

    def _radius(self, prim: GroomPrim, factor: float, where: str) -> np.ndarray:
        """Return the radius of nodes [m], with the floor."""
        radius, counts = factor * prim.at_nodes(prim.widths).astype(np.float64), prim.sampled.counts
        owner = np.repeat(prim.curves, counts)
        for node in np.flatnonzero(~(np.isfinite(radius) & (radius >= 0.0)))[:1]:
            raise CurveError(
                f"{where}: curve {owner[node]} has a width of {radius[node] / factor:g}; give it one of 0 or more"
            )
        largest = np.maximum.reduceat(radius, np.cumsum(counts) - counts)
        for strand in np.flatnonzero(largest == 0.0)[:1]:
            raise CurveError(f"{where}: curve {prim.curves[strand]} has no width at all; give it one, or delete it")
        least = FLOOR * np.repeat(largest, counts)
        low = radius < least
        if low.any():
            self._say(
                prim.path,
                f"widths of {len(np.unique(owner[low]))} curves fall below {FLOOR:g} of their largest, the first of them curve "
                f"{owner[low][0]}: they are simulated with {FLOOR:g} of it, and stay in the file",
            )
        return np.maximum(radius, least)

    def _list_rest(self, curves: UsdGeom.BasisCurves, name: str) -> None:
        """List animation, and attributes and relationships that are not read."""
        for label, attribute in (
            ("the points", curves.GetPointsAttr()),
            ("the vertex counts", curves.GetCurveVertexCountsAttr()),
            ("the widths", curves.GetWidthsAttr()),
        ):
            if len(codes := attribute.GetTimeSamples()) > 1:
                self._say(name, f"{label} have {len(codes)} time samples: those of time code {self._code} are read")
        prim = curves.GetPrim()
        for attribute in prim.GetAuthoredAttributes():
            kind = str(attribute.GetName())
            if kind not in GEOMETRY and not kind.startswith(("primvars:", "xformOp")) and attribute.HasValue():
                self._say(name, f"attribute {kind!r} is not read")
        for relationship in prim.GetAuthoredRelationships():
            kind = str(relationship.GetName())
            if relationship.GetTargets() and not kind.startswith("material:binding"):
                deforms = ": its deformation is not evaluated, bake it" if kind.startswith("skel:") else ""
                self._say(name, f"relationship {kind!r} is not read{deforms}")
        for child in prim.GetChildren():
            if not child.IsA(UsdGeom.Gprim):
                self._say(name, f"{child.GetPath()} ({child.GetTypeName() or 'no type'}) is not read")


def _is_of_strands(primvar: Primvar) -> bool:
    return primvar.interpolation in (UsdGeom.Tokens.uniform, UsdGeom.Tokens.constant)


def _left_out(curves: UsdGeom.BasisCurves) -> str:
    """Return why curves are no rendered hair, or ""."""
    if curves.ComputeVisibility(Usd.TimeCode.EarliestTime()) == UsdGeom.Tokens.invisible:
        return "is invisible"
    purpose = curves.ComputePurpose()
    return f"is of purpose {purpose}" if purpose in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy) else ""


def _range(stage: Usd.Stage, curves: list[UsdGeom.BasisCurves]) -> tuple[float, float]:
    """Return the first and the last time code: of the stage, else of the points."""
    if stage.HasAuthoredTimeCodeRange():
        return stage.GetStartTimeCode(), stage.GetEndTimeCode()
    codes = [code for each in curves for code in each.GetPointsAttr().GetTimeSamples()]
    return (min(codes), max(codes)) if codes else (0.0, 0.0)


def _material(curves: UsdGeom.BasisCurves) -> str:
    material, _ = UsdShade.MaterialBindingAPI(curves).ComputeBoundMaterial()
    return str(material.GetPath()) if material else ""


def _instances(prim: Usd.Prim) -> tuple[str, ...]:
    """Return the paths of the instances that hold a prim, from the outermost."""
    if not prim.IsInstanceProxy():
        return ()
    ancestors = [prim.GetStage().GetPrimAtPath(path) for path in prim.GetPath().GetPrefixes()]
    return tuple(str(each.GetPath()) for each in ancestors if each.IsInstance())


def prim_motion(groom: Groom, roots: np.ndarray, strands: np.ndarray) -> FrameMotion | None:
    """Return the motion of roots (n, 3) [m] of some strands (n,) with the transforms of their prims; None if all stay."""
    stage = Usd.Stage.Open(str(groom.path))
    owner = np.repeat(np.arange(len(groom.prims)), [len(prim.curves) for prim in groom.prims])[strands]
    if not any(_moves(stage.GetPrimAtPath(prim.path)) for prim in groom.prims):
        return None

    def matrices(t: float) -> np.ndarray:
        code = Usd.TimeCode(groom.start + t * groom.rate)
        curves = [UsdGeom.BasisCurves(stage.GetPrimAtPath(prim.path)) for prim in groom.prims]
        return np.stack([placement(each, code, str(groom.path), CurveError)[0] for each in curves])

    back = np.linalg.inv(matrices(0.0))

    def frames(t: float) -> tuple[np.ndarray, np.ndarray]:
        moved = (back @ matrices(t))[owner]
        rotation = nearest_rotations(moved[:, :3, :3].swapaxes(1, 2))
        return np.einsum("ni,nij->nj", roots, moved[:, :3, :3]) + moved[:, 3, :3] - roots, rotation

    return FrameMotion(roots, frames)


def _moves(prim: Usd.Prim) -> bool:
    """Return True if the transform of a prim or of an ancestor changes with time."""
    while prim:
        if prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
            return True
        prim = prim.GetParent()
    return False

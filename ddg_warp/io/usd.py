"""USD: recorded rods out, as curves or as tubes. `read_curves` and `validate` are here too, for one import.

All rods of a batch stand in one prim below /World: a linear BasisCurves, or a Mesh of tubes for programs that draw no
curves or drop their materials. z is up, lengths are in metres, times in seconds times timeCodesPerSecond.
USD saves a file in place, over its old table of contents, so that a process killed meanwhile leaves it unreadable.
The stage therefore lives in a file `NAME.partial.usdc`; after each save a copy of it takes the final name in one step.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, Vt

from ddg_warp.io import CurveError, Curves
from ddg_warp.io.tube import SIDES, tube_faces, tube_points
from ddg_warp.io.usd_check import validate
from ddg_warp.io.usd_read import read_curves

__all__ = ["CurvesWriter", "read_curves", "validate"]

PALETTE = ((0.12, 0.47, 0.71), (0.89, 0.47, 0.20), (0.17, 0.63, 0.42), (0.74, 0.27, 0.35), (0.55, 0.42, 0.70))
GROWTH = 8  # saves are at least an eighth of the recording apart, which bounds what their copies cost


class CurvesWriter:
    """Writes frames of rods to a USD file.

    Args:
        path: The file, .usdc or .usda; an existing one is replaced.
        curves: Rods without points, such as `model.curves`, or a `CurveSet`.
        fps: Time codes per second.
        colors: RGB of each rod, shape (R, 3), or of each point, shape (P, 3); by default one color a batch.
        tube: Whether to write tubes instead of curves.
        block: Frames between two saves, at least; a killed process leaves the frames saved last.
    """

    def __init__(self, path, curves, *, fps: float = 24.0, colors=None, tube: bool = False, block: int = 32):
        self.path = Path(path)
        self._partial = self.path.with_name(f"{self.path.stem}.partial{self.path.suffix}")
        self._partial.unlink(missing_ok=True)
        self._fps, self._block = fps, block
        self._frames = self._saved = 0
        self._stage = Usd.Stage.CreateNew(str(self._partial))
        self._describe_stage()
        self._prims = _define_prims(self._stage, curves, colors, _TubesPrim if tube else _CurvesPrim)

    def __enter__(self) -> CurvesWriter:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def write(self, time: float, points, *, velocities=None, scalars: Mapping[str, np.ndarray] | None = None) -> None:
        """Adds a frame.

        Args:
            time: Time [s], later than those before.
            points: Positions [m], shape (P, 3).
            velocities: Velocities [m/s], shape (P, 3).
            scalars: Values at the points by name, each of shape (P,), written unchanged as primvars.
        """
        code = Usd.TimeCode(round(time * self._fps, 6))
        for prim in self._prims:
            prim.write(code, points, velocities, scalars or {})
        if self._frames == 0:
            self._stage.SetStartTimeCode(code.GetValue())
        self._stage.SetEndTimeCode(code.GetValue())
        self._frames += 1
        if self._frames - self._saved >= max(self._block, self._frames // GROWTH):
            self.save()

    def save(self) -> None:
        """Gives the final file all frames so far."""
        self._stage.GetRootLayer().Save()
        copy = self.path.with_name(f"{self.path.stem}.copy{self.path.suffix}")
        shutil.copyfile(self._partial, copy)
        os.replace(copy, self.path)
        self._saved = self._frames

    def close(self) -> None:
        """Saves what is left and lets go of the stage."""
        if self._stage is not None:
            self._stage.GetRootLayer().Save()
            self._prims, self._stage = [], None
            os.replace(self._partial, self.path)

    def _describe_stage(self) -> None:
        UsdGeom.SetStageUpAxis(self._stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(self._stage, 1.0)
        self._stage.SetTimeCodesPerSecond(self._fps)
        self._stage.SetFramesPerSecond(self._fps)
        self._stage.SetDefaultPrim(UsdGeom.Xform.Define(self._stage, "/World").GetPrim())


class _CurvesPrim:
    """The rods of one batch as one BasisCurves prim.

    Args:
        stage: Where to define it.
        path: Path of the new prim.
        curves: The rods of the batch, all closed or all open.
        nodes: Index of each of their points among all points, shape (p,).
        color: One RGB, or one for each point, shape (p, 3).
    """

    def __init__(self, stage: Usd.Stage, path: str, curves: Curves, nodes: np.ndarray, color: np.ndarray):
        self._curves, self._nodes = curves, nodes
        self._prim = self._define(stage, path)
        primvars = UsdGeom.PrimvarsAPI(self._prim)
        uniform = color.ndim == 1
        kind = UsdGeom.Tokens.constant if uniform else UsdGeom.Tokens.vertex
        shown = _vectors([color] if uniform else self._at_vertices(color))
        primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, kind).Set(shown)
        radius = _floats(self._at_vertices(curves.radius))
        primvars.CreatePrimvar("radius", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex).Set(radius)
        self._primvars = primvars

    def write(self, code: Usd.TimeCode, points, velocities, scalars: Mapping[str, np.ndarray]) -> None:
        """Sets the samples of one frame; the arrays hold all rods' points."""
        shown = _vectors(self._vertices(np.asarray(points, dtype=np.float64)[self._nodes]))
        self._prim.GetPointsAttr().Set(shown, code)
        self._prim.GetExtentAttr().Set(self._extent(shown), code)
        if velocities is not None:
            self._prim.GetVelocitiesAttr().Set(_vectors(self._at_vertices(np.asarray(velocities)[self._nodes])), code)
        for name, values in scalars.items():
            primvar = self._primvars.CreatePrimvar(name, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
            primvar.Set(_floats(self._at_vertices(np.asarray(values)[self._nodes])), code)

    def _define(self, stage: Usd.Stage, path: str) -> UsdGeom.PointBased:
        curves = UsdGeom.BasisCurves.Define(stage, path)
        curves.CreateTypeAttr(UsdGeom.Tokens.linear)
        curves.CreateWrapAttr(UsdGeom.Tokens.periodic if self._curves.closed[0] else UsdGeom.Tokens.nonperiodic)
        curves.CreateCurveVertexCountsAttr(_ints(self._curves.counts))
        widths = 2.0 * self._curves.radius
        uniform = np.ptp(widths) == 0.0
        self._widths = _floats(widths[:1] if uniform else widths)
        curves.CreateWidthsAttr(self._widths)
        curves.SetWidthsInterpolation(UsdGeom.Tokens.constant if uniform else UsdGeom.Tokens.vertex)
        return curves

    def _vertices(self, points: np.ndarray) -> np.ndarray:
        return points

    def _at_vertices(self, values: np.ndarray) -> np.ndarray:
        """Values at the points, as values at the vertices."""
        return values

    def _extent(self, vertices: Vt.Vec3fArray) -> Vt.Vec3fArray:
        return UsdGeom.Curves.ComputeExtent(vertices, self._widths)


class _TubesPrim(_CurvesPrim):
    """The rods of one batch as one Mesh; a velocity is that of the centreline."""

    def _define(self, stage: Usd.Stage, path: str) -> UsdGeom.PointBased:
        mesh = UsdGeom.Mesh.Define(stage, path)
        sizes, indices = tube_faces(self._curves.counts, self._curves.closed)
        mesh.CreateFaceVertexCountsAttr(_ints(sizes))
        mesh.CreateFaceVertexIndicesAttr(_ints(indices))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(False)
        return mesh

    def _vertices(self, points: np.ndarray) -> np.ndarray:
        return tube_points(points, self._curves.counts, self._curves.closed, self._curves.radius)

    def _at_vertices(self, values: np.ndarray) -> np.ndarray:
        return np.repeat(values, SIDES, axis=0)

    def _extent(self, vertices: Vt.Vec3fArray) -> Vt.Vec3fArray:
        return UsdGeom.PointBased.ComputeExtent(vertices)


def _define_prims(stage: Usd.Stage, curves, colors, kind: type[_CurvesPrim]) -> list[_CurvesPrim]:
    """One prim for each batch; two where it has open and closed rods, because USD wraps all curves of a prim alike."""
    if curves.radius is None:
        raise CurveError("the rods have no radius, so they cannot be drawn: give each point one [m]")
    curves = Curves.tiled(curves, 1)
    if colors is not None and len(colors) == len(curves.counts):
        colors = np.repeat(colors, curves.counts, axis=0)
    prims = []
    for batch in np.unique(curves.batch):
        for closed in (False, True):
            rods = (curves.batch == batch) & (curves.closed == closed)
            if rods.any():
                mine = np.repeat(rods, curves.counts)
                names, radius = curves.names[rods], curves.radius[mine]
                part = Curves(curves.counts[rods], curves.closed[rods], radius, names, curves.batch[rods])
                color = np.array(PALETTE[batch % len(PALETTE)]) if colors is None else np.asarray(colors)[mine]
                prims.append(kind(stage, _free_path(stage, str(names[0])), part, np.flatnonzero(mine), color))
    return prims


def _free_path(stage: Usd.Stage, name: str) -> str:
    """A path below /World from a name, with a number if it is taken."""
    base = path = f"/World/{Tf.MakeValidIdentifier(name)}"
    number = 1
    while stage.GetPrimAtPath(path):
        number += 1
        path = f"{base}_{number}"
    return path


def _vectors(values) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def _floats(values) -> Vt.FloatArray:
    return Vt.FloatArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def _ints(values) -> Vt.IntArray:
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, dtype=np.int32))

"""Writer of simulated strands as a layer over the stage of a groom.

The layer overrides points, velocities and extents of the same prims by time samples, in their basis, axes, units and time codes. All
else stays: counts, widths, primvars, materials and the stage itself, which is a sublayer.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, Vt
from scipy import sparse
from scipy.sparse.linalg import splu

from ddg_warp import argument_checks
from ddg_warp.io.paths import CurveError, as_path
from ddg_warp.io.usd_groom import Groom, GroomPrim
from ddg_warp.io.usd_prims import vectors
from ddg_warp.io.usd_read import placement
from ddg_warp.typing import FilePath, Numbers

SUFFIXES = (".usd", ".usda", ".usdc")
RATE_STEP = 1e-3  # time codes, step of the differences of transforms
METADATA = ("colorConfiguration", "colorManagementSystem", "customLayerData")  # of the stage besides units and times


class GroomLayer:
    """Layer over the stage of a groom, with time samples of its strands.

        with GroomLayer(groom, "out.usda") as layer:
            layer.write(time, points, velocities)

    Cubic curves go through interpolating nodes exactly; with more nodes than vertices they are fitted by least squares.
    Instances that hold a prim become editable. The file is written at the end.

    Args:
        groom: The groom, see `open_groom`.
        path: The layer, .usd, .usda or .usdc, to open instead of the stage; an existing file is replaced.

    Attributes:
        error: Largest distance so far between a node and its written curve [m], before rounding to the float32 of the file.

    Raises:
        CurveError: The path is the groom's own or has another suffix; or curves have too few nodes to find their vertices.
    """

    def __init__(self, groom: Groom, path: FilePath):
        self.groom, self.path, self.error = groom, as_path("GroomLayer: path", path, CurveError), 0.0
        if self.path.suffix.lower() not in SUFFIXES:
            raise CurveError(f"{path}: a layer is a {', '.join(SUFFIXES)} file; give it one of these suffixes")
        if self.path.resolve() == groom.path.resolve():
            raise CurveError(f"{path} is the groom itself, which stays as it is; name another file for the layer")
        self._vertices = [_vertex_finder(groom, prim) for prim in groom.prims]
        self._layer = Sdf.Layer.CreateAnonymous(self.path.suffix)
        self._layer.subLayerPaths.append(str(groom.path.resolve()))
        self._stage = Usd.Stage.Open(self._layer)
        self._copy_metadata()
        for instance in dict.fromkeys(each for prim in groom.prims for each in prim.instances):
            self._stage.OverridePrim(instance).SetInstanceable(False)
        self._prims = [UsdGeom.BasisCurves(self._stage.GetPrimAtPath(prim.path)) for prim in groom.prims]
        self._widths = [
            curves.GetWidthsAttr().Get(Usd.TimeCode(groom.start)) or Vt.FloatArray() for curves in self._prims
        ]
        for curves in self._prims:
            if curves.GetAccelerationsAttr().HasAuthoredValue():
                curves.GetAccelerationsAttr().Block()

    def __enter__(self) -> GroomLayer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, time: float, points: Numbers, velocities: Numbers | None = None) -> None:
        """Write the nodes of all strands at a time.

        Args:
            time: Time [s], 0 at the first time code of the groom.
            points: Nodes [m], shape (P, 3), in the order of the groom.
            velocities: Velocities [m/s], shape (P, 3).

        Raises:
            CurveError: Arrays of another shape, or values that are not finite.
        """
        groom, time = self.groom, argument_checks.number("GroomLayer.write: time", time)
        code = Usd.TimeCode(float(f"{groom.start + time * groom.rate:.12g}"))
        points = self._checked("points", points)
        velocities = None if velocities is None else self._checked("velocities", velocities)
        nodes = np.cumsum([0, *(prim.sampled.counts.sum() for prim in groom.prims)])
        for index, prim in enumerate(groom.prims):
            mine = slice(nodes[index], nodes[index + 1])
            self._write(index, prim, code, points[mine], None if velocities is None else velocities[mine])
        self._stage.SetStartTimeCode(min(self._stage.GetStartTimeCode(), code.GetValue()))
        self._stage.SetEndTimeCode(max(self._stage.GetEndTimeCode(), code.GetValue()))

    def close(self) -> None:
        """Write the file, with the stage as a sublayer by a path relative to the layer."""
        if self._stage is None:
            return
        self._prims, self._stage = [], None
        source, folder = self.groom.path.resolve(), self.path.resolve().parent
        relative = Path(os.path.relpath(source, folder)).as_posix()
        self._layer.subLayerPaths[0] = relative if relative.startswith(".") else f"./{relative}"
        partial = self.path.with_name(f"{self.path.stem}.partial{self.path.suffix}")
        try:
            self._layer.Export(str(partial))
            os.replace(partial, self.path)
            if opened_before := Sdf.Layer.Find(str(self.path.resolve())):
                opened_before.Reload(force=True)
        except Tf.ErrorException as reason:
            raise OSError(f"{self.path} cannot be written ({reason})") from reason
        finally:
            partial.unlink(missing_ok=True)

    def _write(self, index: int, prim: GroomPrim, code: Usd.TimeCode, points, velocities) -> None:
        curves, find = self._prims[index], self._vertices[index]
        where = f"{self.groom.path}, {prim.path}"
        to_world, _ = placement(curves, code, where, CurveError)
        to_local = np.linalg.inv(to_world[:3, :3])
        vertices, moved = prim.vertices.copy(), find((points - to_world[3, :3]) @ to_local)
        off = np.linalg.norm(prim.sampled.blend(moved) @ to_world[:3, :3] + to_world[3, :3] - points, axis=1).max()
        self.error = max(self.error, float(off))
        vertices[prim.read] = moved
        values = vectors(vertices)
        curves.GetPointsAttr().Set(values, code)
        curves.GetExtentAttr().Set(UsdGeom.Curves.ComputeExtent(values, self._widths[index]), code)
        if velocities is not None:
            rate = self._rate_of_placement(curves, code, where)
            local = (velocities - (prim.sampled.blend(moved) @ rate[:3, :3] + rate[3, :3])) @ to_local
            all_velocities = np.zeros_like(vertices)
            all_velocities[prim.read] = find(local)
            curves.GetVelocitiesAttr().Set(vectors(all_velocities), code)

    def _rate_of_placement(self, curves: UsdGeom.BasisCurves, code: Usd.TimeCode, where: str) -> np.ndarray:
        """Return the rate of the matrix to the world [1/s] (4, 4), backward as velocities of steps are, forward at the start."""
        first = code.GetValue() - (RATE_STEP if code.GetValue() > self.groom.start else 0.0)
        before, after = (
            placement(curves, Usd.TimeCode(each), where, CurveError)[0] for each in (first, first + RATE_STEP)
        )
        return (after - before) * (self.groom.rate / RATE_STEP)

    def _checked(self, name: str, values) -> np.ndarray:
        values = np.asarray(values, np.float64)
        if values.shape != self.groom.points.shape:
            raise CurveError(
                f"GroomLayer.write: {name} have shape {values.shape}, not {self.groom.points.shape}; give all nodes of the groom"
            )
        for node in np.flatnonzero(~np.isfinite(values).all(1))[:1]:
            strand = int(np.searchsorted(np.cumsum(self.groom.counts), node, side="right"))
            raise CurveError(
                f"GroomLayer.write: {name} of strand {strand} are not finite; write frames of good steps only"
            )
        return values

    def _copy_metadata(self) -> None:
        groom, source = self.groom, Usd.Stage.Open(str(self.groom.path), Usd.Stage.LoadNone)
        UsdGeom.SetStageUpAxis(self._stage, groom.up)
        UsdGeom.SetStageMetersPerUnit(self._stage, groom.unit)
        self._stage.SetTimeCodesPerSecond(groom.rate)
        self._stage.SetFramesPerSecond(source.GetFramesPerSecond())
        self._stage.SetStartTimeCode(groom.start)
        self._stage.SetEndTimeCode(groom.end)
        if source.GetDefaultPrim():
            self._layer.defaultPrim = source.GetRootLayer().defaultPrim
        for name in METADATA:
            if source.HasAuthoredMetadata(name):
                self._stage.SetMetadata(name, source.GetMetadata(name))


def _vertex_finder(groom: Groom, prim: GroomPrim):
    """Return the function from nodes (P, ...) to the vertices of the curves that are read.

    Raises:
        CurveError: A curve has fewer nodes than vertices.
    """
    sampled, counts = prim.sampled, prim.counts[prim.curves]
    few = np.flatnonzero(sampled.counts < counts)
    if few.size:
        segments = (sampled.counts[few[0]] - (not prim.closed)) // int(groom.samples)
        raise CurveError(
            f"{groom.path}, {prim.path}: curve {prim.curves[few[0]]} has {counts[few[0]]} vertices, which {sampled.counts[few[0]]} "
            f"nodes do not determine; open the groom with samples={-(-counts[few[0]] // max(segments, 1))}, or without samples"
        )
    if sampled.weights.shape[1] == 1:
        return lambda nodes: nodes
    matrix = sampled.matrix()
    if (sampled.counts == counts).all():
        return splu(matrix).solve
    normal = splu(sparse.csc_matrix(matrix.T @ matrix))
    return lambda nodes: normal.solve(matrix.T @ nodes)

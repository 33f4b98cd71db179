"""Write scenes/data/strands.usdc: 512 curled strands on a round head, the groom of scenes and tests.

Strands of 32 vertices, 0.3 m long and 2 mm thick, rise along the normals of a spherical cap, curl and droop outwards.
As many grooms do, the file has y up and centimetres, and the head stands below a transform.
The output is deterministic:  python tools/make_groom.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

OUTPUT = Path(__file__).resolve().parents[1] / "scenes" / "data" / "strands.usdc"
STRANDS, VERTICES = 512, 32
HEAD_RADIUS, LENGTH, STRAND_RADIUS = 0.10, 0.30, 0.001  # metres
CAP_ANGLE = np.radians(68.0)
CURL_RADIUS, CURL_TURNS = 0.007, 3.0  # metres, turns along a strand
FINE = 512  # sample points of the curve of a strand
CENTIMETRES = 100.0
HEAD_HEIGHT = 1.6  # metres


def roots() -> np.ndarray:
    """Return unit normals on an even golden-angle spiral over the cap, y up, shape (STRANDS, 3)."""
    k = np.arange(STRANDS) + 0.5
    height = 1.0 - (1.0 - np.cos(CAP_ANGLE)) * k / STRANDS
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - height**2)
    return np.stack([ring * np.cos(azimuth), height, ring * np.sin(azimuth)], axis=1)


def strands(seed: int = 7) -> np.ndarray:
    """Return points of the strands in the head's frame [m], y up, shape (STRANDS, VERTICES, 3)."""
    rng = np.random.default_rng(seed)
    normal = roots()
    droop = rng.uniform(0.75, 1.15, STRANDS)
    phase, size = rng.uniform(0.0, 2.0 * np.pi, STRANDS), rng.uniform(0.6, 1.3, STRANDS)
    curves = HEAD_RADIUS * normal[:, None] + _shapes(normal, droop, phase, size)
    return np.stack([_resampled(curve) for curve in curves])


def _shapes(normal: np.ndarray, droop: np.ndarray, phase: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return plane curves along the normals that bend over, with a helix around each [m], (STRANDS, FINE, 3).

    Args:
        normal: Unit normals of the head, shape (STRANDS, 3).
        droop: Rate of the bend of a strand, shape (STRANDS,).
        phase: Angle of the helix at the root, shape (STRANDS,).
        size: Radius of the helix over CURL_RADIUS, shape (STRANDS,).
    """
    s = np.linspace(0.0, 1.0, FINE)
    fallen = 0.45 * _unit(normal * [1.0, 0.0, 1.0]) - [0.0, 1.0, 0.0]
    binormal = _unit(np.cross(normal, fallen))
    bend = np.arccos(np.sum(normal * _unit(fallen), axis=1))
    progress = np.clip(droop[:, None] * s, 0.0, 1.0)
    angle = (bend[:, None] * progress**2 * (3.0 - 2.0 * progress))[..., None]
    tangent = np.cos(angle) * normal[:, None] + np.sin(angle) * np.cross(binormal, normal)[:, None]
    guide = np.cumsum(tangent, axis=1) * (1.1 * LENGTH / FINE)

    helix_angle = (2.0 * np.pi * CURL_TURNS * s + phase[:, None])[..., None]
    growth = (CURL_RADIUS * size[:, None] * np.clip(s / 0.35, 0.0, 1.0) ** 2)[..., None]
    return guide + growth * (
        np.cos(helix_angle) * binormal[:, None] + np.sin(helix_angle) * np.cross(tangent, binormal[:, None])
    )


def _resampled(curve: np.ndarray) -> np.ndarray:
    """Return VERTICES points at equal steps over the first LENGTH metres of a curve."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    positions = np.linspace(0.0, LENGTH, VERTICES)
    return np.stack([np.interp(positions, length, curve[:, k]) for k in range(3)], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def write(path: Path) -> None:
    """Write the groom as a DCC program would."""
    from pxr import Gf, Usd, UsdGeom, Vt

    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0 / CENTIMETRES)
    head = UsdGeom.Xform.Define(stage, "/Head")
    head.AddTranslateOp().Set(Gf.Vec3d(0.0, CENTIMETRES * HEAD_HEIGHT, 0.0))
    head.AddRotateYOp().Set(30.0)
    stage.SetDefaultPrim(head.GetPrim())
    curves = UsdGeom.BasisCurves.Define(stage, "/Head/Strands")
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
    curves.CreateCurveVertexCountsAttr([VERTICES] * STRANDS)
    points = Vt.Vec3fArray.FromNumpy((CENTIMETRES * strands()).reshape(-1, 3).astype(np.float32))
    widths = Vt.FloatArray([2.0 * CENTIMETRES * STRAND_RADIUS])
    curves.CreatePointsAttr(points)
    curves.CreateWidthsAttr(widths)
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    curves.CreateExtentAttr(UsdGeom.Curves.ComputeExtent(points, widths))
    color = curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant)
    color.Set(Vt.Vec3fArray([Gf.Vec3f(0.35, 0.22, 0.14)]))
    stage.GetRootLayer().documentation = "512 strands of 32 vertices, 0.3 m long; made by tools/make_groom.py"
    stage.GetRootLayer().Save()


if __name__ == "__main__":
    write(OUTPUT)
    print(f"{OUTPUT}: {OUTPUT.stat().st_size} bytes")

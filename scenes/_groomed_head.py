"""Stage of a shot as of an artist's program: a groom on a deforming head, y up, in centimetres, at 24 frames per second.

The strands are pinned cubic B-splines of unequal vertex counts with primvars and a material. The head moves, nods and is squashed.

    python -m ddg_warp.scenes._groomed_head shot.usda
"""

import sys
from pathlib import Path

import numpy as np

from ddg_warp.geometry import meshes
from ddg_warp.typing import FilePath

CURVES, HEAD, LOOK = "/char/hair/scalp_long", "/char/head", "/char/looks/hair"
RATE, FIRST = 24.0, 1  # frames per second, first time code
RADIUS, LENGTH, HEIGHT = 9.0, 18.0, 150.0  # cm, of the head, of strands, and of the head above the floor
WIDTH = (0.012, 0.004)  # cm, of roots and tips
LEAST, MOST = 10, 16  # vertices of a strand
CAP = 0.3  # least height of roots over the radius
LIFT = (0.6, 1.6)  # cm
FINE = 240  # steps along a strand
SWAY, SQUASH, NOD = 4.0, 0.05, 0.25  # cm, fraction, rad


def strands(count: int, seed: int = 0) -> tuple[list[np.ndarray], np.ndarray]:
    """Return vertices of strands, each (n, 3) [cm], and roots on the unit sphere (count, 3)."""
    rng = np.random.default_rng(seed)
    height = CAP + (1.0 - CAP) * (np.arange(count) + 0.5) / count
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - height**2)
    normals = np.stack([ring * np.cos(azimuth), height, ring * np.sin(azimuth)], 1)
    counts = rng.integers(LEAST, MOST + 1, count)
    lift = rng.uniform(*LIFT, (count, 1))  # cm, the distance from the head at which a strand is combed down
    down = np.array([0.0, -1.0, 0.0])
    away = np.stack([np.cos(azimuth), 0.0 * azimuth, np.sin(azimuth)], 1)
    fine, step = [RADIUS * normals], LENGTH / FINE
    for k in range(FINE):
        outward = fine[-1] / np.linalg.norm(fine[-1], axis=1, keepdims=True)
        upper = np.maximum(outward[:, 1:2], 0.0)
        along = down + upper * outward + 1e-3 * away
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        direction = along + 2.0 * np.exp(-step * k / lift) * outward
        fine.append(fine[-1] + step * direction / np.linalg.norm(direction, axis=1, keepdims=True))
    every = np.stack(fine, 1)
    result = [every[k, np.linspace(0, FINE, n).round().astype(int)] for k, n in enumerate(counts)]
    return result, normals


def head(frame: int, points: np.ndarray) -> np.ndarray:
    """Return points of the head (n, 3) [cm] at a frame, counted from 0."""
    phase = 2.0 * np.pi * frame / RATE
    moved = points * [1.0, 1.0 + SQUASH * np.sin(phase), 1.0]
    angle = NOD * np.sin(0.5 * phase)
    c, s = np.cos(angle), np.sin(angle)
    return moved @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) + [SWAY * np.sin(phase), 0.0, 0.0]


def write(path: FilePath, count: int = 400, frames: int = 49, subdivisions: int = 3) -> None:
    """Write the stage with `count` strands and `frames` time samples of the head."""
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

    def vectors(values):
        return Vt.Vec3fArray.FromNumpy(np.asarray(values, np.float32))

    Path(path).unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(RATE)
    stage.SetFramesPerSecond(RATE)
    stage.SetStartTimeCode(FIRST)
    stage.SetEndTimeCode(FIRST + frames - 1)
    root = UsdGeom.Xform.Define(stage, "/char")
    root.AddTranslateOp().Set(Gf.Vec3d(0.0, HEIGHT, 0.0))
    stage.SetDefaultPrim(root.GetPrim())
    for scope in ("/char/hair", "/char/looks"):
        UsdGeom.Scope.Define(stage, scope)

    points, normals = strands(count)
    widths = Vt.FloatArray.FromNumpy(
        np.concatenate([np.linspace(*WIDTH, len(each)) for each in points]).astype(np.float32)
    )
    curves = UsdGeom.BasisCurves.Define(stage, CURVES)
    curves.CreateTypeAttr(UsdGeom.Tokens.cubic)
    curves.CreateBasisAttr(UsdGeom.Tokens.bspline)
    curves.CreateWrapAttr(UsdGeom.Tokens.pinned)
    curves.CreateCurveVertexCountsAttr([len(each) for each in points])
    curves.CreatePointsAttr(vectors(np.concatenate(points)))
    curves.CreateWidthsAttr(widths)
    curves.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    curves.CreateExtentAttr(UsdGeom.Curves.ComputeExtent(curves.GetPointsAttr().Get(), widths))
    primvars = UsdGeom.PrimvarsAPI(curves)
    around = np.arctan2(normals[:, 2], normals[:, 0]) / (2.0 * np.pi) + 0.5
    uv = np.stack([around, normals[:, 1]], 1).astype(np.float32)
    primvar = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.uniform)
    primvar.Set(Vt.Vec2fArray.FromNumpy(uv))
    primvar = primvars.CreatePrimvar("clump_id", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.uniform)
    primvar.Set(Vt.IntArray.FromNumpy((8 * around).astype(np.int32)))

    material = UsdShade.Material.Define(stage, LOOK)
    shader = UsdShade.Shader.Define(stage, f"{LOOK}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.3, 0.2, 0.05))
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(curves.GetPrim()).Bind(material)

    sphere, triangles = meshes.sphere(subdivisions, RADIUS)
    mesh = UsdGeom.Mesh.Define(stage, HEAD)
    mesh.CreateFaceVertexCountsAttr([3] * len(triangles))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.GetPointsAttr().Set(vectors(sphere))  # some readers refuse a mesh without default values
    mesh.GetExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(vectors(sphere)))
    for frame in range(frames):
        moved = vectors(head(frame, sphere))
        mesh.GetPointsAttr().Set(moved, FIRST + frame)
        mesh.GetExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(moved), FIRST + frame)
    stage.GetRootLayer().Save()


if __name__ == "__main__":
    write(Path(sys.argv[1]))

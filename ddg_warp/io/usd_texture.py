"""Texture coordinates of USD meshes (`primvars:st`), and a list of contents of a Mesh prim that are not read."""

from __future__ import annotations

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

NAME = "st"


def corner_texture(mesh: UsdGeom.Mesh, time: Usd.TimeCode, indices: np.ndarray) -> tuple[np.ndarray | None, list[str]]:
    """Return (texture coordinates of each corner of the faces (C, 2) or None, texts for others that do not fit)."""
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(NAME)
    if not primvar.HasValue():
        return None, []
    values = np.array(primvar.ComputeFlattened(time) or np.zeros((0, 2)), float)
    kind = primvar.GetInterpolation()
    if kind in (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying) and values.ndim == 2 and len(values) > indices.max():
        values = values[indices]
    elif kind != UsdGeom.Tokens.faceVarying:
        values = np.zeros((0, 2))
    if values.shape != (len(indices), 2):
        return None, [f"primvars:{NAME} ({kind}), as there is not one for each corner of the faces or each point"]
    return values, []


def write_texture(mesh: UsdGeom.Mesh, uv: np.ndarray) -> None:
    """Write texture coordinates of the corners of triangles (T, 3, 2), once for equal values."""
    flat, numbers = np.unique(uv.reshape(-1, 2).astype(np.float32), axis=0, return_inverse=True)
    kind = Sdf.ValueTypeNames.TexCoord2fArray
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(NAME, kind, UsdGeom.Tokens.faceVarying)
    primvar.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(flat)))
    primvar.SetIndices(Vt.IntArray.FromNumpy(numbers.reshape(-1).astype(np.int32)))


def subdivision(mesh: UsdGeom.Mesh) -> str:
    """Return the subdivision scheme of a Mesh, "" without."""
    scheme = mesh.GetSubdivisionSchemeAttr()
    return str(scheme.Get()) if scheme.HasAuthoredValue() and scheme.Get() != UsdGeom.Tokens.none else ""


def unread_of_mesh(mesh: UsdGeom.Mesh, holes: np.ndarray) -> list[str]:
    """Return a text for each content of a Mesh that is not read."""
    unread = [f"{len(holes)} holes (holeIndices)"] * bool(len(holes))
    samples = mesh.GetPointsAttr().GetNumTimeSamples()
    if samples > 1:
        unread.append(f"{samples - 1} further time samples of the points")
    if scheme := subdivision(mesh):
        unread.append(f"subdivision ({scheme}): the mesh is that of its control points")
    for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithAuthoredValues():
        if primvar.GetPrimvarName() != NAME:
            unread.append(f"primvars:{primvar.GetPrimvarName()}")
    for name in ("normals", "velocities"):
        if mesh.GetPrim().GetAttribute(name).HasAuthoredValue():
            unread.append(name)
    return unread

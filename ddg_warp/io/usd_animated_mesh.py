"""Reader of animated meshes in USD files: all time samples of points and transforms, in metres with z up."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom

from ddg_warp.io.faces import triangulated
from ddg_warp.io.paths import MeshError, existing
from ddg_warp.io.usd_read import is_reversed, mesh_below, opened, placement
from ddg_warp.io.usd_texture import subdivision
from ddg_warp.scene.animated_mesh import AnimatedMesh
from ddg_warp.typing import FilePath


def read_animated_mesh(
    path: FilePath, prim: str | None = None, *, start: float | None = None, outside: bool = False
) -> AnimatedMesh:
    """Read a mesh of fixed topology with all time samples of points and transforms.

    Polygons are cut by `triangulated`, holes and vertices without a face left out. A subdivision surface is read as its control mesh.
    Transforms are linear between samples; a rotation needs samples close together.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        prim: Path of the Mesh prim, or of an ancestor; needed if the file has several meshes.
        start: Time code of t = 0; by default the first of the stage, or of the samples.
        outside: Whether layers, references and payloads outside the folder of the file may be opened.

    Raises:
        MeshError: There is no mesh to read, its topology changes, or a frame is not finite; names prim and time code.
    """
    path = existing(path)
    with opened(path, MeshError, outside) as stage:
        mesh, _ = mesh_below(stage, path, prim)
        where = f"{path}, {mesh.GetPath()}"
        codes = _codes(mesh)
        if start is None and stage.HasAuthoredTimeCodeRange():
            start = stage.GetStartTimeCode()
        start = (codes[0] if codes else 0.0) if start is None else float(start)
        counts, indices, holes = _topology(mesh, where)
        frames = []
        for code in codes or [start]:
            time = Usd.TimeCode(code)
            points = np.array(mesh.GetPointsAttr().Get(time) or [], np.float64).reshape(-1, 3)
            if frames and len(points) != len(frames[0]):
                raise MeshError(
                    f"{where}: there are {len(points)} points at time code {code:g} and {len(frames[0])} at {codes[0]:g}; export a "
                    "mesh of fixed topology"
                )
            to_world, _ = placement(mesh, time, where, MeshError)
            frames.append(points @ to_world[:3, :3] + to_world[3, :3])
            if not np.isfinite(frames[-1]).all():
                raise MeshError(f"{where}: a point at time code {code:g} is not finite; correct it")
        triangles, face = triangulated(frames[0], counts, indices, where)
        triangles = triangles[~np.isin(face, holes)]
        if is_reversed(mesh, to_world):
            triangles = triangles[:, [0, 2, 1]]
        used, triangles = np.unique(triangles, return_inverse=True)
        unread = _unread(mesh, len(frames[0]) - len(used))
        times = (np.array(codes or [start]) - start) / stage.GetTimeCodesPerSecond()
        name = mesh.GetPrim().GetName()
        return AnimatedMesh(times, np.stack(frames)[:, used], triangles.reshape(-1, 3), name, unread)


def _codes(mesh: UsdGeom.Mesh) -> list[float]:
    """Return the time codes of all samples of points and transforms, ancestors included, sorted."""
    codes, prim = set(mesh.GetPointsAttr().GetTimeSamples()), mesh.GetPrim()
    while prim:
        if prim.IsA(UsdGeom.Xformable):
            codes.update(UsdGeom.Xformable(prim).GetTimeSamples())
        prim = prim.GetParent()
    return sorted(codes)


def _topology(mesh: UsdGeom.Mesh, where: str) -> list[np.ndarray]:
    """Return counts, indices and holes of faces, and refuse faces that change with time."""
    result = []
    for attribute in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetHoleIndicesAttr()):
        codes = attribute.GetTimeSamples()
        first = np.array(attribute.Get(Usd.TimeCode.EarliestTime()) or [], int)
        for code in codes[1:]:
            if not np.array_equal(first, np.array(attribute.Get(code) or [], int)):
                raise MeshError(
                    f"{where}: {attribute.GetName()} changes at time code {code:g}; export a mesh of fixed topology"
                )
        result.append(first)
    return result


def _unread(mesh: UsdGeom.Mesh, unused: int) -> list[str]:
    path = mesh.GetPath()
    result = [f"{path}: {unused} vertices are of no face and left out"] if unused else []
    if mesh.GetPrim().GetRelationship("skel:skeleton").GetTargets():
        result.append(f"{path}: its skeleton is not evaluated; bake the deformation into points")
    if scheme := subdivision(mesh):
        result.append(f"{path}: its subdivision ({scheme}) is not evaluated, the control mesh is read")
    return result

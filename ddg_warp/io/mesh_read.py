"""Reader of triangle meshes in files of many formats, distinguished by suffix.

USD and GLB files state units and the up axis. FOLD files may state a unit. Numbers of all other files are taken as metres with z up,
unless `unit` and `up` are given.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

from ddg_warp import argument_checks
from ddg_warp.errors import SceneWarning
from ddg_warp.io.axes import in_metres
from ddg_warp.io.file_mesh import FileMesh
from ddg_warp.io.paths import MeshError, existing
from ddg_warp.typing import FilePath

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
SUFFIXES = (
    ".obj",
    ".stl",
    ".ply",
    ".glb",
    ".off",
    ".msh",
    ".vtk",
    ".vtu",
    ".inp",
    ".fold",
    ".txt (DisMech)",
    *USD_SUFFIXES,
)


def read_mesh(
    path: FilePath,
    prim: str | None = None,
    weld: float | None = None,
    outside: bool = False,
    unit: float | None = None,
    up: Literal["y", "z"] | None = None,
) -> FileMesh:
    """Return the mesh of a file: (points (P, 3) [m], triangles (T, 3), name), with attributes of `FileMesh`.

    Convex polygons are cut into fans from the first corner, others by ear clipping. Vertices that no face uses are dropped; `vertices`
    of the result holds the indices in the file of the others. Contents that are not read are listed in `unread`. A `SceneWarning`
    names elements and vertices among them. `Surface` checks the topology of the result.

    Args:
        path: A .obj, .stl, .ply, .glb, .off, .msh (Gmsh), .vtk (legacy, unstructured grid), .vtu, .inp (Abaqus), .fold, .txt (DisMech),
            .usd, .usda, .usdc or .usdz file.
        prim: For USD, path of the Mesh prim, or of an ancestor; needed if the file has several meshes.
        weld: Vertices within this distance [m] of each other become one, for seams of exported files and for STL, where every
            triangle has its own; None keeps all.
        outside: For USD, whether layers, references and payloads outside the folder of the file may be opened. Files that other formats
            refer to are never opened.
        unit: Length of the unit of the file [m], such as 0.001, if the format does not state one; by default 1.
        up: Axis of the file that points up, "y" or "z", if the format does not state one; by default "z".

    Raises:
        MeshError: the file cannot be read; names the file, the line or prim, and the remedy.
        MissingPackageError: the format needs the extra `meshes`.
        SceneError: `weld` or `unit` is no positive length.
    """
    path, outside = existing(path), argument_checks.flag("read_mesh: outside", outside)
    if unit is not None:
        argument_checks.positive("read_mesh: unit", unit, "m")
    if up is not None:
        argument_checks.choice("read_mesh: up", up, ("y", "z"))
    mesh, own_unit, own_axis = _read(path, prim, outside)
    for name, value, stated in (("unit", unit, own_unit is not None), ("up", up, own_axis)):
        if value is not None and stated:
            raise MeshError(f"{path}: {name} = {value!r}, but the file states its own; leave it out")
    points = in_metres(mesh.points, unit or own_unit, up)
    if mesh.lost:
        warnings.warn(f"{path}: not read: {', '.join(mesh.lost)}", SceneWarning, stacklevel=2)
    count, mesh = len(points), mesh.changed(points, mesh.triangles).used()
    if len(mesh.points) < count:
        warnings.warn(f"{path}: {mesh.unread[-1]}", SceneWarning, stacklevel=2)
    return mesh if weld is None else mesh.welded(weld).used()


def _read(path: Path, prim: str | None, outside: bool) -> tuple[FileMesh, float | None, bool]:
    """Return (mesh, unit of its points if the file states one [m], whether z is up by the format)."""
    suffix = path.suffix.lower()
    if suffix in USD_SUFFIXES:
        from ddg_warp.io.usd_read import read_mesh_prim

        return read_mesh_prim(path, prim, outside), 1.0, True
    if prim is not None:
        raise MeshError(f"{path}: prim = {prim!r}, but {suffix or 'such'} files have no prims; leave it out")
    if suffix == ".fold":
        from ddg_warp.io.fold import read_fold

        return *read_fold(path), False
    if suffix == ".obj":
        from ddg_warp.io.obj import read_obj as reader
    elif suffix == ".txt":
        from ddg_warp.io.dismech import read_shell as reader
    else:
        from ddg_warp.io import mesh_formats

        if suffix == ".glb":
            return mesh_formats.read_glb(path), 1.0, True
        readers = {".stl": mesh_formats.read_stl, ".off": mesh_formats.read_off}
        readers |= dict.fromkeys(mesh_formats.MESHIO, mesh_formats.read_by_meshio)
        if suffix not in readers:
            raise MeshError(f"{path}: meshes are read from {', '.join(SUFFIXES)} files")
        reader = readers[suffix]
    return reader(path), None, False

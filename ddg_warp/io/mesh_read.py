"""Reader of triangle meshes in OBJ and USD files.

OBJ files state neither units nor the up axis: numbers are taken as metres with z up. All objects and groups of an OBJ file form
one mesh; texture coordinates and normals are not read.
Source: B1. Object Files, Advanced Visualizer manual, Wavefront Technologies (statements v, f, o, g; line continuation).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneWarning
from ddg_warp.geometry import polygons
from ddg_warp.io import MeshError, existing, shown

BEYOND = 2**31  # a vertex index that no file has; larger numbers are clipped to it
USD_SUFFIXES = {".usd", ".usda", ".usdc", ".usdz"}


def read_mesh(
    path, prim: str | None = None, weld: float | None = None, outside: bool = False
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the mesh of an OBJ or USD file: (points (P, 3) [m], triangles (T, 3), name).

    Convex polygons are cut into fans from the first corner, others by ear clipping. Vertices that no face uses are dropped, with a
    `SceneWarning`. `Surface` checks the topology of the result.

    Args:
        path: A .obj, .usd, .usda, .usdc or .usdz file.
        prim: For USD, path of the Mesh prim, or of an ancestor; needed if the file has several meshes.
        weld: Vertices within this distance [m] of each other become one, for seams of exported files; None keeps all.
        outside: For USD, whether layers, references and payloads outside the folder of the file may be opened. Files that an OBJ
            file names (mtllib) are never opened.

    Raises:
        MeshError: the file cannot be read; names the file, the line or prim, and the remedy.
        SceneError: `weld` is no positive length.
    """
    from ddg_warp.geometry import meshes

    path = existing(path)
    points, triangles, name = _read(path, prim, arguments.flag("read_mesh: outside", outside))
    used, count = meshes.drop_unused(points, triangles), len(points)
    if len(used[0]) < count:
        first = np.argmin(np.isin(np.arange(count), triangles))
        warnings.warn(
            f"{path}: {count - len(used[0])} of {count} vertices are dropped, the first of them {first}: no face uses them",
            SceneWarning,
            stacklevel=2,
        )
    return *(used if weld is None else meshes.weld(*used, weld)), name


def _read(path: Path, prim: str | None, outside: bool) -> tuple[np.ndarray, np.ndarray, str]:
    if path.suffix.lower() in USD_SUFFIXES:
        from ddg_warp.io.usd_read import read_mesh_prim

        return read_mesh_prim(path, prim, outside)
    if path.suffix.lower() == ".obj":
        if prim is not None:
            raise MeshError(f"{path}: prim = {prim!r}, but an OBJ file has no prims; leave it out")
        return _read_obj(path)
    raise MeshError(f"{path}: meshes are read from .obj, .usd, .usda, .usdc and .usdz files")


def triangulated(
    points: np.ndarray, counts: np.ndarray, indices: np.ndarray, where: str, lines: list[int] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return (triangles (T, 3), face of each triangle (T,)): fans for convex faces, ear clipping for others.

    Args:
        points: (P, 3).
        counts: Corners of each face, shape (F,).
        indices: Points of the corners, face after face.
        where: Start of messages.
        lines: Line of each face, for messages that name lines instead of faces.
    """

    def name_of(face: int) -> str:
        return f"{where}: face {face}" if lines is None else f"{where}:{lines[face]}: the face"

    if not len(counts):
        raise MeshError(f"{where}: there is not a single face; export the mesh with its faces")
    for face in np.flatnonzero(counts < 3)[:1]:
        raise MeshError(f"{name_of(face)} has {counts[face]} corners; a face has at least 3, so delete it")
    if counts.sum() != len(indices):
        raise MeshError(
            f"{where}: the faces have {counts.sum()} corners, but {len(indices)} are listed; export it again"
        )
    for corner in np.flatnonzero((indices < 0) | (indices >= len(points)))[:1]:
        face = np.searchsorted(np.cumsum(counts), corner, side="right")
        raise MeshError(
            f"{name_of(face)} has a corner at a vertex that does not exist, there are {len(points)}; correct it"
        )
    for vertex in np.flatnonzero(~np.isfinite(points).all(axis=1))[:1]:
        raise MeshError(f"{where}: vertex {vertex} is not finite; re-export it or delete it")
    face = np.repeat(np.arange(len(counts)), counts - 2)
    step = np.arange(len(face)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
    first = (np.cumsum(counts) - counts)[face]
    triangles = indices[np.stack([first, first + step + 1, first + step + 2], axis=1)]
    for count in np.unique(counts[counts > 3]):
        same = np.flatnonzero(counts == count)
        corners = indices[(np.cumsum(counts) - counts)[same][:, None] + np.arange(count)]
        for number in np.flatnonzero(~fans_suit(points[corners])):
            local, fault = polygons.triangulate(points[corners[number]])
            if fault:
                line = "" if lines is None else f":{lines[same[number]]}"
                raise MeshError(
                    f"{where}{line}: face {same[number]} with {count} corners {fault}; cut it into triangles, or correct it"
                )
            triangles[face == same[number]] = corners[number][local]
    return triangles, face


def fans_suit(corners: np.ndarray) -> np.ndarray:
    """Return (F,) bool: True for faces (F, n, 3) that fans from the first corner triangulate well."""
    steps = np.diff(corners, axis=1)[:, 1:], (corners[:, 1:] - corners[:, :1])[:, :-1]
    vectors, normals = np.cross(steps[1], steps[0]), polygons.area_vectors(corners)[:, None]
    sizes = np.linalg.norm(vectors, axis=-1) * np.linalg.norm(normals, axis=-1)
    return polygons.convex(corners) & ((vectors * normals).sum(-1) >= polygons.STEEP * sizes).all(1)


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    points: list[list[float]] = []
    indices: list[int] = []
    counts, lines, name = [], [], ""
    for number, (keyword, *words) in _statements(path):
        try:
            if keyword == "v":
                x, y, z = (float(word) for word in words[:3])
                points.append([x, y, z])
            elif keyword == "f":
                corners = [int(word.partition("/")[0]) for word in words]
                if 0 in corners:
                    raise MeshError(f"{path}:{number}: the face names vertex 0; an OBJ file counts from 1, correct it")
                # negative indices count back from the last vertex so far
                indices += [min(k - 1, BEYOND) if k > 0 else max(len(points) + k, -1) for k in corners]
                counts.append(len(corners))
                lines.append(number)
            elif keyword in {"o", "g"} and not name:
                name = " ".join(words)
        except MeshError:
            raise
        except ValueError:
            wanted = "three numbers" if keyword == "v" else "vertices as v, v/vt, v//vn or v/vt/vn"
            text = shown([keyword, *words])
            raise MeshError(f"{path}:{number}: '{text}' cannot be read; write {wanted} after {keyword}") from None
    vertices = np.array(points, dtype=np.float64).reshape(-1, 3)
    triangles, _ = triangulated(vertices, np.array(counts, int), np.array(indices, int), str(path), lines)
    return vertices, triangles, name or path.stem


def _statements(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (number of the first line, words) of every statement, without comments; lines ending in \\ are joined."""
    pending: list[str] = []
    start = 0
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            text = line.partition("#")[0].rstrip()
            start = start if pending else number
            continued = text.endswith("\\")
            pending += text.removesuffix("\\").split()
            if pending and not continued:
                yield start, pending
                pending = []
    if pending:
        yield start, pending

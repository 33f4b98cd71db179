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

from ddg_warp import argument_checks
from ddg_warp.errors import SceneWarning
from ddg_warp.io.faces import triangulated
from ddg_warp.io.paths import MeshError, existing, shown
from ddg_warp.typing import FilePath, Floats, Integers

BEYOND = 2**31  # a vertex index that no file has; larger numbers are clipped to it
USD_SUFFIXES = {".usd", ".usda", ".usdc", ".usdz"}


def read_mesh(
    path: FilePath, prim: str | None = None, weld: float | None = None, outside: bool = False
) -> tuple[Floats, Integers, str]:
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
    points, triangles, name = _read(path, prim, argument_checks.flag("read_mesh: outside", outside))
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

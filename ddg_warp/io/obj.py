"""Reader of triangle meshes in OBJ files.

All objects and groups form one mesh. Texture coordinates are read where every corner has them. Normals, materials, lines, points
and free-form geometry are counted, not read. Files that an OBJ file names (mtllib) are never opened.
Source: B1. Object Files, Advanced Visualizer manual, Wavefront Technologies (statements v, vt, f, o, g; line continuation).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ddg_warp.io.file_mesh import FileMesh, mesh_of_polygons
from ddg_warp.io.paths import MeshError, shown

BEYOND = 2**31  # a vertex index that no file has; larger numbers are clipped to it
ELEMENTS = {"l": "polylines (l)", "p": "points (p)", "curv": "curves (curv)", "surf": "free-form surfaces (surf)"}
OTHERS = {"vn": "normals (vn)", "usemtl": "materials (usemtl)", "mtllib": "material libraries (mtllib)"}
WANTED = {"v": "three numbers", "vt": "two numbers", "f": "vertices as v, v/vt, v//vn or v/vt/vn"}


def read_obj(path: Path) -> FileMesh:
    """Return the mesh of an OBJ file, in units and axes of the file.

    Raises:
        MeshError: A statement cannot be read; names the line.
    """
    points: list[list[float]] = []
    texture: list[list[float]] = []
    corners: list[int] = []
    texture_corners: list[int] = []  # -1: none
    counts, lines, name, skipped = [], [], "", Counter()
    for number, (keyword, *words) in _statements(path):
        try:
            if keyword == "v":
                x, y, z = (float(word) for word in words[:3])
                points.append([x, y, z])
            elif keyword == "vt":
                texture.append([float(word) for word in (words + ["0"])[:2]])
            elif keyword == "f":
                indices = [word.split("/") for word in words]
                of_face = [int(each[0]) for each in indices]
                if 0 in of_face:
                    raise MeshError(f"{path}:{number}: the face names vertex 0; an OBJ file counts from 1, correct it")
                corners += [_index(k, len(points)) for k in of_face]
                texture_corners += [
                    _index(int(each[1]), len(texture)) if "".join(each[1:2]) else -1 for each in indices
                ]
                counts.append(len(of_face))
                lines.append(number)
            elif keyword in {"o", "g"} and not name:
                name = " ".join(words)
            elif keyword in ELEMENTS or keyword in OTHERS:
                skipped[keyword] += 1
        except MeshError:
            raise
        except ValueError:
            text = shown([keyword, *words])
            raise MeshError(
                f"{path}:{number}: '{text}' cannot be read; write {WANTED[keyword]} after {keyword}"
            ) from None
    vertices = np.array(points, dtype=np.float64).reshape(-1, 3)
    uv, unread = _texture(np.array(texture).reshape(-1, 2), np.array(texture_corners, int))
    return mesh_of_polygons(
        vertices,
        counts,
        corners,
        str(path),
        name or path.stem,
        uv=uv,
        lines=lines,
        lost=[f"{skipped[key]} {text}" for key, text in ELEMENTS.items() if skipped[key]],
        unread=unread + [f"{skipped[key]} {text}" for key, text in OTHERS.items() if skipped[key]],
    )


def _index(number: int, count: int) -> int:
    """Return an index from 0 of a number from 1; negative numbers count back from the last of `count` so far."""
    return min(number - 1, BEYOND) if number > 0 else max(count + number, -1)


def _texture(texture: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray | None, list[str]]:
    """Return texture coordinates of each corner, or None, and a text if only some corners have them."""
    has = (corners >= 0) & (corners < len(texture))
    if has.all() and len(corners):
        return texture[corners], []
    if not len(texture):
        return None, []
    return None, [f"{len(texture)} texture coordinates (vt), as {np.count_nonzero(~has)} corners have none"]


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

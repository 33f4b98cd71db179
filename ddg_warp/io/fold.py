"""Reader of creased sheets in FOLD files: faces and creases with fold angles.

The first frame is read. Fold angles are `edges_foldAngle` in degrees, positive for valleys; without them a mountain (M) has -180,
a valley (V) 180, and other edges 0. A fold of 180 degrees lies flat on the other side.
Source: FOLD format 1.2, Demaine, Ku and Lang, github.com/edemaine/fold.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ddg_warp.io.file_mesh import Creases, FileMesh, mesh_of_polygons
from ddg_warp.io.paths import MeshError

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": 0.0254, "pt": 0.0254 / 72.0}
FULL = {"M": -180.0, "V": 180.0}
READ = {"vertices_coords", "faces_vertices", "edges_vertices", "edges_assignment", "edges_foldAngle"}
DESCRIBING = ("file_", "frame_")


def read_fold(path: Path) -> tuple[FileMesh, float | None]:
    """Return (mesh with creases in units of the file, unit of the file [m] or None)."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig", errors="replace"))
    except (ValueError, RecursionError) as error:
        raise MeshError(f"{path}: this is no FOLD file, or it is cut short ({error}); export it again") from error
    if not isinstance(content, dict):
        raise MeshError(f"{path}: the file holds a {type(content).__name__}, not an object of FOLD; export it again")
    points = _rows(content, "vertices_coords", path, (2, 3), float)
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    faces = content.get("faces_vertices")
    if not isinstance(faces, list) or not faces:
        raise MeshError(f"{path}: there are no faces_vertices; export the pattern with its faces")
    sizes = [len(face) if isinstance(face, list) else 0 for face in faces]
    try:
        indices = np.array([corner for face in faces for corner in face])
    except (TypeError, ValueError):
        indices = np.zeros(0)
    if indices.dtype.kind not in "iu" or indices.ndim != 1:
        raise MeshError(f"{path}: faces_vertices are no lists of whole numbers; export the file again")
    unread = [name for name in content if name not in READ and not name.startswith(DESCRIBING)]
    if content.get("file_frames"):
        unread.append(f"{len(content['file_frames'])} further frames (file_frames)")
    name = content.get("frame_title") or content.get("file_title") or path.stem
    mesh = mesh_of_polygons(
        points, sizes, indices, str(path), str(name), creases=_creases(content, len(points), path), unread=unread
    )
    return mesh, UNITS.get(content.get("frame_unit"))


def _creases(content: dict, count: int, path: Path) -> Creases:
    """Return the creases of a sheet of `count` vertices."""
    if "edges_vertices" not in content:
        return Creases(np.zeros((0, 2), int), np.zeros(0, str), np.zeros(0))
    edges = _rows(content, "edges_vertices", path, (2,), int)
    for k in np.flatnonzero(((edges < 0) | (edges >= count)).any(1))[:1]:
        raise MeshError(f"{path}: edge {k} names a vertex that does not exist, there are {count}; correct it")
    kinds = content.get("edges_assignment", ["U"] * len(edges))
    angles = content.get("edges_foldAngle", [None] * len(edges))
    for key, values in (("edges_assignment", kinds), ("edges_foldAngle", angles)):
        if not isinstance(values, list) or len(values) != len(edges):
            raise MeshError(f"{path}: {key} are not one for each of {len(edges)} edges; export the file again")
    angles = [FULL.get(kind, 0.0) if angle is None else angle for angle, kind in zip(angles, kinds, strict=True)]
    for k, angle in enumerate(angles):
        if not isinstance(angle, int | float) or not -180.0 <= angle <= 180.0:
            raise MeshError(f"{path}: the fold angle of edge {k} is {angle!r}; give degrees from -180 to 180")
    return Creases(edges, np.array(kinds, str), np.radians(np.array(angles, float)))


def _rows(content: dict, key: str, path: Path, widths: tuple[int, ...], kind: type) -> np.ndarray:
    """Return an array of rows of numbers."""
    try:
        values = np.array(content.get(key))
    except ValueError:
        values = np.zeros(0)
    numeric = values.dtype.kind in ("iuf" if kind is float else "iu")
    if values.ndim != 2 or values.shape[1] not in widths or not numeric:
        wanted = " or ".join(map(str, widths))
        raise MeshError(f"{path}: {key} are missing, or no rows of {wanted} numbers; export the file again")
    return values.astype(kind)

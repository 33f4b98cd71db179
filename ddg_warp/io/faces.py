"""Polygonal faces of a mesh file, cut into triangles."""

import numpy as np

from ddg_warp.geometry import polygons
from ddg_warp.io.paths import MeshError


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


def corners_of(triangles: np.ndarray, face: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the corner among `indices` at each corner of triangles, shape (T, 3); see `triangulated`."""
    beyond = indices.max() + 1
    keys = np.repeat(np.arange(len(counts)), counts) * beyond + indices
    order = np.argsort(keys, kind="stable")
    return order[np.searchsorted(keys, face[:, None] * beyond + triangles, sorter=order)]


def fans_suit(corners: np.ndarray) -> np.ndarray:
    """Return (F,) bool: True for faces (F, n, 3) that fans from the first corner triangulate well."""
    steps = np.diff(corners, axis=1)[:, 1:], (corners[:, 1:] - corners[:, :1])[:, :-1]
    vectors, normals = np.cross(steps[1], steps[0]), polygons.area_vectors(corners)[:, None]
    sizes = np.linalg.norm(vectors, axis=-1) * np.linalg.norm(normals, axis=-1)
    return polygons.convex(corners) & ((vectors * normals).sum(-1) >= polygons.STEEP * sizes).all(1)

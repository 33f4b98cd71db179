"""Closed polygon tubes around rods, for programs without curves or curve materials."""

from __future__ import annotations

import numpy as np

SIDES = 10


def tube_faces(counts: np.ndarray, closed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces of the tubes, counter-clockwise seen from outside.

    Point p of the rods has the mesh vertices SIDES p ... SIDES p + SIDES - 1, see `tube_points`.

    Args:
        counts: Points of each rod, shape (R,).
        closed: Whether each rod is closed, shape (R,).

    Returns:
        (vertices of each face, shape (faces,); vertex indices, face after face).
    """
    start, end = _edges(counts, closed)
    near, far = np.arange(SIDES), np.roll(np.arange(SIDES), -1)
    a, b = SIDES * start[:, None], SIDES * end[:, None]
    sides = np.stack([a + near, a + far, b + far, b + near], axis=-1).reshape(-1, 4)
    last = np.cumsum(counts) - 1
    first = last - counts + 1
    caps = [SIDES * first[~closed][:, None] + near[::-1], SIDES * last[~closed][:, None] + near]
    sizes = np.concatenate([np.full(len(sides), 4), np.full(2 * np.count_nonzero(~closed), SIDES)])
    return sizes, np.concatenate([sides.ravel(), *(cap.ravel() for cap in caps)])


def tube_triangles(counts: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Return the triangles of tubes without end caps, shape (t, 3); see `tube_faces`."""
    sizes, corners = tube_faces(counts, closed)
    quads = corners[: sizes[sizes == 4].sum()].reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def tube_points(points: np.ndarray, counts: np.ndarray, closed: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the vertices of the tubes [m], shape (SIDES P, 3): a ring around each point, parallel-transported.

    Args:
        points: Positions of the rods [m], shape (P, 3).
        counts: Points of each rod, shape (R,).
        closed: Whether each rod is closed, shape (R,).
        radius: Radius at each point [m], shape (P,).
    """
    tangents = _tangents(points, counts, closed)
    first = _transported(tangents, counts, closed)
    second = np.cross(tangents, first)
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    outward = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    return (points[:, None] + radius[:, None, None] * outward).reshape(-1, 3)


def _edges(counts: np.ndarray, closed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (first point, second point) of every edge, rod after rod."""
    last = np.cumsum(counts) - 1
    start = np.delete(np.arange(counts.sum()), last[~closed])
    after = np.arange(counts.sum()) + 1
    after[last] = last - counts + 1
    return start, after[start]


def _tangents(points: np.ndarray, counts: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Return the mean direction of the edges at each point, shape (P, 3), of length 1."""
    start, end = _edges(counts, closed)
    direction = _unit(points[end] - points[start])
    tangents = np.zeros_like(points)
    np.add.at(tangents, start, direction)
    np.add.at(tangents, end, direction)
    return _unit(tangents)


def _transported(tangents: np.ndarray, counts: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Return a normal at each point, shape (P, 3), parallel-transported from the first point of the rod.

    The holonomy of a closed rod is distributed evenly over its points.
    """
    first = np.cumsum(counts) - counts
    normals = np.zeros_like(tangents)
    axis = np.eye(3)[np.argmin(np.abs(tangents[first]), axis=1)]
    normals[first] = _unit(np.cross(tangents[first], axis))
    for step in range(1, counts.max()):
        index = first[counts > step] + step
        normals[index] = _carried(normals[index - 1], tangents[index - 1], tangents[index])
    last = first + counts - 1
    back = _carried(normals[last], tangents[last], tangents[first])
    sine = np.einsum("ij,ij->i", np.cross(back, normals[first]), tangents[first])
    excess = np.where(closed, np.arctan2(sine, np.einsum("ij,ij->i", back, normals[first])), 0.0)
    fraction = (np.arange(len(tangents)) - np.repeat(first, counts)) / np.repeat(counts, counts)
    angle = (np.repeat(excess, counts) * fraction)[:, None]
    return np.cos(angle) * normals + np.sin(angle) * np.cross(tangents, normals)


def _carried(normal: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the parallel transport of `normal` from the unit vector `before` to `after`, each (k, 3)."""
    axis = np.cross(before, after)
    cosine = np.einsum("ij,ij->i", before, after)[:, None]
    along = np.einsum("ij,ij->i", axis, normal)[:, None] / np.maximum(1.0 + cosine, 1e-12)
    turned = cosine * normal + np.cross(axis, normal) + along * axis
    return _unit(turned - np.einsum("ij,ij->i", turned, after)[:, None] * after)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)

"""Triangulation of polygons in space by ear clipping.

A corner of a simple polygon is an ear if its neighbours see each other past it; clipping it leaves a polygon with one corner less.
Every simple polygon has two (Meisters, Am. Math. Monthly 82, 1975, 648). Lengths are divided by the size of the polygon, so that
tolerances do not depend on scale.
"""

import numpy as np

LEAST = 1e-12  # least area of a polygon over the square of its size
STEEP = 0.5  # cosine of the largest angle between a triangle and the plane of its polygon


def area_vectors(corners: np.ndarray) -> np.ndarray:
    """Return area times unit normal (..., 3) of polygons with corners (..., n, 3), by Newell's rule."""
    around = corners - corners[..., :1, :]
    return 0.5 * np.cross(around, np.roll(around, -1, -2)).sum(-2)


def convex(corners: np.ndarray) -> np.ndarray:
    """Return (F,) bool: True for polygons (F, n, 3) strictly convex seen along their normals, which a fan triangulates."""
    flat = _in_plane(corners)
    steps = np.roll(flat, -1, 1) - flat
    before = np.roll(steps, 1, 1)
    exterior = np.arctan2(_cross(before, steps), (before * steps).sum(-1))
    return (exterior > LEAST).all(1) & (np.abs(exterior.sum(1) - 2.0 * np.pi) < 1.0)


def triangulate(corners: np.ndarray) -> tuple[np.ndarray, str]:
    """Return triangles (n - 2, 3) of the corners (n, 3) of a polygon, and why there are none, empty on success."""
    flat, count = _in_plane(corners), len(corners)
    none = np.zeros((0, 3), int)
    if 0.5 * _cross(flat, np.roll(flat, -1, 0)).sum() <= LEAST:
        return none, "has no area"
    if (np.linalg.norm(np.roll(flat, -1, 0) - flat, axis=1) <= LEAST).any():
        return none, "has an edge without length"
    if _crosses_itself(flat):
        return none, "crosses itself"
    left, triangles = list(range(count)), []
    while len(left) > 3:
        ear = _best_ear(flat[left])
        if ear < 0:
            return none, "intersects itself"
        triangles.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    triangles = np.array([*triangles, left])
    vectors = area_vectors(corners[triangles])
    normal = area_vectors(corners)
    if (vectors @ normal < STEEP * np.linalg.norm(vectors, axis=1) * np.linalg.norm(normal)).any():
        return none, "is far from a plane"
    return triangles, ""


def _in_plane(corners: np.ndarray) -> np.ndarray:
    """Return corners (..., n, 2) seen along the normal, over the size of the polygon, counter-clockwise; zero without area."""
    around = corners - corners.mean(-2, keepdims=True)
    around = around / np.maximum(np.abs(around).max((-2, -1), keepdims=True), np.finfo(float).tiny)
    normal = _unit(area_vectors(around))
    first = _unit(np.cross(normal, np.eye(3)[np.abs(normal).argmin(-1)]))
    return around @ np.stack([first, np.cross(normal, first)], -1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.finfo(float).tiny)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _crosses_itself(flat: np.ndarray) -> bool:
    """Return True if two edges of a polygon (n, 2) cross at an inner point of both."""
    a, b = flat, np.roll(flat, -1, 0)
    side = _cross((b - a)[:, None], flat[None] - a[:, None])  # side of edge i that node j lies on
    crossed = side * np.roll(side, -1, 1) < 0.0
    clear = np.minimum(np.abs(side), np.abs(np.roll(side, -1, 1))) > LEAST
    crossed &= clear
    return bool((crossed & crossed.T).any())


def _best_ear(flat: np.ndarray) -> int:
    """Return the ear of a polygon (n, 2) with the largest smallest angle; -1 without an ear."""
    before, after = np.roll(flat, 1, 0), np.roll(flat, -1, 0)
    sides = flat - before, after - flat, before - after
    area = _cross(sides[0], sides[1])
    lengths = np.stack([np.linalg.norm(side, axis=1) for side in sides])
    # twice the area over the product of the two longest sides is the sine of the smallest angle
    quality = area * lengths.min(0) / np.maximum(lengths.prod(0), np.finfo(float).tiny)
    for ear in np.argsort(-quality):
        if area[ear] <= LEAST:
            return -1
        triangle = np.stack([before[ear], flat[ear], after[ear]])
        inside = np.ones(len(flat), bool)
        for k in range(3):
            inside &= _cross(triangle[(k + 1) % 3] - triangle[k], flat - triangle[k]) >= -LEAST
        corner = (np.abs(flat[:, None] - triangle).max(-1) <= LEAST).any(1)
        if not (inside & ~corner).any():
            return int(ear)
    return -1

"""Polygons in space as triangles, by ears in their plane.

A corner of a simple polygon is an ear if its neighbours see each other past it; clipped, it leaves a polygon with a corner less. Every
simple polygon has two (Meisters, Am. Math. Monthly 82, 1975, 648). Lengths are over the size of the polygon, so that what is told
apart is the same at every scale.
"""

import numpy as np

LEAST = 1e-12  # of the square of a polygon's size, the area from which on it has one
STEEP = 0.5  # cosine of the largest angle between a triangle and the plane of its polygon


def area_vectors(corners: np.ndarray) -> np.ndarray:
    """Area times unit normal of polygons with corners (..., n, 3), by Newell's rule: (..., 3)."""
    around = corners - corners[..., :1, :]
    return 0.5 * np.cross(around, np.roll(around, -1, -2)).sum(-2)


def convex(corners: np.ndarray) -> np.ndarray:
    """Whether polygons (F, n, 3) are strictly convex as seen along their normals: a fan from any corner suits them, (F,)."""
    flat = _in_plane(corners)
    steps = np.roll(flat, -1, 1) - flat
    before = np.roll(steps, 1, 1)
    turns = np.arctan2(_cross(before, steps), (before * steps).sum(-1))
    return (turns > LEAST).all(1) & (np.abs(turns.sum(1) - 2.0 * np.pi) < 1.0)


def triangulate(corners: np.ndarray) -> tuple[np.ndarray, str]:
    """Triangles (n - 2, 3) of the corners (n, 3) of a polygon, and why there are none, empty where there are."""
    flat, count = _in_plane(corners), len(corners)
    none = np.zeros((0, 3), int)
    if 0.5 * _cross(flat, np.roll(flat, -1, 0)).sum() <= LEAST:
        return none, "has no area"
    if (np.linalg.norm(np.roll(flat, -1, 0) - flat, axis=1) <= LEAST).any():
        return none, "has an edge without length"
    if _crosses_itself(flat):
        return none, "crosses itself"
    left, found = list(range(count)), []
    while len(left) > 3:
        ear = _best_ear(flat[left])
        if ear < 0:
            return none, "touches itself"
        found.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    found = np.array([*found, left])
    vectors = area_vectors(corners[found])
    normal = area_vectors(corners)
    if (vectors @ normal < STEEP * np.linalg.norm(vectors, axis=1) * np.linalg.norm(normal)).any():
        return none, "is far from a plane"
    return found, ""


def _in_plane(corners: np.ndarray) -> np.ndarray:
    """Corners (..., n, 2) as seen along the normal, over the size of the polygon, counter-clockwise in all; zero without area."""
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
    """Whether two edges of a polygon (n, 2) cross at an inner point of both."""
    a, b = flat, np.roll(flat, -1, 0)
    side = _cross((b - a)[:, None], flat[None] - a[:, None])  # of edge i, where node j is
    apart = side * np.roll(side, -1, 1) < 0.0
    clear = np.minimum(np.abs(side), np.abs(np.roll(side, -1, 1))) > LEAST
    apart &= clear
    return bool((apart & apart.T).any())


def _best_ear(flat: np.ndarray) -> int:
    """The ear of a polygon (n, 2) whose smallest angle is the largest; -1 where there is none."""
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

"""Random scenes for the contact search, and the expected pairs by all pairs in NumPy."""

import numpy as np
import warp as wp

from ddg_warp.solve.collision.collision_mesh import BALLS, CollisionMesh

SIDES = ((2, 2), (1, 3))  # numbers of nodes of the two primitives of a pair, without balls


def upload(x: np.ndarray, device: str, dtype=wp.vec3d) -> wp.array:
    return wp.array(np.ascontiguousarray(x), dtype=dtype, device=device)


def candidate_pairs(search) -> list[np.ndarray]:
    """Return the pairs (n, 2) of each candidate list, in order."""
    return [pairs.pairs.numpy()[: pairs.count.numpy()[0]] for pairs in search.lists]


def curves(rng, rods: int, nodes: int, spread: float, step: float) -> np.ndarray:
    """Return random walks with a persistent direction from starts within a cube (rods * nodes, 3)."""
    steps = rng.normal(size=(rods, nodes, 3)).cumsum(axis=1)
    steps *= step / np.linalg.norm(steps, axis=2, keepdims=True)
    return (rng.uniform(0.0, spread, (rods, 1, 3)) + steps.cumsum(axis=1)).reshape(-1, 3)


def soup(rng, triangles: int, spread: float, size: float) -> np.ndarray:
    """Return the corners of disjoint triangles (3 * triangles, 3)."""
    return (rng.uniform(0.0, spread, (triangles, 1, 3)) + rng.uniform(-size, size, (triangles, 3, 3))).reshape(-1, 3)


def scene(
    seed: int, spread: float, rods: int = 50, nodes: int = 21, triangles: int = 500
) -> tuple[CollisionMesh, np.ndarray]:
    """Return rods of 1,000 edges in all and 500 triangles of five shells, and the points."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([curves(rng, rods, nodes, spread, 0.05), soup(rng, triangles, spread, 0.04)])
    shapes = CollisionMesh(points)
    for r in range(rods):
        shapes.rod(r * nodes + np.arange(nodes), 0.003 + 0.001 * (r % 3), closed=r % 5 == 4)
    loose = rods * nodes + np.arange(3 * triangles).reshape(-1, 3)
    for part in np.array_split(loose, min(5, triangles)):
        shapes.shell(part, 0.004)
    return shapes, points


def point_edge(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distances of points from edges (..., 3)."""
    u = b - a
    square = np.maximum((u * u).sum(-1), 1e-300)
    s = np.clip(((p - a) * u).sum(-1) / square, 0.0, 1.0)
    return np.linalg.norm(p - a - s[..., None] * u, axis=-1)


def edge_edge(a0, a1, b0, b1) -> np.ndarray:
    """Return the distances of edges (..., 3): from an end, or between the lines where both closest points are interior."""
    ends = [point_edge(a0, b0, b1), point_edge(a1, b0, b1), point_edge(b0, a0, a1), point_edge(b1, a0, a1)]
    best = np.min(ends, axis=0)
    u, v, w = a1 - a0, b1 - b0, b0 - a0
    uu, uv, vv = ((p * q).sum(-1) for p, q in ((u, u), (u, v), (v, v)))
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    det = uu * vv - uv * uv
    sound = det > 1e-12 * uu * vv
    det = np.where(sound, det, 1.0)
    s, t = (uw * vv - vw * uv) / det, (uw * uv - vw * uu) / det
    inside = sound & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    s, t = np.where(inside, s, 0.0), np.where(inside, t, 0.0)
    lines = np.linalg.norm(s[..., None] * u - t[..., None] * v - w, axis=-1)
    return np.where(inside, np.minimum(best, lines), best)


def point_triangle(p, a, b, c) -> np.ndarray:
    """Return the distances of points from triangles (..., 3)."""
    best = np.min([point_edge(p, a, b), point_edge(p, b, c), point_edge(p, c, a)], axis=0)
    n = np.cross(b - a, c - a)
    length = np.linalg.norm(n, axis=-1)
    sound = length > 0
    n = n / np.where(sound, length, 1.0)[..., None]
    height = ((p - a) * n).sum(-1)
    foot = p - height[..., None] * n
    sides = [(np.cross(r - q, foot - q) * n).sum(-1) for q, r in ((a, b), (b, c), (c, a))]
    inside = sound & (np.min(sides, axis=0) >= 0)
    return np.where(inside, np.abs(height), best)


def admissible_pairs(shapes: CollisionMesh, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (n,), (n,) of pairs of primitives that are not excluded, by numbers of nodes."""
    nodes_a, _, owner_a, span_a = shapes.primitives(first)
    nodes_b, _, owner_b, _ = shapes.primitives(second)
    fits = ~(nodes_a[:, None, :, None] == nodes_b[None, :, None, :]).any((2, 3))
    lower, upper = np.minimum(owner_a[:, None], owner_b), np.maximum(owner_a[:, None], owner_b)
    fits &= ~np.isin(lower * len(shapes.names) + upper, shapes.ignored)
    still = np.array(sorted(shapes.obstacle), int)
    fits &= ~(np.isin(lower, still) & np.isin(upper, still))
    if second == BALLS and first == 2:
        fits &= span_a[:, 3:] >= 0.0
    if first == second:
        fits &= np.arange(len(nodes_a))[:, None] < np.arange(len(nodes_b))
    if first == second != BALLS:
        middle, half = 0.5 * (span_a[:, 0] + span_a[:, 1]), 0.5 * (span_a[:, 1] - span_a[:, 0])
        along = np.abs(middle[:, None] - middle)
        loop = span_a[:, 2]
        along = np.where(loop > 0, np.minimum(along, loop - along), along) - half[:, None] - half
        fits &= ~((owner_a[:, None] == owner_b) & (along < span_a[:, 3:]))
    return np.nonzero(fits)


def distances(shapes: CollisionMesh, x: np.ndarray, first: int, second: int, i, j) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances and thicknesses (n,) of pairs."""
    nodes_a, radius_a, *_ = shapes.primitives(first)
    nodes_b, radius_b, *_ = shapes.primitives(second)
    corners = [*np.moveaxis(x[nodes_a[i]], 1, 0), *np.moveaxis(x[nodes_b[j]], 1, 0)]
    if first == second == BALLS:
        return np.linalg.norm(corners[0] - corners[1], axis=-1), radius_a[i] + radius_b[j]
    if second == BALLS:
        return point_edge(corners[2], *corners[:2]), radius_a[i] + radius_b[j]
    return (edge_edge if first == 2 else point_triangle)(*corners), radius_a[i] + radius_b[j]


def near_pairs(
    shapes: CollisionMesh, x: np.ndarray, first: int, second: int, search_distance: float
) -> set[tuple[int, int]]:
    """Return the pairs with a gap of at most `search_distance`."""
    i, j = admissible_pairs(shapes, first, second)
    balls = []
    for size in (first, second):
        nodes, radius, *_ = shapes.primitives(size)
        middle = x[nodes].mean(1)
        balls.append((middle, np.linalg.norm(x[nodes] - middle[:, None], axis=2).max(1) + radius))
    (centre_a, extent_a), (centre_b, extent_b) = balls
    hit = np.linalg.norm(centre_a[i] - centre_b[j], axis=1) <= extent_a[i] + extent_b[j] + search_distance
    i, j = i[hit], j[hit]
    d, thickness = distances(shapes, x, first, second, i, j)
    close = d - thickness <= search_distance
    return set(zip(i[close].tolist(), j[close].tolist(), strict=True))

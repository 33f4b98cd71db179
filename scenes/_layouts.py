"""Layouts of many rods without overlap: random sequential addition and overlap resolution."""

import numpy as np


def random(seed: int):
    """Return the random generator of a seed.

    Raises:
        ValueError: the seed is negative.
    """
    if seed < 0:
        raise ValueError("random numbers have a seed of 0 or more")
    return np.random.default_rng(seed)


def placed_apart(rng, count: int, length: float, separation: float, size, height: float) -> np.ndarray:
    """Return straight rods at random positions and directions in a box without overlap (random sequential addition).

    Args:
        rng: random generator.
        count: number of rods.
        length: length of a rod [m].
        apart: least distance of two axes, and half of it of an axis and the box [m].
        size: the box is 0 <= x <= size[0], 0 <= y <= size[1] [m].
        height: initial height of the box [m]; it grows where no room is left.

    Returns:
        First and last points (count, 2, 3) [m], at heights of 0 or more.
    """
    placed, half = np.empty((count, 2, 3)), 0.5 * separation
    slabs: dict[int, list[int]] = {}
    done, tried = 0, 0
    while done < count:
        direction = rng.normal(size=3)
        direction *= length / np.linalg.norm(direction)
        spare = np.array([*size, height]) - 2.0 * half - np.abs(direction)
        tried += 1
        if tried > 200:  # no room is left
            tried, height = 0, height + 0.25 * length
        if (spare < 0.0).any():
            continue
        start = half + rng.uniform(size=3) * spare + np.maximum(0.0, -direction)
        end = start + direction
        slab = int(0.5 * (start[2] + end[2]) // length)
        near = [i for k in (slab - 1, slab, slab + 1) for i in slabs.get(k, ())]
        if near and distances(start, end, placed[near]).min() < separation:
            continue
        placed[done] = start, end
        slabs.setdefault(slab, []).append(done)
        done, tried = done + 1, 0
    return placed


def distances(start: np.ndarray, end: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Return distances (n,) of a segment, or of n segments, from segments (n, 2, 3); none is a point."""
    return np.linalg.norm(_between(start, end, *np.moveaxis(segments, 1, 0))[0], axis=1)


def _between(a, b, c, d) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vectors from segments c-d to segments a-b (n, 3) and the parameters (n,) of both closest points.

    Source: Ericson, Real-Time Collision Detection, 5.1.9.
    """
    u, v, r = b - a, d - c, a - c
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    ur, vr = (u * r).sum(-1), (v * r).sum(-1)
    s = np.clip((uv * vr - ur * vv) / np.maximum(uu * vv - uv * uv, 1e-12 * uu * vv), 0.0, 1.0)
    t = np.clip((uv * s + vr) / vv, 0.0, 1.0)
    s = np.clip((uv * t - ur) / uu, 0.0, 1.0)
    return r + s[:, None] * u - t[:, None] * v, s, t


def resolve_overlaps(points: np.ndarray, apart: float, held: int = 0, rounds: int = 400) -> np.ndarray:
    """Move nodes of rods (rods, nodes, 3) until edges of two rods are `apart` [m] apart; the first `held` nodes are fixed.

    Edges that are too close move by equal amounts along the line between closest points, so that crossing rods separate.

    Raises:
        ValueError: rods still overlap after `rounds` rounds.
    """
    rods, nodes, _ = points.shape
    flat = points.reshape(-1, 3).copy()
    first = np.delete(np.arange(len(flat)).reshape(rods, nodes), -1, axis=1).ravel()
    free = np.tile(np.arange(nodes) >= held, rods)
    since, near = np.inf, None
    for _ in range(rounds):
        if since > apart:  # each edge of a pair may have moved by this much
            near, since = _near(flat, first, nodes, 4.0 * apart), 0.0
        first_edge, second = near.T
        away, s, t = _between(flat[first_edge], flat[first_edge + 1], flat[second], flat[second + 1])
        distance = np.linalg.norm(away, axis=1)
        close = np.flatnonzero(distance < apart)
        if not len(close):
            return flat.reshape(points.shape)
        correction = away[close] / np.maximum(distance[close], 1e-12)[:, None]
        correction *= 0.5 * (1.02 * apart - distance[close])[:, None]
        moved, weights = np.zeros_like(flat), np.full(len(flat), 1e-12)
        for edge, parameter, shift in ((first_edge, s, correction), (second, t, -correction)):
            for node, weight in ((edge[close], 1.0 - parameter[close]), (edge[close] + 1, parameter[close])):
                np.add.at(moved, node, weight[:, None] * shift)
                np.add.at(weights, node, weight**2)
        moved *= (free / np.maximum(1.0, weights))[:, None]
        flat += moved
        since += np.linalg.norm(moved, axis=1).max()
    raise ValueError(
        f"{len(close)} pairs of edges are still closer than {apart:.3g} m after {rounds} rounds; take fewer or thinner rods"
    )


def _near(flat: np.ndarray, first: np.ndarray, nodes: int, within: float) -> np.ndarray:
    """Return pairs (n, 2) of edges of two rods, each by its first node, within a distance [m]."""
    from scipy.spatial import cKDTree

    middle = 0.5 * (flat[first] + flat[first + 1])
    tree, pairs = cKDTree(middle), []
    reach = np.linalg.norm(flat[first + 1] - flat[first], axis=1).max() + within
    for chunk in np.array_split(np.arange(len(first)), -(-len(first) // 20000)):
        each = tree.query_ball_point(middle[chunk], reach)
        first_edge, second = np.repeat(chunk, list(map(len, each))), np.concatenate(each).astype(int)
        first_edge, second = first[first_edge], first[second]
        kept = (first_edge < second) & (first_edge // nodes != second // nodes)
        first_edge, second = first_edge[kept], second[kept]
        away, *_ = _between(flat[first_edge], flat[first_edge + 1], flat[second], flat[second + 1])
        kept = np.linalg.norm(away, axis=1) < within
        pairs.append(np.stack([first_edge[kept], second[kept]], axis=1))
    return np.concatenate(pairs)

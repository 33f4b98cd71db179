"""Layouts of many rods that do not overlap: placed at random, or pushed apart."""

import numpy as np


def random(seed: int):
    """Random numbers of a seed.

    Raises:
        ValueError: the seed is negative.
    """
    if seed < 0:
        raise ValueError("random numbers have a seed of 0 or more")
    return np.random.default_rng(seed)


def placed_apart(rng, count: int, length: float, apart: float, size, height: float) -> np.ndarray:
    """Straight rods of random places and directions in a box, none closer to another than `apart` (random sequential addition).

    Args:
        rng: random numbers.
        count: rods.
        length: of a rod [m].
        apart: least distance of two axes, and half of it of an axis and the box [m].
        size: of the box, 0 <= x <= size[0] and 0 <= y <= size[1] [m].
        height: that the box begins with [m]; it grows where there is no room left.

    Returns:
        First and last points (count, 2, 3) [m], the lowest 0 or more above the ground.
    """
    placed, half = np.empty((count, 2, 3)), 0.5 * apart
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
        if near and distances(start, end, placed[near]).min() < apart:
            continue
        placed[done] = start, end
        slabs.setdefault(slab, []).append(done)
        done, tried = done + 1, 0
    return placed


def distances(start: np.ndarray, end: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distances (n,) of a segment, or of n, from others (n, 2, 3); none is a point."""
    return np.linalg.norm(_between(start, end, *np.moveaxis(others, 1, 0))[0], axis=1)


def _between(a, b, c, d) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From segments c-d to segments a-b (n, 3), and shares (n,) of both at which they are closest.

    Ericson, Real-Time Collision Detection, 5.1.9.
    """
    u, v, r = b - a, d - c, a - c
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    ur, vr = (u * r).sum(-1), (v * r).sum(-1)
    s = np.clip((uv * vr - ur * vv) / np.maximum(uu * vv - uv * uv, 1e-12 * uu * vv), 0.0, 1.0)
    t = np.clip((uv * s + vr) / vv, 0.0, 1.0)
    s = np.clip((uv * t - ur) / uu, 0.0, 1.0)
    return r + s[:, None] * u - t[:, None] * v, s, t


def pushed_apart(points: np.ndarray, apart: float, held: int = 0, rounds: int = 400) -> np.ndarray:
    """Rods (rods, nodes, 3) with nodes moved until edges of two rods are not closer than `apart` [m]; the first `held` nodes stay.

    What is too close is pushed apart along the line between, by equal parts; so rods that cross become rods that pass by.

    Raises:
        ValueError: they still overlap after so many rounds.
    """
    rods, nodes, _ = points.shape
    flat = points.reshape(-1, 3).copy()
    first = np.delete(np.arange(len(flat)).reshape(rods, nodes), -1, axis=1).ravel()
    free = np.tile(np.arange(nodes) >= held, rods)
    since, near = np.inf, None
    for _ in range(rounds):
        if since > apart:  # two edges may both have moved by so much
            near, since = _near(flat, first, nodes, 4.0 * apart), 0.0
        one, other = near.T
        away, s, t = _between(flat[one], flat[one + 1], flat[other], flat[other + 1])
        distance = np.linalg.norm(away, axis=1)
        close = np.flatnonzero(distance < apart)
        if not len(close):
            return flat.reshape(points.shape)
        way = away[close] / np.maximum(distance[close], 1e-12)[:, None]
        way *= 0.5 * (1.02 * apart - distance[close])[:, None]
        moved, shares = np.zeros_like(flat), np.full(len(flat), 1e-12)
        for edge, share, push in ((one, s, way), (other, t, -way)):
            for node, part in ((edge[close], 1.0 - share[close]), (edge[close] + 1, share[close])):
                np.add.at(moved, node, part[:, None] * push)
                np.add.at(shares, node, part**2)
        moved *= (free / np.maximum(1.0, shares))[:, None]
        flat += moved
        since += np.linalg.norm(moved, axis=1).max()
    raise ValueError(
        f"{len(close)} pairs of edges are still closer than {apart:.3g} m after {rounds} rounds; take fewer or thinner rods"
    )


def _near(flat: np.ndarray, first: np.ndarray, nodes: int, within: float) -> np.ndarray:
    """Pairs (n, 2) of edges of two rods, each by its first node, that are not farther than `within` from each other [m]."""
    from scipy.spatial import cKDTree

    middle = 0.5 * (flat[first] + flat[first + 1])
    tree, found = cKDTree(middle), []
    reach = np.linalg.norm(flat[first + 1] - flat[first], axis=1).max() + within
    for part in np.array_split(np.arange(len(first)), -(-len(first) // 20000)):
        each = tree.query_ball_point(middle[part], reach)
        one, other = np.repeat(part, list(map(len, each))), np.concatenate(each).astype(int)
        one, other = first[one], first[other]
        kept = (one < other) & (one // nodes != other // nodes)
        one, other = one[kept], other[kept]
        away, *_ = _between(flat[one], flat[one + 1], flat[other], flat[other + 1])
        kept = np.linalg.norm(away, axis=1) < within
        found.append(np.stack([one[kept], other[kept]], axis=1))
    return np.concatenate(found)

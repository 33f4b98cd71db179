"""Layouts of many rods without overlap: random sequential addition and overlap resolution."""

import math

import numpy as np

from ddg_warp.geometry import polyline

PATIENCE = 200  # failures in a row, after which the box of `placed_apart` grows
PIECES = 3  # of a rod, in the search for near ones
BATCH = 2000  # rods that are searched together


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

    Trials up to the next growth of the box are tested together, and accepted in their order.

    Args:
        rng: random generator.
        count: number of rods.
        length: length of a rod [m].
        separation: least distance of two axes, and half of it of an axis and the box [m].
        size: the box is 0 <= x <= size[0], 0 <= y <= size[1] [m].
        height: initial height of the box [m]; it grows where no room is left.

    Returns:
        First and last points (count, 2, 3) [m], at heights of 0 or more.
    """
    placed, done, failed = np.empty((count, 2, 3)), 0, 0
    batches = []  # all but the last placed rods
    while done < count:
        trials = PATIENCE + 1 - failed
        trial, rods = _trials(rng, trials, length, separation, np.array([*size, height]))
        last = BATCH * len(batches)
        for batch in (*batches, _pieces(placed[last:done])):
            free = np.delete(np.arange(len(rods)), _overlaps(_pieces(rods), batch, separation)[0])
            trial, rods = trial[free], rods[free]
        taken: set[int] = set()
        earlier: list[list] = [[] for _ in rods]
        for rod, neighbour in zip(*_overlaps(_pieces(rods), _pieces(rods), separation).tolist(), strict=True):
            earlier[rod] += [neighbour] * (neighbour < rod)
        for rod, neighbours in enumerate(earlier):
            taken |= {rod} if taken.isdisjoint(neighbours) else set()
        accepted = sorted(taken)[: count - done]
        placed[done : done + len(accepted)] = rods[accepted]
        done += len(accepted)
        batches += [_pieces(placed[last : last + BATCH])] if done - last >= BATCH else []
        if not accepted or trial[accepted[0]] == trials - 1:  # no room is left
            failed, height = 0, height + 0.25 * length
        else:
            failed = trials - 1 - trial[accepted[-1]]
    return placed


def _trials(rng, count: int, length: float, separation: float, size) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (n,) of the trials that fit into a box, of `count`, and their first and last points (n, 2, 3)."""
    room, trial, directions, places = size - separation, [], [], []
    for number in range(count):
        direction = rng.normal(size=3)
        direction *= length / math.sqrt(direction.dot(direction))
        if (np.abs(direction) <= room).all():
            trial.append(number)
            directions.append(direction)
            places.append(rng.uniform(size=3))
    direction, place = (np.array(values).reshape(-1, 3) for values in (directions, places))
    start = 0.5 * separation + place * (room - np.abs(direction)) + np.maximum(0.0, -direction)
    return np.array(trial, int), np.stack([start, start + direction], axis=1)


def _pieces(rods: np.ndarray) -> tuple:
    """Return straight rods (n, 2, 3) and the tree of the middles of `PIECES` equal pieces of each, rod by rod."""
    from scipy.spatial import cKDTree

    along = (np.arange(PIECES)[:, None] + 0.5) / PIECES
    middles = rods[:, :1] + along * (rods[:, 1:] - rods[:, :1])
    return rods, cKDTree(middles.reshape(-1, 3), balanced_tree=False)


def _overlaps(first: tuple, second: tuple, separation: float) -> np.ndarray:
    """Return pairs (2, n) of rods of one length, of two results of `_pieces`, that are closer than `separation`."""
    (rods, tree), (candidates, candidates_tree) = first, second
    within = np.linalg.norm(np.diff(rods, axis=1), axis=-1).max(initial=0.0) / PIECES + separation
    near = tree.sparse_distance_matrix(candidates_tree, 1.001 * within, output_type="ndarray")
    pairs = np.stack([near["i"], near["j"]]) // PIECES
    return pairs[:, distances(*rods[pairs[0]].swapaxes(0, 1), candidates[pairs[1]]) < separation]


def distances(start: np.ndarray, end: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Return distances (n,) of a segment, or of n segments, from segments (n, 2, 3); none is a point."""
    return polyline.length(_between(start, end, *np.moveaxis(segments, 1, 0))[0])


def _between(a, b, c, d) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vectors from segments c-d to segments a-b (n, 3) and the parameters (n,) of both closest points.

    Source: Ericson, Real-Time Collision Detection, 5.1.9.
    """
    u, v, r = b - a, d - c, a - c
    dot = polyline.dot
    uu, vv, uv, ur, vr = dot(u, u), dot(v, v), dot(u, v), dot(u, r), dot(v, r)
    s = np.clip((uv * vr - ur * vv) / np.maximum(uu * vv - uv * uv, 1e-12 * uu * vv), 0.0, 1.0)
    t = np.clip((uv * s + vr) / vv, 0.0, 1.0)
    s = np.clip((uv * t - ur) / uu, 0.0, 1.0)
    return r + s[:, None] * u - t[:, None] * v, s, t


def resolve_overlaps(points: np.ndarray, min_distance: float, num_fixed: int = 0, rounds: int = 400) -> np.ndarray:
    """Move nodes of rods (rods, nodes, 3) until edges of two rods are `min_distance` [m] apart; the first `num_fixed` nodes are fixed.

    Edges that are too close move by equal amounts along the line between closest points, so that crossing rods separate.

    Raises:
        ValueError: rods still overlap after `rounds` rounds.
    """
    rods, nodes, _ = points.shape
    flat = points.reshape(-1, 3).copy()
    first = np.delete(np.arange(len(flat)).reshape(rods, nodes), -1, axis=1).ravel()
    free = np.tile(np.arange(nodes) >= num_fixed, rods)
    since, near = np.inf, None
    for _ in range(rounds):
        if since > min_distance:  # each edge of a pair may have moved by this much
            near, since = _near(flat, first, nodes, 4.0 * min_distance), 0.0
        first_edge, second = near.T
        away, s, t = _between(flat[first_edge], flat[first_edge + 1], flat[second], flat[second + 1])
        distance = np.linalg.norm(away, axis=1)
        close = np.flatnonzero(distance < min_distance)
        if not len(close):
            return flat.reshape(points.shape)
        correction = away[close] / np.maximum(distance[close], 1e-12)[:, None]
        correction *= 0.5 * (1.02 * min_distance - distance[close])[:, None]
        moved, weights = np.zeros_like(flat), np.full(len(flat), 1e-12)
        for edge, parameter, shift in ((first_edge, s, correction), (second, t, -correction)):
            for node, weight in ((edge[close], 1.0 - parameter[close]), (edge[close] + 1, parameter[close])):
                np.add.at(moved, node, weight[:, None] * shift)
                np.add.at(weights, node, weight**2)
        moved *= (free / np.maximum(1.0, weights))[:, None]
        flat += moved
        since += np.linalg.norm(moved, axis=1).max()
    raise ValueError(
        f"{len(close)} pairs of edges are still closer than {min_distance:.3g} m after {rounds} rounds; take fewer or thinner rods"
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

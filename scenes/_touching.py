"""What scenes of many rods that touch share: what is observed and checked of contact, and layouts that do not overlap."""

import numpy as np

import ddg_warp as ddg
from ddg_warp.io.tube import SIDES, tube_faces, tube_points
from ddg_warp.solve.tangent import Tangent

HALVED = 0.1  # of all solves, those that may fail before their step is taken in halves
GREY = 0.75  # brightness of obstacles in pictures
CROWDED = "nothing passes through anything"


def observe(model, state) -> dict[str, float]:
    """Pairs in contact, distinct pairs of rods among them, momentum [N s], kinetic and whole energy [J], force on obstacles [N]."""
    found, energies = model.contacts(state), model.energies(state)
    between = found.objects[(found.objects < rods_of(model)).all(axis=1)]
    pairs = np.unique(np.sort(between, axis=1), axis=0)
    held = model.reactions(state)[len(model.scene.supports) :]
    return {
        "contacts": float(len(found)),
        "touching_rods": float((pairs[:, 0] != pairs[:, 1]).sum()),
        "momentum": float(momentum(model, state)[2]),
        "kinetic": energies["kinetic"],
        "energy": sum(energies.values()),
        # what carries an obstacle pushes it up by as much as it is pressed down
        "carried": float(sum(reaction.force[2] for reaction in held)),
    }


def rods_of(model) -> int:
    """Rods of the scene."""
    return model.scene.rod_count


def mass(model) -> float:
    """Of all rods and shells [kg]."""
    return float(_masses(model).sum())


def momentum(model, state) -> np.ndarray:
    """Of all rods and shells (3,) [N s]."""
    each = _masses(model)
    return each @ state.net.v.numpy()[: len(each)].astype(float)


def weight(model) -> float:
    """Weight of all rods and shells [N]."""
    return float(mass(model) * np.linalg.norm(model.scene.gravity))


def checks(result) -> list[ddg.Check]:
    """Converged, finite, nothing passed through anything, and nothing overlaps."""
    outcomes, contact = result.statistics["outcomes"], result.statistics["contact"]
    failed = sum(number for name, number in outcomes.items() if not name.startswith("converged"))
    share = failed / max(1, sum(outcomes.values()))
    series = [np.array(values) for values in result.series.values()]
    finite = np.isfinite(result.state.points()).all() and all(np.isfinite(values).all() for values in series)
    gap = contact["smallest_gap"]
    return [
        ddg.Check("solves taken again in halves, of all", share, 0.0, HALVED, "what was taken converged"),
        ddg.Check("values that are not finite", float(not finite), 0.0, 0.0),
        ddg.Check("pairs that passed through each other", contact["refused_crossings"], 0.0, 0.0, CROWDED),
        ddg.Check("overlap of surfaces [m]", max(0.0, -gap) if gap else np.nan, 0.0, 0.0, "the barrier"),
    ]


def energy_check(result, work: np.ndarray | float = 0.0, tolerance: float = 1e-4) -> ddg.Check:
    """The most that energy rises above an earlier value, over what there was of it to lose.

    Args:
        result: the run
        work: of what moves supports and obstacles up to each time (times,) [J], which is no rise; that of a step is the force at
            its end times the way
        tolerance: of the share; gaps are no convex functions of positions, so that implicit Euler may make some energy where
            something is run into, the less the shorter the step is
    """
    left = np.array(result.series["energy"]) - work
    gained = float((left - np.minimum.accumulate(left)).max() / max(np.ptp(left), 1e-300))
    return ddg.Check("energy created over energy lost", gained, 0.0, tolerance, "but for work; friction takes it")


def weight_check(result, tolerance: float) -> ddg.Check:
    """Force of obstacles less inertia the momentum, over the weight: the median of the last quarter of the run.

    By implicit Euler the force at the end of a step acts throughout it, so that this holds in motion as at rest.
    """
    times, carried, momentum = (
        np.array(v) for v in (result.times, result.series["carried"], result.series["momentum"])
    )
    last = slice(-max(1, len(times) // 4), None)
    inertia = np.diff(momentum) / np.diff(times) + result.model.scene.mass_damping * momentum[1:]
    found = (carried[1:] - inertia)[last] / weight(result.model)
    return ddg.Check("force of obstacles less inertia over weight", np.median(found), 1.0, tolerance, "Newton")


def colors(model) -> np.ndarray:
    """RGB (rods, 3), each rod in a color of its own."""
    return np.random.default_rng(1).uniform(0.1, 0.85, (rods_of(model), 3))


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


def _masses(model) -> np.ndarray:
    """Of the nodes of a net [kg], without those that obstacles have."""
    host = model.net.host
    first = min((int(nodes.min()) for nodes in host.obstacles), default=host.nodes)
    return host.mass[:first, 0]


def kept_apart(result) -> list[ddg.Check]:
    """Nothing passed through anything, and surfaces that a barrier keeps apart never overlapped."""
    found = result.statistics["contact"]
    checks = [ddg.Check("pairs that passed through each other", found["refused_crossings"], 0.0, 0.0)]
    if result.model.scene.touching.law == "barrier":
        overlap = max(0.0, -found["smallest_gap"])
        checks.append(ddg.Check("largest overlap of surfaces [m]", overlap, 0.0, 0.0, "the barrier"))
    return checks


def jitter(shape: tuple, seed: int) -> np.ndarray:
    """Random numbers between -1 and 1, the same for the same seed; zeros for one below 0."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape) if seed >= 0 else np.zeros(shape)


def jittered(model, seed: int):
    """The first state, with what is not held moved by up to a fifth of the range of contact, at random; see `jitter`."""
    tangent, points = Tangent(model), model.state().points()
    free = tangent.at_points(tangent.free.astype(float))
    return model.state(points=points + 0.2 * model.scene.touching.range * free * jitter(points.shape, seed))


def smallest_gap(model, state) -> float:
    """The smallest gap of what is within the range of contact [m], the range where nothing is."""
    gap = model.contacts(state).gap
    return float(gap.min()) if len(gap) else float(model.scene.touching.range)


def tubes(model, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m] and triangles (t, 3) of all rods of the first world, as thick as they are, open at their ends."""
    counts, closed = np.asarray(model.curves.counts), np.asarray(model.curves.closed)
    radius = [np.full(batch.rods * batch.nodes, np.max(batch.section.radius)) for batch in model.scene.batches]
    sizes, corners = tube_faces(counts, closed)
    quads = corners[: sizes[sizes == 4].sum()].reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return tube_points(points, counts, closed, np.concatenate(radius)), triangles


def colored_tubes(model, points: np.ndarray, t: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same with RGB of each triangle (t, 3), each rod in a color of its own, and in grey the obstacles at a time [s]."""
    own = tubes(model, points)
    rod = np.searchsorted(SIDES * np.cumsum(model.curves.counts), own[1][:, 0], side="right")
    bodies = [own]
    if model.obstacles is not None:
        moved = [each.motion.place(t, each.shape.points) for each in model.scene.obstacles if each.motion is not None]
        bodies.append(model.obstacles.surface(np.concatenate(moved) if moved else None))
    points, triangles = joined(*bodies)
    return points, triangles, np.concatenate([colors(model)[rod], np.full((len(triangles) - len(rod), 3), GREY)])


def joined(*bodies: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """One mesh of several."""
    first = np.cumsum([0] + [len(points) for points, _ in bodies])
    return np.concatenate([points for points, _ in bodies]), np.concatenate(
        [triangles + offset for (_, triangles), offset in zip(bodies, first[:-1], strict=True)]
    )

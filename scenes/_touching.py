"""What scenes of many rods that touch share: what is observed and checked of contact, and layouts that do not overlap."""

import numpy as np

import ddg_warp as ddg
from ddg_warp.io.tube import SIDES, tube_faces, tube_points
from ddg_warp.solve.tangent import Tangent

HALVED = 0.1  # of all solves, those that may fail before their step is taken in halves
GREY = 0.75  # brightness of obstacles in pictures
CROWDED = "nothing passes through anything"


def rubbing(friction: float, **how) -> dict:
    """Arguments of `Scene.contact` about friction: the coefficient, and how it acts where there is any."""
    return {"friction": friction, **(how if friction else {})}


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


def checks(result, refused: int = 0) -> list[ddg.Check]:
    """Converged, finite, and what `kept_apart` says."""
    outcomes = result.statistics["outcomes"]
    failed = sum(number for name, number in outcomes.items() if not name.startswith("converged"))
    share = failed / max(1, sum(outcomes.values()))
    series = [np.array(values) for values in result.series.values()]
    finite = np.isfinite(result.state.points()).all() and all(np.isfinite(values).all() for values in series)
    return [
        ddg.Check("solves taken again in halves, of all", share, 0.0, HALVED, "what was taken converged"),
        ddg.Check("values that are not finite", float(not finite), 0.0, 0.0),
        *kept_apart(result, refused),
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


def _masses(model) -> np.ndarray:
    """Of the nodes of a net [kg], without those that obstacles have."""
    host = model.net.host
    first = min((int(nodes.min()) for nodes in host.obstacles), default=host.nodes)
    return host.mass[:first, 0]


def kept_apart(result, refused: int = 0) -> list[ddg.Check]:
    """Nothing passed through anything, and surfaces never overlapped.

    `refused`: pairs that may have seemed to pass, by the straight line between both ends of steps that were then taken in halves.
    """
    found = result.statistics["contact"]
    gap, seemed = found["smallest_gap"], found["refused_crossings"]
    return [
        ddg.Check("pairs that seemed to pass, in steps not taken", seemed, 0.0, refused, CROWDED),
        ddg.Check("largest overlap of surfaces [m]", max(0.0, -gap) if gap else np.nan, 0.0, 0.0, "the barrier"),
    ]


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

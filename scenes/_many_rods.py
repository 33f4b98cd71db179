"""Shared pieces of scenes of many rods in contact: observed quantities, checks, jitter and pictures."""

import numpy as np

import ddg_warp as ddg
from ddg_warp.solve.equilibrium.tangent import Tangent

HALVED = 0.1  # allowed fraction of failed solves, whose steps are then halved
CROWDED = "nothing passes through anything"


def friction_options(friction: float, **how) -> dict:
    """Return the friction arguments of `Scene.contact`; options only for a positive coefficient."""
    return {"friction": friction, **(how if friction else {})}


def observe(model, state) -> dict[str, float]:
    """Return numbers of contacts and of rod pairs in contact, vertical momentum [N s], energies [J], and vertical force [N]."""
    contacts, energies = model.contacts(state), model.energies(state)
    between = contacts.objects[(contacts.objects < rods_of(model)).all(axis=1)]
    pairs = np.unique(np.sort(between, axis=1), axis=0)
    obstacles = model.reactions(state)[len(model.scene.supports) :]
    return {
        "contacts": float(len(contacts)),
        "touching_rods": float((pairs[:, 0] != pairs[:, 1]).sum()),
        "momentum": float(momentum(model, state)[2]),
        "kinetic": energies["kinetic"],
        "energy": sum(energies.values()),
        # reactions on obstacles are opposite to contact forces on them
        "carried": float(sum(reaction.force[2] for reaction in obstacles)),
    }


def rods_of(model) -> int:
    """Return the number of rods of the scene."""
    return model.scene.rod_count


def mass(model) -> float:
    """Return the mass of all rods, shells and rigid bodies [kg]."""
    return float(masses(model).sum())


def momentum(model, state) -> np.ndarray:
    """Return the momentum (3,) of all rods, shells and rigid bodies [N s]."""
    each = masses(model)
    return each @ state.coupled.v.numpy()[: len(each)].astype(float)


def weight(model) -> float:
    """Return the weight of all rods, shells and rigid bodies [N]."""
    return float(mass(model) * np.linalg.norm(model.scene.gravity))


def checks(result, refused: int = 0) -> list[ddg.Check]:
    """Check convergence, finite values and `kept_apart`."""
    outcomes = result.statistics["outcomes"]
    failed = sum(number for name, number in outcomes.items() if not name.startswith("converged"))
    fraction = failed / max(1, sum(outcomes.values()))
    series = [np.array(values) for values in result.series.values()]
    finite = np.isfinite(result.state.points()).all() and all(np.isfinite(values).all() for values in series)
    return [
        ddg.Check("solves taken again in halves, of all", fraction, 0.0, HALVED, "what was taken converged"),
        ddg.Check("values that are not finite", float(not finite), 0.0, 0.0),
        *kept_apart(result, refused),
    ]


def energy_check(result, work: np.ndarray | float = 0.0, tolerance: float = 1e-4) -> ddg.Check:
    """Check the largest rise of the energy above an earlier value, over the energy lost.

    Implicit Euler may create energy at an impact, since gaps are not convex functions of positions; shorter steps create less.

    Args:
        result: a run.
        work: cumulative work of moving supports and obstacles (times,) [J], force at the end of each step times its displacement.
        tolerance: tolerance of the ratio.
    """
    left = np.array(result.series["energy"]) - work
    gained = float((left - np.minimum.accumulate(left)).max() / max(np.ptp(left), 1e-300))
    return ddg.Check("energy created over energy lost", gained, 0.0, tolerance, "but for work; friction takes it")


def weight_check(result, tolerance: float) -> ddg.Check:
    """Check force of obstacles minus rate of momentum over weight, as median of the last quarter of the run.

    In implicit Euler the force at the end of a step acts throughout the step, so that the balance holds in motion, too.
    """
    times, carried, momentum = (
        np.array(v) for v in (result.times, result.series["carried"], result.series["momentum"])
    )
    last = slice(-max(1, len(times) // 4), None)
    inertia = np.diff(momentum) / np.diff(times) + result.model.scene.mass_damping * momentum[1:]
    ratios = (carried[1:] - inertia)[last] / weight(result.model)
    return ddg.Check("force of obstacles less inertia over weight", np.median(ratios), 1.0, tolerance, "Newton")


def colors(model) -> np.ndarray:
    """Return RGB colors (rods, 3), one a rod."""
    return np.random.default_rng(1).uniform(0.1, 0.85, (rods_of(model), 3))


def masses(model) -> np.ndarray:
    """Return masses of the nodes of the coupled system [kg], zero for obstacles."""
    host = model.coupled.host
    result = host.mass[: host.nodes, 0].copy()
    result[np.concatenate([np.zeros(0, int), *host.obstacles, *host.markers])] = 0.0
    return result


def kept_apart(result, refused: int = 0) -> list[ddg.Check]:
    """Check that nothing interpenetrated and that surfaces never overlapped.

    `refused`: allowed number of crossing pairs in steps that were rejected and halved. The interpenetration check is conservative:
    it tests straight lines between both ends of a step.
    """
    statistics = result.statistics["contact"]
    gap, crossings = statistics["smallest_gap"], statistics["refused_crossings"]
    return [
        ddg.Check("pairs that seemed to pass, in steps not taken", crossings, 0.0, refused, CROWDED),
        ddg.Check("largest overlap of surfaces [m]", max(0.0, -gap) if gap else np.nan, 0.0, 0.0, "the barrier"),
    ]


def jitter(shape: tuple, seed: int) -> np.ndarray:
    """Return random numbers between -1 and 1 of a seed; zeros for a negative seed."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape) if seed >= 0 else np.zeros(shape)


def jittered(model, seed: int):
    """Return the initial state with free nodes moved randomly by up to a fifth of the activation distance; see `jitter`."""
    tangent, points = Tangent(model), model.state().points()
    free = tangent.at_points(tangent.free.astype(float))
    return model.state(points=points + 0.2 * model.scene.contact_settings.range * free * jitter(points.shape, seed))


def smallest_gap(model, state) -> float:
    """Return the smallest gap within the activation distance [m], or that distance if there is none."""
    gap = model.contacts(state).gap
    return float(gap.min()) if len(gap) else float(model.scene.contact_settings.range)

"""Combed hair: a comb is pulled down through curled strands, each between the same two teeth throughout.

Strands hang from fixed roots, as helices that widen with distance. Teeth of the comb start between groups of strands, near the
roots, and move down and out of the hair. They are closer than the curls are wide and straighten these as they pass. Roots and comb
together carry at every time the weight of the hair and its inertia. The hair gains no more energy than the work of the comb. The
comb is smooth; there is friction between strands.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _layouts, _many_rods

LENGTH = 0.12  # m
RADIUS, TOOTH = 4e-4, 1e-3  # m, of strands and teeth
SPACING = 2e-3  # m, of strands
ABREAST = 3  # strands of a row between two teeth
RANGE = 2e-4  # m, activation distance
APART = 2.0 * RADIUS + 1.5 * RANGE  # m, initial distance of strands
CURL, TURNS = 3e-3, 3.0  # m, radius of the helices, and number of turns of a strand
STRAIGHT = 0.02  # m, straight length at the roots
BEYOND = 0.012  # m, extent of teeth beyond the roots on both sides
BEGINS = 8e-3  # m, initial distance of the comb below the roots
LEAVES = 0.03  # m, final distance of the comb below the ends of straight strands
HAIR = ddg.Material(young=1e7, density=1000.0, poisson=0.5)


def build(
    gaps: int = 4,
    rows: int = 4,
    n: int = 40,
    friction: float = 0.3,
    speed: float = 0.2,
    damping: float = 4.0,
    dt: float = 1.0 / 300.0,
    seed: int = 1,
) -> ddg.Scene:
    """Build strands that hang along -z from the plane z = 0, with teeth along x.

    Args:
        gaps: gaps between teeth, each with 3 strands in a row
        rows: rows of strands
        n: edges of a strand
        friction: Coulomb friction coefficient between strands
        speed: speed of the comb [m/s]
        damping: mass-proportional damping by the air [1/s]
        dt: time step [s]
        seed: seed of the random phases of the curls
    """
    duration = np.ceil((LENGTH + LEAVES - BEGINS) / speed / dt) * dt
    points = _layouts.resolve_overlaps(curled(gaps, rows, n, _layouts.random(seed)), APART, num_fixed=2)
    scene = ddg.Scene(mass_damping=damping, analysis=ddg.Dynamics(dt=dt, duration=duration))
    hair = scene.add_rods(points, section=ddg.Circle(RADIUS), material=HAIR, name="hair")
    scene.clamp(hair, edges=[0])
    moved = ddg.Motion(translation=lambda t: (0.0, 0.0, -speed * t))
    for y in teeth(gaps):
        start, end = (-BEYOND, y, -BEGINS), (SPACING * (rows - 1) + BEYOND, y, -BEGINS)
        scene.add_obstacle(ddg.Capsule(start, end, TOOTH), motion=moved, name="comb")
    scene.contact(range=RANGE, friction=friction)
    scene.contact_between("hair", "comb", friction=0.0)
    return scene


def teeth(gaps: int) -> np.ndarray:
    """Return positions of teeth along y (gaps + 1,) [m], which leave one extra spacing between groups of strands."""
    return SPACING * (ABREAST + 1) * np.arange(gaps + 1)


def curled(gaps: int, rows: int, n: int, random) -> np.ndarray:
    """Return strands (rods, nodes, 3) [m], gap by gap and row by row; they may overlap."""
    y = (teeth(gaps)[:-1, None] + SPACING * np.arange(1, ABREAST + 1)).ravel()
    roots = np.stack(np.meshgrid(y, SPACING * np.arange(rows), indexing="ij"), axis=-1).reshape(-1, 1, 2)[..., ::-1]
    s = np.linspace(0.0, LENGTH, n + 1)
    wide = CURL * np.sin(0.5 * np.pi * np.clip((s - STRAIGHT) / (0.5 * LENGTH), 0.0, 1.0)) ** 2
    angle = 2.0 * np.pi * TURNS * s / LENGTH + random.uniform(-0.7, 0.7, (len(roots), 1))
    curl = wide[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([roots + curl, np.broadcast_to(-s[:, None], (*angle.shape, 1))], axis=-1)


def observe(model, state) -> dict[str, float]:
    """Return `_many_rods.observe` with the upward force of the comb [N], strands in a wrong gap, and forces on the hair [N].

    Components of the force of roots and comb, weight included, and of the momentum [N s] are named `force_k` and `momentum_k`.
    """
    roots, *comb = (np.array(reaction.force) for reaction in model.reactions(state))
    forces = sum(comb) + roots + _many_rods.mass(model) * np.array(model.scene.gravity)
    momentum = _many_rods.momentum(model, state)
    parts = {f"{n}_{k}": float(v[k]) for n, v in (("force", forces), ("momentum", momentum)) for k in range(3)}
    return (
        _many_rods.observe(model, state) | parts | {"comb": float(sum(comb)[2]), "astray": float(astray(model, state))}
    )


def comb_at(model, t: float) -> float:
    """Return the height of the comb at a time [m]."""
    return float(model.scene.obstacles[0].motion.shift(t)[0, 2]) - BEGINS


def astray(model, state) -> int:
    """Return the number of strand crossings of the comb's height in a gap other than at the root."""
    points, gaps = state.points().reshape(_many_rods.rods_of(model), -1, 3), len(model.scene.obstacles) - 1
    above = points[..., 2] - comb_at(model, state.time)
    rod, edge = np.nonzero(above[:, :-1] * above[:, 1:] <= 0.0)
    weight = above[rod, edge] / (above[rod, edge] - above[rod, edge + 1])
    y = (1.0 - weight) * points[rod, edge, 1] + weight * points[rod, edge + 1, 1]
    return int((np.searchsorted(teeth(gaps), y) - 1 != rod // (len(points) // gaps)).sum())


def check(result) -> list[ddg.Check]:
    """Check that nothing interpenetrates, momentum balances, comb work covers the energy, and no strand leaves its gap."""
    model, times = result.model, np.array(result.times)
    series = {name: np.array(values) for name, values in result.series.items()}
    force, momentum = (np.stack([series[f"{name}_{k}"] for k in range(3)], axis=1) for name in ("force", "momentum"))
    inertia = np.diff(momentum, axis=0) / np.diff(times)[:, None] + model.scene.mass_damping * momentum[1:]
    off = np.linalg.norm(force[1:] - inertia, axis=1) / _many_rods.weight(model)
    # a step of several substeps ends with the force of the last one
    whole = np.sort(off)[: max(1, len(off) - result.statistics["retries"])]
    displacement = np.diff([comb_at(model, t) for t in times])
    return [
        *_many_rods.checks(result),
        ddg.Check("forces less inertia over the weight", whole.max(), 0.0, 1e-5, "Newton"),
        _many_rods.energy_check(result, np.append(0.0, np.cumsum(series["comb"][1:] * displacement)), 2e-3),
        ddg.Check("strands in another gap than their roots", series["astray"].max(), 0.0, 0.0, "teeth part the hair"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the work of the comb over edges and steps."""
    return ddg.bench.Study(
        {"n": (20, 40), "dt": (1 / 150, 1 / 300)},
        lambda result: np.mean(result.series["comb"]),
        {"n": 60, "dt": 1 / 1200},
        fixed={"gaps": 2, "rows": 2},
        unit="N",
    )


def picture(result, frames) -> dict:
    """Draw hair and comb before, halfway, and at the end."""
    times = sorted(frames)
    times = times[0], times[len(times) // 2], times[-1]
    return {
        "points_by_time": {t: frames[t] for t in times},
        "colors": _many_rods.colors(result.model),
        "thick": True,
        "side_by_side": True,
    }

"""Crossed beams: the clamps of an upper beam are lowered onto a lower one at a right angle.

Each is clamped at both ends, a spring of 192 EI / L^3 at its middle. Two in series take half of the overlap delta each and exert
96 EI delta / L^3 on each other. Implicit Euler steps that are long against the beams' periods lead to the equilibrium.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

LENGTH = 1.0  # m
RADIUS = 0.01  # m
SPEED_UP = 8  # steps of the lowering; as many follow for vibrations to decay
GAP = 0.02  # activation distance over the overlap
SOURCE = "two springs of 192 EI / L^3 in series"


def build(n: int = 40, overlap: float = 1e-3, dt: float = 1.0, law: str = "barrier", seed: int = -1) -> ddg.Scene:
    """Build beams along x and y, a gap of twice the activation distance apart.

    Args:
        n: edges of each beam, an even number
        overlap: displacement of the clamps beyond first contact, over the length
        dt: time step [s]
        law: "barrier" or "penalty"
        seed: seed of the initial jitter of nodes, a quarter of the activation distance; no jitter below 0
    """
    if n < 4 or n % 2:
        raise ValueError(f"n = {n}; a beam has an even number of edges, 4 at least, and a node in the middle")
    down = overlap * LENGTH
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Dynamics(dt=dt, duration=2 * SPEED_UP * dt),
        initial=lambda model: jittered(model, 0.25 * GAP * down, seed),
    )
    s = np.linspace(-0.5, 0.5, n + 1) * LENGTH
    height = 2.0 * RADIUS + 2.0 * GAP * down
    lower = np.stack([s, 0.0 * s, 0.0 * s], axis=1)
    upper = np.stack([0.0 * s, s, 0.0 * s + height], axis=1)
    material = ddg.Material(young=1e7, density=1000.0, poisson=0.5)
    whole = down + 2.0 * GAP * down

    def lowered(t: float) -> tuple:
        return (0.0, 0.0, -whole * min(1.0, t / (SPEED_UP * dt)))

    motion = ddg.Motion(translation=lowered)
    for points, name, moved in ((lower, "lower", None), (upper, "upper", motion)):
        beam = scene.add_rod(points, section=ddg.Circle(RADIUS), material=material, name=name)
        for end in ("first", "last"):
            scene.clamp_end(beam, end, motion=moved)
    stiffness = 192.0 * scene.batches[0].section.EI1 / LENGTH**3
    scene.contact(law=law, range=GAP * down, stiffness=stiffness / GAP)
    return scene


def jittered(model, size: float, seed: int):
    """Return the beams at rest with inner nodes moved by up to `size` [m]."""
    points = np.concatenate([batch.points[0] for batch in model.scene.batches])
    inner = np.tile(np.pad(np.ones(len(points) // 2 - 2), 1), 2)[:, None]
    return model.state(points=points + size * inner * _many_rods.jitter(points.shape, seed))


def observe(model, state) -> dict[str, float]:
    """Return heights of both middles [m] and vertical forces on the clamps of both beams [N]."""
    points = state.points()
    middle = len(points) // 4
    reactions = model.reactions(state)
    return {
        "lower": points[middle, 2],
        "upper": points[len(points) // 2 + middle, 2],
        "force": float(sum(reaction.force[2] for reaction in reactions[:2])),
        "force_upper": float(sum(reaction.force[2] for reaction in reactions[2:])),
    }


def check(result) -> list[ddg.Check]:
    """Check force and deflections against springs in series, and action against reaction."""
    batch = result.model.scene.batches[0]
    names = ("force L^3 / (EI delta)", "deflection of the lower beam over delta", "action and reaction")
    checks = once_reached(result, result.model.scene.analysis.duration, names, lambda: _checks(result, batch, names))
    return checks + _many_rods.kept_apart(result)


def _checks(result, batch, names) -> list[ddg.Check]:
    series = {name: values[-1] for name, values in result.series.items()}
    down = -result.model.scene.supports[2].motion.shift(result.times[-1])[0, 2]
    start = result.model.scene.batches[1].points[0, 0, 2]
    overlap = down - start + 2.0 * RADIUS
    force = series["force"] * LENGTH**3 / (float(np.max(batch.section.EI1)) * overlap)
    space = 0.01 * max(1.0, (40.0 / batch.edges) ** 2)
    return [
        ddg.Check(names[0], force, 96.0, space + GAP, SOURCE, True),
        ddg.Check(names[1], -series["lower"] / overlap, 0.5, space + GAP, SOURCE, True),
        ddg.Check(names[2], series["force_upper"] / series["force"], -1.0, 1e-6, "balance of forces"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the force over the nodes of the beams."""
    return ddg.bench.Study({"n": (10, 20, 40, 80)}, "force", whole=True)


def picture(result, frames) -> dict:
    """Draw the beams at the end with the contact force, and the force over the overlap."""
    batch, motion = result.model.scene.batches[0], result.model.scene.supports[2].motion
    start = result.model.scene.batches[1].points[0, 0, 2]
    overlap = np.array([start - 2.0 * RADIUS + motion.shift(t)[0, 2] for t in result.times])
    exact = 96.0 * float(np.max(batch.section.EI1)) / LENGTH**3 * np.maximum(-overlap, 0.0)
    last = max(frames)
    return {
        "points_by_time": {last: frames[last]},
        "colors": np.array([[0.45, 0.6, 0.8], [0.82, 0.29, 0.36]]),
        "contacts": result.model.contacts(result.state),
        "chart": {
            "lines": [
                ("96 EI / L³ times the overlap", -1e3 * overlap, exact, "-"),
                ("on the clamps", -1e3 * overlap, result.series["force"], "o"),
            ],
            "x": "overlap of the clamped beams [mm]",
            "y": "force [N]",
        },
    }

"""Two beams cross at right angles, and the clamps of the upper one are lowered onto the lower one.

Each is clamped at both ends, a spring of 192 EI / L^3 at its middle; two of them in series take half of the overlap delta each, and
push each other with 96 EI delta / L^3. Steps of implicit Euler that are long against the beams' periods lead to the equilibrium.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _touching

LENGTH = 1.0  # m
RADIUS = 0.01  # m
SPEED_UP = 8  # steps in which the clamps come down; as many follow for what still swings
GAP = 0.02  # of the overlap, the range of contact
SOURCE = "two springs of 192 EI / L^3 in series"


def build(n: int = 40, overlap: float = 1e-3, dt: float = 1.0, law: str = "barrier", seed: int = -1) -> ddg.Scene:
    """The beams along x and along y, a gap of twice the range apart.

    Args:
        n: edges of each beam, an even number
        overlap: how far the clamps go on from where the beams touch, over the length
        dt: time step [s]
        law: "barrier" or "penalty"
        seed: of a jitter of where the nodes are at first, a quarter of the range of contact; none below 0
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
    apart = 2.0 * RADIUS + 2.0 * GAP * down
    lower = np.stack([s, 0.0 * s, 0.0 * s], axis=1)
    upper = np.stack([0.0 * s, s, 0.0 * s + apart], axis=1)
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
    """The beams at rest, inner nodes moved by up to a size [m]."""
    points = np.concatenate([batch.points[0] for batch in model.scene.batches])
    inner = np.tile(np.pad(np.ones(len(points) // 2 - 2), 1), 2)[:, None]
    return model.state(points=points + size * inner * _touching.jitter(points.shape, seed))


def observe(model, state) -> dict[str, float]:
    """Heights of both middles [m], and the vertical force on the clamps of the lower beam [N]."""
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
    """Force and deflections against those of springs, and action against reaction."""
    batch = result.model.scene.batches[0]
    names = ("force L^3 / (EI delta)", "deflection of the lower beam over delta", "action and reaction")
    checks = once_reached(result, result.model.scene.analysis.duration, names, lambda: _checks(result, batch, names))
    return checks + _touching.kept_apart(result)


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
    """The force over the nodes of the beams."""
    return ddg.bench.Study({"n": (10, 20, 40, 80)}, "force", whole=True)


def picture(result, frames) -> dict:
    """The beams as thick as they are, at the end."""
    last = max(frames)
    return {"points_by_time": frames, "bodies": {last: _touching.tubes(result.model, frames[last])}}

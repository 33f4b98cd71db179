"""Stick-slip: a rod pressed onto a rough floor buckles; its tip sticks, and then slips.

The tip of a rod of length L is in contact with the floor, and the clamp comes down by delta. While the tip sticks, the rod is an
elastica, clamped at its top and hinged at its tip. It exerts the normal force P and the horizontal force H, and H / P grows with
delta from 0. The tip slips at H / P = mu. Regularised sticking friction creeps at less than its threshold nu.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

LENGTH = 1.0  # m
RADIUS = 0.002  # m
B = 1.0  # N m^2
STIFF = 1e5  # EA L^2 / B
MASS_PER_LENGTH = 1e-3  # kg/m
RANGE = 1e-4  # m, activation distance
CLOSE = 0.5  # initial gap over the activation distance, so that the floor acts from the start
NUDGE = 0.1  # N, in the middle at first; sets the direction of buckling
NUDGED = 0.006  # displacement over L in which the nudge fades
BEYOND = 1.1  # final displacement of the clamp over the delta of the slip
STEP_TIME = 1.0  # s, long against the periods of the rod: motion is quasi-static
SLIP = {0.05: (0.01238049378, 20.28494139), 0.1: (0.04687417821, 20.54906118), 0.2: (0.1548673548, 21.38052121)}
SLIP |= {0.3: (0.2715634261, 22.23208412), 0.35: (0.3239935114, 22.56281079)}  # mu: delta / L, P L^2 / B
STICKS = {
    0.01: 0.04485369793,
    0.05: 0.1035447758,
    0.1: 0.1527925554,
    0.2: 0.2377737849,
    0.3: 0.3264913142,
}  # delta / L: H / P
SOURCE = "elastica, clamped and hinged, by collocation to 1e-12"


def build(
    friction: float = 0.2,
    n: int = 40,
    steps: int = 150,
    velocity: float = 1e-6,
    stiffness: float = 5e4,
    range: float = RANGE,
    friction_iterations: int = 2,
    seed: int = -1,
) -> ddg.Scene:
    """Build the rod along z, its tip half the activation distance above the floor z = 0.

    Args:
        friction: friction coefficient; one of 0.05, 0.1, 0.2, 0.3 and 0.35
        n: edges of the rod, an even number
        steps: time steps of the clamp motion
        velocity: stick threshold nu of the friction law [m/s]; the clamp moves by about 1e-3 m/s
        stiffness: contact stiffness [N/m]
        range: activation distance of contact [m]
        friction_iterations: normal-force iterations a step
        seed: seed of a jitter of the sideways nudge; no jitter below 0
    """
    if friction not in SLIP:
        raise ValueError(f"friction = {friction}; there are references for {', '.join(map(str, SLIP))}")
    if n < 4 or n % 2:
        raise ValueError(f"n = {n}; the rod has an even number of edges, 4 at least, and a node in the middle")
    duration = steps * STEP_TIME
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Dynamics(dt=STEP_TIME, duration=duration))
    points = np.zeros((n + 1, 3))
    points[:, 2] = np.linspace(LENGTH, 0.0, n + 1) + RADIUS + CLOSE * range
    section = ddg.Stiffness(
        EA=STIFF * B / LENGTH**2, EI1=B, GJ=B, mass_per_length=MASS_PER_LENGTH, rotary_inertia=1e-9, radius=RADIUS
    )
    rod = scene.add_rod(points, section=section, name="rod")
    displacement = BEYOND * SLIP[friction][0] * LENGTH
    scene.clamp_end(rod, "first", motion=ddg.Motion(translation=lambda t: (0.0, 0.0, -displacement * t / duration)))
    fades = min(1.0, NUDGED * LENGTH / displacement) * duration
    nudge = NUDGE * (1.0 + 0.5 * float(_many_rods.jitter((), seed)))
    scene.add_force(rod, n // 2, (nudge, 0.0, 0.0), amplitude=lambda t: max(0.0, 1.0 - t / fades))
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(
        range=range, stiffness=stiffness, friction=friction, velocity=velocity, friction_iterations=friction_iterations
    )
    return scene


def observe(model, state) -> dict[str, float]:
    """Return delta over L, both forces of the floor L^2 / B, and position and speed of the tip over L."""
    count = model.scene.batches[0].points.shape[1]
    points, velocities = state.points().reshape(-1, 3), state.velocities().reshape(-1, 3)
    force = model.reactions(state)[0].force.reshape(-1, 3)[0] * LENGTH**2 / B
    return {
        "delta": 1.0 - (points[0, 2] - points[count - 1, 2]) / LENGTH,
        "normal": -force[2],
        "tangential": abs(force[0]),
        "tip": points[count - 1, 0] / LENGTH,
        "tip_speed": abs(velocities[count - 1, 0]) / LENGTH,
    }


def check(result) -> list[ddg.Check]:
    """Check delta of the slip, forces there and before, and creep until then."""
    mu, law = result.model.scene.contact_settings.friction, result.model.scene.contact_settings
    series = {name: np.array(values) for name, values in result.series.items()}
    slips = np.flatnonzero(series["tip_speed"] * LENGTH > law.velocity)
    where, normal = SLIP[mu]
    sticks = {delta: ratio for delta, ratio in STICKS.items() if delta < where}
    names = ["delta / L of the slip", "normal force L^2 / B at the slip", "tip creeps over L before"]
    names += [f"H / P at delta = {delta} L" for delta in sticks]
    checks = once_reached(
        result,
        result.model.scene.analysis.duration,
        names,
        lambda: _checks(result, series, slips, (where, normal, sticks), names),
    )
    return checks + _many_rods.kept_apart(result)


def _checks(result, series, slips, reference, names) -> list[ddg.Check]:
    where, normal, sticks = reference
    first = slips[0] if len(slips) else -1
    mu, law = result.model.scene.contact_settings.friction, result.model.scene.contact_settings
    ratio = series["tangential"] / np.maximum(series["normal"], 1e-12)
    previous = max(first - 1, 0)
    # the tangential force reaches its bound within the step before the first slipping one
    fraction = np.clip((mu - ratio[previous]) / max(ratio[previous] - ratio[previous - 1], 1e-12), 0.0, 1.0)
    # extrapolated from before the slip, which changes the forces
    delta, force = (
        v[previous] + fraction * (v[previous] - v[previous - 1]) for v in (series["delta"], series["normal"])
    )
    crept = abs(series["tip"][previous] - series["tip"][1])
    return [
        ddg.Check(names[0], delta, where, 0.02, SOURCE, True),
        ddg.Check(names[1], force, normal, 0.01, SOURCE, True),
        ddg.Check(names[2], crept, 0.0, law.velocity * result.times[previous] / LENGTH, "nu times the time"),
        *(
            # H / P grows as the root of delta at first
            ddg.Check(name, np.sqrt(np.interp(d, series["delta"], ratio**2)), exact, 0.02, SOURCE, True)
            for name, (d, exact) in zip(names[3:], sticks.items(), strict=True)
        ),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the delta of the slip over parameters of contact, friction, steps and nodes, one by one."""
    grid = {"n": (10, 20, 40, 80), "dt": (3.0, 1.5, 1.0, 0.5), "velocity": (1e-7, 1e-6, 1e-5, 1e-4)}
    grid |= {"stiffness": (5e3, 1.5e4, 5e4, 1.5e5, 5e5), "range": (2.5e-5, 5e-5, RANGE, 2e-4, 4e-4)}
    return ddg.bench.Study(
        grid | {"rtol": (1e-3, 1e-4, 1e-5, 1e-6, 1e-8), "friction_iterations": (1, 2, 3)},
        "delta / L of the slip",
        one_by_one=True,
    )


def picture(result, frames) -> dict:
    """Draw the rod at a few times, and the floor."""
    corners, cells = meshes.rectangle(1, 1)
    floor = np.column_stack([0.6 * corners[:, 0] - 0.15, 0.3 * corners[:, 1] - 0.15, 0.0 * corners[:, 0]])
    return {"points_by_time": frames, "bodies": {min(frames): (floor, cells)}}

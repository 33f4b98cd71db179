"""Rolling rods: of three rods across a slope one rolls, one is bowled and comes to roll, and one slips.

Surface friction rotates a rod about its axis. A cylinder, I = m r^2 / 2, rolls with 2/3 g sin a at any friction mu with tan(a) <= 3
mu. Sliding with the speed v, its acceleration is g (sin a - mu cos a), and that of its surface, r omega, 2 mu g cos a. A rod bowled
with v0 comes to roll after v0 / (g (3 mu cos a - sin a)); where tan(a) > 3 mu none ever does.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods, rod_on_floor

LENGTH = 0.1  # m
RADIUS = 0.005  # m
GRAVITY = 9.81  # m/s^2
RANGE = 1e-4  # m, activation distance
NAMES = ("rolls", "bowled", "slips")
WAYS = [
    f"way of {what} that {does} [m]" for what in ("the rod", "the surface") for does in ("rolls", "is bowled", "slips")
]
LANE = 1.5 * LENGTH  # m, between rods


def build(
    n: int = 10,
    angle: float = 10.0,
    friction: float = 0.3,
    slippery: float = 0.04,
    speed: float = 1.0,
    velocity: float = 1e-3,
    stiffness: float = 2e4,
    range: float = RANGE,
    friction_iterations: int = 2,
    dt: float = 1e-3,
    duration: float = 0.5,
    seed: int = -1,
) -> ddg.Scene:
    """Build the rods side by side, across a slope that falls towards x.

    Args:
        n: edges of each rod
        angle: angle of the plane [degrees]
        friction: friction coefficient of the rolling and the bowled rod
        slippery: friction coefficient of the slipping rod
        speed: initial speed of the bowled rod [m/s]
        velocity: stick threshold nu of the friction law [m/s]
        stiffness: contact stiffness [N/m]
        range: activation distance of contact [m]
        friction_iterations: normal-force iterations a step
        dt: time step [s]
        duration: duration of the run [s]
        seed: seed of the initial jitter of rods; no jitter below 0
    """
    down, normal, steep = rod_on_floor.slope(angle)
    if not 3.0 * slippery < steep < 3.0 * friction:
        raise ValueError(
            f"friction = {friction}, slippery = {slippery}; a third of tan(angle) = {steep:.3g} is between them"
        )
    scene = ddg.Scene(
        gravity=(0.0, 0.0, -GRAVITY),
        analysis=ddg.Dynamics(dt=dt, duration=duration),
        initial=lambda model: rod_on_floor.thrown(model, speed * down, "bowled"),
    )
    jitter = _many_rods.jitter((len(NAMES), 2), seed)
    along = np.outer(np.linspace(-0.5, 0.5, n + 1) * LENGTH, [0.0, 1.0, 0.0])
    for k, name in enumerate(NAMES):
        start = k * LANE * np.array([0.0, 1.0, 0.0]) + 0.1 * RADIUS * jitter[k, 0] * down
        scene.add_rod(
            start + along + (RADIUS + range * (0.95 + 0.04 * jitter[k, 1])) * normal,
            section=ddg.Circle(RADIUS),
            material=ddg.Material(young=1e7, density=1000.0, poisson=0.5),
            name=name,
        )
    scene.add_obstacle(ddg.Plane(normal=tuple(normal)), name="plane")
    scene.contact(
        range=range,
        stiffness=stiffness,
        friction=friction,
        velocity=velocity,
        friction_iterations=friction_iterations,
        rolling=True,
    )
    scene.contact_between("slips", "plane", friction=slippery)
    return scene


def observe(model, state) -> dict[str, float]:
    """Return downhill displacements of rods and surface rotations of rods [m], and the smallest gap [m]."""
    edges = len(model.scene.batches[0].points[0]) - 1
    rotations = (state.angles() - model.state().angles()).reshape(-1, len(NAMES), edges)[0].mean(1)
    observed = rod_on_floor.ways(model, state)
    observed |= {f"{name}, turned": RADIUS * value for name, value in zip(NAMES, rotations, strict=True)}
    return observed | {"gap": _many_rods.smallest_gap(model, state)}


def expected(angle: float, friction: float, speed: float, t: float) -> tuple[float, float]:
    """Return displacement down a slope [rad], and of the surface about the axis [m], at time t from an initial speed."""
    pull, brake = GRAVITY * np.sin(angle), GRAVITY * friction * np.cos(angle)
    slides = min(t, speed / (3.0 * brake - pull)) if 3.0 * brake > pull else t
    rolls, surface_speed = t - slides, 2.0 * brake * slides
    rolled = surface_speed * rolls + pull / 3.0 * rolls**2
    return (speed + 0.5 * (pull - brake) * slides) * slides + rolled, brake * slides**2 + rolled


def check(result) -> list[ddg.Check]:
    """Check displacements of rods, and of surfaces about the axes."""
    scene = result.model.scene
    checks = once_reached(result, scene.analysis.duration, WAYS, lambda: _checks(result, scene))
    return checks + _many_rods.kept_apart(result)


def _checks(result, scene) -> list[ddg.Check]:
    normal, mu = np.array(scene.obstacles[0].shape.normal), scene.contact_settings.friction
    speed = np.linalg.norm(scene.initial(result.model).velocities().reshape(-1, 3), axis=-1).max()
    inputs = {"rolls": (mu, 0.0), "bowled": (mu, speed), "slips": (scene.betweens[0].friction, 0.0)}
    exact = [expected(np.arctan2(normal[0], normal[2]), *inputs[name], result.times[-1]) for name in NAMES]
    law = "m x'' = m g sin a - f, I omega' = f r, f = mu N while it slides"
    last = {name: values[-1] for name, values in result.series.items()}
    close = 0.01 * max(1.0, result.dt / 1e-3)
    keys = [*NAMES, *(f"{name}, turned" for name in NAMES)]
    displacements = [displacement for displacement, _ in exact] + [rotation for _, rotation in exact]
    return [
        ddg.Check(name, last[key], displacement, min(ddg.Check.COARSEST, close), law, True)
        for name, key, displacement in zip(WAYS, keys, displacements, strict=True)
    ]


def benchmark() -> ddg.bench.Study:
    """Study the displacement of the bowled rod over parameters of contact, friction, steps and nodes, one by one."""
    grid = {"n": (5, 10, 20), "dt": (4e-3, 2e-3, 1e-3, 5e-4), "velocity": (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)}
    grid |= {"stiffness": (2e3, 2e4, 2e5), "range": (2.5e-5, RANGE, 4e-4), "friction_iterations": (1, 2, 3)}
    return ddg.bench.Study(grid, WAYS[1], one_by_one=True)


picture = rod_on_floor.picture

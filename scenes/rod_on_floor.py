"""Rods on a slope: Coulomb friction holds one rod, lets one slide, and stops one thrown downhill.

By Coulomb's law a rod sticks at the angle a where tan(a) < mu. Else it slides with the acceleration g (sin a - mu cos a). Thrown at
the speed v it stops after v^2 / (2 g (mu cos a - sin a)). Regularised friction creeps: the logistic law carries tan(a) / mu of mu N
at the constant speed nu atanh(tan(a) / mu) / 7.5. Friction acts here on the centreline of a rod, which slides and never rolls; see
`rolling_rods`.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

LENGTH = 0.3  # m
RADIUS = 0.005  # m
GRAVITY = 9.81  # m/s^2
LANE = 0.1  # m, between rods
LEAN = 0.05  # rad, initial inclination of the sticking rod to the plane
RANGE = 1e-4  # m, activation distance
SETTLED = 0.5  # fraction of the run after which the sticking rod is at rest
STEEPNESS = 7.5  # of the logistic law
NAMES = ("rests", "slides", "thrown")


def build(
    n: int = 20,
    angle: float = 10.0,
    friction: float = 0.35,
    slippery: float = 0.08,
    speed: float = 1.0,
    velocity: float = 1e-3,
    stiffness: float = 2e4,
    range: float = RANGE,
    friction_iterations: int = 2,
    dt: float = 1e-3,
    duration: float = 1.2,
    seed: int = -1,
) -> ddg.Scene:
    """Build the rods side by side, along a slope that falls towards x.

    Args:
        n: edges of each rod
        angle: angle of the plane [degrees]
        friction: friction coefficient of the sticking and the thrown rod
        slippery: friction coefficient of the sliding rod
        speed: initial speed of the thrown rod [m/s]
        velocity: stick threshold nu of the friction law [m/s]
        stiffness: contact stiffness [N/m]
        range: activation distance of contact [m]
        friction_iterations: normal-force iterations a step
        dt: time step [s]
        duration: duration of the run [s]
        seed: seed of the initial jitter of rods; no jitter below 0
    """
    down, normal, steep = slope(angle)
    if not slippery < steep < friction:
        raise ValueError(f"friction = {friction}; tan(angle) = {steep:.3g} is between it and slippery = {slippery}")
    scene = ddg.Scene(
        gravity=(0.0, 0.0, -GRAVITY),
        analysis=ddg.Dynamics(dt=dt, duration=duration),
        initial=lambda model: thrown(model, speed * down),
    )
    jitter = _many_rods.jitter((len(NAMES), 3), seed)
    s = np.linspace(0.0, LENGTH, n + 1)[:, None]
    for k, name in enumerate(NAMES):
        lean = (LEAN if name == "rests" else 0.0) * (1.0 + 0.3 * jitter[k, 0])
        along = np.cos(lean) * down + np.sin(lean) * normal + 0.02 * jitter[k, 1] * np.array([0.0, 1.0, 0.0])
        start = k * LANE * np.array([0.0, 1.0, 0.0]) + (RADIUS + range * (1.05 + 0.05 * jitter[k, 2])) * normal
        scene.add_rod(
            start + s * along / np.linalg.norm(along),
            section=ddg.Circle(RADIUS),
            material=ddg.Material(young=1e7, density=1000.0, poisson=0.5),
            name=name,
        )
    scene.add_obstacle(ddg.Plane(normal=tuple(normal)), name="plane")
    scene.contact(
        range=range, stiffness=stiffness, friction=friction, velocity=velocity, friction_iterations=friction_iterations
    )
    scene.contact_between("slides", "plane", friction=slippery)
    return scene


def slope(angle: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the downhill direction of a slope that falls towards x, its normal, and the tangent of its angle [degrees]."""
    a = np.radians(angle)
    if not 0.0 < a < 0.5 * np.pi:
        raise ValueError(f"angle = {angle}; a slope is between 0 and 90 degrees")
    return np.array([np.cos(a), 0.0, -np.sin(a)]), np.array([np.sin(a), 0.0, np.cos(a)]), float(np.tan(a))


def thrown(model, velocity: np.ndarray, name: str = "thrown"):
    """Return the rest state with a velocity of the rod `name`."""
    batches = model.scene.batches
    velocities = np.zeros((len(batches), len(batches[0].points[0]), 3))
    velocities[[batch.name for batch in batches].index(name)] = velocity
    return model.state(velocities=velocities.reshape(-1, 3))


def ways(model, state) -> dict[str, float]:
    """Return the downhill displacement of each rod [m], by name."""
    batches, normal = model.scene.batches, np.array(model.scene.obstacles[0].shape.normal)
    start = np.array([batch.points[0].mean(0) for batch in batches])
    middles = state.points().reshape(-1, len(batches), *batches[0].points.shape[1:])[0].mean(1)
    moved = (middles - start) @ np.array([normal[2], 0.0, -normal[0]])
    return dict(zip((batch.name for batch in batches), moved, strict=True))


def observe(model, state) -> dict[str, float]:
    """Return downhill displacements of rods [m], the smallest gap [m], and the plane's force over the normal weight."""
    normal = np.array(model.scene.obstacles[0].shape.normal)
    weight = sum(batch.section.mass_per_length for batch in model.scene.batches) * LENGTH * GRAVITY * normal[2]
    carried = np.reshape(model.reactions(state)[-1].force, (-1, 3))[0] @ normal
    return ways(model, state) | {"gap": _many_rods.smallest_gap(model, state), "carried": float(carried / weight)}


def check(result) -> list[ddg.Check]:
    """Check the carried weight, creep of the sticking rod, and displacements of the sliding and the stopping rod."""
    names = (
        "plane carries, over the weight across it",
        "creep of the rod that rests [m/s]",
        "way of the rod that slides [m]",
        "way of the rod that was thrown [m]",
    )
    scene = result.model.scene
    checks = once_reached(result, scene.analysis.duration, names, lambda: _checks(result, scene, names))
    return checks + _many_rods.kept_apart(result)


def _checks(result, scene, names) -> list[ddg.Check]:
    normal = np.array(scene.obstacles[0].shape.normal)
    tangent, cosine = normal[0] / normal[2], normal[2]
    law, slippery = scene.contact_settings, scene.betweens[0].friction
    speed = np.linalg.norm(scene.initial(result.model).velocities().reshape(-1, 3), axis=-1).max()
    series = {name: np.array(values) for name, values in result.series.items()}
    t, settled = np.array(result.times), np.array(result.times) > SETTLED * result.times[-1]
    rests = series["rests"][settled]
    creep = (rests[-1] - rests[0]) / (t[settled][-1] - t[settled][0])
    slow = law.velocity * np.arctanh(tangent / law.friction) / STEEPNESS
    pull = GRAVITY * cosine * (tangent - slippery)
    brake = GRAVITY * cosine * (law.friction - tangent)
    # implicit Euler advances by the speed at the end of each step; the thrown rod creeps after it has stopped
    slid = 0.5 * pull * t[-1] * (t[-1] + result.dt)
    stopped = 0.5 * speed * (speed / brake - result.dt) + slow * (t[-1] - speed / brake)
    # friction lags by a step with one normal-force iteration
    tolerance = min(ddg.Check.COARSEST, 0.01 * max(1.0, result.dt / 1e-3)) if law.friction_iterations == 1 else 1e-3
    return [
        ddg.Check(names[0], series["carried"][settled].mean(), 1.0, 1e-3, "balance of forces"),
        ddg.Check(names[1], creep, slow, 0.01, "nu atanh(tan(a) / mu) / 7.5", True),
        ddg.Check(names[2], series["slides"][-1], slid, tolerance, "g (sin a - mu cos a) t^2 / 2", True),
        ddg.Check(names[3], series["thrown"][-1], stopped, tolerance, "v^2 / (2 g (mu cos a - sin a))", True),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the displacement of the thrown rod over parameters of contact, friction, steps and nodes, one by one."""
    grid = {"n": (5, 10, 20, 40), "dt": (4e-3, 2e-3, 1e-3, 5e-4), "velocity": (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)}
    grid |= {"stiffness": (2e3, 6e3, 2e4, 6e4, 2e5), "range": (2.5e-5, 5e-5, RANGE, 2e-4, 4e-4)}
    grid |= {"rtol": (1e-3, 1e-4, 1e-5, 1e-6, 1e-8), "friction_iterations": (1, 2, 3)}
    return ddg.bench.Study(grid, "way of the rod that was thrown", one_by_one=True)


def picture(result, frames) -> dict:
    """Draw the rods on the plane at the end with actual thickness."""
    scene, last = result.model.scene, max(frames)
    plane = scene.obstacles[0].shape
    points = frames[last]
    down, across = np.array([plane.normal[2], 0.0, -plane.normal[0]]), np.array([0.0, 1.0, 0.0])
    low, high = (f([f(shape @ down) for shape in frames.values()]) for f in (np.min, np.max))
    corners, cells = meshes.rectangle(1, 1)
    left, right = np.min(points[:, 1]) - 0.5 * LANE, np.max(points[:, 1]) + 0.5 * LANE
    x, y = low + (high - low) * corners[:, :1], left + (right - left) * corners[:, 1:2]
    floor = x * down + y * across
    return {
        "points_by_time": frames,
        "bodies": {min(frames): (floor, cells)},
        "thick": True,
    }

"""Spring car: a car on leaf springs drives over rough ground, its rear wheels driven.

Each axle hangs on two straight rods, cantilevers of length L below the chassis, whose ends rotate with the axle. Wheels roll about the
axles without friction, so that an axle takes no couple while the car stands, and a load F sinks the end of a rod by

    F L^3 / (3 EI) .

Wheels that rotate by an angle p and do not slip travel R p along the ground, R up to the rounded surface. At every time the ground
carries weight and inertia.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scene.obstacles import MESH
from ddg_warp.scenes import _bodies, _many_rods

WHEEL, WIDTH, ROUND = 0.05, 0.025, 2e-3  # m, radius and width of a wheel, and radius of its rounded surface
BASE, TRACK = 0.15, 0.09  # m, of the wheels from the middle
SPRING, RADIUS, SIDE = 0.12, 2.5e-3, 0.05  # m, length, radius of the rods, and distance from the middle
LEAF = ddg.Material(young=4e9, poisson=0.3, density=100.0, viscosity=2e-2)
CHASSIS, AXLE, RIM = 1.0, 0.05, 0.1  # kg, masses of the chassis, an axle and a wheel
RANGE, STIFFNESS = 1e-3, 5e4  # m, N/m, of contact
SLIP = 5e-3  # m/s, stick threshold of friction
BUMP = 0.03  # m, radius of the bumps
GRAVITY = 9.81  # m/s^2
GREY, BLUE = 0.85, (0.35, 0.5, 0.75)  # of the ground and of the car in pictures
STANDS, STARTS = 0.6, 1.0  # s: the motor starts, and reaches its speed
NAMES = ("sinking of the springs at rest [m]", "travel over that of wheels that do not slip", "bumps passed")


def build(
    speed: float = 0.5,
    rough: float = 6e-3,
    friction: float = 0.8,
    sides: int = 32,
    dt: float = 5e-3,
    duration: float = 2.5,
    seed: int = 3,
) -> ddg.Scene:
    """Build the car along x, its wheels a little above the ground.

    Args:
        speed: speed of the car [m/s]
        rough: height of the bumps [m]
        friction: Coulomb friction coefficient of the wheels
        sides: edges around a wheel
        dt: time step [s]
        duration: duration of the run [s]
        seed: seed of the positions of bumps
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, -GRAVITY), analysis=ddg.Dynamics(dt=dt, duration=duration))
    z = WHEEL + ROUND + RANGE
    box = ddg.Box((0.0, 0.0, z + 0.02), (0.12, 0.06, 0.015))
    chassis = scene.add_body(box, mass=CHASSIS, name="chassis")
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # z to y
    profile = [(0.0, -0.5 * WIDTH), (WHEEL, -0.5 * WIDTH), (WHEEL, 0.5 * WIDTH), (0.0, 0.5 * WIDTH)]
    wheel = _bodies.moved(_bodies.revolved(profile, sides, ROUND), upright)
    for side in (-1, 1):
        x = side * BASE
        shaft = ddg.Capsule((x, -TRACK, z), (x, TRACK, z), 4e-3)
        axle = scene.add_body(shaft, mass=AXLE, name=f"axle {side}")
        for y in (-SIDE, SIDE):
            points = np.linspace((side * (BASE - SPRING), y, z), (x, y, z), 9)
            rod = scene.add_rod(points, section=ddg.Circle(RADIUS), material=LEAF, name="spring")
            scene.attach(rod, [0], chassis)
            scene.attach(rod, [-1], axle)
        for y in (-TRACK, TRACK):
            center = (x, y, z)
            body = scene.add_body(_bodies.moved(wheel, shift=center), mass=RIM, name="wheels")
            drive = {"angle": Drive(speed)} if side < 0 else {}
            scene.hinge(axle, body, point=center, axis=(0.0, 1.0, 0.0), **drive)
    scene.add_obstacle(ddg.Plane(), name="ground")
    along = BASE + 0.12 + np.cumsum(np.random.default_rng(seed).uniform(0.08, 0.16, 6))
    for x in along if rough > 0.0 else ():
        low = rough - BUMP
        scene.add_obstacle(ddg.Capsule((x, -0.15, low), (x, 0.15, low), BUMP), name="bumps")
    scene.contact(
        objects=["wheels"], range=RANGE, stiffness=STIFFNESS, **_many_rods.friction_options(friction, velocity=SLIP)
    )
    return scene


class Drive:
    """Angle of the driven wheels [rad] over time: at rest until `STANDS`, at full speed [m/s] from `STARTS` on."""

    def __init__(self, speed: float):
        self.rate = speed / (WHEEL + ROUND)

    def __call__(self, t: float) -> float:
        s = np.clip(t - STANDS, 0.0, STARTS - STANDS)
        return float(self.rate * (0.5 * s * s / (STARTS - STANDS) + max(0.0, t - STARTS)))


def observe(model, state) -> dict[str, float]:
    """Return `_bodies.observe` with position of the chassis [m], height above the axles, pitch [rad], and positions of axles."""
    chassis = state.body("chassis")
    axles = [state.body(f"axle {side}").position for side in (-1, 1)]
    return _bodies.observe(model, state) | {
        "x": float(chassis.position[0]),
        "z": float(chassis.position[2]),
        "above": float(chassis.position[2] - np.mean(axles, axis=0)[2]),
        "pitch": float(-np.arcsin(chassis.rotation[2, 0])),
        **{
            f"{name} {axis}": float(axle[k])
            for name, axle in zip(("rear", "front"), axles, strict=True)
            for k, axis in ((0, "x"), (2, "z"))
        },
    }


def check(result) -> list[ddg.Check]:
    """Check springs, travel, and that the ground carries the car."""
    checks = [*_many_rods.checks(result), _many_rods.weight_check(result, 0.02)]
    checks += once_reached(result, STANDS, NAMES[:1], lambda: _resting(result))
    driven = max(STARTS, result.scene.analysis.duration)
    return checks + once_reached(result, driven, NAMES[1:], lambda: _driving(result))


def _resting(result) -> list[ddg.Check]:
    sunk = result.series["above"][0] - result.at(STANDS, "above")
    stiffness = LEAF.young * np.pi * RADIUS**4 / 4.0
    exact = 0.25 * CHASSIS * GRAVITY * SPRING**3 / (3.0 * stiffness)
    return [ddg.Check(NAMES[0], sunk, exact, 0.07, "F L^3 / (3 EI)", relative=True)]


def _driving(result) -> list[ddg.Check]:
    scene, end = result.scene, result.times[-1]
    drive = next(joint.angle for joint in scene.body_joints if joint.angle is not None)
    moved = result.series["x"][-1] - result.at(STANDS, "x")
    bumps = [obstacle.shape.points[0, 0] for obstacle in scene.obstacles[1:]]
    front = result.series["x"][-1] + BASE
    passed = sum(x < front for x in bumps)
    return [
        ddg.Check(NAMES[1], moved / ((WHEEL + ROUND) * drive(end)), 1.0, 0.03, "rolling"),
        ddg.Check(NAMES[2], float(passed), float(len(bumps)), 0.0, "positions of bumps"),
    ]


def picture(result, frames) -> dict:
    """Draw the car at the start, on the bumps and behind them, on a strip of the ground."""
    times = sorted(frames)
    end = result.series["x"][-1] + BASE + 2.0 * WHEEL
    strip, cells = meshes.rectangle(160, 6, (end + BASE + 2.0 * WHEEL, 3.0 * TRACK))
    strip = strip - [BASE + 2.0 * WHEEL, 1.5 * TRACK, 0.0]
    for bump in result.scene.obstacles[1:]:
        x, _, z = bump.shape.points[0]
        strip[:, 2] = np.maximum(strip[:, 2], z + np.sqrt(np.maximum(BUMP**2 - (strip[:, 0] - x) ** 2, 0.0)))
    ground = [(strip, cells)]
    bodies = {}
    for time in (times[0], times[3], times[5]):
        parts = [*_car(result, time), *(ground if time == times[0] else [])]
        colors = [np.full((len(cells), 3), GREY if k > 4 else BLUE) for k, (_, cells) in enumerate(parts)]
        bodies[time] = *_bodies.joined(*parts), np.concatenate(colors)
    return {"points_by_time": {t: frames[t] for t in bodies}, "bodies": bodies}


def _car(result, time: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the surfaces of chassis and wheels at a time [s], from the observed numbers."""
    box, *shapes = (body.shapes[0] for body in result.scene.bodies)
    wheels = [(shape.points, shape.cells) for shape in shapes if shape.kind == MESH]
    values = {name: result.at(time, name) for name in ("x", "z", "pitch", "rear x", "rear z", "front x", "front z")}
    chassis = (box.points - box.points.mean(0)) @ _bodies.tilted(values["pitch"]).T
    parts = [(chassis + [values["x"], 0.0, values["z"]], box.cells)]
    for points, cells in wheels:
        middle = 0.5 * (points.min(0) + points.max(0))
        axle = "rear" if middle[0] < 0.0 else "front"
        parts.append((points - middle + [values[f"{axle} x"], middle[1], values[f"{axle} z"]], cells))
    return parts


def benchmark() -> ddg.bench.Study:
    """Study the height of the chassis over steps."""
    return ddg.bench.Study(
        {"dt": (1e-2, 5e-3, 2.5e-3)}, lambda result: result.series["z"][-1], {"dt": 1.25e-3}, unit="m"
    )

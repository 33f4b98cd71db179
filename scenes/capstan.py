"""Capstan: a rod slides over a fixed drum, and friction multiplies its tension (Euler and Eytelwein).

A string wound about a drum by the angle phi slides at T2 = T1 exp(mu phi). Friction acts here on the centreline, between the
closest points of rod and axis. It makes no couple, and the exponent is mu instead of the smaller one of surface friction. A rod with
bending stiffness B leaves the drum, of radius R to its centreline, at an angle t to its line of pull T. With
sin(t/2) = sqrt(B / T) / 2R the drum exerts a point force T sin(t) there:

    T2 (cos t2 - mu sin t2) = T1 (cos t1 + mu sin t1) exp(mu (phi - t1 - t2)) ,

equal to T1 exp(mu phi) up to t^2. A dead force T1 pulls one end; the other moves away at a constant speed.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods, _pictures

DRUM = 0.05  # m, radius
RADIUS = 0.001  # m
RANGE = 1e-4  # m, activation distance
AROUND = DRUM + RADIUS + 0.5 * RANGE  # m, radius of the wound centreline
B = 1e-4  # N m^2
STIFF = 4.0e4  # EA over T2
MASS_PER_LENGTH = 1e-4  # kg/m
TAIL = 1.0  # length of either end off the drum over AROUND
SPREAD = 6.0  # radii between neighbouring turns
STEP_TIME = 1.0  # s, long against all periods: motion is quasi-static
SPEED = 2.5e-3 * AROUND  # m/s, of the drawn end
VELOCITY = 0.5 * SPEED  # m/s, stick threshold, below the sliding speed so that friction is full
SETTLED = 0.5  # fraction of the run after which the tension is averaged


def build(
    friction: float = 0.3,
    turns: float = 0.5,
    n: int = 60,
    tension: float = 1000.0,
    steps: int = 60,
    stiffness: float = 1e4,
    range: float = RANGE,
    velocity: float = VELOCITY,
    friction_iterations: int = 1,
    seed: int = -1,
) -> ddg.Scene:
    """Build the rod about a drum along y, wound upwards over its top.

    Args:
        friction: friction coefficient
        turns: turns of the rod about the drum
        n: edges in half a turn
        tension: tension of the slack end, T1 R^2 / B
        steps: time steps
        stiffness: contact stiffness [N/m]
        range: activation distance of contact [m]
        velocity: stick threshold nu of the friction law [m/s]; the default is half the drawing speed
        friction_iterations: normal-force iterations a step
        seed: seed of the initial jitter of nodes, a fifth of the activation distance; no jitter below 0
    """
    if not 0.0 < turns <= 1.0:
        raise ValueError(f"turns = {turns}; the rod is wound by up to one turn")
    if n < 8:
        raise ValueError(f"n = {n}; half a turn has 8 edges at least")
    if not tension * 4.0 > 1.0 + 4.0 / TAIL**2:
        raise ValueError(f"tension = {tension}; below {0.25 + 1.0 / TAIL**2:g} the rod is too stiff to lie on the drum")
    slack = tension * B / AROUND**2
    points, ends = wound(2.0 * np.pi * turns, np.pi * AROUND / n, DRUM + RADIUS + 0.5 * range)
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Dynamics(dt=STEP_TIME, duration=steps * STEP_TIME),
        initial=lambda model: bent(model, points, seed),
    )
    EA = STIFF * slack * np.exp(2.0 * np.pi * friction * turns)
    section = ddg.Stiffness(EA=EA, EI1=B, GJ=B, mass_per_length=MASS_PER_LENGTH, rotary_inertia=1e-10, radius=RADIUS)
    rod = scene.add_rod(points, section=section, natural="straight", name="rod")
    scene.add_force(rod, 0, slack * ends[0])
    scene.fix(rod, [-1], motion=ddg.Motion(translation=lambda t: tuple(SPEED * t * ends[1])))
    scene.add_obstacle(ddg.Capsule((0.0, -DRUM, 0.0), (0.0, DRUM, 0.0), DRUM), name="drum")
    scene.contact(
        range=range,
        stiffness=stiffness,
        **_many_rods.friction_options(friction, velocity=velocity, friction_iterations=friction_iterations),
    )
    return scene


def wound(angle: float, edge: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) [m] of a helix about y with straight ends, and outward unit vectors (2, 3) along the ends.

    Edges of length `edge` [m] are tangent at their middles to the cylinder of radius `radius` [m].
    """
    around = radius / np.cos(0.5 * edge / radius)
    rise = SPREAD * RADIUS / (2.0 * np.pi) * (angle > np.pi)  # up to half a turn it stays in a plane
    speed = np.hypot(around, rise)
    tail = TAIL * around
    count = int(np.ceil((angle * speed + 2.0 * tail) / edge))
    s = np.linspace(-0.5, 0.5, count + 1) * (angle * speed + 2.0 * tail)
    a = np.clip(s / speed, -0.5 * angle, 0.5 * angle)
    beyond = (s - a * speed)[:, None]
    tangent = np.stack([around * np.cos(a), rise + 0.0 * a, -around * np.sin(a)], axis=1) / speed
    points = np.stack([around * np.sin(a), rise * a, around * np.cos(a)], axis=1) + beyond * tangent
    return points, np.stack([-tangent[0], tangent[-1]])


def bent(model, points: np.ndarray, seed: int):
    """Return the wound state of the rod; its rest shape is straight."""
    free = np.arange(len(points))[:, None] < len(points) - 1
    return model.state(
        points=points + 0.2 * model.scene.contact_settings.range * free * _many_rods.jitter(points.shape, seed)
    )


def observe(model, state) -> dict[str, float]:
    """Return the tension of the drawn end over that of the slack end, and the smallest gap [m]."""
    slack = np.array(model.scene.loads[0].force)
    drawn = np.reshape(model.reactions(state)[0].force, (-1, 3))[0]
    return {
        "ratio": float(np.linalg.norm(drawn) / np.linalg.norm(slack)),
        "gap": _many_rods.smallest_gap(model, state),
    }


def expected(friction: float, angle: float, slack: float) -> float:
    """Return T2 / T1 of a rod wound by an angle [rad] between both pulls, with T1 = slack [N]."""
    from scipy.optimize import brentq

    def leaves(tension):
        return 2.0 * np.arcsin(min(1.0, 0.5 * np.sqrt(B / tension) / AROUND))

    first = leaves(slack)
    low = slack * (np.cos(first) + friction * np.sin(first))

    def excess(tension):
        t = leaves(tension)
        return tension * (np.cos(t) - friction * np.sin(t)) - low * np.exp(friction * (angle - first - t))

    string = slack * np.exp(friction * angle)
    return brentq(excess, 0.5 * string, 2.0 * string) / slack


def check(result) -> list[ddg.Check]:
    """Check the ratio of tensions against a rod and a string."""
    names = ("T2 / T1 of a rod", "T2 / T1 of a string")
    checks = once_reached(result, result.model.scene.analysis.duration, names, lambda: _checks(result, names))
    return checks + _many_rods.kept_apart(result)


def _checks(result, names) -> list[ddg.Check]:
    scene = result.model.scene
    mu, slack = scene.contact_settings.friction, np.array(scene.loads[0].force)
    tension = np.linalg.norm(slack)
    steps = np.diff(scene.batches[0].points[0], axis=0)
    steps /= np.linalg.norm(steps, axis=1)[:, None]
    angle = np.arccos(np.clip((steps[1:] * steps[:-1]).sum(axis=1), -1.0, 1.0)).sum()
    settled = np.array(result.times) > SETTLED * result.times[-1]
    ratio = np.array(result.series["ratio"])[settled].mean()
    leaves = B / tension / AROUND**2  # t1^2
    return [
        ddg.Check(names[0], ratio, expected(mu, angle, tension), 0.02, "capstan with bending stiffness, exact", True),
        ddg.Check(names[1], ratio, np.exp(mu * angle), 0.02 + leaves, "Euler and Eytelwein", True),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the ratio of tensions over parameters of contact, friction, steps and nodes, one by one."""
    grid = {"n": (15, 30, 60, 120), "dt": (4.0, 2.0, 1.0, 0.5)}
    grid |= {
        name: tuple(usual * s for s in (0.1, 0.3, 1.0, 3.0, 10.0))
        for name, usual in (("stiffness", 1e4), ("velocity", VELOCITY))
    }
    grid |= {
        "range": (2.5e-5, 5e-5, RANGE, 2e-4, 4e-4),
        "rtol": (1e-3, 1e-4, 1e-5, 1e-6, 1e-8),
        "friction_iterations": (1, 2, 3),
    }
    return ddg.bench.Study(grid, "T2 / T1 of a rod", one_by_one=True)


def picture(result, frames) -> dict:
    """Draw the rod on the drum, colored by the tension, and the tension along the rod against the formula."""
    tension = _pictures.at_points(result.model, result.state, "axial_force")
    points = result.state.points()
    around = np.unwrap(np.arctan2(points[:, 0], points[:, 2]))
    arc = np.degrees(around - around[0])
    slack, friction = float(np.linalg.norm(result.scene.loads[0].force)), result.scene.contact_settings.friction
    wound = np.abs(np.hypot(points[:, 0], points[:, 2]) - AROUND) < RANGE
    start = arc[wound][0]
    return {
        "points_by_time": {max(frames): frames[max(frames)]},
        "values": tension,
        "label": "tension [N]",
        "chart": {
            "lines": [
                (
                    "slack end times exp(µ angle)",
                    arc[wound],
                    slack * np.exp(friction * np.radians(arc[wound] - start)),
                    "-",
                ),
                ("along the rod", arc, tension, "o"),
            ],
            "x": "angle about the drum [degrees]",
            "y": "tension [N]",
        },
    }

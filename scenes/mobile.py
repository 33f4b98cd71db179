"""Mobile: bars hinged to clips on threads carry balls, swing, and come to rest by the law of the lever.

A bar is pivoted at a clip, a height d above its axis, and threads hang on both arms. The loads are W1 and W2 at the arms a and b, the
weight of the bar is W at c from the pivot. At rest the bar is inclined by the angle p of

    tan(p) = (W2 b - W1 a + W c) / ((W1 + W2 + W) d) ,

and every thread carries the weight of all below it. Pivots are placed for balance; then the last ball is made a little heavier, by
which every bar above it inclines.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

THREAD_MASS = 1e-5  # kg/m
THREAD = ddg.Stiffness(EA=2e3, EI1=1e-8, GJ=1e-8, mass_per_length=THREAD_MASS, rotary_inertia=1e-11, radius=5e-4)
EDGES = 4  # edges of a thread
DROP = 0.08  # m, length of a thread
RAISED = 0.015  # m, of the pivot above the bar
BAR, CLIP = 3e-3, 4e-3  # m, radii
CLIP_MASS = 1e-3  # kg
DENSITY, LEAD = 1000.0, 2000.0  # kg/m^3, of bars and balls
BALLS = (0.05, 0.02, 0.012, 0.01)  # kg, from the left of the highest bar to the right of the lowest
SPANS = (0.30, 0.22, 0.16)  # m, lengths of the bars, from above
GRAVITY = 9.81  # m/s^2
RESTS = 5.0  # s, time at which the damped mobile is at rest


def build(
    heavier: float = 0.1, damping: float = 2.0, dt: float = 1e-2, duration: float = 6.0, spin: float = 2.0
) -> ddg.Scene:
    """Build the mobile in the plane of x and z, hung up at the origin.

    Args:
        heavier: additional mass of the last ball, over its mass at balance
        damping: mass-proportional damping by the air [1/s]
        dt: time step [s]
        duration: duration of the run [s]
        spin: rate of the highest bar about the vertical at the start [rad/s]
    """
    scene = ddg.Scene(
        gravity=(0.0, 0.0, -GRAVITY), mass_damping=damping, analysis=ddg.Dynamics(dt=dt, duration=duration)
    )
    carrier, hook = None, np.zeros(3)
    for level in range(len(SPANS)):
        thread = hang(scene, hook, f"thread {level}")
        if carrier is None:
            scene.fix(thread, [0], name="hook")
        else:
            scene.attach(thread, [0], carrier, frame=False)
        pivot = hook - [0.0, 0.0, DROP]
        clip = scene.add_body(ddg.Sphere(tuple(pivot), CLIP), mass=CLIP_MASS, name=f"clip {level}")
        scene.attach(thread, [-1], clip, frame=False)
        left, right = arms(level)
        ends = pivot + [[-left, 0.0, -RAISED], [right, 0.0, -RAISED]]
        rate = (0.0, 0.0, 0.0 if level else spin)
        carrier = scene.add_body(
            ddg.Capsule(*ends, BAR),
            density=DENSITY,
            velocity=np.cross(rate, ends.mean(0)),
            angular_velocity=rate,
            name=f"bar {level}",
        )
        scene.hinge(clip, carrier, point=pivot, axis=(0.0, 1.0, 0.0), name=f"hinge {level}")
        for number, end in enumerate(ends if level == len(SPANS) - 1 else ends[:1], level):
            below = hang(scene, end, f"ball thread {number}")
            mass = BALLS[number] * (1.0 + heavier * (number == len(BALLS) - 1))
            radius = (3.0 * mass / (4.0 * np.pi * LEAD)) ** (1.0 / 3.0)
            shape = ddg.Sphere(tuple(end - [0.0, 0.0, DROP + radius]), radius)
            ball = scene.add_body(shape, mass=mass, name=f"ball {number}")
            scene.attach(below, [0], carrier, frame=False)
            scene.attach(below, [-1], ball, frame=False)
        hook = ends[1]
    return scene


def hang(scene, top, name: str):
    """Add a thread that hangs from a point, and return it."""
    points = np.linspace(top, top - np.array([0.0, 0.0, DROP]), EDGES + 1)
    return scene.add_rod(points, section=THREAD, twist=False, name=name)


def arms(level: int) -> tuple[float, float]:
    """Return the arms of a bar (a, b) [m], which balance the loads at its ends and the weight of the bar."""
    left, right, bar = loads(level)
    span = SPANS[level]
    total = left + right + bar
    a = (right * span + bar * 0.5 * span) / total
    return a, span - a


def loads(level: int, heavier: float = 0.0) -> tuple[float, float, float]:
    """Return the masses that hang at both ends of a bar, and of the bar [kg]."""
    bars = [DENSITY * np.pi * BAR**2 * (span + 4.0 / 3.0 * BAR) for span in SPANS]
    last = len(SPANS) - 1
    thread, clip = DROP * THREAD_MASS, CLIP_MASS
    right = BALLS[-1] * (1.0 + heavier) + thread
    for k in range(last, level, -1):
        right += BALLS[k] + thread + bars[k] + clip + thread
    return BALLS[level] + thread, right, bars[level]


def expected(level: int, heavier: float) -> float:
    """Return the inclination of a bar [rad], positive if its right end is lower."""
    left, right, bar = loads(level, heavier)
    a, b = arms(level)
    moment = right * b - left * a + bar * 0.5 * (b - a)
    return np.arctan2(moment, (left + right + bar) * RAISED)


def observe(model, state) -> dict[str, float]:
    """Return inclinations of the bars [rad], forces in the threads [N] and the kinetic energy [J]."""
    stresses, result = model.stresses(state), {"kinetic": model.energies(state)["kinetic"]}
    for level in range(len(SPANS)):
        along = state.body(f"bar {level}").rotation[:, 0]
        result[f"inclination {level}"] = float(-np.arcsin(along[2]))
        result[f"force {level}"] = float(stresses.rod(f"thread {level}").axial_force.mean())
    return result


def check(result) -> list[ddg.Check]:
    """Check inclinations of the bars and forces in the threads at rest."""
    names = [
        f"{text} {level}"
        for text in ("tangent of the inclination of bar", "force in thread over weight below it,")
        for level in range(len(SPANS))
    ]
    heavier = result.model.scene.bodies[-1].mass / BALLS[-1] - 1.0
    return once_reached(result, RESTS, names, lambda: _checks(result, heavier, names))


def _checks(result, heavier: float, names) -> list[ddg.Check]:
    last = {name: values[-1] for name, values in result.series.items()}
    count = len(SPANS)
    tangents = [np.tan(last[f"inclination {level}"]) for level in range(count)]
    weights = [GRAVITY * (sum(loads(level, heavier)) + CLIP_MASS + 0.5 * DROP * THREAD_MASS) for level in range(count)]
    ratios = [last[f"force {level}"] / weights[level] for level in range(count)]
    exact = [np.tan(expected(level, heavier)) for level in range(count)]
    checks = [
        ddg.Check(name, value, reference, 0.02 * max(abs(reference), 0.1), "law of the lever")
        for name, value, reference in zip(names, tangents, exact, strict=False)
    ]
    return checks + [
        ddg.Check(name, ratio, 1.0, 0.01, "equilibrium") for name, ratio in zip(names[count:], ratios, strict=True)
    ]


def picture(result, frames) -> dict:
    """Draw the mobile at the start, in motion and at rest."""
    times = sorted(frames)
    return {"points_by_time": {t: frames[t] for t in (times[0], times[1], times[-1])}, "side_by_side": True}


def benchmark() -> ddg.bench.Study:
    """Study the inclination of the lowest bar over steps."""
    return ddg.bench.Study(
        {"dt": (4e-2, 2e-2, 1e-2)}, lambda result: result.series["inclination 2"][-1], {"dt": 5e-3}, unit="rad"
    )

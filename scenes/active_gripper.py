"""Five fingers wind about a post and hold it: the pull that it takes to draw it out is what friction says.

The fingers are rods that stand around a post, straight and askew, clamped at a palm. Muscles give them natural curvature and twist,
those of helices that are narrower than the post: so they wind about it, side by side, and press on it. Then the post is drawn away
from the palm. Where it slides through the fingers, along itself, friction is mu times all that they press, and the palm feels as much.
The pull makes the helices narrower, so that they press the harder. Each finger is the next one, turned by 72 degrees.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _touching

FINGERS = 5
LENGTH = 0.2  # m, of a finger
RADIUS = 2e-3  # m, of a finger
RUBBER = ddg.Material(young=5e7, poisson=0.5, density=1100.0, viscosity=5e-3)
POST = 0.01  # m, radius
STANDS = POST + RADIUS + 1e-3  # m, from the axis of the post to the clamps
RISE = 0.02  # m, of the helices in a radian about the post
TIGHT = 0.8  # radius of the natural helices over the one that fingers have on the post
RANGE = 2e-4  # m, of contact
WINDS, PULLS, END = 1.0, 1.5, 2.5  # s: muscles are tense; the post starts to move; end
SPEED = 0.02  # m/s, of the post
VELOCITY = 1e-3  # m/s, of the friction law


def build(n: int = 60, friction: float = 0.3, dt: float = 0.01, damping: float = 2.0, seed: int = -1) -> ddg.Scene:
    """The fingers hang from the palm z = 0, the post is along z.

    Args:
        n: edges of a finger
        friction: coefficient
        dt: time step [s]
        damping: of masses [1/s]
        seed: of a jitter of the nodes at first, half of the range of contact; none below 0
    """
    scene = ddg.Scene(
        analysis=ddg.Dynamics(dt=dt, duration=END),
        mass_damping=damping,
        initial=lambda model: standing(model, seed),
        callbacks=[lambda state: actuate(state.model, state.time)],
    )
    angle = 2.0 * np.pi * np.arange(FINGERS) / FINGERS
    out = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    round_it = np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
    tangent = TIGHT * (POST + RADIUS) * round_it - RISE * np.array([0.0, 0.0, 1.0])
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    points = STANDS * out[:, None] + np.linspace(0.0, LENGTH, n + 1)[:, None] * tangent[:, None]
    fingers = scene.add_rods(
        points, section=ddg.Circle(RADIUS), material=RUBBER, natural="straight", director=-out, name="fingers"
    )
    scene.clamp_end(fingers)
    pulled = ddg.Motion(translation=lambda t: (0.0, 0.0, -SPEED * max(0.0, t - PULLS)))
    scene.add_obstacle(
        ddg.Capsule((0.0, 0.0, -1.5 * LENGTH), (0.0, 0.0, 0.5 * LENGTH), POST), motion=pulled, name="post"
    )
    scene.contact(range=RANGE, friction=friction, velocity=VELOCITY)
    return scene


def standing(model, seed: int):
    """The fingers as they stand, but for a jitter."""
    actuate(model, 0.0)
    points = model.state().points()
    free = np.arange(model.scene.batches[0].nodes) > 1
    return model.state(
        points=points + 0.5 * RANGE * np.tile(free, FINGERS)[:, None] * _touching.jitter(points.shape, seed)
    )


def actuate(model, t: float) -> None:
    """Give the fingers the natural curvature and twist of a time [s]; right where they have it."""
    share = np.sin(0.5 * np.pi * min(1.0, t / WINDS)) ** 2
    radius = TIGHT * (POST + RADIUS)
    for name, whole in (("rest_1", radius), ("rest_3", -RISE)):
        value = share * whole / (radius**2 + RISE**2)
        if np.any(model.parameters()[f"net/rod_bend_twist/{name}"] != value):
            model.set_parameter("rod_bend_twist", name, value)


def observe(model, state) -> dict[str, float]:
    """Fewest turns of a finger about the post; what presses on it and what the palm feels of its pull [N]; how much fingers differ.

    The last is the difference between the finger that presses most and the one that presses least, over their mean.
    """
    points = state.points().reshape(FINGERS, -1, 3)
    turns = np.diff(np.unwrap(np.arctan2(points[..., 1], points[..., 0]), axis=1)[:, [0, -1]], axis=1) / (2.0 * np.pi)
    found = model.contacts(state)
    pressed = np.zeros(FINGERS + 1)
    np.add.at(pressed, found.objects[:, 0], np.linalg.norm(found.force, axis=1) * (found.objects[:, 1] >= FINGERS))
    each = pressed[:FINGERS]
    palm = np.reshape(model.reactions(state)[0].force, (-1, 3))[:, 2].sum()
    return {
        "turns": float(np.abs(turns).min()),
        "pressed": float(each.sum()),
        "pull": float(palm - weight(model)),
        "unlike": float(np.ptp(each) / max(each.mean(), 1e-300)),
        "gap": _touching.smallest_gap(model, state),
    }


def weight(model) -> float:
    """Of all fingers [N]."""
    return float(FINGERS * LENGTH * model.scene.batches[0].section.mass_per_length * 9.81)


def check(result) -> list[ddg.Check]:
    """The fingers wind about the post, all alike, and it slides as soon as it is drawn by mu times what they press."""
    names = (
        "turns of fingers about the post",
        "pull over mu times what presses on the post",
        "fingers press on the post unlike",
    )
    return once_reached(result, END, names, lambda: _checks(result, names)) + _touching.kept_apart(result)


def _checks(result, names) -> list[ddg.Check]:
    series, t = {name: np.array(values) for name, values in result.series.items()}, np.array(result.times)
    slides, still = t > PULLS + 0.6 * (END - PULLS), (t > WINDS + 0.25) & (t <= PULLS)
    mu = result.model.scene.touching.friction
    wound = LENGTH / np.hypot(POST + RADIUS, RISE) / (2.0 * np.pi)
    ratio = series["pull"][slides] / (mu * series["pressed"][slides])
    return [
        ddg.Check(
            names[0], series["turns"][still].mean(), wound, 0.15, "helix on the post, as steep as the natural one", True
        ),
        ddg.Check(names[1], ratio.mean(), 1.0, 0.01, "Coulomb"),
        ddg.Check(names[2], series["unlike"][still].max(), 0.0, 0.02, "turned by 72 degrees"),
    ]


def benchmark() -> ddg.bench.Study:
    """The pull that the fingers hold, over edges and steps, against a finer one."""
    return ddg.bench.Study(
        {"n": (30, 60), "dt": (0.02, 0.01)}, lambda result: result.series["pull"][-1], {"n": 120, "dt": 0.005}, unit="N"
    )


def picture(result, frames) -> dict:
    """Fingers and post at first, as they wind, and drawn at the end, all as thick as they are."""
    pole, cells = meshes.cylinder(24, 1, POST, 1.2 * LENGTH)
    pole = pole - [0.0, 0.0, 1.1 * LENGTH]
    times = sorted(frames)
    times = times[0], min(times, key=lambda t: abs(t - 0.5 * WINDS)), times[-1]
    post = {t: (pole - [0.0, 0.0, SPEED * max(0.0, t - PULLS)], cells) for t in times}
    return {
        "points_by_time": {t: frames[t] for t in times},
        "bodies": post,
        "colors": _touching.colors(result.model),
        "side_by_side": True,
    }

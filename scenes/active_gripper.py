"""Active gripper: five fingers coil around a post, and friction resists the pull that extracts it.

The fingers are rods around a post, straight and inclined, clamped at a palm. Muscles give them the natural curvature and twist of
helices narrower than the post, so that they coil around it side by side and press on it. Then the post moves away from the palm.
While it slides axially through the fingers, friction is mu times the total normal force, and the palm carries the same force. The
pull narrows the helices, so that they press harder. The fingers are rotated copies, 72 degrees apart.
"""

from functools import partial

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

FINGERS = 5
LENGTH = 0.2  # m, of a finger
RADIUS = 2e-3  # m, of a finger
RUBBER = ddg.Material(young=5e7, poisson=0.5, density=1100.0, viscosity=5e-3)
POST = 0.01  # m, radius
STANDS = POST + RADIUS + 1e-3  # m, distance of the clamps from the axis of the post
RISE = 0.02  # m, rise of the helices per radian around the post
TIGHT = 0.8  # radius of the natural helices over that of fingers on the post
RANGE = 2e-4  # m, activation distance
WINDS, PULLS, END = 1.0, 1.5, 2.5  # s: end of muscle activation, start of the post's motion, end of the run
SPEED = 0.02  # m/s, of the post
VELOCITY = 1e-3  # m/s, stick threshold of friction


def build(n: int = 60, friction: float = 0.3, dt: float = 0.01, damping: float = 2.0, seed: int = -1) -> ddg.Scene:
    """Build the scene: fingers hang from the palm z = 0, the post is along z.

    Args:
        n: edges of a finger
        friction: friction coefficient
        dt: time step [s]
        damping: mass-proportional damping [1/s]
        seed: seed of the initial jitter of nodes, half of the activation distance; no jitter below 0
    """
    scene = ddg.Scene(
        analysis=ddg.Dynamics(dt=dt, duration=END),
        mass_damping=damping,
        initial=lambda model: standing(model, seed),
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
    radius = TIGHT * (POST + RADIUS)
    for name, strain, whole in (("curl", "rest_1", radius), ("twist", "rest_3", -RISE)):
        scene.prescribe(name, f"rod_bend_twist.{strain}", partial(activated, whole / (radius**2 + RISE**2)))
    pulled = ddg.Motion(translation=lambda t: (0.0, 0.0, -SPEED * max(0.0, t - PULLS)))
    scene.add_obstacle(
        ddg.Capsule((0.0, 0.0, -1.5 * LENGTH), (0.0, 0.0, 0.5 * LENGTH), POST), motion=pulled, name="post"
    )
    scene.contact(range=RANGE, friction=friction, velocity=VELOCITY)
    return scene


def standing(model, seed: int):
    """Return the initial state with jitter of the free nodes."""
    points = model.state().points()
    free = np.arange(model.scene.batches[0].nodes) > 1
    return model.state(
        points=points + 0.5 * RANGE * np.tile(free, FINGERS)[:, None] * _many_rods.jitter(points.shape, seed)
    )


def activated(strain: float, t: float) -> float:
    """Return the natural strain that muscles have built up at a time [s], out of a whole one."""
    return strain * np.sin(0.5 * np.pi * min(1.0, t / WINDS)) ** 2


def observe(model, state) -> dict[str, float]:
    """Return the fewest turns of a finger, normal force on the post and pull on the palm [N], and the spread of finger forces.

    The spread is the difference between the largest and the smallest normal force of a finger, over the mean.
    """
    points = state.points().reshape(FINGERS, -1, 3)
    turns = np.diff(np.unwrap(np.arctan2(points[..., 1], points[..., 0]), axis=1)[:, [0, -1]], axis=1) / (2.0 * np.pi)
    contacts = model.contacts(state)
    pressed = np.zeros(FINGERS + 1)
    np.add.at(
        pressed, contacts.objects[:, 0], np.linalg.norm(contacts.force, axis=1) * (contacts.objects[:, 1] >= FINGERS)
    )
    each = pressed[:FINGERS]
    palm = np.reshape(model.reactions(state)[0].force, (-1, 3))[:, 2].sum()
    return {
        "turns": float(np.abs(turns).min()),
        "pressed": float(each.sum()),
        "pull": float(palm - weight(model)),
        "unlike": float(np.ptp(each) / max(each.mean(), 1e-300)),
        "gap": _many_rods.smallest_gap(model, state),
    }


def weight(model) -> float:
    """Return the weight of all fingers [N]."""
    return float(FINGERS * LENGTH * model.scene.batches[0].section.mass_per_length * 9.81)


def check(result) -> list[ddg.Check]:
    """Check coiling and symmetry of the fingers, and a pull of mu times the normal force during sliding."""
    names = (
        "turns of fingers about the post",
        "pull over mu times what presses on the post",
        "fingers press on the post unlike",
    )
    return once_reached(result, END, names, lambda: _checks(result, names)) + _many_rods.kept_apart(result)


def _checks(result, names) -> list[ddg.Check]:
    series, t = {name: np.array(values) for name, values in result.series.items()}, np.array(result.times)
    slides, still = t > PULLS + 0.6 * (END - PULLS), (t > WINDS + 0.25) & (t <= PULLS)
    mu = result.model.scene.contact_settings.friction
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
    """Study the final pull over edges and steps against a finer run."""
    return ddg.bench.Study(
        {"n": (30, 60), "dt": (0.02, 0.01)}, lambda result: result.series["pull"][-1], {"n": 120, "dt": 0.005}, unit="N"
    )


def picture(result, frames) -> dict:
    """Draw fingers and post at the start, during coiling and at the end, with actual thickness."""
    pole, cells = meshes.cylinder(24, 1, POST, 1.2 * LENGTH)
    pole = pole - [0.0, 0.0, 1.1 * LENGTH]
    times = sorted(frames)
    times = times[0], min(times, key=lambda t: abs(t - 0.5 * WINDS)), times[-1]
    post = {t: (pole - [0.0, 0.0, SPEED * max(0.0, t - PULLS)], cells) for t in times}
    return {
        "points_by_time": {t: frames[t] for t in times},
        "bodies": post,
        "colors": _many_rods.colors(result.model),
        "side_by_side": True,
    }

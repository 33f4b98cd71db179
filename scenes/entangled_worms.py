"""Entangled worms: active rods in a bundle coil around each other and tangle into a blob.

They start as the wires of a rope, in layers of alternating hand. Muscles change their natural shapes to narrower and steeper helices,
so that they coil further and press inwards, and drive waves of curvature of random phases along them. Living worms tangle by helical
waves as well (Patil et al., Science 380, 2023, 392). There is no gravity, no fluid and no wall: momentum stays zero under muscles,
contact, friction and internal damping.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _layouts, _many_rods

LENGTH = 0.15  # m
RADIUS = 1.5e-3  # m
FLESH = ddg.Material(young=5e5, density=1000.0, poisson=0.5, viscosity=0.02)
RANGE = 3e-4  # m, activation distance
SPACING = 2.2 * RADIUS + 1.5 * RANGE  # m, between layers of the bundle
LAY = 0.4  # slope of worms against the axis of the bundle
COIL, RISE = 5e-3, 4e-3  # m, final radius of the natural helices, and rise per radian
WAVES, AMPLITUDE = 1.5, 0.2  # number of curvature waves along a worm, and amplitude over the curvature
PERIOD = 1.0  # s, of the waves
WINDS = 1.0  # s, duration of the growth of curvature and twist


def build(
    count: int = 13,
    n: int = 60,
    friction: float = 0.3,
    dt: float = 0.01,
    duration: float = 1.5,
    seed: int = 1,
) -> ddg.Scene:
    """Build the bundle along z.

    Args:
        count: number of worms, 7 or more
        n: edges of each
        friction: Coulomb friction coefficient
        dt: time step [s]
        duration: duration of the run [s]
        seed: seed of the phases
    """
    if count < 7:
        raise ValueError(f"count = {count}; there are 7 worms at least, one and six about it")
    phases = 2.0 * np.pi * _layouts.random(seed).uniform(size=(count, 1))
    angle, radius, hand = bundle(count)
    tight = np.stack([COIL * hand**0, RISE * hand]) / (COIL**2 + RISE**2)
    slack = LAY / (1.0 + LAY**2) / np.maximum(radius, SPACING) * np.stack([LAY * hand**2, hand])

    def activation(t: float) -> float:
        return np.sin(0.5 * np.pi * min(1.0, t / WINDS)) ** 2

    def curvature(t: float) -> np.ndarray:
        grown = slack[0] + activation(t) * (tight - slack)[0]
        wave = np.sin(2.0 * np.pi * (WAVES * np.arange(1, n) / n - t / PERIOD) + phases)
        return grown[:, None] * (1.0 + activation(t) * AMPLITUDE * wave)

    def twist(t: float) -> np.ndarray:
        return (slack[1] + activation(t) * (tight - slack)[1])[:, None]

    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Dynamics(dt=dt, duration=duration))
    z = np.linspace(-0.5 * LENGTH, 0.5 * LENGTH, n + 1) / np.sqrt(1.0 + LAY**2)
    turned = (angle + hand * LAY * z[:, None] / np.maximum(radius, SPACING)).T
    out = np.stack([np.cos(turned), np.sin(turned), 0.0 * turned], axis=-1)
    points, inwards = radius[:, None, None] * out + z[:, None] * [0.0, 0.0, 1.0], -(out[:, 1:] + out[:, :-1])
    scene.add_rods(
        points, section=ddg.Circle(RADIUS), material=FLESH, natural="straight", director=inwards, name="worms"
    )
    scene.prescribe("curvature", "rod_bend_twist.rest_1", curvature)
    scene.prescribe("twist", "rod_bend_twist.rest_3", twist)
    scene.contact(range=RANGE, friction=friction)
    return scene


def bundle(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return angle about the axis [rad], distance from it [m], and hand of worms (count,): one, six around, and so on."""
    layers = int(np.ceil(np.sqrt(count / 3.0))) + 1
    sizes, left = [], count
    for layer in range(layers):
        sizes.append(min(left, max(1, 6 * layer)))
        left -= sizes[-1]
    layer = np.repeat(np.arange(layers), sizes)
    angle = np.concatenate([2.0 * np.pi * np.arange(size) / max(1, size) for size in sizes])
    return angle, SPACING * layer, np.where(layer > 0, 1.0 - 2.0 * (layer % 2), 0.0)


def observe(model, state) -> dict[str, float]:
    """Return `_many_rods.observe` with total contact force [N], momentum [N s], radius of gyration [m], and number of blobs.

    The total contact force is the sum of magnitudes over all pairs; a blob is a connected component of worms in contact.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    points, contacts, worms = state.points(), model.contacts(state), _many_rods.rods_of(model)
    touching = coo_array((np.ones(len(contacts)), contacts.objects.T), shape=(worms, worms))
    return _many_rods.observe(model, state) | {
        "pushed": float(np.linalg.norm(contacts.force, axis=1).sum()),
        "drift": float(np.linalg.norm(_many_rods.momentum(model, state))),
        "gyration": float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())),
        "blobs": float(connected_components(touching, directed=False)[0]),
    }


def check(result) -> list[ddg.Check]:
    """Check that nothing interpenetrates, momentum stays zero, and all worms form one blob denser than a bundle."""
    names = (
        "pairs that touch in the closest bundle over those here",
        "radius of gyration over that of the bundle",
        "blobs of worms",
    )
    momentum = max(result.series["drift"]) / (result.dt * np.sum(result.series["pushed"]))
    return [
        *_many_rods.checks(result),
        ddg.Check("momentum over all that worms exchange", momentum, 0.0, 1e-6, "actio is reactio"),
        *once_reached(result, WINDS, names, lambda: _checks(result, names)),
    ]


def _checks(result, names) -> list[ddg.Check]:
    worms, final = _many_rods.rods_of(result.model), slice(-max(1, len(result.times) // 10), None)
    # largest number of contacts between n equal disks in a plane
    most = np.floor(3.0 * worms - np.sqrt(12.0 * worms - 3.0))
    pairs, size = np.mean(result.series["touching_rods"][final]), result.series["gyration"]
    return [
        ddg.Check(names[0], most / pairs, 0.0, 0.9, "Harborth 1974, of parallel cylinders"),
        ddg.Check(names[1], np.mean(size[final]) / size[0], 0.0, 0.8, "they wind up"),
        ddg.Check(names[2], max(result.series["blobs"][final]), 1.0, 0.0, "they hold each other"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the radius of gyration of a few coiling worms over edges and steps."""
    return ddg.bench.Study(
        {"n": (30, 60), "dt": (0.02, 0.01)},
        lambda result: result.series["gyration"][-1],
        {"n": 90, "dt": 0.0025},
        fixed={"count": 7, "duration": 0.6},
        unit="m",
    )


def picture(result, frames) -> dict:
    """Draw the bundle and the blob with actual thickness."""
    times = sorted(frames)
    times = times[0], times[len(times) // 3], times[-1]
    return {
        "points_by_time": {t: frames[t] for t in times},
        "colors": _many_rods.colors(result.model),
        "thick": True,
        "side_by_side": True,
    }

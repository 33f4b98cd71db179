"""Worms in a bundle wind about each other and tangle into a blob: nothing but each other acts on them.

They start as the wires of a rope, in layers that are wound by turns to the right and to the left. Muscles make their natural shapes
helices that become narrower and steeper, so that they wind on and press inwards, and let waves of curvature of random phases run along
them, by which they writhe; living worms tangle by helical waves as well (Patil et al., Science 380, 2023, 392). There is no gravity, no
fluid and no wall: momentum stays zero, whatever muscles, contact, friction and inner damping do.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _layouts, _touching

LENGTH = 0.15  # m
RADIUS = 1.5e-3  # m
FLESH = ddg.Material(young=5e5, density=1000.0, poisson=0.5, viscosity=0.02)
RANGE = 3e-4  # m, of contact
SPACING = 2.2 * RADIUS + 1.5 * RANGE  # m, between layers of the bundle
LAY = 0.4  # slope of worms against its axis
COIL, RISE = 5e-3, 4e-3  # m, radius of the natural helices in the end, and how far they rise in a radian
WAVES, AMPLITUDE = 1.5, 0.2  # of their curvature along a worm, and how large over it
PERIOD = 1.0  # s, of the waves
WINDS = 1.0  # s, until when curvature and twist grow


def build(
    count: int = 13,
    n: int = 60,
    friction: float = 0.3,
    dt: float = 0.01,
    duration: float = 1.5,
    seed: int = 1,
) -> ddg.Scene:
    """The bundle along z.

    Args:
        count: worms, 7 or more
        n: edges of each
        friction: Coulomb's coefficient
        dt: time step [s]
        duration: of the run [s]
        seed: of the phases
    """
    if count < 7:
        raise ValueError(f"count = {count}; there are 7 worms at least, one and six about it")
    phases = 2.0 * np.pi * _layouts.random(seed).uniform(size=(count, 1))
    angle, radius, hand = bundle(count)
    tight = np.stack([COIL * hand**0, RISE * hand]) / (COIL**2 + RISE**2)
    slack = LAY / (1.0 + LAY**2) / np.maximum(radius, SPACING) * np.stack([LAY * hand**2, hand])

    def act(model, t: float) -> None:
        share = np.sin(0.5 * np.pi * min(1.0, t / WINDS)) ** 2
        curvature, twist = ((1.0 - share) * slack + share * tight)[..., None]
        wave = np.sin(2.0 * np.pi * (WAVES * np.arange(1, n) / n - t / PERIOD) + phases)
        for name, values in (("rest_1", curvature * (1.0 + share * AMPLITUDE * wave)), ("rest_3", twist + 0.0 * wave)):
            model.set_parameter("rod_bend_twist", name, values.ravel())

    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Dynamics(dt=dt, duration=duration),
        initial=lambda model: act(model, 0.0) or model.state(),
        callbacks=[lambda state: act(state.model, state.time)],
    )
    z = np.linspace(-0.5 * LENGTH, 0.5 * LENGTH, n + 1) / np.sqrt(1.0 + LAY**2)
    turned = (angle + hand * LAY * z[:, None] / np.maximum(radius, SPACING)).T
    out = np.stack([np.cos(turned), np.sin(turned), 0.0 * turned], axis=-1)
    points, inwards = radius[:, None, None] * out + z[:, None] * [0.0, 0.0, 1.0], -(out[:, 1:] + out[:, :-1])
    scene.add_rods(
        points, section=ddg.Circle(RADIUS), material=FLESH, natural="straight", director=inwards, name="worms"
    )
    scene.contact(range=RANGE, friction=friction)
    return scene


def bundle(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of worms (count,) the angle about the axis [rad], the distance from it [m], and the hand: one, six about it, and so on."""
    layers = int(np.ceil(np.sqrt(count / 3.0))) + 1
    sizes, left = [], count
    for layer in range(layers):
        sizes.append(min(left, max(1, 6 * layer)))
        left -= sizes[-1]
    layer = np.repeat(np.arange(layers), sizes)
    angle = np.concatenate([2.0 * np.pi * np.arange(size) / max(1, size) for size in sizes])
    return angle, SPACING * layer, np.where(layer > 0, 1.0 - 2.0 * (layer % 2), 0.0)


def observe(model, state) -> dict[str, float]:
    """See `_touching.observe`; and what worms push each other by [N], their momentum [N s], radius of gyration [m], and how many blobs.

    What they push by is the sum of the sizes of the forces of all pairs; a blob is of worms that are linked by such that touch.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    points, found, worms = state.points(), model.contacts(state), _touching.rods_of(model)
    touching = coo_array((np.ones(len(found)), found.objects.T), shape=(worms, worms))
    return _touching.observe(model, state) | {
        "pushed": float(np.linalg.norm(found.force, axis=1).sum()),
        "drift": float(np.linalg.norm(_touching.momentum(model, state))),
        "gyration": float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())),
        "blobs": float(connected_components(touching, directed=False)[0]),
    }


def check(result) -> list[ddg.Check]:
    """Nothing passes or overlaps, momentum stays zero, and all worms are in one blob, in which more touch than do in a bundle."""
    names = (
        "pairs that touch in the closest bundle over those here",
        "radius of gyration over that of the bundle",
        "blobs of worms",
    )
    momentum = max(result.series["drift"]) / (result.dt * np.sum(result.series["pushed"]))
    return [
        *_touching.checks(result),
        ddg.Check("momentum over all that worms exchange", momentum, 0.0, 1e-6, "actio is reactio"),
        *once_reached(result, WINDS, names, lambda: _checks(result, names)),
    ]


def _checks(result, names) -> list[ddg.Check]:
    worms, late = _touching.rods_of(result.model), slice(-max(1, len(result.times) // 10), None)
    # of n equal disks in a plane, however they lie, this many pairs touch at most
    most = np.floor(3.0 * worms - np.sqrt(12.0 * worms - 3.0))
    pairs, size = np.mean(result.series["touching_rods"][late]), result.series["gyration"]
    return [
        ddg.Check(names[0], most / pairs, 0.0, 0.9, "Harborth 1974, of parallel cylinders"),
        ddg.Check(names[1], np.mean(size[late]) / size[0], 0.0, 0.8, "they wind up"),
        ddg.Check(names[2], max(result.series["blobs"][late]), 1.0, 0.0, "they hold each other"),
    ]


def benchmark() -> ddg.bench.Study:
    """The radius of gyration of a few worms while they wind up, over edges and steps."""
    return ddg.bench.Study(
        {"n": (30, 60), "dt": (0.02, 0.01)},
        lambda result: result.series["gyration"][-1],
        {"n": 90, "dt": 0.0025},
        fixed={"count": 7, "duration": 0.6},
        unit="m",
    )


def picture(result, frames) -> dict:
    """The bundle, and the blob, as thick as worms are."""
    times = sorted(frames)
    times = times[0], times[len(times) // 3], times[-1]
    return {
        "points_by_time": {t: frames[t] for t in times},
        "bodies": {t: _touching.colored_tubes(result.model, frames[t]) for t in times},
        "lines": False,
        "side_by_side": True,
    }

"""Rods are dropped into a box and come to rest on each other: 30, or 10,000 of 50 nodes each.

They start in all directions, apart from each other, and fall. Straight stiff rods in all directions pack to the density phi at which
phi L / D = 5.4 +- 0.2 (Philipse, Langmuir 12, 1996: his experiments and his random contact equation, by which phi L / D is half of
the contacts a rod), whatever their length L over the diameter D is, where that is more than about 15. These here bend under
what lies on them, lie down where they land, and feel smooth walls one and a half lengths apart, so that they pack closer; a pile
that is lower than half a length is no packing in this sense, and is not compared.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _layouts, _touching

LENGTH = 0.1  # m
RADIUS = 1e-3  # m; L / D = 50
START = 1.0  # phi L / D before the fall: a rod that is placed at random meets 2 others
NODES = 50
RANDOM_CONTACT = 5.4  # phi L / D of long rods
SOFT = 2e-6  # m, stiffness of contact over Young's modulus
REFUSED = 50  # pairs: iterates may slip around the end of a rod to its other side; the straight way, which cuts it, is not taken
RTOL = 3e-2  # of a rod's weight, to which forces balance: nodes are off by a fiftieth of what half the step changes
SLIP = 5e-3  # m/s, from which on friction is all there
DENSEST = np.pi / np.sqrt(12.0)  # cylinders side by side in a hexagonal lattice
PHILIPSE = "Philipse 1996, of stiff rods in all directions"


def build(
    count: int = 30,
    width: float = 0.0,
    young: float = 1e8,
    friction: float = 0.3,
    dt: float = 1.0 / 240.0,
    duration: float = 0.5,
    seed: int = 1,
) -> ddg.Scene:
    """Rods above the floor of a square box.

    Args:
        count: rods
        width: of the box over the length of a rod; 0 takes 1.5, and more from 1,000 rods on, so that a pile is about a length high
        young: Young's modulus [Pa]
        friction: Coulomb friction coefficient between rods, and between rods and the floor; walls are smooth
        dt: time step [s]
        duration: duration of the run [s]
        seed: seed of the random numbers
    """
    width = LENGTH * (width or max(1.5, 1.5 * np.sqrt(count / 1000.0)))
    if width < LENGTH:
        raise ValueError(f"width = {width / LENGTH}; a box is at least as wide as its rods are long, 1 or more")
    diameter = 2.0 * RADIUS
    box = count * np.pi * RADIUS**2 * LENGTH / (START * diameter / LENGTH * width**2)
    ends = _layouts.placed_apart(
        _layouts.random(seed), count, LENGTH, 1.5 * diameter, (width, width), max(box, 0.25 * LENGTH)
    )
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=dt, duration=duration, rtol=RTOL))
    s = np.linspace(0.0, 1.0, NODES)[:, None]
    scene.add_rods(
        (1.0 - s) * ends[:, None, 0] + s * ends[:, None, 1],
        section=ddg.Circle(RADIUS),
        material=ddg.Material(young=young, density=1000.0, poisson=0.5, viscosity=2e-3),
        name="rods",
    )
    # as fast as they fall, stiffer contact and friction take twice the iterations
    scene.contact(stiffness=SOFT * young, **_touching.rubbing(friction, velocity=SLIP))
    scene.add_obstacle(ddg.Plane(), name="floor")
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        wall = ddg.Plane((0.5 * width * (1 - x), 0.5 * width * (1 - y), 0.0), (x, y, 0.0))
        scene.add_obstacle(wall, name="walls")
    scene.contact_between("rods", "walls", friction=0.0)
    return scene


def observe(model, state) -> dict[str, float]:
    """As of all scenes of contact; height of the pile, twice that of its centre [m], and phi L / D."""
    found = _touching.observe(model, state)
    points, walls = state.points(), np.array([each.shape.points[0] for each in model.scene.obstacles[1:]])
    height = 2.0 * float(points[:, 2].mean())
    share = _touching.rods_of(model) * np.pi * RADIUS**2 * LENGTH / (np.ptp(walls[:, 0]) * np.ptp(walls[:, 1]) * height)
    contacts = 2.0 * found["touching_rods"] / _touching.rods_of(model)
    return {**found, "height": height, "packing": share * LENGTH / (2.0 * RADIUS), "contacts_per_rod": contacts}


def check(result) -> list[ddg.Check]:
    """No crossing and no overlap, impulses, energy; rods inside of their box; and the packing of a pile that is high enough."""
    series = {name: values[-1] for name, values in result.series.items()}
    share = series["packing"] * 2.0 * RADIUS / LENGTH
    checks = [
        *_touching.checks(result, REFUSED),
        _touching.weight_check(result, 1e-3),
        _touching.energy_check(result),
        ddg.Check("rods outside of the box [m]", outside(result), 0.0, 0.0, "floor and walls"),
        ddg.Check("packing fraction over that of cylinders side by side", share / DENSEST, 0.0, 1.0, "Thue 1910"),
    ]
    resting = series["kinetic"] < 1e-3 * max(result.series["kinetic"])
    if resting and series["height"] > 0.5 * LENGTH:
        checks.append(ddg.Check("phi L / D", series["packing"], RANDOM_CONTACT, 0.5, PHILIPSE, relative=True))
    return checks


def outside(result) -> float:
    """How far surfaces of rods reach out of the box [m], 0 where they do not."""
    points, planes = result.state.points(), [each.shape for each in result.model.scene.obstacles]
    depth = [np.min((points - plane.point) @ np.array(plane.normal, float)) - RADIUS for plane in planes]
    return max(0.0, -float(min(depth)))


def benchmark() -> ddg.bench.Study:
    """Height of the pile's centre over steps and seconds of the clock."""
    return ddg.bench.Study(
        {"dt": (1 / 120, 1 / 240, 1 / 480)},
        lambda result: result.series["height"][-1],
        {"dt": 1 / 1920},
        fixed={"count": 12, "duration": 0.1},
        unit="m",
    )


def picture(result, frames) -> dict:
    """Before the fall, during it, and the pile, each rod in a color of its own."""
    times = list(frames)
    return {
        "points_by_time": {t: frames[t] for t in (times[0], times[len(times) // 3], times[-1])},
        "colors": _touching.colors(result.model),
        "side_by_side": True,
    }

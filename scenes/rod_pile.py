"""Rod pile: 30 rods, or 10,000 of 50 nodes each, fall into a box and come to rest on each other.

They start in random directions without overlap, and fall. Long stiff rods with random directions pack to the density phi at which
phi L / D = 5.4 +- 0.2, for ratios of length L to diameter D above about 15 (Philipse, Langmuir 12, 1996). By the random contact
equation phi L / D is half of the contacts a rod. Here rods bend under load, align with the floor, and are in contact with smooth
walls one and a half lengths apart, so that they pack closer. A pile lower than half a length is no packing in this sense, and is
not compared.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _layouts, _many_rods

LENGTH = 0.1  # m
RADIUS = 1e-3  # m; L / D = 50
START = 1.0  # initial phi L / D: a rod placed at random meets 2 others
NODES = 50
RANDOM_CONTACT = 5.4  # phi L / D of long rods
SOFT = 2e-6  # m, contact stiffness over Young's modulus
REFUSED = 50  # pairs: iterates may slip around the end of a rod, where the straight motion cuts it
RTOL = 3e-2  # relative to the weight of a rod: position errors are a fiftieth of the change by half the step
SLIP = 5e-3  # m/s, stick threshold of friction
DENSEST = np.pi / np.sqrt(12.0)  # parallel cylinders in a hexagonal lattice
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
    """Build rods above the floor of a square box.

    Args:
        count: number of rods
        width: width of the box over the length of a rod; 0 takes 1.5, more from 1,000 rods on, for a pile about a length high
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
    # Measured: stiffer contact and friction, for this speed of fall, take twice the iterations.
    scene.contact(stiffness=SOFT * young, **_many_rods.friction_options(friction, velocity=SLIP))
    scene.add_obstacle(ddg.Plane(), name="floor")
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        wall = ddg.Plane((0.5 * width * (1 - x), 0.5 * width * (1 - y), 0.0), (x, y, 0.0))
        scene.add_obstacle(wall, name="walls")
    scene.contact_between("rods", "walls", friction=0.0)
    return scene


def observe(model, state) -> dict[str, float]:
    """Return `_many_rods.observe` with height of the pile, twice that of its centre [m], phi L / D, and contacts a rod."""
    observed = _many_rods.observe(model, state)
    points, walls = state.points(), np.array([each.shape.points[0] for each in model.scene.obstacles[1:]])
    height = 2.0 * float(points[:, 2].mean())
    fraction = (
        _many_rods.rods_of(model) * np.pi * RADIUS**2 * LENGTH / (np.ptp(walls[:, 0]) * np.ptp(walls[:, 1]) * height)
    )
    contacts = 2.0 * observed["touching_rods"] / _many_rods.rods_of(model)
    return {**observed, "height": height, "packing": fraction * LENGTH / (2.0 * RADIUS), "contacts_per_rod": contacts}


def check(result) -> list[ddg.Check]:
    """Check no crossing, no overlap, impulses, energy, the box, and the packing of a sufficiently high pile."""
    series = {name: values[-1] for name, values in result.series.items()}
    fraction = series["packing"] * 2.0 * RADIUS / LENGTH
    checks = [
        *_many_rods.checks(result, REFUSED),
        _many_rods.weight_check(result, 1e-3),
        _many_rods.energy_check(result),
        ddg.Check("rods outside of the box [m]", outside(result), 0.0, 0.0, "floor and walls"),
        ddg.Check("packing fraction over that of cylinders side by side", fraction / DENSEST, 0.0, 1.0, "Thue 1910"),
    ]
    resting = series["kinetic"] < 1e-3 * max(result.series["kinetic"])
    if resting and series["height"] > 0.5 * LENGTH:
        checks.append(ddg.Check("phi L / D", series["packing"], RANDOM_CONTACT, 0.5, PHILIPSE, relative=True))
    return checks


def outside(result) -> float:
    """Return how far surfaces of rods protrude from the box [m], 0 if none does."""
    points, planes = result.state.points(), [each.shape for each in result.model.scene.obstacles]
    depth = [np.min((points - plane.point) @ np.array(plane.normal, float)) - RADIUS for plane in planes]
    return max(0.0, -float(min(depth)))


def benchmark() -> ddg.bench.Study:
    """Study the height of the pile's centre over steps and run time."""
    return ddg.bench.Study(
        {"dt": (1 / 120, 1 / 240, 1 / 480)},
        lambda result: result.series["height"][-1],
        {"dt": 1 / 1920},
        fixed={"count": 12, "duration": 0.1},
        unit="m",
    )


def picture(result, frames) -> dict:
    """Draw the rods before the fall, during it, and in the pile, one color a rod."""
    times = list(frames)
    return {
        "points_by_time": {t: frames[t] for t in (times[0], times[len(times) // 3], times[-1])},
        "colors": _many_rods.colors(result.model),
        "side_by_side": True,
    }

"""Plectoneme: a long twisted rod under tension coils into two strands on one helix with an end loop.

Strands of a plectoneme of the contact radius r have the angle a to its axis. The energy is stationary at

    M r / B = 2 sin^3(a) cos(a) / cos(2 a) ,    T r^2 / B = sin^4(a) (1 / 2 + 1 / cos(2 a)) ,

with B the bending stiffness, T the tension and M the torque. During growth both are constant (Clauvelin, Audoly and Neukirch,
Mechanical response of plectonemic DNA: an analytical solution, Macromolecules 41, 4479, 2008). The twisting stiffness only
determines how much of the end rotation becomes twist. Here the tension is a dead force, the ends are hinges, and one of them
rotates. A straight rod bears more than twice that torque before it buckles. The rod is therefore drawn with a loop of one turn and
a half, which tension and twist close.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

RADIUS = 1e-3  # m
B = 1e-4  # N m^2
STIFF = 10.0  # EA h^2 / B
RANGE = 0.4 * RADIUS  # m, activation distance
CLOSE = 1.15  # radii, initial half distance of the strands
BEND = 8.0 * RADIUS  # m, initial radius of the bends between ends and strands
WOUND = 1.5  # initial turns of the strands
LOOP = (6.0 * RADIUS, 14.0 * RADIUS)  # m, approximate initial half width and height of the loop
LOOPED = 0.4  # rad, the angle at which the loop has that size
STEP_TIME = 1.0  # s, long against all periods: motion is quasi-static
MASS_PER_LENGTH = 1000.0  # kg/m; inertia is some thousandths of the tension, yet slows free motion
TWISTED = 1.1  # initial torque over that of the plectoneme
FINE = 0.16  # longest edge over the radius, times sin^2(a), for errors of 5 %
SETTLED = 0.6  # fraction of the run after which results are compared
SOURCE = "Clauvelin, Audoly and Neukirch, 2008"


def build(
    angle: float = 0.4, turns: float = 7.0, tail: float = 70.0, edge: float = 1.0, steps: int = 200, seed: int = -1
) -> ddg.Scene:
    """Build the rod along x, with a loop along y.

    Args:
        angle: angle between strands and axis that sets the tension [rad]
        turns: revolutions of the end
        tail: initial length of the rod on either side over its radius
        edge: length of an edge over the radius of the rod
        steps: time steps
        seed: seed of the initial jitter of nodes, a tenth of the activation distance; no jitter below 0
    """
    if not 0.3 <= angle <= 0.5:
        raise ValueError(
            f"angle = {angle}; strands are found at 0.3 to 0.5 to the axis: a weaker tension does not keep the loop until they are in "
            "contact, a stronger one opens it"
        )
    longest = min(2.0, FINE / np.sin(angle) ** 2)
    if not 0.0 < edge <= longest:
        raise ValueError(
            f"edge = {edge}; edges are {longest:.3g} radii of the rod at most where strands lie at {angle:g} to the axis, whose "
            "curvature they follow"
        )
    points = looped(angle, tail * RADIUS, edge * RADIUS)
    duration = steps * STEP_TIME
    free = np.pad(np.ones(len(points) - 2), 1)[:, None]
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        analysis=ddg.Dynamics(dt=STEP_TIME, duration=duration),
        initial=lambda model: model.state(points=points + 0.1 * RANGE * free * _many_rods.jitter(points.shape, seed)),
    )
    section = ddg.Stiffness(
        EA=STIFF * B / RADIUS**2,
        EI1=B,
        GJ=B,
        mass_per_length=MASS_PER_LENGTH,
        rotary_inertia=MASS_PER_LENGTH * RADIUS**2,
        radius=RADIUS,
    )
    rod = scene.add_rod(points, section=section, natural=(0.0, 0.0, TWISTED * law(angle)[0] / RADIUS), name="rod")
    scene.fix(rod, [0])
    scene.fix(rod, [-1], components="yz")
    scene.fix_twist(rod, [0])
    scene.fix_twist(
        rod, [-1], motion=ddg.Motion(angle=lambda t: -2.0 * np.pi * turns * t / duration, axis=(1.0, 0.0, 0.0))
    )
    tension = law(angle)[1] * B / RADIUS**2
    scene.add_force(rod, -1, (tension, 0.0, 0.0))
    scene.contact(range=RANGE, stiffness=0.1 * B / RADIUS**3)
    return scene


def law(angle: float) -> tuple[float, float]:
    """Return M r / B and T r^2 / B of strands at an angle [rad] to the axis."""
    s, c, both = np.sin(angle), np.cos(angle), np.cos(2.0 * angle)
    return 2.0 * s**3 * c / both, s**4 * (0.5 + 1.0 / both)


def looped(angle: float, tail: float, edge: float) -> np.ndarray:
    """Return points (n, 3) [m] of two ends along x that bend into strands about y with a loop, from edges of a length [m]."""
    r = CLOSE * RADIUS
    high = 2.0 * np.pi * WOUND * r / np.tan(angle)
    u = np.linspace(0.0, 1.0, 4001)
    quarter, end = 0.5 * np.pi * u, np.linspace(tail, 0.0, 4001)
    # distance from y, angle about it, and height, from the end to the top of the loop
    distance = [r + BEND + end, r + BEND * (1.0 - np.sin(quarter)), r + 0.0 * u]
    # a weaker tension keeps a larger loop, as sqrt(B / T)
    wide, tall = np.array(LOOP) * np.sqrt(law(LOOPED)[1] / law(angle)[1])
    distance.append(np.cos(quarter) * (r + wide * np.sin(quarter) ** 2))
    about = [0.0 * u, 0.0 * u, np.pi * 2.0 * WOUND * u, 2.0 * np.pi * WOUND + 0.0 * u]
    height = [0.0 * u, BEND * (1.0 - np.cos(quarter)), BEND + high * u, BEND + high + tall * np.sin(quarter)]
    d, a, y = (np.concatenate([piece[:-1] for piece in pieces]) for pieces in (distance, about, height))
    one = np.stack([-d * np.cos(a), y, d * np.sin(a)], axis=1)
    curve = np.concatenate([one, (one * [-1.0, 1.0, -1.0])[::-1]])
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
    position = np.linspace(0.0, along[-1], int(np.ceil(along[-1] / edge)) + 1)
    return np.stack([np.interp(position, along, component) for component in curve.T], axis=1)


def observe(model, state) -> dict[str, float]:
    """Return torque [N m], tension [N], half distance of strands in contact [m], and the smallest gap [m].

    The middle of the contact region adds the angle [rad] between strands and axis, the mean distance [m] from it (both 0 without
    contact), and the length [m] of that region.
    """
    points, contacts = state.points().reshape(-1, 3), model.contacts(state)
    forces = np.linalg.norm(contacts.force, axis=1)
    reactions = model.reactions(state)
    inner, axis = wound(points, contacts.point)
    angle = radius = 0.0
    if len(inner) > 8:
        tangents = np.diff(points, axis=0)
        tangents /= np.linalg.norm(tangents, axis=1)[:, None]
        angle = np.arccos(np.abs(tangents[inner[:-1]] @ axis)).mean()
        away = points[inner] - points[inner].mean(axis=0)
        radius = np.sqrt(((away - np.outer(away @ axis, axis)) ** 2).sum(axis=1)).mean()
    return {
        "torque": abs(np.reshape(reactions[2].moment, (-1, 3))[0, 0]),
        "tension": abs(np.reshape(reactions[0].force, (-1, 3))[0, 0]),
        "half": RADIUS + 0.5 * float((forces * contacts.gap).sum() / max(forces.sum(), 1e-300)),
        "gap": _many_rods.smallest_gap(model, state),
        "angle": angle,
        "radius": radius,
        "length": float(np.ptp(contacts.point @ axis)) if len(contacts.point) else 0.0,
    }


def wound(points: np.ndarray, touching: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes of the middle half of the contact region of points (n, 3) [m], and the direction (3,) of the axis."""
    if len(touching) < 4:
        return np.zeros(0, int), np.array([0.0, 1.0, 0.0])
    middle = touching.mean(axis=0)
    axis = np.linalg.svd(touching - middle)[2][0]
    along, reach = (points - middle) @ axis, 0.25 * np.ptp(touching @ axis)
    near = np.linalg.norm(points - middle - np.outer(along, axis), axis=1) < 3.0 * RADIUS
    return np.flatnonzero((np.abs(along) < reach) & near), axis


def check(result) -> list[ddg.Check]:
    """Check torque, tension, angle and radius of the growing plectoneme."""
    names = (
        "torque M r / B by the tension",
        "tension T r^2 / B by the angle",
        "angle by the tension",
        "radius over that of contact",
    )
    checks = once_reached(result, result.model.scene.analysis.duration, names, lambda: _checks(result, names))
    return checks + _many_rods.kept_apart(result)


def _checks(result, names) -> list[ddg.Check]:
    from scipy.optimize import brentq

    settled = np.array(result.times) > SETTLED * result.times[-1]
    values = {name: np.array(series)[settled].mean() for name, series in result.series.items()}
    r, tension = values["half"], values["tension"]
    pull = tension * r**2 / B
    angle = brentq(lambda a: law(a)[1] - pull, 1e-3, 0.75)
    return [
        ddg.Check(names[0], values["torque"] * r / B, law(angle)[0], 0.05, SOURCE, True),
        ddg.Check(names[1], pull, law(values["angle"])[1], 0.05, SOURCE, True),
        ddg.Check(names[2], values["angle"], angle, 0.05, SOURCE, True),
        ddg.Check(names[3], values["radius"] / r, 1.0, 0.05, "the strands touch on the axis", True),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the torque over the length of edges."""
    return ddg.bench.Study({"edge": (2.0, 1.4, 1.0, 0.7)}, "torque", whole=True)


def picture(result, frames) -> dict:
    """Draw the rod at the end, with most of the ends cut off."""
    last = max(frames)
    points = frames[last].copy()
    top = points[points[:, 1].argmax(), 0]
    points[:, 0] = points[:, 0].clip(top - 30.0 * RADIUS, top + 30.0 * RADIUS)
    return {"points_by_time": {last: points}}

"""Crawlers: rods with waves of natural curvature on the ground, of which two travel from head to tail.

Muscles set the natural curvature kappa(s, t) of a rod that is stiff against bending by friction; gravity keeps it down. With less
friction along the rod than across, as of a snake on cloth (mu = 0.11 forwards, 0.14 backwards, 0.20 across; Hu, Nirody,
Scott and Shelley, PNAS 106, 2009, 10081), a travelling wave moves it forwards. Without inertia, friction forces and moments of the
known shape balance at every time. This gives the three velocities of the rod of least frictional power (Hu and Shelley, in: Natural
Locomotion in Fluids and on Surfaces, 2012). The reference is that balance, of a fine curve, with the friction law of the scene.

Coulomb friction is no drag: with one coefficient for all directions a travelling wave still drifts, a quarter as far and in
reverse, along with the wave. A standing wave that is its own mirror image does not travel.
"""

from functools import partial

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

LENGTH = 0.3  # m
RADIUS = 5e-3  # m
LANE = 0.12  # m, between crawlers
RANGE = 1e-4  # m, activation distance
PERIOD = 4.0  # s; inertia is some 1 % of friction
WAVES = 1.5  # along a crawler
CURVATURE = 15.0  # 1/m, amplitude
RISES = 0.5  # periods of the growth of waves
PERIODS = 2
VELOCITY = 1e-3  # m/s, stick threshold of friction
STEEPNESS = 7.5  # of the logistic law
SNAKE, EVEN, STANDING = NAMES = ("snake", "even", "standing")
MATERIAL = ddg.Material(young=1e7, density=1000.0, poisson=0.5)
BALANCE = "balance of friction of the known shape"


def build(
    forwards: float = 0.11,
    backwards: float = 0.14,
    across: float = 0.2,
    n: int = 80,
    steps: int = 150,
    seed: int = -1,
) -> ddg.Scene:
    """Build the crawlers side by side along x, straight at first, their heads at the last node.

    Args:
        forwards, backwards, across: friction coefficients of the snake; others have `across` in all directions
        n: edges of each
        steps: time steps in a period
        seed: seed of the initial jitter of crawlers; no jitter below 0
    """
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=PERIOD / steps, duration=PERIODS * PERIOD))
    jitter = _many_rods.jitter((len(NAMES), 3), seed)
    x = np.linspace(0.0, LENGTH, n + 1)
    for k, name in enumerate(NAMES):
        shift = np.array([0.0, LANE * k, RADIUS + 1.01 * RANGE]) + jitter[k] * [0.01, 0.01, 5e-3 * RANGE]
        points = np.stack([x, 0.0 * x, 0.0 * x], axis=1) + shift
        rod = {"section": ddg.Circle(RADIUS), "material": MATERIAL, "director": (0.0, 1.0, 0.0), "name": name}
        crawler = scene.add_rod(points, natural="straight", **rod)
        scene.prescribe(
            f"muscles of {name}", "rod_bend_twist.rest_1", partial(curvature, name), rods=crawler, over="arc_length"
        )
    scene.add_obstacle(ddg.Plane(), name="ground")
    scene.contact(range=RANGE, friction=across, velocity=VELOCITY)
    scene.contact_between(SNAKE, "ground", friction=(forwards, backwards, across))
    return scene


def curvature(name: str, s: np.ndarray, t: float) -> np.ndarray:
    """Return the natural curvature of a crawler at arc lengths s [m] from the tail, to the left [1/m]."""
    rise = np.sin(0.5 * np.pi * min(1.0, t / (RISES * PERIOD))) ** 2
    position, phase = 2.0 * np.pi * WAVES * (s / LENGTH - 0.5), 2.0 * np.pi * t / PERIOD
    if name == STANDING:
        return CURVATURE * rise * np.cos(position) * np.sin(phase)
    return CURVATURE * rise * np.sin(position + phase)


def observe(model, state) -> dict[str, float]:
    """Return the x position of each crawler's middle [m], the smallest gap [m], and ground force over weight."""
    middles = state.points().reshape(-1, len(NAMES), model.scene.batches[0].nodes, 3)[0, ..., 0]
    weight = sum(batch.section.mass_per_length for batch in model.scene.batches) * LENGTH * 9.81
    carried = np.reshape(model.reactions(state)[-1].force, (-1, 3))[0, 2]
    positions = {name: float(0.5 * (x[1:] + x[:-1]).mean()) for name, x in zip(NAMES, middles, strict=True)}
    return positions | {"gap": _many_rods.smallest_gap(model, state), "carried": float(carried / weight)}


def advance(name: str, coefficients, segments: int = 120, steps: int = 200) -> float:
    """Return the displacement of a crawler along x in the last period [m], by the balance of friction.

    Args:
        name: name of the crawler
        coefficients: friction coefficients forwards, backwards and across
        segments, steps: of the curve, and in a period

    Raises:
        ValueError: no velocities balance.
    """
    from scipy.optimize import root

    ds, dt = LENGTH / segments, PERIOD / steps
    weight = np.full(segments + 1, ds)
    weight[[0, -1]] *= 0.5
    s = ds * np.arange(1, segments)
    least = min(coefficients)

    def shape(t):
        """Return points from the centre of mass, and tangents, in the frame of the first edge; complex."""
        edges = np.exp(1j * np.concatenate([[0.0], np.cumsum(curvature(name, s, t) * ds)]))
        points = np.concatenate([[0.0], np.cumsum(edges * ds)])
        tangents = np.concatenate([edges[:1], edges[1:] + edges[:-1], edges[-1:]])
        return points - (weight * points).sum() / weight.sum(), tangents / np.abs(tangents)

    def balance(rates, points, tangents, deformation):
        """Return force and moment of friction for the velocity of the centre and the spin of the frame."""
        speed = (deformation + rates[0] + 1j * rates[1] + 1j * rates[2] * points / LENGTH) * tangents.conj()
        along = np.where(speed.real > 0.0, coefficients[0], coefficients[1])
        slip = along * speed.real / least + 1j * coefficients[2] * speed.imag / least
        size = np.maximum(np.abs(slip), 1e-300)
        pull = weight * np.tanh(STEEPNESS * size / VELOCITY) / size
        force = pull * (along * slip.real + 1j * coefficients[2] * slip.imag) * tangents
        return [force.real.sum(), force.imag.sum(), (points.conj() * force).imag.sum() / LENGTH]

    heading, position, rates, path = 0.0, 0.0, np.zeros(3), [0.0]
    for k in range(PERIODS * steps):
        t = (k + 0.5) * dt
        points, tangents = shape(t)
        deformation = (shape(t + 0.5 * dt)[0] - shape(t - 0.5 * dt)[0]) / dt
        solution = root(balance, rates, args=(points, tangents, deformation), tol=1e-10)
        if not solution.success:
            raise ValueError(f"friction of {name!r} finds no balance at {t:g} s: {solution.message}")
        rates = solution.x
        position += (rates[0] + 1j * rates[1]) * np.exp(1j * (heading + 0.5 * dt * rates[2] / LENGTH)) * dt
        heading += dt * rates[2] / LENGTH
        path.append(position.real)
    return path[-1] - path[-1 - steps]


def check(result) -> list[ddg.Check]:
    """Check displacements in the last period against the balance of friction, and the ground force."""
    names = (
        "snake: way a period [m]",
        "even: way a period [m]",
        "standing: way a period over its length",
        "ground carries, over weight",
    )
    checks = once_reached(result, PERIODS * PERIOD, names, lambda: _checks(result, names))
    return checks + _many_rods.kept_apart(result)


def _checks(result, names) -> list[ddg.Check]:
    scene = result.model.scene
    steps = round(PERIOD / result.dt)
    gone = {name: result.series[name][-1] - result.series[name][-1 - steps] for name in NAMES}
    mu = scene.contact_settings.friction
    carried = np.array(result.series["carried"][-steps:])
    return [
        ddg.Check(names[0], gone[SNAKE], advance(SNAKE, scene.betweens[0].friction), 0.02, BALANCE, True),
        ddg.Check(names[1], gone[EVEN], advance(EVEN, (mu, mu, mu)), 0.05, BALANCE, True),
        ddg.Check(names[2], gone[STANDING] / LENGTH, 0.0, 1e-4, "its mirror image goes the other way"),
        ddg.Check(names[3], carried.mean(), 1.0, 1e-3, "balance of forces"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the displacement of the snake over edges and steps."""
    return ddg.bench.Study({"n": (20, 40, 80), "steps": (75, 150, 300)}, "snake: way a period [m]", whole=True)


def picture(result, frames) -> dict:
    """Draw the crawlers from above, with actual thickness."""
    above = np.array([1.0, 1.0, 0.0])
    return {"points_by_time": {t: points * above for t, points in frames.items()}, "thick": True, "obstacles": None}

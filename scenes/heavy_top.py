"""A heavy top: a spinning rod that one end holds up stays level and goes round, by the gyroscopic couple of its spin.

A top of mass m whose centre is at l from its pivot, with the spin momentum I3 w along its level axis, goes round the vertical without
nutation at

    W = m g l / (I3 w) ,

exactly, as a level axis has no part of W along itself. The rod starts with that; without the couple it would fall by g t^2 / 2 at once.
Lumped masses have their own m l. Energy and the vertical angular momentum are constants.
"""

import numpy as np

import ddg_warp as ddg

LENGTH = 0.1  # m
RADIUS = 5e-3  # m
DENSITY = 1000.0  # kg/m^3
GRAVITY = 9.81  # m/s^2
EXACT = "W = m g l / (I3 w), level axis"


def build(
    spin: float = 2000.0,
    n: int = 8,
    steps: int = 400,
    turns: float = 1.0,
    young: float = 1e10,
    scheme: str = "implicit_midpoint",
) -> ddg.Scene:
    """The top along x, its pivot at the origin.

    Args:
        spin: of the rod about its axis, w [rad/s]
        n: edges of the rod
        steps: time steps in a turn about the vertical
        turns: about the vertical that the run lasts
        young: Young's modulus, by which little the rod bends [Pa]
        scheme: time integration scheme
    """
    turn = 2.0 * np.pi / rate(spin)  # s
    scene = ddg.Scene(
        gravity=(0.0, 0.0, -GRAVITY),
        analysis=ddg.Dynamics(dt=turn / steps, duration=round(turns * steps) * turn / steps, scheme=scheme),
        initial=lambda model: going_round(model, spin),
    )
    points = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), n + 1)
    material = ddg.Material(young, poisson=0.3, density=DENSITY)
    top = scene.add_rod(points, section=ddg.Circle(RADIUS), material=material, director=(0, 0, 1), name="top")
    scene.fix(top, [0])
    return scene


def rate(spin: float) -> float:
    """W [rad/s]; m l = rho A L^2 / 2 of lumped masses as of the rod itself, I3 = rho A L r^2 / 2."""
    return GRAVITY * LENGTH / (RADIUS**2 * spin)


def going_round(model, spin: float):
    """The level top with its steady motion."""
    points = model.scene.batches[0].points[0]
    velocities = np.cross((0.0, 0.0, rate(spin)), points)
    return model.state(velocities=velocities, spins=np.full(len(points) - 1, spin))


def observe(model, state) -> dict[str, float]:
    """Angle that the axis has gone round, up to half a turn either way [rad], and height of the end [m]."""
    end = state.points().reshape(-1, model.points_count, 3)[0, -1]
    return {"angle": float(np.arctan2(end[1], end[0])), "height": float(end[2])}


def check(result) -> list[ddg.Check]:
    """Rate of going round, and how level the axis stays."""
    spin = float(result.model.scene.initial(result.model).groups[0].omega.numpy().max())
    angle = np.unwrap(result.series["angle"])
    times = np.array(result.times)
    step = rate(spin) * result.dt
    tolerance = 5e-3 + step**2 if result.model.scene.analysis.scheme == "implicit_midpoint" else 5e-3 + step
    measured = (angle[-1] - angle[0]) / (times[-1] - times[0])
    height = np.abs(result.series["height"]).max() / LENGTH
    return [
        ddg.Check("rate of going round [rad/s]", measured, rate(spin), tolerance, EXACT, relative=True),
        ddg.Check("largest height of the end over the length", height, 0.0, 0.02, EXACT),
    ]


def benchmark() -> ddg.bench.Study:
    """The rate over steps and schemes."""
    return ddg.bench.Study(
        {"steps": (100, 200, 400, 800), "scheme": ("implicit_euler", "implicit_midpoint")},
        "rate of going round [rad/s]",
        series=("scheme",),
    )

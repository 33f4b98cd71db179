"""Heavy top: a spinning rod, supported at one end, stays level and precesses by its gyroscopic couple.

A top of mass m with its centre at l from the pivot and spin momentum I3 w along its level axis precesses without nutation at

    W = m g l / (I3 w) ,

exactly, as W has no component along a level axis. The rod starts in this motion; without the couple it would fall by g t^2 / 2 at
once. Lumped masses have the same m l. Energy and the vertical angular momentum are constants.
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
    """Build the top along x, its pivot at the origin.

    Args:
        spin: spin of the rod about its axis, w [rad/s]
        n: edges of the rod
        steps: time steps in a period of precession
        turns: duration of the run in periods of precession
        young: Young's modulus, large for small bending [Pa]
        scheme: time integration scheme
    """
    period = 2.0 * np.pi / rate(spin)  # s
    scene = ddg.Scene(
        gravity=(0.0, 0.0, -GRAVITY),
        analysis=ddg.Dynamics(dt=period / steps, duration=round(turns * steps) * period / steps, scheme=scheme),
        initial=lambda model: going_round(model, spin),
    )
    points = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), n + 1)
    material = ddg.Material(young, poisson=0.3, density=DENSITY)
    top = scene.add_rod(points, section=ddg.Circle(RADIUS), material=material, director=(0, 0, 1), name="top")
    scene.fix(top, [0])
    return scene


def rate(spin: float) -> float:
    """Return W [rad/s], with m l = rho A L^2 / 2, also of lumped masses, and I3 = rho A L r^2 / 2."""
    return GRAVITY * LENGTH / (RADIUS**2 * spin)


def going_round(model, spin: float):
    """Return the level top in steady precession."""
    points = model.scene.batches[0].points[0]
    velocities = np.cross((0.0, 0.0, rate(spin)), points)
    return model.state(velocities=velocities, spins=np.full(len(points) - 1, spin))


def observe(model, state) -> dict[str, float]:
    """Return the precession angle, between -pi and pi [rad], and the height of the end [m]."""
    end = state.points().reshape(-1, model.points_count, 3)[0, -1]
    return {"angle": float(np.arctan2(end[1], end[0])), "height": float(end[2])}


def check(result) -> list[ddg.Check]:
    """Check the precession rate and the level of the axis."""
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
    """Study the rate over steps and schemes."""
    return ddg.bench.Study(
        {"steps": (100, 200, 400, 800), "scheme": ("implicit_euler", "implicit_midpoint")},
        "rate of going round [rad/s]",
        series=("scheme",),
    )

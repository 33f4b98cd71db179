"""Flying beam: a flexible beam in free flight, forced and rotated at one end for five seconds, then unloaded.

A test of conservation after Simo and Vu-Quoc (J. Appl. Mech. 53, 1986, 849 and 855): no support, no gravity, large rotations. By the
impulse theorem the beam leaves with the momentum of the load, (20, 0) N s. The moment of the load, couple included, is its angular
momentum, and from then on its energy is constant. The implicit midpoint rule keeps both momenta to rounding, and the energy up to the
square of the step. At steps of 0.02 s and more it is unstable here, and the integrator takes substeps to stay within its bound on
the energy.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

FIRST, LAST = (6.0, 0.0), (0.0, 8.0)  # ends in the plane of x and z [m]
LENGTH = 10.0  # m
EI = 100.0  # N m^2
EA = 1.0e4  # N
MASS_PER_LENGTH = 1.0  # kg/m
PEAK = 8.0  # N
UNLOADED = 5.0  # s
ARM = 10.0  # m; couple over force
IMPULSE = "impulse of the load"


def force(t: float) -> float:
    """Return the force along x [N]: a triangle from 0 to UNLOADED."""
    return PEAK * max(0.0, 1.0 - abs(2.0 * t / UNLOADED - 1.0))


def build(n: int = 40, scheme: str = "implicit_midpoint") -> ddg.Scene:
    """Build the beam, inclined, at rest.

    Args:
        n: edges of the beam
        scheme: time integration scheme
    """
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        dimension=2,
        analysis=ddg.Dynamics(dt=0.01, duration=15.0, scheme=scheme),
    )
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(FIRST[0], LAST[0], n + 1)
    points[:, 2] = np.linspace(FIRST[1], LAST[1], n + 1)
    beam = scene.add_rod(
        points, section=ddg.Stiffness(EA=EA, EI1=EI, mass_per_length=MASS_PER_LENGTH, radius=0.05), name="beam"
    )
    scene.add_force(beam, 0, (1.0, 0.0, 0.0), amplitude=force)
    scene.add_couple(beam, 0, (0.0, ARM, 0.0), amplitude=force)  # tumbles forward, in the direction of flight
    return scene


def masses(n: int) -> np.ndarray:
    """Return lumped masses of n + 1 nodes [kg]."""
    mass = np.full(n + 1, MASS_PER_LENGTH * LENGTH / n)
    mass[[0, -1]] *= 0.5
    return mass


def observe(model, state) -> dict[str, float]:
    """Return momentum [N s], angular momentum about y [N m s], height of the loaded end [m] and energies [J]."""
    n = int(model.curves.counts[0]) - 1
    points, velocities = state.points().reshape(-1, n + 1, 3)[0], state.velocities().reshape(-1, n + 1, 3)[0]
    mass, cell = masses(n), LENGTH / n
    edges = np.diff(points[:, [0, 2]], axis=0)
    length = np.linalg.norm(edges, axis=1)
    first, second = edges[:-1], edges[1:]
    # Curvature measure of the rod, 2 tan(angle / 2) over the cell, by the half-angle formula.
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    curvature = 2.0 * cross / (length[:-1] * length[1:] + (first * second).sum(axis=1)) / cell
    momentum = mass @ velocities
    return {
        "momentum_x": momentum[0],
        "momentum_z": momentum[2],
        "angular_momentum": float((mass @ np.cross(points, velocities))[1]),
        "end_z": points[0, 2],
        "kinetic": float(0.5 * mass @ (velocities**2).sum(axis=1)),
        "elastic": float(0.5 * cell * (EA * ((length / cell - 1.0) ** 2).sum() + EI * (curvature**2).sum())),
    }


def moment_of_load(times, end_z) -> float:
    """Return the angular impulse about y [N m s] by the midpoint rule over the recorded path of the loaded end."""
    times, end_z = np.asarray(times), np.asarray(end_z)
    push = np.array([force(t) for t in 0.5 * (times[1:] + times[:-1])])
    return float((np.diff(times) * push * (ARM + 0.5 * (end_z[1:] + end_z[:-1]))).sum())


def check(result) -> list[ddg.Check]:
    """Check momentum and angular momentum after the load, and the energy from then on."""
    names = ("momentum once unloaded [N s]", "angular momentum once unloaded [N m s]", "drift of the energy, unloaded")
    return once_reached(result, UNLOADED, names, lambda: unloaded(result))


def unloaded(result) -> list[ddg.Check]:
    """Return the checks of a run beyond the load."""
    series = {name: np.array(values) for name, values in result.series.items()}
    begin = int(np.argmin(np.abs(np.array(result.times) - UNLOADED)))
    after = slice(begin, None)
    angular = moment_of_load(result.times, series["end_z"])
    energy = (series["kinetic"] + series["elastic"])[after]
    order = (result.dt / 0.01) ** 2  # of the midpoint rule
    checks = [
        ddg.Check("momentum along x [N s]", result.at(UNLOADED, "momentum_x"), 20.0, 1e-6, IMPULSE),
        ddg.Check("momentum along z [N s]", result.at(UNLOADED, "momentum_z"), 0.0, 1e-6, IMPULSE),
        ddg.Check("momentum along x at the end [N s]", series["momentum_x"][-1], 20.0, 1e-6, "no force"),
        ddg.Check("angular momentum at 5 s [N m s]", series["angular_momentum"][begin], angular, 0.05 * order, IMPULSE),
    ]
    drift = np.abs(series["angular_momentum"][after] / series["angular_momentum"][begin] - 1.0).max()
    checks.append(ddg.Check("drift of the angular momentum, unloaded", drift, 0.0, 1e-7, "no moment"))
    if result.scene.analysis.scheme == "implicit_midpoint":
        drift = np.abs(energy / energy[0] - 1.0).max()
        checks.append(ddg.Check("drift of the energy, unloaded", drift, 0.0, 2e-3 * order, "no load"))
    return checks


def benchmark() -> ddg.bench.Study:
    """Study both ends of the beam after 3 s over edges, steps and schemes, against a finer run."""
    return ddg.bench.Study(
        {"n": (10, 20, 40), "dt": (0.04, 0.02, 0.01), "scheme": ("implicit_euler", "implicit_midpoint")},
        lambda result: result.state.points()[[0, -1]],
        {"n": 160, "dt": 0.001, "scheme": "implicit_midpoint"},
        fixed={"duration": 3.0},
        series=("scheme",),
        unit="m",
    )

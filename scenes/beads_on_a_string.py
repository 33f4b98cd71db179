"""Beads on a string: equal beads on a hanging thread swing in a mode, at a zero of a Laguerre polynomial.

Of N equal masses, a distance a apart on a hanging thread without mass, the j-th from below (j = 0, 1, ...) moves in the mode k by
L_j(l_k) with

    omega_k^2 = l_k g / a ,   L_N(l_k) = 0 ,

where L_j are the Laguerre polynomials (the hanging chain of Bernoulli 1733, Lagrange 1788). The beads are balls which the thread
carries at their centres, free to rotate about them.
"""

import numpy as np
from numpy.polynomial import laguerre

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _bodies

GAP = 0.05  # m, between the centres of beads
RADIUS = 0.01  # m, of beads
MASS = 0.01  # kg, of a bead
GRAVITY = 9.81  # m/s^2
EDGES = 3  # edges of the thread from bead to bead
THREAD = ddg.Stiffness(
    EA=500.0, EI1=1e-9, GJ=1e-9, mass_per_length=1e-4, rotary_inertia=1e-11, radius=1e-3, viscosity=3e-3
)  # the viscosity ends the oscillation of its stretch, which starts from zero
SWINGS = 3  # periods that the frequency takes
NAMES = (
    "angular frequency [rad/s]",
    "shape: largest difference over the mode's largest deflection",
    "mean force below the hook over the weight",
)
SOURCE = "zero of the Laguerre polynomial"


def build(beads: int = 5, mode: int = 2, amplitude: float = 0.07, dt: float = 2e-3, duration: float = 1.6) -> ddg.Scene:
    """Build the string along -z from the origin, its beads thrown along x by a mode.

    Args:
        beads: number of beads
        mode: mode, 1 for the slowest
        amplitude: largest deflection over the distance of beads
        dt: time step [s]
        duration: duration of the run [s]
    """
    if not 1 <= mode <= beads:
        raise ValueError(f"mode = {mode}; {beads} beads have the modes 1 to {beads}")
    analysis = ddg.Dynamics(dt=dt, duration=duration, scheme="implicit_midpoint")
    scene = ddg.Scene(gravity=(0.0, 0.0, -GRAVITY), analysis=analysis)
    points = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, -beads * GAP), beads * EDGES + 1)
    thread = scene.add_rod(points, section=THREAD, twist=False, name="thread")
    scene.fix(thread, [0], name="hook")
    omega, shape = exact(beads, mode)
    for k in range(beads):
        center = (0.0, 0.0, -(k + 1) * GAP)
        speed = amplitude * GAP * omega * shape[k]
        bead = scene.add_body(ddg.Sphere(center, RADIUS), mass=MASS, velocity=(speed, 0.0, 0.0), name=f"bead {k}")
        scene.attach(thread, [(k + 1) * EDGES], bead, frame=False)
    return scene


def exact(beads: int, mode: int) -> tuple[float, np.ndarray]:
    """Return angular frequency [rad/s] and deflections of a mode, from the first bead below the hook on, 1 at most."""
    root = np.sort(laguerre.lagroots([0.0] * beads + [1.0]).real)[mode - 1]
    shape = np.array([laguerre.lagval(root, np.eye(beads)[j]) for j in range(beads)])[::-1]
    return np.sqrt(root * GRAVITY / GAP), shape / np.abs(shape).max()


def observe(model, state) -> dict[str, float]:
    """Return the deflection of every bead [m] and the force in the thread below the hook [N]."""
    deflections = {body.name: float(state.body(k).position[0]) for k, body in enumerate(model.scene.bodies)}
    return deflections | {"force": float(model.stresses(state).rod("thread").axial_force[0])}


def check(result) -> list[ddg.Check]:
    """Check frequency and shape of the motion, and the weight that the thread carries."""
    bodies = result.model.scene.bodies
    values = np.column_stack([result.series[body.name] for body in bodies])
    speeds = np.array([body.velocity[0] for body in bodies])
    shape = speeds / speeds[np.abs(speeds).argmax()]
    modes = [exact(len(bodies), k + 1) for k in range(len(bodies))]
    omega, _ = max(modes, key=lambda mode: abs(mode[1] @ shape) / np.linalg.norm(mode[1]))
    return once_reached(result, 2.0 * np.pi / omega * SWINGS, NAMES, lambda: _checks(result, values, shape, omega))


def _checks(result, values, shape, omega) -> list[ddg.Check]:
    along = values @ shape / (shape @ shape)
    aside = values - np.outer(along, shape)
    measured = _bodies.frequency(result.times, along)
    force = np.mean(result.series["force"]) / (values.shape[1] * MASS * GRAVITY)
    return [
        ddg.Check(NAMES[0], measured, omega, 0.01, SOURCE, relative=True),
        ddg.Check(NAMES[1], np.abs(aside).max() / np.abs(along).max(), 0.0, 0.03, "one mode alone"),
        ddg.Check(NAMES[2], force, 1.0, 0.01, "equilibrium"),
    ]


def picture(result, frames) -> dict:
    """Draw thread and beads at the largest deflections, side by side."""
    times = sorted(frames)
    return {"points_by_time": {t: frames[t] for t in times[1:5]}, "side_by_side": True}


def benchmark() -> ddg.bench.Study:
    """Study the frequency over steps and modes."""
    return ddg.bench.Study({"dt": (8e-3, 4e-3, 2e-3), "mode": (1, 2)}, NAMES[0], series=("mode",))

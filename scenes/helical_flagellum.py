"""Helical flagellum: a motor rotates a stiff helix in a viscous fluid; thrust, torque and swimming speed.

A right-handed helix of radius R, pitch p and contour length S has the angle theta between tangent and axis, tan(theta) = 2 pi R /
p. Moving at U along its axis and rotating at W about it, it feels the force -(A U + B W) and the torque -(B U + D W). By resistive
force theory, for whole turns,

    A = S (zeta_t cos^2 + zeta_n sin^2) ,  B = -(zeta_n - zeta_t) sin cos R S ,
    D = R^2 S (zeta_t sin^2 + zeta_n cos^2) + zeta_r cos^2 S

(Gray and Hancock, J. Exp. Biol. 32, 1955, 802; Lighthill, SIAM Review 18, 1976, 161). Free along its axis it swims at U = -B W / A.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

RADIUS = 0.25  # m
PITCH = 1.5  # m
THICKNESS = 0.02  # m, radius of the rod
RATE = 1.0  # rad/s
THETA = np.arctan2(2.0 * np.pi * RADIUS, PITCH)
LAWS = {
    "gray_hancock": ddg.Viscous(1.0, "gray_hancock", scale=PITCH),
    "lighthill": ddg.Viscous(1.0, "lighthill", scale=PITCH / np.cos(THETA)),
}
SOURCE = "resistive force theory, whole turns"


def build(
    theory: str = "gray_hancock",
    swims: bool = False,
    n: int = 40,
    turns: int = 2,
    dt: float = 0.02,
    duration: float = 2.0,
    stiffness: float = 1e5,
) -> ddg.Scene:
    """Build the helix about z, without inertia, rotated at its first end.

    Args:
        theory: gray_hancock or lighthill
        swims: whether the helix is free to move along z
        n: edges in a turn
        turns: turns of the helix, a whole number
        dt: time step [s]; the rate is one radian a second
        duration: duration of the run [s]
        stiffness: bending and twisting stiffness [N m^2]
    """
    if theory not in LAWS:
        raise ValueError(f"theory {theory!r}: take one of {', '.join(LAWS)}")
    analysis = ddg.Dynamics(dt=dt, duration=duration)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=analysis, initial=turning)
    angle = 2.0 * np.pi * np.arange(n * turns + 1) / n
    points = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), PITCH * angle / (2.0 * np.pi)], -1)
    section = ddg.Stiffness(EA=10.0 * stiffness, EI1=stiffness, GJ=stiffness, radius=THICKNESS)
    rod = scene.add_rod(points, section=section, name=f"{theory}, {'swims' if swims else 'held'}")
    motor = ddg.Motion(angle=lambda t: RATE * t, axis=(0.0, 0.0, 1.0))
    scene.clamp_end(rod, "first", motion=motor, components="xy" if swims else "xyz")
    scene.drag(rod, LAWS[theory])
    return scene


def turning(model):
    """Return the rest shape in rigid rotation."""
    points = model.scene.batches[0].points[0]
    edges = np.diff(points, axis=0)
    axis = np.array([0.0, 0.0, RATE])
    return model.state(velocities=np.cross(axis, points), spins=edges @ axis / np.linalg.norm(edges, axis=1))


def grand_resistance(theory: str, turns: float) -> tuple[float, float, float]:
    """Return A [N s/m], B [N s] and D [N m s]."""
    length = turns * PITCH / np.cos(THETA)
    rows = LAWS[theory].coefficients("", np.array(THICKNESS), np.array(length))
    along, across, about = (float(value) for value in rows[:3])
    s, c = np.sin(THETA), np.cos(THETA)
    return (
        length * (along * c**2 + across * s**2),
        -(across - along) * s * c * RADIUS * length,
        RADIUS**2 * length * (along * s**2 + across * c**2) + about * c**2 * length,
    )


def observe(model, state) -> dict[str, float]:
    """Return force [N] and torque [N m] of the fluid along the axis, and speed along it [m/s]."""
    points, drag = state.points().reshape(-1, model.points_count, 3)[0], model.drag(state)
    force, moment = drag.force.reshape(-1, *points.shape)[0], drag.moment.reshape(-1, len(points) - 1)[0]
    tangents = np.diff(points, axis=0) / np.linalg.norm(np.diff(points, axis=0), axis=1, keepdims=True)
    torque = np.cross(points, force)[:, 2].sum() + moment @ tangents[:, 2]
    return {
        "force": force[:, 2].sum(),
        "torque": torque,
        "speed": state.velocities().reshape(-1, *points.shape)[0][:, 2].mean(),
    }


def check(result) -> list[ddg.Check]:
    """Check thrust and torque of a fixed helix, or speed and torque of a swimming one."""
    theory, how = result.model.curves.names[0].split(", ")
    points = result.scene.batches[0].points[0]
    edges = 2.0 * np.pi / (np.unwrap(np.arctan2(points[:, 1], points[:, 0]))[1])
    A, B, D = grand_resistance(theory, (len(points) - 1) / edges)
    U = -B / A * RATE if how == "swims" else 0.0
    bent = 60.0 / result.scene.batches[0].section.EI1  # departure of the helix from a rigid body
    tolerance = 8.0 / edges**2 + 0.5 * (RATE * result.dt) ** 2 + bent
    final = {name: values[-1] for name, values in result.series.items()}
    checks = {"torque [N m]": (final["torque"], -(B * U + D * RATE))}
    if how == "swims":
        checks["speed [m/s]"] = (final["speed"], U)
    else:
        checks["thrust [N]"] = (final["force"], -B * RATE)
    return once_reached(
        result,
        3.0 * result.dt,  # velocities are means over steps, from the second on
        tuple(checks),
        lambda: [ddg.Check(name, *pair, tolerance, SOURCE, relative=True) for name, pair in checks.items()],
    )


def benchmark() -> ddg.bench.Study:
    """Study the torque over edges and steps."""
    return ddg.bench.Study({"n": (10, 20, 40, 80), "dt": (0.04, 0.02, 0.01)}, "torque", series=("dt",))

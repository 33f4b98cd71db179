"""Rod and payload: a box on the end of a cantilever rod swings slower than a point of its mass would.

A light rod of length L and bending stiffness EI carries a box of mass m and moment of inertia J, whose centre lies e beyond the end.
With the deflection w and the slope s of the end,

    K = EI / L^3 [[12, -6 L], [-6 L, 4 L^2]] ,   M = [[m, m e], [m e, J + m e^2]] ,

and the lowest mode has the frequency of det(K - omega^2 M) = 0. A point mass at the end would have omega^2 = 3 EI / (m L^3). The box
starts in this mode, so that its rotation keeps a constant ratio to its deflection.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _bodies

LENGTH, RADIUS = 0.2, 2e-3  # m, of the rod
MATERIAL = ddg.Material(young=1e7, poisson=0.5, density=1.0)  # its mass is a ten thousandth of the payload's
DENSITY = 500.0  # kg/m^3, of the payload
SWINGS = 2  # periods that the frequency takes
NAMES = ("angular frequency [rad/s]", "rotation over deflection [rad/m]", "frequency over that of a point mass")


def build(
    n: int = 40, half: float = 0.02, amplitude: float = 0.1, dt: float = 2e-2, duration: float = 16.0
) -> ddg.Scene:
    """Build the rod along x from a clamp at the origin, the box at its end.

    Args:
        n: edges of the rod
        half: half a side of the box [m]
        amplitude: deflection of the centre of the box over the length of the rod
        dt: time step [s]
        duration: duration of the run [s]
    """
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0), analysis=ddg.Dynamics(dt=dt, duration=duration, scheme="implicit_midpoint")
    )
    points = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), n + 1)
    rod = scene.add_rod(points, section=ddg.Circle(RADIUS), material=MATERIAL, name="rod")
    scene.clamp_end(rod, "first")
    omega, ratio = exact(half)
    speed = amplitude * LENGTH * omega
    box = scene.add_body(
        ddg.Box((LENGTH + half, 0.0, 0.0), (half, half, half)),
        density=DENSITY,
        velocity=(0.0, 0.0, speed),
        angular_velocity=(0.0, -ratio * speed, 0.0),
        name="payload",
    )
    scene.attach(rod, [-1], box)
    return scene


def exact(half: float) -> tuple[float, float]:
    """Return the lowest frequency [rad/s], and the slope of the end over the deflection of the centre [1/m]."""
    stiffness = MATERIAL.young * np.pi * RADIUS**4 / 4.0 / LENGTH**3
    mass = DENSITY * (2.0 * half) ** 3
    K = stiffness * np.array([[12.0, -6.0 * LENGTH], [-6.0 * LENGTH, 4.0 * LENGTH**2]])
    M = mass * np.array([[1.0, half], [half, 2.0 / 3.0 * half**2 + half**2]])
    squares, modes = np.linalg.eig(np.linalg.solve(M, K))
    lowest = squares.real.argmin()
    deflection, slope = modes[:, lowest].real
    return float(np.sqrt(squares.real[lowest])), float(slope / (deflection + half * slope))


def observe(model, state) -> dict[str, float]:
    """Return the deflection of the centre of the payload [m] and the rotation [rad]."""
    payload = state.body("payload")
    along = payload.rotation[:, 0]
    return {"deflection": float(payload.position[2]), "rotation": float(np.arctan2(along[2], along[0]))}


def check(result) -> list[ddg.Check]:
    """Check frequency and mode."""
    half = result.model.scene.bodies[0].shapes[0].points[:, 1].max()
    omega, ratio = exact(half)
    names = NAMES
    return once_reached(result, 2.0 * np.pi / omega * SWINGS, names, lambda: _checks(result, half, omega, ratio))


def _checks(result, half, omega, ratio) -> list[ddg.Check]:
    deflection, rotation = (np.array(result.series[name]) for name in ("deflection", "rotation"))
    measured = _bodies.frequency(result.times, deflection)
    point = np.sqrt(3.0 * MATERIAL.young * np.pi * RADIUS**4 / 4.0 / (DENSITY * (2.0 * half) ** 3 * LENGTH**3))
    source = "det(K - omega^2 M) = 0"
    return [
        ddg.Check(NAMES[0], measured, omega, 5e-3, source, relative=True),
        ddg.Check(NAMES[1], deflection @ rotation / (deflection @ deflection), ratio, 0.01, source, relative=True),
        ddg.Check(NAMES[2], measured / point, omega / point, 5e-3, source),
    ]


def picture(result, frames) -> dict:
    """Draw rod and payload at the start and near both reversals."""
    deflection = [result.at(t, "deflection") for t in frames]
    times = sorted(frames)
    chosen = {times[0], times[int(np.argmin(deflection))], times[int(np.argmax(deflection))]}
    return {"points_by_time": {t: frames[t] for t in sorted(chosen)}, "side_by_side": True}


def benchmark() -> ddg.bench.Study:
    """Study the frequency over steps and edges of the rod."""
    return ddg.bench.Study({"dt": (8e-2, 4e-2, 2e-2), "n": (10, 20, 40)}, NAMES[0], one_by_one=True)

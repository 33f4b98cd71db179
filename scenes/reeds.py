"""Reeds in a shear flow: elastic stems of several radii bend under quadratic drag until it balances bending and weight.

The wind is u = G z along x. With the slope phi of a stem of arc length s against the vertical, internal force F and moment M,

    EI phi' = M ,  M' = -(F_x cos(phi) - F_z sin(phi)) ,  F' = -f ,

and the load f has the weight, c_n |u_n| u_n across, u_n = u cos(phi), and c_t |u_t| u_t along, u_t = u sin(phi). This boundary value
problem is solved by collocation, as a reference (compare Gosselin, de Langre and Machado-Almeida, J. Fluid Mech. 650, 2010, 319).
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

LENGTH, SPACING = 1.0, 0.15  # m
STEM = ddg.Material(young=2e9, density=500.0)
AIR = ddg.QuadraticDrag(density=1.2, normal=1.1, tangential=0.02)
RADII = (1.5e-3, 2e-3, 2.5e-3, 3.5e-3)  # m
SETTLED = 4.0  # s
SOURCE = "boundary value problem, collocation"


def build(n: int = 40, shear: float = 14.0, dt: float = 0.02, duration: float = SETTLED) -> ddg.Scene:
    """Build the reeds, upright along z and clamped at the ground.

    Args:
        n: edges of a reed
        shear: G, growth of the wind with height [1/s]
        dt: time step [s]
        duration: duration of the run [s]
    """
    scene = ddg.Scene(flow=Shear(shear), analysis=ddg.Dynamics(dt=dt, duration=duration))
    for i, radius in enumerate(RADII):
        points = np.zeros((n + 1, 3))
        points[:, 1], points[:, 2] = i * SPACING, np.linspace(0.0, LENGTH, n + 1)
        reed = scene.add_rod(points, section=ddg.Circle(radius), material=STEM, name=f"{2e3 * radius:g} mm thick")
        scene.clamp_end(reed)
    scene.drag(law=AIR)
    return scene


class Shear:
    """Wind along x that grows with height."""

    def __init__(self, rate: float):
        self.rate = rate

    def __call__(self, points: np.ndarray, t: float) -> np.ndarray:
        """Return velocities at points (..., 3)."""
        return points[..., 2:] * [self.rate, 0.0, 0.0]


def equilibrium(radius: float, shear: float, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the reference: points (n, 2) at arc lengths s [m], and force along x and moment at the base [N, N m]."""
    from scipy.integrate import solve_bvp

    stiffness = STEM.young * 0.25 * np.pi * radius**4
    weight = STEM.density * np.pi * radius**2 * 9.81
    along, across = (float(row) for row in AIR.coefficients("", np.array(radius), np.array(LENGTH))[:2])

    def derivative(y, part):
        _, z, phi, moment, force_x, force_z = y
        sine, cosine, wind = np.sin(phi), np.cos(phi), shear * z
        normal = across * np.abs(wind * cosine) * wind * cosine
        tangential = along * np.abs(wind * sine) * wind * sine
        load_x, load_z = normal * cosine + tangential * sine, tangential * cosine - normal * sine - weight
        shear_force = force_z * sine - force_x * cosine
        return np.stack([sine, cosine, moment / stiffness, shear_force, -part * load_x, -part * load_z])

    def ends(first, last):
        return np.array([*first[:3], *last[3:]])

    values = np.zeros((6, len(s)))
    values[1] = s
    for part in (0.2, 0.5, 1.0):  # load steps
        solved = solve_bvp(lambda s, y, part=part: derivative(y, part), ends, s, values, tol=1e-8, max_nodes=10**5)
        values = solved.sol(s)
    return values[:2].T, values[[4, 3], 0]


def observe(model, state) -> dict[str, float]:
    """Return the force of the wind along x [N] and the kinetic energy [J]."""
    return {
        "wind": float(model.drag(state).force.reshape(-1, 3)[:, 0].sum()),
        "kinetic": model.energies(state)["kinetic"],
    }


def check(result) -> list[ddg.Check]:
    """Check shapes, and forces and moments at the base, against the boundary value problem."""
    names = [
        f"{name}, {result.model.curves.names[i]}"
        for i in range(len(RADII))
        for name in ("largest error [m]", "force", "moment")
    ]
    return once_reached(result, SETTLED, names, lambda: _checks(result, names))


def _checks(result, names) -> list[ddg.Check]:
    scene, state = result.model.scene, result.state
    checks, along = [], np.linspace(0.0, LENGTH, scene.batches[0].nodes)
    tolerance = 4.0 / scene.batches[0].edges ** 2
    for i, reaction in enumerate(result.model.reactions(state)):
        exact, base = equilibrium(RADII[i], scene.flow.rate, along)
        error = np.abs(state.points(i)[:, [0, 2]] - exact).max()
        measured = -float(np.ravel(reaction.force)[0]), -float(np.ravel(reaction.moment)[1])
        checks.append(ddg.Check(names[3 * i], error, 0.0, tolerance, SOURCE))
        for name, value, reference in zip(names[3 * i + 1 : 3 * i + 3], measured, base, strict=True):
            checks.append(ddg.Check(name, value, reference, tolerance, SOURCE, relative=True))
    return checks


def picture(result, frames) -> dict:
    """Draw the reeds upright and bent, and their shapes against the boundary value problem."""
    times, scene = sorted(frames), result.model.scene
    lines = []
    for i, radius in enumerate(RADII):
        points = np.asarray(result.state.points(i))
        lines.append((result.model.curves.names[i], points[:, 0], points[:, 2], "-"))
        exact, _ = equilibrium(radius, scene.flow.rate, np.linspace(0.0, LENGTH, 11))
        lines.append(("reference" if i == 0 else "", *exact.T, "k."))
    return {
        "points_by_time": {t: frames[t] for t in (times[0], times[-1])},
        "chart": {"lines": lines, "x": "x [m]", "y": "z [m]"},
    }

"""Magnetic cantilever: a hard-magnetic beam, magnetised along its axis, bends into a field at any angle.

A beam along x has the magnetisation M along its tangent (cos th, sin th). In a uniform field B (cos a, sin a) it has the energy
int EI th'^2 / 2 - M A B cos(th - a) ds. With G = M A B L^2 / EI, the magnetic load over bending,

    th'' = G sin(th - a) / L^2 ,  th(0) = 0 ,  th'(L) = 0

(Zhao, Kim, Cabrera, Ferracin, Nguyen and Dunn, J. Mech. Phys. Solids 124, 2019, 244; Wang, Kim, Guo and Zhao, J. Mech. Phys. Solids
142, 2020, 104045). Across, a = 90 degrees, it is the elastica with a dead force G EI / L^2 at its tip. For small bending the tip
rotates by tan(a) (1 - 1 / cosh(sqrt(G cos a))), which is G / 2 across.
"""

import numpy as np

import ddg_warp as ddg

LENGTH = 1.0  # m
EI = 1.0  # N m^2
EA = 1.0e7  # N; nearly inextensible
AREA = 1.0e-4  # m^2
MAGNETISATION = 1.0e5  # A/m
SOURCE = "EI th'' = M A B sin(th - a) as a boundary value problem"


def build(load: float = 5.0, angle: float = 90.0, n: int = 50) -> ddg.Scene:
    """Build the beam along x, in a field in the plane of x and z.

    Args:
        load: M A B L^2 / EI, the magnetic load over bending
        angle: angle of the field from the axis of the beam [degrees], between -170 and 170
        n: edges of the beam
    """
    if not abs(angle) <= 170.0:
        raise ValueError(
            f"angle = {angle}; it is between -170 and 170 degrees, see magnetic_buckling for a field that points back"
        )
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2, analysis=ddg.Statics(load_steps=5))
    section = ddg.Stiffness(EA=EA, EI1=EI, area=AREA, radius=0.01)
    beam = scene.add_rod(np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), n + 1), section=section, name="beam")
    scene.clamp_end(beam, "first")
    scene.magnetize(beam, MAGNETISATION)
    field = load * EI / (MAGNETISATION * AREA * LENGTH**2)  # T
    scene.magnetic_field((field * np.cos(np.radians(angle)), 0.0, field * np.sin(np.radians(angle))))
    return scene


def exact(load: float, angle: float) -> tuple[float, float, float]:
    """Return angle [rad] and position (x, z) [m] of the tip, in a field at `angle` [rad] from the axis."""
    from scipy.integrate import solve_bvp

    s = np.linspace(0.0, 1.0, 401)
    y = np.stack([0.0 * s, 0.0 * s, s, 0.0 * s])  # th, th', x, z
    for k in load * np.linspace(0.1, 1.0, 10):

        def rates(_s, y, k=k):
            return np.stack([y[1], k * np.sin(y[0] - angle), np.cos(y[0]), np.sin(y[0])])

        def ends(first, last):
            return np.array([first[0], last[1], first[2], first[3]])

        solution = solve_bvp(rates, ends, s, y, tol=1e-9, max_nodes=20_000)
        s, y = solution.x, solution.y
    return y[0, -1], LENGTH * y[2, -1], LENGTH * y[3, -1]


def linear(load: float, angle: float) -> float:
    """Return the tip angle [rad] for small bending: th'' = G (th cos a - sin a)."""
    root = np.sqrt(complex(load * np.cos(angle)))
    return float(np.tan(angle) * (1.0 - 1.0 / np.cosh(root)).real) if abs(root) > 1e-6 else 0.5 * load * np.sin(angle)


def tip(state) -> tuple[float, float, float]:
    """Return angle [rad] and position (x, z) [m] of the tip; th' is zero in the half edge between midpoint and tip."""
    points = state.points()
    edge = points[-1] - points[-2]
    return float(np.arctan2(edge[2], edge[0])), points[-1, 0], points[-1, 2]


def check(result) -> list[ddg.Check]:
    """Check the tip against the boundary value problem, and at a hundredth of the field against the linear beam."""
    field = result.scene.applied_field.value.at(0.0)
    load = np.linalg.norm(field) * MAGNETISATION * AREA * LENGTH**2 / EI
    angle = float(np.arctan2(field[2], field[0]))
    n = len(result.state.points()) - 1
    tolerance = min(
        ddg.Check.COARSEST, (1.0 + load) / n**2
    )  # the field bends the beam within L / sqrt(load) of the clamp
    names = ("angle of the tip [rad]", "tip x [m]", "tip z [m]")
    values = zip(names, tip(result.state), exact(load, angle), strict=True)
    checks = [ddg.Check(name, measured, reference, tolerance, SOURCE) for name, measured, reference in values]
    small = 0.01 / max(1.0, load)
    state = ddg.statics.solve(result.model, end=small)
    reference = linear(small * load, angle)
    if reference:
        checks.append(
            ddg.Check(
                "angle of the tip in a weak field [rad]", tip(state)[0], reference, 1e-3, "linear beam", relative=True
            )
        )
    return checks


def benchmark() -> ddg.bench.Study:
    """Study the tip over the edges of the beam."""
    return ddg.bench.Study({"n": (20, 40, 80, 160)}, "tip x")

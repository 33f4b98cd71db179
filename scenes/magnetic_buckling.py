"""Magnetic buckling: a hard-magnetic column, magnetised along its axis, in an opposite field.

The field's couple M A B sin(th) is that of a dead force M A B at the free end of Euler's column. Clamped and free it buckles at

    M A B L^2 / EI = (pi / 2)^2

and then follows the elastica. With the tip angle th1 and k = sin(th1 / 2) (Love, Mathematical Theory of Elasticity, 1927, art.
263),

    M A B L^2 / EI = K(k)^2 ,  deflection of the tip = 2 L k / K(k) ,  its height = L (2 E(k) / K(k) - 1) .
"""

import numpy as np

import ddg_warp as ddg

LENGTH = 1.0  # m
EI = 1.0  # N m^2
EA = 1.0e7  # N; nearly inextensible
AREA = 1.0e-4  # m^2
MAGNETISATION = 1.0e5  # A/m
CRITICAL = 0.25 * np.pi**2
SOURCE = "(pi / 2)^2, as Euler's column clamped and free"
BENT = "elastica, elliptic integrals"


def build(over: float = 1.8, n: int = 50) -> ddg.Scene:
    """Build the column along z.

    Args:
        over: field over the critical field
        n: edges of the column
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2, analysis=ddg.Statics(load_steps=10))
    section = ddg.Stiffness(EA=EA, EI1=EI, area=AREA, radius=0.01)
    column = scene.add_rod(np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, LENGTH), n + 1), section=section, name="column")
    scene.clamp_end(column, "first")
    scene.magnetize(column, MAGNETISATION)
    scene.magnetic_field((0.0, 0.0, -over * CRITICAL * EI / (MAGNETISATION * AREA * LENGTH**2)))
    return scene


def exact(over: float) -> tuple[float, float]:
    """Return deflection and height of the tip [m] in a field beyond the critical one."""
    from scipy.optimize import brentq
    from scipy.special import ellipe, ellipk

    square = brentq(lambda m: ellipk(m) ** 2 - over * CRITICAL, 0.0, 1.0 - 1e-12, xtol=1e-16)
    whole = ellipk(square)
    return 2.0 * LENGTH * np.sqrt(square) / whole, LENGTH * (2.0 * ellipe(square) / whole - 1.0)


def critical_field(n: int, device: str = "cpu") -> float:
    """Return M A B L^2 / EI of a zero lowest eigenvalue, for a column of n edges."""
    model = build(1.0, n).build(device, "float64")

    def straight(load_factor):
        return model, ddg.statics.solve(model, end=load_factor, mode="follow")

    return CRITICAL * ddg.stability.critical(straight, 0.9, 1.1)


def check(result) -> list[ddg.Check]:
    """Check the critical field and the tip of the buckled column."""
    n = len(result.state.points()) - 1
    over = -result.scene.applied_field.value.at(0.0)[2] * MAGNETISATION * AREA * LENGTH**2 / (EI * CRITICAL)
    tolerance = min(ddg.Check.COARSEST, 1.0 / n**2)
    critical = critical_field(n, result.model.device)
    checks = [ddg.Check("critical field [EI / M A L^2]", critical, CRITICAL, tolerance, SOURCE, relative=True)]
    if over > 1.0:
        x, _, z = result.state.points()[-1]
        deflection, height = exact(over)
        # the deflection grows like the root of the supercritical field, and the critical field has an error of order
        # h^2
        near = min(ddg.Check.COARSEST, 3.0 / (n**2 * (over - 1.0)))
        checks.append(ddg.Check("deflection of the tip [m]", abs(x), deflection, near, BENT, relative=True))
        checks.append(ddg.Check("height of the tip [m]", z, height, near, BENT))
    return checks


def benchmark() -> ddg.bench.Study:
    """Study the critical field over the edges of the column."""
    return ddg.bench.Study({"n": (20, 40, 80, 160)}, "critical field")

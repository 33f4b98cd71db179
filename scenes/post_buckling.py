"""Post-buckling: a hinged rod compressed far beyond its Euler load.

A naturally straight rod starts as a circular arc, hinged at its ends. The elastica by elliptic integrals
(Love, Mathematical Theory of Elasticity, 1927, art. 263): with the angle a of the ends and k = sin(a / 2),

    shortening = 2 L (1 - E(k) / K(k)) ,  P = 4 K(k)^2 EI / L^2 ,  amplitude = L k / K(k) .
"""

import numpy as np

import ddg_warp as ddg

LENGTH = 1.0  # m
EI = 1.0  # N m^2
SOURCE = "elastica, elliptic integrals"


def build(shortening: float = 0.3, axial: float = 1.0e8, n: int = 100) -> ddg.Scene:
    """Build the rod along x, buckled towards z.

    Args:
        shortening: approach of the ends over the length of the rod
        axial: EA L^2 / EI; the reference is inextensible, and P over it adds to the shortening
        n: edges of the rod, an even number
    """
    if n < 4 or n % 2:
        raise ValueError(f"n = {n}; it is an even number, 4 at least: the middle of the arc is a node")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2, analysis=ddg.Statics(load_steps=1))
    section = ddg.Stiffness(EA=axial * EI / LENGTH**2, EI1=EI, radius=0.01)
    rod = scene.add_rod(arc(shortening, n), section=section, natural="straight", name="strip")
    scene.fix(rod, [0, -1])
    return scene


def arc(shortening: float, n: int) -> np.ndarray:
    """Return nodes (n + 1, 3) [m] on a circle, LENGTH / n apart, with a chord of (1 - shortening) LENGTH along x."""
    from scipy.optimize import brentq

    def chord(angle):
        return np.sin(0.5 * n * angle) / (n * np.sin(0.5 * angle))

    angle = brentq(lambda a: chord(a) - (1.0 - shortening), 1e-9, 2.0 * np.pi / n)
    slope = 0.5 * (n - 1) * angle - angle * np.arange(n)
    points = np.zeros((n + 1, 3))
    points[1:, 0] = np.cumsum(np.cos(slope)) * LENGTH / n
    points[1:, 2] = np.cumsum(np.sin(slope)) * LENGTH / n
    return points


def exact(shortening: float) -> tuple[float, float, float]:
    """Return axial load [N], amplitude in the middle [m] and angle of the ends [rad]."""
    from scipy.optimize import brentq
    from scipy.special import ellipe, ellipk

    square = brentq(lambda m: 2.0 * (1.0 - ellipe(m) / ellipk(m)) - shortening, 1e-15, 0.9, xtol=1e-16)
    load = 4.0 * ellipk(square) ** 2 * EI / LENGTH**2
    return load, LENGTH * np.sqrt(square) / ellipk(square), 2.0 * np.arcsin(np.sqrt(square))


def measure(model, state) -> tuple[float, float, float]:
    """Return axial load [N], amplitude in the middle [m] and angle of the first edge [rad]."""
    from ddg_warp.solve.equilibrium.tangent import Tangent

    points = state.points()
    edge = points[1] - points[0]
    load = Tangent(model).gradient(state)[0]  # first dof: x of the first node, fixed
    return load, points[len(points) // 2, 2], np.arctan2(edge[2], edge[0])


def check(result) -> list[ddg.Check]:
    """Check reaction, amplitude and angle against elliptic integrals."""
    points = result.state.points()
    shortening = 1.0 - (points[-1, 0] - points[0, 0]) / LENGTH
    tolerance = min(ddg.Check.COARSEST, 1e-3 * max(1.0, (100.0 / (len(points) - 1)) ** 2))
    names = ("axial load [N]", "amplitude [m]", "angle of the ends [rad]")
    values = zip(names, measure(result.model, result.state), exact(shortening), strict=True)
    return [ddg.Check(name, measured, reference, tolerance, SOURCE, True) for name, measured, reference in values]


def benchmark() -> ddg.bench.Study:
    """Study the axial load over the edges of the column."""
    return ddg.bench.Study({"n": (26, 50, 100, 200)}, "axial load")

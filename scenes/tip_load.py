"""Tip load: large bending of a cantilever by a transverse dead force at its tip.

The elastica by elliptic integrals (Frisch-Fay, Flexible Bars, 1962; Mattiasson, Int. J. Numer. Meth. Eng. 17, 1981): with the angle
a of the tip, p^2 = (1 + sin a) / 2 and sin(phi) = 1 / (p sqrt 2),

    sqrt(P L^2 / EI) = K(p) - F(phi, p) ,  x^2 = 2 EI sin(a) / P ,  z = -L + 2 sqrt(EI / P) (E(p) - E(phi, p)) .
"""

import numpy as np

import ddg_warp as ddg

LENGTH = 1.0  # m
EI = 1.0  # N m^2
EA = 1.0e8  # N; nearly inextensible
SOURCE = "elastica, elliptic integrals"


def build(load: float = 10.0, n: int = 100) -> ddg.Scene:
    """Build the cantilever along x, loaded downwards.

    Args:
        load: force over EI / L^2
        n: edges of the rod
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2, analysis=ddg.Statics(load_steps=5))
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n + 1)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=EA, EI1=EI, radius=0.01), name="strip")
    scene.clamp_end(rod, "first")
    scene.add_force(rod, -1, (0.0, 0.0, -load * EI / LENGTH**2))
    return scene


def exact(load: float) -> tuple[float, float, float]:
    """Return the tip (x, z) [m] and its angle below the horizontal [rad], for a force over EI / L^2."""
    from scipy.optimize import brentq
    from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

    def parts(angle):
        square = 0.5 * (1.0 + np.sin(angle))
        return square, np.arcsin(np.sqrt(0.5 / square))

    def excess(angle):
        square, phi = parts(angle)
        return ellipk(square) - ellipkinc(phi, square) - np.sqrt(load)

    angle = brentq(excess, 1e-12, 0.5 * np.pi - 1e-12, xtol=1e-15)
    square, phi = parts(angle)
    drop = 1.0 - 2.0 / np.sqrt(load) * (ellipe(square) - ellipeinc(phi, square))
    return LENGTH * np.sqrt(2.0 * np.sin(angle) / load), -LENGTH * drop, angle


def tip(state) -> tuple[float, float, float]:
    """Return the tip (x, z) [m] and the angle of the last edge below the horizontal [rad]."""
    points = state.points()
    edge = points[-1] - points[-2]
    return points[-1, 0], points[-1, 2], np.arctan2(-edge[2], edge[0])


def observe(model, state) -> dict[str, float]:
    """Return position [m] and angle [rad] of the tip."""
    return dict(zip(("tip_x", "tip_z", "tip_angle"), tip(state), strict=True))


def check(result) -> list[ddg.Check]:
    """Check the tip against elliptic integrals."""
    load = -result.model.scene.loads[0].force[2] * LENGTH**2 / EI
    tolerance = min(ddg.Check.COARSEST, 1e-4 * max(1.0, (100.0 / (result.model.curves.counts[0] - 1)) ** 2))
    values = zip(("tip x [m]", "tip z [m]", "tip angle [rad]"), tip(result.state), exact(load), strict=True)
    return [ddg.Check(name, measured, reference, tolerance, SOURCE) for name, measured, reference in values]


def benchmark() -> ddg.bench.Study:
    """Study the tip over the edges of the rod."""
    return ddg.bench.Study({"n": (25, 50, 100, 200)}, "tip x", scale=1.0)

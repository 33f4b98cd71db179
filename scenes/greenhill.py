"""Greenhill: a straight rod under tension is twisted until it buckles.

Both ends are clamped, the last can slide under a dead tension T. With a moment M, its deflection u + i v follows

    B w'''' - i M w''' - T w'' = 0 ,  w ~ 1, s, exp(i a s), exp(i b s) ,  a, b = (M +- sqrt(M^2 - 4 B T)) / 2B ,

and clamped ends give (Greenhill 1883; van der Heijden & Thompson, Nonlinear Dynamics 21, 2000), L = 1,

    (a cos(a/2) - 2 sin(a/2)) b sin(b/2) = (b cos(b/2) - 2 sin(b/2)) a sin(a/2) .
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.postprocess.mode_shape import buckled_points

LENGTH = 1.0  # m
B, C = 1.0, 1.0  # bending and twisting stiffness [N m^2], of which C only sets the end rotation
EA = 1.0e9  # N, nearly inextensible
SOURCE = "Greenhill 1883, determinant for clamped ends"


def build(tension: float = 100.0, moment: float = 20.0, n: int = 200) -> ddg.Scene:
    """Build the rod along x.

    Args:
        tension: dead load at the end over B / L^2; compression where negative
        moment: moment at the end over B / L, reached by rotating it
        n: edges of the rod
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    points = np.zeros((n + 1, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n + 1)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=EA, EI1=B, GJ=C, radius=0.01), name="rod")
    scene.clamp_end(rod, "first")
    turn = ddg.Motion(angle=lambda t: t * moment * B / C, axis=(1.0, 0.0, 0.0))
    scene.clamp_end(rod, "last", components="yz", motion=turn)
    scene.add_force(rod, -1, (tension * B / LENGTH**2, 0.0, 0.0), amplitude=lambda t: 1.0)
    return scene


def exact(tension: float) -> float:
    """Return the critical moment over B / L."""
    from scipy.optimize import brentq

    tension = tension or 1e-9  # without tension b is zero and the equation is 0 = 0

    def parts(x):
        return x * np.cos(0.5 * x) - 2.0 * np.sin(0.5 * x), x * np.sin(0.5 * x)

    def balance(root):
        """Return the characteristic equation in that square root, over its trivial zeros."""
        a, b = np.sqrt(root**2 + tension) + root, np.sqrt(root**2 + tension) - root
        (fa, ga), (fb, gb) = parts(a), parts(b)
        return (fa * gb - fb * ga) / (b * b * root)

    low = np.sqrt(max(0.0, -tension)) + 1e-3
    while balance(low) * balance(low + 0.05) > 0.0:
        low += 0.05
    return 2.0 * np.sqrt(brentq(balance, low, low + 0.05) ** 2 + tension)


def critical_moment(tension: float, n: int, device: str = "cpu") -> float:
    """Return the moment over B / L of a zero lowest eigenvalue, for a rod of n edges."""
    from ddg_warp.solve.equilibrium import stability
    from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions

    unit = exact(tension)
    model = build(tension, unit, n).build(device, "float64")
    equilibrium = Equilibrium(model, StaticsOptions(mode="follow"))

    # Relative edge rotations of M h / B lower it by up to a third of their square. A narrow bracket contains one mode
    # only.
    low, high = 1.0 - 0.5 * (unit / n) ** 2, 1.0 + 0.1 * (unit / n) ** 2
    start = equilibrium.load(model.state(), 1, 0.0, low)

    def twisted(t):
        return model, equilibrium.load(start, 1, low, t)

    return unit * stability.critical(twisted, low, high, tolerance=1e-4)


def check(result) -> list[ddg.Check]:
    """Check the critical moment against the determinant, within the discretisation error."""
    tension = result.model.scene.loads[0].force[0] * LENGTH**2 / B
    n = result.model.curves.counts[0] - 1
    reference = exact(tension)
    measured = critical_moment(tension, n, result.model.device)
    return [
        ddg.Check(
            "critical moment [B/L]",
            measured,
            reference,
            min(ddg.Check.COARSEST, (reference / n) ** 2 / 5.0),
            SOURCE,
            relative=True,
        )
    ]


def benchmark() -> ddg.bench.Study:
    """Study the critical moment over the nodes of the rod."""
    return ddg.bench.Study({"n": (50, 100, 200, 400)}, "critical moment")


def picture(result, frames) -> dict:
    """Draw the buckling mode next to the straight rod."""
    shapes = {0.0: result.state.points(), 1.0: buckled_points(result.model, result.state, 0.1 * LENGTH)}
    return {"points_by_time": shapes, "label": "amplitude of the buckling mode"}

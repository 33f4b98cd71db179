"""Steel wire: a thin stiff cantilever, released straight, sags and swings.

A wire of length 1 m and radius 2 mm (E = 200 GPa, nu = 0.3, 7800 kg/m^3) bends by a tenth of its length. Its stretching
stiffness is a million times its bending stiffness over the length squared. It is therefore the most sensitive to rounding of the
stretch and to a linear solve in single precision. Implicit Euler at 0.01 s, as in the published comparison.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

LENGTH = 1.0  # m
RADIUS = 2.0e-3  # m
DT = 0.01  # s
SOURCE = "published comparison: discrete elastic rods, implicit Euler at 0.01 s, converged to rounding"

# Nodes -> time [s] -> z of the tip [m].
TIP = {100: {0.05: -0.019206, 0.2: -0.078097, 0.5: -0.065287}}


def build(n: int = 100) -> ddg.Scene:
    """Build the wire along x.

    Args:
        n: nodes of the wire; there are published numbers for 100
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), analysis=ddg.Dynamics(dt=DT, duration=0.5, scheme="implicit_euler"))
    points = np.zeros((n, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n)
    wire = scene.add_rod(
        points,
        section=ddg.Circle(radius=RADIUS),
        material=ddg.Material(young=2.0e11, poisson=0.3, density=7800.0),
        name="wire",
    )
    scene.clamp(wire, edges=[0])
    return scene


def observe(model, state) -> dict[str, float]:
    """Return the tip height [m] and the largest strain of an edge, in the first world."""
    n = model.curves.counts[0]
    points = state.points().reshape(-1, 3)[:n]
    length = np.linalg.norm(np.diff(points, axis=0), axis=1) * ((n - 1) / LENGTH)
    return {"tip_z": points[-1, 2], "strain": np.abs(length - 1.0).max()}


def check(result) -> list[ddg.Check]:
    """Check the tip against the published comparison, and the length of the wire."""
    reference = TIP.get(result.model.curves.counts[0], {}) if result.dt == DT else {}
    tips = [
        check
        for t, value in reference.items()
        for check in once_reached(
            result,
            t,
            [f"tip z at {t} s [m]"],
            lambda t=t, value=value: [ddg.Check(f"tip z at {t} s [m]", result.at(t, "tip_z"), value, 1.0e-5, SOURCE)],
        )
    ] or [ddg.Check.skip("tip z [m]", f"there are published numbers for 100 nodes and dt = {DT} s")]
    # A wire of 7800 kg/m^3 strains by rho g L / E = 4e-7 under its own weight; inertia adds a few times that.
    strain = max(result.series["strain"])
    return [*tips, ddg.Check("largest strain of an edge", strain, 0.0, 1e-6, "weight and inertia over EA")]


def benchmark() -> ddg.bench.Study:
    """Study the tip at 0.1 s over steps, nodes and schemes, against a finer wire in shorter midpoint steps."""
    return ddg.bench.Study(
        {"dt": (0.01, 0.005, 0.0025), "n": (50, 100), "scheme": ("implicit_euler", "implicit_midpoint")},
        lambda result: result.series["tip_z"][-1],
        {"dt": 0.000625, "n": 400, "scheme": "implicit_midpoint"},
        fixed={"duration": 0.1},
        series=("scheme",),
        unit="m",
    )

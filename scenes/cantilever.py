"""Heavy elastica: a horizontal cantilever, released straight, swings under its own weight.

A rod of length 1 m and radius 20 mm (E = 10 MPa, nu = 0.5, 1000 kg/m^3) is clamped at its first edge. It is so soft that it
swings down past the vertical. Implicit Euler damps it: the published numbers hold for dt = 0.01 s only.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

LENGTH = 1.0  # m
DT = 0.01  # s
SOURCE = "published comparison: discrete elastic rods, implicit Euler at 0.01 s, converged to rounding"

# Nodes -> time [s] -> (x, z) of the tip [m].
TIP = {
    50: {0.1: (0.997432, -0.059339), 0.5: (0.276544, -0.857515), 1.0: (0.805274, -0.554348)},
    100: {0.1: (0.997436, -0.059078), 0.5: (0.271301, -0.863334), 1.0: (0.789799, -0.574954)},
}


def build(n: int = 50) -> ddg.Scene:
    """Build the cantilever along x.

    Args:
        n: nodes of the rod; there are published numbers for 50 and 100
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), analysis=ddg.Dynamics(dt=DT, duration=1.0, scheme="implicit_euler"))
    points = np.zeros((n, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, n)
    rod = scene.add_rod(
        points,
        section=ddg.Circle(radius=0.02),
        material=ddg.Material(young=1.0e7, poisson=0.5, density=1000.0),
        name="cantilever",
    )
    scene.clamp(rod, edges=[0])
    return scene


def observe(model, state) -> dict[str, float]:
    """Return the tip position [m] of the first world."""
    x, _, z = state.points().reshape(-1, 3)[model.curves.counts[0] - 1]
    return {"tip_x": x, "tip_z": z}


def check(result) -> list[ddg.Check]:
    """Check the tip against the published comparison at the times that were run."""
    reference = TIP.get(result.model.curves.counts[0], {}) if result.dt == DT else {}
    if not reference:
        return [ddg.Check.skip("tip [m]", f"there are published numbers for 50 and 100 nodes and dt = {DT} s")]
    checks = []
    for t, tip in reference.items():
        wanted = {f"tip {axis} at {t} s [m]": (f"tip_{axis}", value) for axis, value in zip("xz", tip, strict=True)}
        checks += once_reached(
            result,
            t,
            wanted,
            lambda t=t, wanted=wanted: [
                ddg.Check(name, result.at(t, series), value, 1.0e-5, SOURCE) for name, (series, value) in wanted.items()
            ],
        )
    return checks


def benchmark() -> ddg.bench.Study:
    """Study the tip at 0.5 s [m] over steps, nodes, schemes, precisions and tolerances, against a far finer run."""
    return ddg.bench.Study(
        grid={
            "dt": (0.02, 0.01, 0.005, 0.0025, 0.00125),
            "n": (25, 50, 100),
            "scheme": ("implicit_euler", "implicit_midpoint"),
            "precision": ("float64", "mixed", "float32"),
            "rtol": (1e-4, 1e-8),
        },
        measure=lambda result: (result.series["tip_x"][-1], result.series["tip_z"][-1]),
        reference={"dt": 0.001, "n": 800, "scheme": "implicit_midpoint", "precision": "float64", "rtol": 1e-8},
        fixed={"duration": 0.5},
        series=("scheme", "precision"),
        unit="m",
    )

"""Axisymmetric dome: a shallow spherical cap under outer pressure snaps through, as a shell of revolution.

The path passes a largest load, where the dome would jump, and then a smallest one. Under pressure the rim is clamped, and load
parameter 1 is the buckling pressure of the whole sphere, 2 E h^2 / (R^2 sqrt(3 (1 - nu^2))). Under a force on the crown the rim may
slide and rotate, and load parameter 1 is 2 pi D / R. The limits then depend on lambda = (12 (1 - nu^2))^(1/4) a / sqrt(R h) alone
(Budiansky 1959; Huang, J. Appl. Mech. 31, 1964), with a the radius of the rim.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.io.colors import on_scale

RADIUS = 1.0  # m
THICKNESS = 2e-5  # m; the cap is shallow
YOUNG, POISSON = 1.0e9, 0.3
CLASSICAL = 2.0 * YOUNG * THICKNESS**2 / (RADIUS**2 * np.sqrt(3.0 * (1.0 - POISSON**2)))  # Pa
FORCE = np.pi * YOUNG * THICKNESS**3 / (6.0 * (1.0 - POISSON**2) * RADIUS)  # N
UNIT = (RADIUS * THICKNESS) ** 0.5 / (12.0 * (1.0 - POISSON**2)) ** 0.25  # m; a / lambda
SOURCE = "Marguerre and Reissner's equations by collocation (Budiansky 1959, Huang 1964)"

# (load, lambda) -> largest and subsequent smallest load parameter t at nu = 0.3. With x = lambda r / a and rotation b
# and
# stress function f: x (x b')' - b = x f (b - x) - L, x (x f')' - f = x (x b - b^2 / 2).
# Boundary conditions are b = f = 0 at x = 0. Under pressure L = 2 x^3 t, b = x f' - nu f = 0 at lambda.
# Under a force L = x t, x b' + nu b = f = 0 there.
LIMITS = {
    ("pressure", 4): (0.5637254, 0.4244706),
    ("pressure", 5): (0.6159879, 0.2839929),
    ("pressure", 6): (0.9720065, 0.2206402),
    ("force", 5): (2.5781084, 0.7204937),
    ("force", 6): (3.5459727, -1.0137903),
}


def build(load: str = "pressure", shallowness: int = 5, n: int = 80) -> ddg.Scene:
    """Build the dome with the crown at height R.

    Args:
        load: pressure, on a dome clamped at its rim, or force, on the crown of a dome whose rim may slide and rotate
        shallowness: lambda: 4, 5 or 6 under pressure, 5 or 6 under a force
        n: edges of the meridian
    """
    if (load, shallowness) not in LIMITS:
        cases = ", ".join(f"{name} {number}" for name, number in LIMITS)
        raise ValueError(f"load = {load}, shallowness = {shallowness}; there are references for {cases}")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    angle = np.arcsin(shallowness * UNIT / RADIUS) * np.linspace(0.0, 1.0, n + 1)
    points = RADIUS * np.column_stack([np.sin(angle), np.cos(angle)])
    material = ddg.Material(young=YOUNG, poisson=POISSON, density=1000.0)
    dome = scene.add_axisymmetric_shell(points, thickness=THICKNESS, material=material, name=f"dome under {load}")
    if load == "pressure":
        scene.clamp_ring(dome, "last")
        scene.add_axisymmetric_pressure(dome, -CLASSICAL)
    else:
        scene.hold_ring(dome, -1, "z")
        scene.add_pole_force(dome, -FORCE)
    watch = {"drop": ddg.Displacement.of(0, "z", -1.0)}
    scene.analysis = ddg.PathAnalysis(
        watch, ddg.StopCriterion(limit_points=2), step=1e-4, max_step=4e-4, load_scale=400.0
    )
    return scene


def check(result) -> list[ddg.Check]:
    """Check both limit loads within the discretisation error of the meridian."""
    dome = result.scene.axisymmetric_shells[0]
    limits = LIMITS[dome.name.rpartition(" ")[2], round(float(dome.points[-1, 0]) / UNIT)]
    tolerance = min(ddg.Check.COARSEST, 2e-3 * max(1.0, (80.0 / (len(dome.points) - 1)) ** 2))
    names = ("largest load", "smallest load")
    loads = [*(point.load for point in result.path.limit_points), np.nan, np.nan]  # a limit that was not met fails
    return [
        ddg.Check(name, load, limit, tolerance, SOURCE, relative=True)
        for name, load, limit in zip(names, loads, limits, strict=False)
    ]


def picture(result, frames) -> dict:
    """Draw a half of the dome before, at the first limit load, and at the end, with magnified heights, and the path."""
    limits = [point for point in result.path.points if point.kind == "limit point"]
    chosen = [result.path.points[0], *limits[:1], result.path.points[-1]]
    rest = result.path.points[0].state.points()
    across = float(rest[:, 0].max())
    heights = float(f"{0.3 * across / np.ptp(rest[:, 2]):.1g}")
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 49)  # the half beyond the plane y = 0 is seen from its cut
    shapes, cells = {}, None
    for number, point in enumerate(chosen):
        r, _, z = point.state.points().T
        z = heights * (z - rest[:, 2].min()) + 0.45 * across * (len(chosen) - 1 - number)
        around = [np.outer(-np.sin(angle), r), np.outer(np.cos(angle), r), np.tile(z, (len(angle), 1))]
        shapes[float(number)] = np.stack(around, -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(len(angle) - 1), np.arange(len(rest) - 1), indexing="ij")
    first = (i * len(rest) + j).ravel()
    after = first + len(rest)
    cells = np.concatenate([np.stack([first, after, after + 1], 1), np.stack([first, after + 1, first + 1], 1)])
    return {
        "points_by_time": [(k, np.zeros_like(rest) + shapes[k][0]) for k in shapes],
        "bodies": {
            k: (points, cells, np.tile(on_scale(np.array([k]), 0.0, 2.0), (len(cells), 1)))
            for k, points in shapes.items()
        },
        "fixed": None,
        "names": [f"load {point.load:.3g}" for point in chosen],
        "note": f"heights times {heights:,.0f}, one dome above the other",
    }


def benchmark() -> ddg.bench.Study:
    """Study the largest load over the edges of the meridian."""
    return ddg.bench.Study({"n": (20, 40, 80, 160)}, "largest load")

"""Axisymmetric dome: a clamped shallow spherical cap under outer pressure snaps through, as a shell of revolution.

The path passes a largest pressure, where the dome would jump, and a smallest one beyond. Over the buckling pressure of the whole
sphere, p_cl = 2 E h^2 / (R^2 sqrt(3 (1 - nu^2))), which is load parameter 1, they depend on lambda = (12 (1 - nu^2))^(1/4) a /
sqrt(R h) alone (Budiansky 1959; Huang, J. Appl. Mech. 31, 1964), with a the radius of the rim.
"""

import numpy as np

import ddg_warp as ddg

RADIUS = 1.0  # m
THICKNESS = 2e-5  # m; the cap is shallow
YOUNG, POISSON = 1.0e9, 0.3
CLASSICAL = 2.0 * YOUNG * THICKNESS**2 / (RADIUS**2 * np.sqrt(3.0 * (1.0 - POISSON**2)))  # Pa
UNIT = (RADIUS * THICKNESS) ** 0.5 / (12.0 * (1.0 - POISSON**2)) ** 0.25  # m; a / lambda
SOURCE = "Marguerre and Reissner's equations by collocation (Budiansky 1959, Huang 1964)"

# lambda: largest and, beyond it, smallest p / p_cl at nu = 0.3. With x = lambda r / a, b and f rotation and stress function,
# x (x b')' - b = x f (b - x) - 2 x^3 p / p_cl, x (x f')' - f = x (x b - b^2 / 2); b = f = 0 at 0, b = x f' - nu f = 0 at lambda.
LIMITS = {4: (0.5637254, 0.4244725), 5: (0.6159879, 0.2839929), 6: (0.9720065, 0.2206402)}


def build(shallowness: int = 5, n: int = 80) -> ddg.Scene:
    """The dome, its crown at height R.

    Args:
        shallowness: lambda: 4, 5 or 6
        n: edges of the meridian
    """
    if shallowness not in LIMITS:
        raise ValueError(f"shallowness = {shallowness}; there are references for {', '.join(map(str, LIMITS))}")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    angle = np.arcsin(shallowness * UNIT / RADIUS) * np.linspace(0.0, 1.0, n + 1)
    points = RADIUS * np.column_stack([np.sin(angle), np.cos(angle)])
    material = ddg.Material(young=YOUNG, poisson=POISSON, density=1000.0)
    dome = scene.add_axisymmetric_shell(points, thickness=THICKNESS, material=material, name="dome")
    scene.clamp_ring(dome, "last")
    scene.add_axisymmetric_pressure(dome, -CLASSICAL)
    watch = {"drop": ddg.Displacement.of(0, "z", -1.0)}
    scene.analysis = ddg.Trace(watch, ddg.Stop(limit_points=2), step=1e-4, max_step=4e-4, load_scale=400.0)
    return scene


def check(result) -> list[ddg.Check]:
    """Both limit pressures, to what edges of this length can resolve."""
    edges = int(result.model.curves.counts[0]) - 1
    rim = float(result.scene.axisymmetric_shells[0].points[-1, 0])
    tolerance = 2e-3 * max(1.0, (80.0 / edges) ** 2)
    names = ("largest pressure / p_cl", "smallest pressure / p_cl")
    return [
        ddg.Check(name, point.load, limit, tolerance, SOURCE, relative=True)
        for name, point, limit in zip(names, result.path.limit_points, LIMITS[round(rim / UNIT)], strict=True)
    ]

"""Sphere indentation: a point force at the pole of a thin spherical shell, and its stiffness.

Membrane and bending balance over a length sqrt(R h), and k = 4 E h^2 / (R sqrt(3 (1 - nu^2))) for a small force on a shallow shell
(Reissner, J. Math. Phys. 25, 1946). A cap that reaches ten of these lengths from the pole stands for the sphere. Its mesh is
refined towards the pole, where the moments grow like a logarithm.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scenes import _pictures

RADIUS = 1.0  # m
YOUNG = 1.0e9  # Pa
POISSON = 0.3
REACH = 10.0  # rim of the cap over sqrt(R h)
SOURCE = "Reissner 1946"


def build(slenderness: float = 1000.0, rings: int = 32, grading: float = 2.0) -> ddg.Scene:
    """Build the cap about the z axis, clamped at its rim, with the pole loaded to move by a thousandth of the thickness along -z.

    Args:
        slenderness: radius over thickness, 100 at least
        rings: rings of triangles, 6 rings^2 of them
        grading: ring k is at the angle (k / rings)^grading of the rim's; 1 for a uniform mesh
    """
    if slenderness < 100.0:
        raise ValueError(f"slenderness = {slenderness}: the shell is thin, R / h >= 100")
    thickness = RADIUS / slenderness
    points, triangles = cap(rings, REACH / np.sqrt(slenderness), grading)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    shell = scene.add_shell(points, triangles, thickness=thickness, material=ddg.Material(YOUNG, POISSON), name="cap")
    scene.clamp_boundary(shell, np.arange(1 + 3 * rings * (rings - 1), len(points)))
    scene.add_vertex_force(shell, [0], (0.0, 0.0, -1e-3 * thickness * exact(thickness)))
    return scene


def cap(rings: int, angle: float, grading: float) -> meshes.Mesh:
    """Return points and triangles of a cap with rings refined towards the pole."""
    points, triangles = meshes.spherical_cap(rings, RADIUS, angle)
    polar = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    around = np.arctan2(points[:, 1], points[:, 0])
    polar = angle * (polar / angle) ** grading
    return RADIUS * np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1
    ), triangles


def exact(thickness: float) -> float:
    """Return the stiffness [N/m]."""
    return 4.0 * YOUNG * thickness**2 / (RADIUS * np.sqrt(3.0 * (1.0 - POISSON**2)))


def stiffness(model, state) -> float:
    """Return force over displacement of the pole, over the closed form."""
    scene = model.scene
    force = -scene.shell_loads[0].force[0, 2]
    return force / (RADIUS - state.points()[0, 2]) / exact(float(scene.shells[0].thickness))


def check(result) -> list[ddg.Check]:
    """Check the stiffness against Reissner's."""
    measured = stiffness(result.model, result.state)
    return [ddg.Check("stiffness over exact", measured, 1.0, 0.03, SOURCE, relative=True)]


def picture(result, frames) -> dict:
    """Draw the magnified dent, colored by the deflection, and its profile."""
    rest, points = result.model.state().points(), result.state.points()
    deflection = ((points - rest) * rest).sum(1) / RADIUS
    factor = float(f"{0.05 * RADIUS / np.abs(deflection).max():.1g}")
    length = np.sqrt(RADIUS * float(result.scene.shells[0].thickness))
    out = np.hypot(rest[:, 0], rest[:, 1]) / length
    order = np.argsort(out)
    return {
        "points_by_time": _pictures.magnified({1.0: points}, rest, factor),
        "values": 1e6 * deflection,
        "label": "deflection [µm]",
        "note": f"displacements times {factor:,.0f}",
        "chart": {
            "lines": [("", out[order], 1e6 * deflection[order], "-")],
            "x": "distance from the pole over √(R h)",
            "y": "deflection [µm]",
        },
    }


def benchmark() -> ddg.bench.Study:
    """Study the stiffness over the rings of triangles."""
    return ddg.bench.Study({"rings": (16, 32, 64)}, "stiffness")

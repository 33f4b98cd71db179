"""Right-angle frame: a thin angle, clamped at one foot and loaded at the other in its plane, buckles laterally.

Two strips meet rigidly at a right angle; a force along the clamped leg acts at the free end of the other one. Bending of one leg is
twist of the other. (Argyris et al., Comput. Methods Appl. Mech. Eng. 20, 1979; Simo and Vu-Quoc, ibid. 58, 1986.) Reference:
second variation of Kirchhoff rods that are rigid in the plane, by a spectral Ritz method, with J = b t^3 / 3.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.postprocess.mode_shape import buckled_points

LEG, WIDTH, THICKNESS = 240.0, 30.0, 0.6  # mm
E, NU = 71240.0, 0.31  # N/mm^2
LENGTH_UNIT = "mm"
SOURCE = "second variation of Kirchhoff rods, spectral Ritz; 1.088 (Argyris 1979, Simo & Vu-Quoc 1986)"

# Lateral buckling load [N]: pulling and pressing the clamped leg.
CRITICAL = {1: 1.086757492, -1: -0.6802353021}


def build(n: int = 20, sense: int = 1, in_plane: float = 1.0) -> ddg.Scene:
    """Build the frame in the plane of x and z: one leg along x from the clamp, the other down along z.

    Args:
        n: edges of each leg
        sense: 1 pulls the clamped leg, -1 presses it
        in_plane: bending stiffness in the plane over that of the strip; the reference is rigid there
    """
    if sense not in CRITICAL:
        raise ValueError(f"sense = {sense}: it is 1, which pulls the clamped leg, or -1, which presses it")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    t = np.linspace(0.0, LEG, n + 1)[:, None]
    # The first director stands across the plane, and EI2 is of curvature about it.
    weak, strong = E * WIDTH * THICKNESS**3 / 12.0, in_plane * E * WIDTH**3 * THICKNESS / 12.0
    torsion = E / (2.0 * (1.0 + NU)) * WIDTH * THICKNESS**3 / 3.0
    section = ddg.Stiffness(EA=E * WIDTH * THICKNESS, EI1=weak, EI2=strong, GJ=torsion, radius=2.0)
    across = (0.0, 1.0, 0.0)
    clamped = scene.add_rod(t * [1.0, 0.0, 0.0], section=section, director=across, name="clamped leg")
    free = scene.add_rod(t * [0.0, 0.0, -1.0] + [LEG, 0.0, 0.0], section=section, director=across, name="free leg")
    scene.join([(clamped, -1), (free, 0)])
    scene.clamp_end(clamped, "first")
    scene.add_force(free, -1, (float(np.sign(sense)), 0.0, 0.0))
    watch = {"deflection": ddg.Displacement.of(-1, "y")}
    scene.analysis = ddg.PathAnalysis(
        watch, ddg.StopCriterion(load=(-np.inf, 1.3 * abs(CRITICAL[int(np.sign(sense))]))), load_scale=10.0
    )
    return scene


def check(result) -> list[ddg.Check]:
    """Check the load of the bifurcation of the planar path."""
    (force,) = (load.force[0] for load in result.scene.loads)
    loads = [*(point.load for point in result.path.bifurcations), np.nan]  # a path without a branch fails
    return [ddg.Check("lateral buckling load [N]", force * loads[0], CRITICAL[int(force)], 1e-2, SOURCE, relative=True)]


def benchmark() -> ddg.bench.Study:
    """Study the buckling load over the edges of each leg."""
    return ddg.bench.Study({"n": (5, 10, 20, 40)}, "lateral buckling load")


def picture(result, frames) -> dict:
    """Draw the lateral mode of the bifurcation next to the frame at the same load."""
    if not result.path.bifurcations:
        return {}
    branch = result.path.bifurcations[0].state
    shapes = {0.0: branch.points(), 1.0: buckled_points(result.model, branch, 0.25 * LEG)}
    return {"points_by_time": shapes, "label": "amplitude of the buckling mode"}

"""Deep arch: a circular arch of 215 degrees, one foot clamped, the other hinged, pressed down at its crown until it snaps.

The arch sways towards its hinge and reaches its largest load after the crown has come down by more than the radius (DaDeppo and
Schmidt, J. Appl. Mech. 42, 1975). Reference: inextensible elastica by collocation, checked by shooting.
"""

import numpy as np

import ddg_warp as ddg

RADIUS = 100.0  # m
ANGLE = 215.0  # degrees
EI = 1.0e6  # N m^2
EA = 1.0e9  # N; nearly inextensible
LOAD = 1000.0  # N, at load parameter 1
SOURCE = "inextensible elastica, collocation; 897 (DaDeppo & Schmidt 1975)"

# First maximum of the load [N], with downward and sideways displacement of the crown [m].
CRITICAL, DROP, SHIFT = 897.3089968, 113.7320631, 61.14146579


def build(n: int = 240) -> ddg.Scene:
    """Build the arch in the plane of x and z, its crown at (0, 0, R).

    Args:
        n: edges of the arch, an even number
    """
    if n < 4 or n % 2:
        raise ValueError(f"n = {n}; it is an even number, 4 at least: the crown is a node")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    angle = np.radians(ANGLE) * np.linspace(-0.5, 0.5, n + 1)
    points = RADIUS * np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)
    arch = scene.add_rod(points, section=ddg.Stiffness(EA=EA, EI1=EI, radius=1.0), name="arch")
    scene.clamp_end(arch, "first")
    scene.fix(arch, [-1])
    scene.add_force(arch, n // 2, (0.0, 0.0, -LOAD))
    watch = {"drop": ddg.Displacement.of(n // 2, "z", -1.0), "shift": ddg.Displacement.of(n // 2, "x")}
    scene.analysis = ddg.PathAnalysis(watch, ddg.StopCriterion(limit_points=1), step=0.03, max_step=0.15)
    return scene


def check(result) -> list[ddg.Check]:
    """Check the limit load and the crown there, within the discretisation error."""
    limit = next(iter(result.path.limit_points), None)
    if limit is None:
        return [ddg.Check("critical load [N]", np.nan, CRITICAL, 0.0, SOURCE)]  # the path ended before it
    tolerance = min(ddg.Check.COARSEST, 2e-3 * max(1.0, (240.0 / (result.model.curves.counts[0] - 1)) ** 2))
    return [
        ddg.Check("critical load [N]", LOAD * limit.load, CRITICAL, tolerance, SOURCE, relative=True),
        ddg.Check("drop of the crown [m]", limit.values["drop"], DROP, tolerance, SOURCE, relative=True),
        ddg.Check("shift of the crown [m]", limit.values["shift"], SHIFT, tolerance, SOURCE, relative=True),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the critical load over the edges of the arch."""
    return ddg.bench.Study({"n": (60, 120, 240, 480)}, "critical load")

"""Slit annulus: one lip of a cut ring is clamped and the other lifted, by 580 times the thickness.

Case 3.3 of Sze, Liu and Lo (2004). The sheet bends with hardly any stretch, which is where facets of constant strain lock.

The remaining stretch lies in layers along the free edges, of width sqrt(R h) / 1.3 = 0.3 m: nearly half of it in the innermost
twelfth of the width. Even cells a metre wide do not resolve them.

Measured: at 60 cells around the lip rises 1.3 % too little with even cells, 0.9 % with graded ones.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _sze

INNER, OUTER, THICKNESS = 6.0, 10.0, 0.03  # m
YOUNG = 21.0e6  # Pa
FORCE = 0.8  # N/m
GRADING = 0.6  # cells at the free edges are 0.4 times as wide as in the mean, middle ones 1.6 times
# Load factor -> vertical displacement of the inner and the outer corner of the loaded lip [m].
TABLE = {
    0.1: (4.277, 5.876),
    0.25: (7.602, 10.288),
    0.5: (10.468, 13.768),
    0.75: (12.31, 15.842),
    1.0: (13.891, 17.528),
}


def build(
    radial: int = 6, around: int = 60, pattern: str = "crossed", membrane: str = "curved", steps: int = 20
) -> ddg.Scene:
    """Build the annulus in the plane of x and y, its slit along x.

    Args:
        radial: cells along the radius, narrower at the free edges
        around: cells around
        pattern: how cells become triangles: right, alternating, crossed or jittered
        membrane: flat or curved, see Scene.add_shell
        steps: load steps
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=steps))
    flat, triangles = _sze.sheet(around, radial, (np.pi * (INNER + OUTER), OUTER - INNER), pattern)
    across = flat[:, 1] - GRADING * np.sin(2.0 * np.pi * flat[:, 1]) / (2.0 * np.pi)
    angle, radius = 2.0 * np.pi * flat[:, 0], INNER + (OUTER - INNER) * across
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle], axis=1)
    material = ddg.Material(density=1.0, young=YOUNG, poisson=0.0)
    # Triangles of (angle, radius) have the opposite orientation in the plane.
    ring = scene.add_shell(points, triangles[:, ::-1], thickness=THICKNESS, material=material, membrane=membrane)
    scene.clamp_boundary(ring, _sze.side(flat, 0, 0.0))
    scene.add_edge_force(ring, _sze.side(flat, 0, 1.0), (0.0, 0.0, FORCE))
    return scene


def observe(model, state) -> dict[str, float]:
    """Return vertical displacements of the corners of the loaded lip [m]."""
    inner, outer = model.scene.shell_loads[0].vertices[[0, -1]]
    return {"inner": _sze.displacement(model, state, inner, 2), "outer": _sze.displacement(model, state, outer, 2)}


def check(result) -> list[ddg.Check]:
    """Check displacements of the lip against the table, to 1.2 % at 60 cells around."""
    names = {"inner": "inner corner [m]", "outer": "outer corner [m]"}
    return _sze.table_checks(result, TABLE, names, 0.012)


def benchmark() -> ddg.bench.Study:
    """Study the outer corner over meshes and membranes; the published one is of a finite mesh, too."""
    return ddg.bench.Study(
        {"radial": (3, 6), "around": (30, 60), "membrane": ("flat", "curved")},
        "outer corner [m] at 1 P",
        series=("membrane",),
    )

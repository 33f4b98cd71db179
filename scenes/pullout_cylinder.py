"""Pullout of a cylinder: two forces pull an open cylinder apart until membrane stress carries the load.

Case 3.5 of Sze, Liu and Lo (2004): bending first, then, past half of the load, a jump of stiffness as the wall straightens.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _sze

RADIUS, LENGTH, THICKNESS = 4.953, 10.35, 0.094  # m
YOUNG, POISSON = 10.5e6, 0.3125  # Pa, 1
FORCE = 40.0e3  # N
# Load factor -> radial displacement under the force [m].
TABLE = {0.1: (1.707,), 0.25: (2.18,), 0.4: (2.376,), 0.75: (2.692,), 1.0: (2.768,)}


def build(n: int = 16, pattern: str = "crossed", membrane: str = "curved", steps: int = 20) -> ddg.Scene:
    """Build an eighth of the cylinder about z, pulled along x.

    Args:
        n: cells around a quarter and along half of the cylinder
        pattern: how cells become triangles: right, alternating, crossed or jittered
        membrane: flat or curved, see Scene.add_shell
        steps: load steps
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=steps))
    flat, triangles = _sze.sheet(n, n, (1.5 * RADIUS, 0.5 * LENGTH), pattern)
    shell = {"thickness": THICKNESS, "material": ddg.Material(density=1.0, young=YOUNG, poisson=POISSON)}
    cylinder = _sze.add_octant(scene, flat, triangles, RADIUS, 0.5 * LENGTH, membrane=membrane, **shell)
    scene.add_vertex_force(cylinder, [0], (0.25 * FORCE, 0.0, 0.0))
    return scene


def observe(model, state) -> dict[str, float]:
    """Return the radial displacement under the force [m]."""
    return {"radial": _sze.displacement(model, state, 0, 0)}


def check(result) -> list[ddg.Check]:
    """Check the displacement under the force against the table, to 1 % at 16 cells."""
    return _sze.table_checks(result, TABLE, {"radial": "radial displacement [m]"}, 0.01)


def picture(result, frames) -> dict:
    """Draw the whole cylinder before and under the load, and the displacement under the force against the table."""
    force = 1e-3 * FORCE
    return _sze.octants(
        result,
        frames,
        {
            "lines": [
                ("under the force", result.series["radial"], force * np.array(result.times), "-"),
                ("Sze, Liu and Lo", [values[0] for values in TABLE.values()], force * np.array(list(TABLE)), "o"),
            ],
            "x": "radial displacement [m]",
            "y": "force [kN]",
        },
    )


def benchmark() -> ddg.bench.Study:
    """Study the largest displacement over meshes and membranes."""
    return ddg.bench.Study(
        {"n": (8, 16), "membrane": ("flat", "curved")}, "radial displacement [m] at 1 P", series=("membrane",)
    )

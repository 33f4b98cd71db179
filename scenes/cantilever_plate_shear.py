"""Cantilever plate: an end force bends a plate by nearly a right angle.

Case 3.1 of Sze, Liu and Lo (2004), a plate without Poisson's effect, is an elastica with an exact tip (see the scene tip_load).
The published tables of Abaqus S4R differ from it by up to 0.1 %.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.scenes import _sze, tip_load

LENGTH, WIDTH, THICKNESS = 10.0, 1.0, 0.1  # m
YOUNG = 1.2e6  # Pa; so that EI = 100 N m^2
FORCE = 4.0  # N, P L^2 / EI = 4
SOURCE = "elastica, elliptic integrals"


def build(n: int = 32, pattern: str = "crossed", membrane: str = "curved", steps: int = 10) -> ddg.Scene:
    """Build the plate along x, loaded upwards.

    Args:
        n: cells along the plate; an eighth of it across
        pattern: how cells become triangles: right, alternating, crossed or jittered
        membrane: flat or curved, see Scene.add_shell
        steps: load steps
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=steps))
    flat, triangles = _sze.sheet(n, max(1, n // 8), (LENGTH, WIDTH), pattern)
    points = np.column_stack([flat * [LENGTH, WIDTH], np.zeros(len(flat))])
    material = ddg.Material(density=1.0, young=YOUNG, poisson=0.0)
    plate = scene.add_shell(points, triangles, thickness=THICKNESS, material=material, membrane=membrane)
    scene.clamp_boundary(plate, _sze.side(flat, 0, 0.0))
    scene.add_edge_force(plate, _sze.side(flat, 0, 1.0), (0.0, 0.0, FORCE / WIDTH))
    return scene


def observe(model, state) -> dict[str, float]:
    """Return the mean displacement of the loaded end inwards and along the force [m]."""
    tip = model.scene.shell_loads[0].vertices
    moved = (state.points() - model.scene.shells[0].points)[tip].mean(axis=0)
    return {"inwards": -moved[0], "along": moved[2]}


def exact(load: float) -> tuple[float, float]:
    """Return the displacement of the end inwards and along the force [m] at a fraction of the load."""
    x, z, _ = tip_load.exact(load * FORCE * LENGTH**2 / (YOUNG * WIDTH * THICKNESS**3 / 12.0))
    return LENGTH * (1.0 - x), -LENGTH * z


def check(result) -> list[ddg.Check]:
    """Check displacements at half and full load, to 0.3 % of the length at 32 cells."""
    cells = len(np.unique(result.scene.shells[0].points[:, 0].round(9)))
    tolerance = LENGTH * min(ddg.Check.COARSEST, 0.003 * max(1.0, (64.0 / cells) ** 2))
    return [
        ddg.Check(f"displacement {name} at {load:g} P [m]", result.at(load, name), reference, tolerance, SOURCE)
        if result.reached(load)
        else ddg.Check.skip(f"displacement {name} at {load:g} P [m]", "needs a load step there")
        for load in (0.5, 1.0)
        for name, reference in zip(("inwards", "along"), exact(load), strict=True)
    ]


def benchmark() -> ddg.bench.Study:
    """Study the largest deflection over meshes and membranes."""
    return ddg.bench.Study(
        {"n": (8, 16, 32), "membrane": ("flat", "curved")}, "displacement inwards at 1 P", series=("membrane",)
    )

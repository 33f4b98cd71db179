"""Plate buckling: in-plane critical load of a square plate, compressed along one or two axes or sheared.

Kirchhoff's plate under a uniform stress, N = k pi^2 D / b^2. Supported edges: k = 4 and 2 under uniaxial and biaxial compression
(Bryan 1891); shear, and all with clamped edges, by a Legendre-Ritz method (classical values 9.34, 10.07 and 14.71). Dead edge
forces load the plate. The critical factor makes K(0) + factor (K(load) - K(0)) singular, with the exact tangents K of the free and
the loaded plate.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.postprocess.mode_shape import buckled_points
from ddg_warp.scenes.plate_square import SIDE, plate_mesh

THICKNESS = 1e-3  # m
POISSON = 0.3
STIFFNESS = 1.0  # D [N m]
LOADED = 0.1  # load of the run over the critical one
SOURCE = "Kirchhoff plate, Legendre-Ritz; Bryan 1891, Timoshenko and Gere 1961"
STRESSES = {
    "uniaxial": (-1.0, 0.0, 0.0),
    "biaxial": (-1.0, 0.0, -1.0),
    "shear": (0.0, 1.0, 0.0),
}  # N11, N12, N22 over N
FACTORS = {
    ("supported", "uniaxial"): 4.0,
    ("supported", "biaxial"): 2.0,
    ("supported", "shear"): 9.3245203,
    ("clamped", "uniaxial"): 10.07394803,
    ("clamped", "shear"): 14.64201084,
}


def build(
    edges: str = "supported",
    load: str = "uniaxial",
    cells: int = 24,
    mesh: str = "crossed",
    bending: str = "midedge_dof",
) -> ddg.Scene:
    """Build the plate in the plane of x and y at a tenth of the critical load, with edges free in this plane.

    Args:
        edges: supported (free to rotate) or clamped
        load: uniaxial, biaxial (supported edges only) or shear
        cells: cells a side
        mesh: crossed, alternating, right, equilateral or jittered
        bending: midedge_dof, which converges to the plate; midedge and hinge do not on every mesh
    """
    if (edges, load) not in FACTORS:
        raise ValueError(f"edges = {edges!r}, load = {load!r}: one of {', '.join(map(str, FACTORS))}")
    points, triangles = plate_mesh(mesh, cells)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    young = 12.0 * (1.0 - POISSON**2) * STIFFNESS / THICKNESS**3
    plate = scene.add_shell(
        points, triangles, thickness=THICKNESS, material=ddg.Material(young, POISSON), bending=bending, name="plate"
    )
    rim = np.flatnonzero((np.minimum(points, SIDE - points)[:, :2] < 1e-9 * SIDE).any(axis=1))
    if edges == "clamped":
        scene.clamp_boundary(plate, rim, "z")
    else:
        scene.hold(plate, rim, "z")
    corners = [
        int(np.argmin(np.linalg.norm(points - corner, axis=1))) for corner in np.eye(3)[[2, 0]] * [SIDE, SIDE, 0.0]
    ]
    scene.hold(plate, corners[:1], "xy")
    scene.hold(plate, corners[1:], "y")
    n11, n12, n22 = LOADED * FACTORS[edges, load] * np.pi**2 * STIFFNESS / SIDE**2 * np.array(STRESSES[load])
    for axis, coordinate, force in (
        (0, 0.0, (-n11, -n12)),
        (0, SIDE, (n11, n12)),
        (1, 0.0, (-n12, -n22)),
        (1, SIDE, (n12, n22)),
    ):
        path = np.flatnonzero(np.abs(points[:, axis] - coordinate) < 1e-9 * SIDE)
        scene.add_edge_force(plate, path[np.argsort(points[path, 1 - axis])], (*force, 0.0))
    return scene


def critical_load(model, state) -> float:
    """Return the critical load over the exact one, from the tangents of the free and the loaded plate."""
    from ddg_warp.solve.equilibrium import stability

    return LOADED * stability.buckling(model, model.state(), state)[0]


def check(result) -> list[ddg.Check]:
    """Check the critical load against the closed form, within the second-order discretisation error."""
    cells = np.sqrt(0.25 * len(result.model.scene.shells[0].triangles))  # of four triangles
    measured = critical_load(result.model, result.state)
    return [
        ddg.Check(
            "critical load over exact", measured, 1.0, min(ddg.Check.COARSEST, 20.0 / cells**2), SOURCE, relative=True
        )
    ]


def benchmark() -> ddg.bench.Study:
    """Study the critical load over meshes and bending models."""
    return ddg.bench.Study(
        {"cells": (6, 12, 24, 48), "bending": ("midedge_dof", "midedge_boundary", "hinge")},
        "critical load",
        series=("bending",),
    )


def picture(result, frames) -> dict:
    """Draw the buckling mode of the plate, as shape and color."""
    flat = result.state.points()
    size = 0.15 * np.ptp(flat[:, 1])
    shown = buckled_points(result.model, result.state, size)
    return {"points_by_time": {1.0: shown}, "values": shown[:, 2] / size, "label": "deflection over its largest"}

"""Square plate: the deflection of its centre under pressure or a central force, edges supported or clamped.

Kirchhoff's plate, D lap lap w = p with D = E h^3 / (12 (1 - nu^2)). Coefficients of w D / (p a^4) and w D / (P a^2) by a
Legendre-Ritz method, the supported ones also by Navier's series; Timoshenko and Woinowsky-Krieger (1959) print 0.00406, 0.00126,
0.01160 and 0.00560.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes

SIDE = 1.0  # m
THICKNESS = 0.01  # m
POISSON = 0.3
STIFFNESS = 1.0  # D [N m]
DEFLECTION = 1e-3 * THICKNESS  # of the centre [m], small enough to leave the membrane unstressed
SOURCE = "Kirchhoff plate, Legendre-Ritz; Timoshenko and Woinowsky-Krieger 1959"
COEFFICIENTS = {
    ("supported", "pressure"): 0.004062352661,
    ("clamped", "pressure"): 0.001265319087,
    ("supported", "force"): 0.01160083936,
    ("clamped", "force"): 0.005611970251,
}


def build(
    edges: str = "clamped", load: str = "pressure", cells: int = 32, mesh: str = "crossed", bending: str = "midedge_dof"
) -> ddg.Scene:
    """Build the plate in the plane of x and y, loaded along -z.

    Args:
        edges: supported (free to rotate) or clamped
        load: pressure on all of it, or force at its centre
        cells: cells a side, an even number
        mesh: crossed, alternating, right, equilateral or jittered
        bending: midedge_dof, which converges to the plate; midedge and hinge do not on every mesh
    """
    if (edges, load) not in COEFFICIENTS:
        raise ValueError(f"edges = {edges!r}, load = {load!r}: supported or clamped, pressure or force")
    points, triangles = plate_mesh(mesh, cells)
    off = float(np.linalg.norm(points[centre(points), :2] - 0.5 * SIDE))
    if cells % 2 or (mesh != "jittered" and off > 1e-9 * SIDE):
        raise ValueError(
            f"cells = {cells}, mesh = {mesh!r}: no vertex is at the centre, where the plate is loaded and measured; take an even "
            "number, of equilateral cells one with a row of vertices half way up, such as 8 or 32"
        )
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    young = 12.0 * (1.0 - POISSON**2) * STIFFNESS / THICKNESS**3
    plate = scene.add_shell(
        points, triangles, thickness=THICKNESS, material=ddg.Material(young, POISSON), bending=bending, name="plate"
    )
    rim = np.flatnonzero((np.minimum(points, SIDE - points)[:, :2] < 1e-9 * SIDE).any(axis=1))
    if edges == "clamped":
        scene.clamp_boundary(plate, rim)
    else:
        scene.hold(plate, rim)
    size = DEFLECTION * STIFFNESS / COEFFICIENTS[edges, load]
    if load == "pressure":
        scene.add_pressure(plate, -size / SIDE**4, dead=True)
    else:
        scene.add_vertex_force(plate, [centre(points)], (0.0, 0.0, -size / SIDE**2))
    return scene


def plate_mesh(mesh: str, cells: int) -> meshes.Mesh:
    """Return points and triangles of the square."""
    if mesh == "jittered":
        return meshes.jittered_rectangle(cells, cells, (SIDE, SIDE), jitter=0.25)
    return meshes.rectangle(cells, cells, (SIDE, SIDE), mesh)


def centre(points: np.ndarray) -> int:
    """Return the vertex nearest to the centre."""
    return int(np.argmin(np.linalg.norm(points[:, :2] - 0.5 * SIDE, axis=1)))


def deflection(state) -> float:
    """Return the deflection of the centre over the closed form."""
    points = state.points()
    return -points[centre(points), 2] / DEFLECTION


def check(result) -> list[ddg.Check]:
    """Check the deflection against the closed form, of second order, for the force up to a logarithm."""
    scene = result.model.scene
    cells = np.sqrt(0.25 * len(scene.shells[0].triangles))  # of four triangles
    tolerance = min(ddg.Check.COARSEST, (25.0 if scene.shell_loads else 12.0) / cells**2)
    return [ddg.Check("deflection over exact", deflection(result.state), 1.0, tolerance, SOURCE, relative=True)]


def benchmark() -> ddg.bench.Study:
    """Study the deflection over meshes and bending models."""
    return ddg.bench.Study(
        {"cells": (8, 16, 32, 64), "bending": ("midedge_dof", "midedge_boundary", "hinge")},
        "deflection",
        series=("bending",),
    )


def picture(result, frames) -> dict:
    """Draw the magnified deflection, and as color."""
    points = result.state.points()
    deflection = points[:, 2]
    shown = points * [1.0, 1.0, 0.15 * SIDE / np.abs(deflection).max()]
    return {"points_by_time": {1.0: shown}, "values": 1e6 * deflection, "label": "deflection [µm], height not to scale"}

"""Bilayer: a strip of two bonded layers with different free lengths curls.

The layers grow by different amounts in all directions of the plane, so that the stress-free shape is a piece of a sphere of
curvature kappa (Timoshenko, J. Opt. Soc. Am. 11, 1925). A narrow strip bends along its length by kappa; a wide one cannot without
stretching, and rolls up with (1 + nu) kappa. In between the curvature k minimises, per length and D W / 2,

    (1 - nu^2) (k - kappa)^2 + ((1 + nu) kappa - nu k)^2 (1 - phi) ,
    phi = (cosh 2b - cos 2b) / (b (sinh 2b + sin 2b)) ,  b = (W / 2) (E h k^2 / 4 D)^(1/4) .

Its cross-section bends like a beam on the elastic foundation of the strip's hoop stiffness (Ashwell, J. R. Aeronaut. Soc. 54,
1950).
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.model.rest_shapes import bilayer_curvature, grown_metric, principal_form
from ddg_warp.scenes import _pictures

LENGTH = 1.0  # m
THICKNESS = 0.004  # m, of both layers together
YOUNG = 1.0e9  # Pa
POISSON = 0.3
SOURCE = "Timoshenko 1925 and Ashwell 1950"


def build(mismatch: float = 4e-3, width: float = 0.1, cells: int = 8, mesh: str = "crossed") -> ddg.Scene:
    """Build the strip along x, drawn with the curvature of a narrow strip, and released.

    Args:
        mismatch: difference of the free strains of two otherwise equal layers
        width: width of the strip [m]
        cells: cells over the width, an even number; they are about square
        mesh: right, crossed, alternating, equilateral or jittered
    """
    if cells < 2 or cells % 2:
        raise ValueError(f"cells = {cells}; it is an even number, 2 at least: the strip is clamped on its middle line")
    kappa = bilayer_curvature(mismatch, 0.5 * THICKNESS, 0.5 * THICKNESS)
    along = 2 * max(1, round(0.5 * cells * LENGTH / width))
    size = (LENGTH, width)
    flat, triangles = (
        meshes.jittered_rectangle(along, cells, size, jitter=0.2)
        if mesh == "jittered"
        else meshes.rectangle(along, cells, size, mesh)
    )
    flat = flat - [0.5 * LENGTH, 0.5 * width, 0.0]
    rest = grown_metric(flat, triangles, 1.0), principal_form(flat, triangles, kappa, kappa)
    angle = kappa * flat[:, 0]
    points = np.stack([np.sin(angle) / kappa, flat[:, 1], (1.0 - np.cos(angle)) / kappa], -1)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    strip = scene.add_shell(
        points, triangles, thickness=THICKNESS, material=ddg.Material(YOUNG, POISSON), rest=rest, name="strip"
    )
    # Six fixed components suppress rigid-body modes without strain.
    for place, components in (((0.0, 0.0), "xyz"), ((0.25 * LENGTH, 0.0), "yz"), ((0.0, 0.5 * width), "z")):
        scene.hold(strip, [int(np.argmin(np.hypot(*(flat[:, :2] - place).T)))], components)
    return scene


def exact(mismatch: float, width: float) -> float:
    """Return the curvature along the strip [1/m]."""
    from scipy.optimize import minimize_scalar

    kappa = bilayer_curvature(mismatch, 0.5 * THICKNESS, 0.5 * THICKNESS)

    def energy(k):
        b = 0.5 * width * (3.0 * (1.0 - POISSON**2) * (k / THICKNESS) ** 2) ** 0.25
        phi = (np.cosh(2.0 * b) - np.cos(2.0 * b)) / (b * (np.sinh(2.0 * b) + np.sin(2.0 * b)))
        return (1.0 - POISSON**2) * (k / kappa - 1.0) ** 2 + (1.0 + POISSON - POISSON * k / kappa) ** 2 * (1.0 - phi)

    bounds = (0.9 * kappa, 1.1 * (1.0 + POISSON) * kappa)
    return minimize_scalar(energy, bounds=bounds, method="bounded", options={"xatol": 1e-10 * kappa}).x


def rest_curvature(model) -> float:
    """Return kappa [1/m] from the rest forms of the strip."""
    metric, second = model.scene.shells[0].rest
    return float(second[0, 0] / metric[0, 0])


def curvature(model, state) -> float:
    """Return the mean curvature [1/m] of the middle half: rotation between cross-sections over their distance."""
    drawn, points, kappa = model.scene.shells[0].points, state.points(), rest_curvature(model)
    along = np.arctan2(kappa * drawn[:, 0], 1.0 - kappa * drawn[:, 2]) / kappa
    across = drawn[:, 1]
    tangents, positions = [], []
    for side in (-0.25, 0.25):
        near = np.abs(along - side * LENGTH) < 0.05 * LENGTH
        near &= np.abs(across) < 0.25 * np.ptp(across) + 1e-9
        plane = np.column_stack([np.ones(near.sum()), along[near], across[near]])
        slope = np.linalg.lstsq(plane, points[near], rcond=None)[0][1]
        tangents.append(slope / np.linalg.norm(slope))
        positions.append(along[near].mean())
    return float(np.arccos(np.clip(tangents[0] @ tangents[1], -1.0, 1.0)) / (positions[1] - positions[0]))


def check(result) -> list[ddg.Check]:
    """Check the curvature against Ashwell's strip, within effects of free ends and cell size."""
    kappa, drawn = rest_curvature(result.model), result.model.scene.shells[0].points
    width = np.ptp(drawn[:, 1])
    cells = np.sqrt(0.5 * len(result.model.scene.shells[0].triangles) * width / LENGTH)
    reference = exact(kappa * THICKNESS / 1.5, width)
    measured = curvature(result.model, result.state)
    return [
        ddg.Check(
            "curvature [1/m]",
            measured,
            reference,
            min(ddg.Check.COARSEST, 0.01 + 1.0 / cells**2),
            SOURCE,
            relative=True,
        )
    ]


def picture(result, frames) -> dict:
    """Draw the flat strip and the curled one, colored by its elastic energy."""
    drawn, kappa = result.model.scene.shells[0].points, rest_curvature(result.model)
    along = np.arctan2(kappa * drawn[:, 0], 1.0 - kappa * drawn[:, 2]) / kappa
    flat = np.stack([along, drawn[:, 1], 0.0 * along], -1)
    return {
        "points_by_time": [(0.0, flat), (1.0, result.state.points())],
        "values": _pictures.at_points(result.model, result.state, "shell_energy"),
        "label": "elastic energy per area [J/m²]",
        "note": "grey: flat, before growth",
        "fixed": None,
    }


def benchmark() -> ddg.bench.Study:
    """Study the curvature over meshes; the reference is a wide plate, unlike the narrow strip."""
    return ddg.bench.Study({"cells": (4, 8, 16), "mesh": ("right", "crossed")}, "curvature", series=("mesh",))

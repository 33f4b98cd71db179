"""Growing strip: two bonded layers of a flat strip grow apart, and it rolls up by more than a revolution in one static solve.

The growth is a field over the load parameter: the curvature at rest rises from zero to kappa in all directions of the plane
(Timoshenko 1925). The strip bends along its length by the curvature of Ashwell's theory, see `bilayer_strip`.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.model.rest_shapes import bilayer_curvature, principal_form
from ddg_warp.scenes import bilayer_strip
from ddg_warp.scenes.bilayer_strip import LENGTH, POISSON, THICKNESS, YOUNG


def build(mismatch: float = 0.018, width: float = 0.1, cells: int = 4, load_steps: int = 8) -> ddg.Scene:
    """Build the flat strip along x, clamped on the line x = 0.

    Args:
        mismatch: difference of the free strains of two otherwise equal layers at the end
        width: width of the strip [m]
        cells: cells over the width; they are about square
        load_steps: increments of the growth
    """
    along = max(1, round(cells * LENGTH / width))
    flat, triangles = meshes.rectangle(along, cells, (LENGTH, width), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=load_steps))
    material = ddg.Material(YOUNG, POISSON)
    strip = scene.add_shell(flat, triangles, thickness=THICKNESS, material=material, name="strip")
    scene.clamp_boundary(strip, np.flatnonzero(flat[:, 0] < 1e-9))
    kappa = bilayer_curvature(mismatch, 0.5 * THICKNESS, 0.5 * THICKNESS)
    grown = principal_form(flat, triangles, kappa, kappa)
    scene.prescribe("growth", "curvature", lambda factor: factor * grown, shell=strip)
    return scene


def rotation(model, state) -> tuple[np.ndarray, np.ndarray]:
    """Return positions along the middle of the strip [m], and rotations of its edges there [rad]."""
    flat = model.scene.shells[0].points
    across = np.abs(flat[:, 1] - 0.5 * np.ptp(flat[:, 1]))
    line = np.flatnonzero(across < across.min() + 1e-9)
    line = line[np.argsort(flat[line, 0])]
    edges = np.diff(state.points()[line], axis=0)
    angle = np.unwrap(np.arctan2(edges[:, 2], edges[:, 0]))
    return 0.5 * (flat[line[1:], 0] + flat[line[:-1], 0]), angle


def observe(model, state) -> dict[str, float]:
    """Return the revolutions of the end of the strip."""
    return {"revolutions": float(np.abs(np.ptp(rotation(model, state)[1])) / (2.0 * np.pi))}


def check(result) -> list[ddg.Check]:
    """Check the curvature of the middle half against Ashwell's strip, within effects of ends and cell size."""
    shell = result.model.scene.shells[0]
    position, angle = rotation(result.model, result.state)
    middle = np.abs(position - 0.5 * LENGTH) < 0.25 * LENGTH
    measured = abs(np.polyfit(position[middle], angle[middle], 1)[0])
    first = shell.points[shell.triangles[0]]
    kappa = result.model.fields.items["growth"].at(1.0)[0, 0] / ((first[1] - first[0]) ** 2).sum()
    width = np.ptp(shell.points[:, 1])
    reference = bilayer_strip.exact(kappa * THICKNESS / 1.5, width)
    cells = np.sqrt(0.5 * len(shell.triangles) * width / LENGTH)
    tolerance = min(ddg.Check.COARSEST, 0.01 + 1.0 / cells**2)
    return [ddg.Check("curvature [1/m]", measured, reference, tolerance, bilayer_strip.SOURCE, relative=True)]


def benchmark() -> ddg.bench.Study:
    """Study the curvature over meshes."""
    return ddg.bench.Study({"cells": (2, 4, 8)}, "curvature")

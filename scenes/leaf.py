"""Leaf: a strip with a grown edge ripples.

The strip is clamped along its root and has grown along it by growth (y / W)^2 at the distance y. Flat, it would be compressed. It
buckles and approaches its grown metric, the better the thinner it is (Sharon, Roman, Marder, Shin, Swinney, Nature
419, 2002; Efrati, Sharon, Kupferman, J. Mech. Phys. Solids 57, 2009): the remaining energy is bending.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.model.rest_shapes import grown_metric

LENGTH, WIDTH = 1.0, 0.25  # m
YOUNG = 1.0e6  # Pa
POISSON = 0.3
SOURCE = "energy and length of the grown metric"


def build(growth: float = 0.2, thickness: float = 0.005, waves: int = 4, cells: int = 40) -> ddg.Scene:
    """Build the strip in the plane of x and y with ripples of the grown length, released between symmetry planes.

    Args:
        growth: strain of the free edge
        thickness: thickness of the strip [m]
        waves: half waves of the initial ripples; it may change their number
        cells: cells along the strip
    """
    flat, triangles = mesh(cells)
    # The clamp fixes the normals of the drawn triangles; the first row is flat.
    first = np.min(flat[flat[:, 1] > 1e-9, 1])
    lift = np.clip((flat[:, 1] - first) / (WIDTH - first), 0.0, None) ** 2
    points = flat.copy()
    points[:, 2] = 2.0 * np.sqrt(growth) * lift * LENGTH / (np.pi * waves) * np.cos(np.pi * waves * flat[:, 0] / LENGTH)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    strip = scene.add_shell(
        points,
        triangles,
        thickness=thickness,
        material=ddg.Material(YOUNG, POISSON),
        rest=(grown(growth, cells), np.zeros((len(triangles), 3))),
        name="leaf",
    )
    scene.clamp_boundary(strip, np.flatnonzero(flat[:, 1] < 1e-9))
    for end in (0.0, LENGTH):
        scene.symmetry(strip, np.flatnonzero(np.abs(flat[:, 0] - end) < 1e-9), "x")
    return scene


def mesh(cells: int) -> meshes.Mesh:
    """Return points and triangles of the flat strip."""
    return meshes.rectangle(cells, max(2, round(cells * WIDTH / LENGTH)), (LENGTH, WIDTH), "alternating")


def grown(growth: float, cells: int) -> np.ndarray:
    """Return the rest metric (T, 3) [m^2]."""
    flat, triangles = mesh(cells)
    return grown_metric(flat, triangles, 1.0 + growth * (flat[triangles].mean(1)[:, 1] / WIDTH) ** 2, 1.0)


def edge(state) -> np.ndarray:
    """Return points of the free edge, in order (., 3) [m]."""
    drawn = state.model.scene.shells[0].points
    return state.points()[drawn[:, 1] > WIDTH - 1e-9]


def strains(state) -> tuple[float, float]:
    """Return the strain of the free edge against the initial length: actual, and in the rest metric."""
    shell = state.model.coupled.host.shells[0]
    sides = np.flatnonzero((shell.surface.points[shell.surface.edges, 1] > WIDTH - 1e-9).all(1))
    triangle, corner = np.nonzero(np.isin(shell.surface.triangle_edges, sides))
    rest = np.sqrt(shell.plate.lengths_squared[triangle, corner]).sum()
    length = np.linalg.norm(np.diff(edge(state), axis=0), axis=1).sum()
    return float(length / LENGTH - 1.0), float(rest / LENGTH - 1.0)


def flat_state(model):
    """Return the flat state of the strip."""
    return model.state(points=model.scene.shells[0].points * [1.0, 1.0, 0.0])


def check(result) -> list[ddg.Check]:
    """Check energy below a tenth of the flat state, and the strain of the free edge to a tenth."""
    model = result.model
    energies = [sum(model.energies(state).values()) for state in (result.state, flat_state(model))]
    strain, rest = strains(result.state)
    return [
        ddg.Check("energy over that of the flat state", energies[0] / energies[1], 0.0, 0.1, SOURCE),
        ddg.Check("strain of the free edge", strain, rest, 0.1, SOURCE, relative=True),
    ]


def benchmark() -> ddg.bench.Study:
    """Study the strain of the free edge over meshes; its limit is a thinner leaf."""
    return ddg.bench.Study({"cells": (10, 20, 40)}, "strain of the free edge")

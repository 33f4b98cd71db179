"""Hanging sheet: a square of rubber, fixed at two corners, falls from flat and hangs; from 16 to 1024 cells a side.

A sheet this thin carries its weight by tension from the two corners, in folds. Implicit Euler only loses energy. At rest the
corners carry half the weight each, and the lowest vertex agrees with a finer mesh.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.postprocess.quantities import energies
from ddg_warp.run.check import once_reached

SIDE = 1.0  # m
THICKNESS = 1e-3  # m
MATERIAL = ddg.Material(young=1.0e6, poisson=0.3, density=1000.0, viscosity=0.02)
GRAVITY = 9.81  # m/s^2
BALANCE = "balance of forces at rest"
LOWEST = -1.0214
HANGS = 3.0  # s, time at which the sheet is at rest


def build(
    cells: int = 16, duration: float = 3.0, dt: float = 1.0 / 60.0, damping: float = 4.0, bending: str = "midedge_dof"
) -> ddg.Scene:
    """Build a square sheet, fixed at two neighbouring corners.

    Args:
        cells: cells along a side, two triangles each
        duration: end of the run [s]
        dt: time step [s]
        damping: mass-proportional damping [1/s]
        bending: midedge_dof or hinge
    """
    points, triangles = meshes.rectangle(cells, cells, (SIDE, SIDE), "alternating")
    scene = ddg.Scene(
        gravity=(0.0, 0.0, -GRAVITY), mass_damping=damping, analysis=ddg.Dynamics(dt=dt, duration=duration)
    )
    shell = scene.add_shell(points, triangles, thickness=THICKNESS, material=MATERIAL, bending=bending, name="sheet")
    for corner in held(points):
        scene.hold(shell, [corner])
    return scene


def held(points: np.ndarray) -> list[int]:
    """Return the two corners with the smallest x."""
    left = np.flatnonzero(points[:, 0] == points[:, 0].min())
    return [int(left[np.argmin(points[left, 1])]), int(left[np.argmax(points[left, 1])])]


def observe(model, state) -> dict[str, float]:
    """Return the height of the lowest vertex [m], and total and kinetic energy [J]."""
    contributions = energies(model, state)
    lowest = float(state.points().reshape(-1, 3)[:, 2].min())
    return {"lowest": lowest, "energy": sum(contributions.values()), "kinetic": contributions["kinetic"]}


def check(result) -> list[ddg.Check]:
    """Check that energy only falls, and at rest the balance of forces and the height of the lowest vertex."""
    energy = np.array(result.series["energy"])
    gain = max(0.0, float(np.diff(energy).max())) / (energy[0] - energy[-1])
    energies = ddg.Check("largest gain of energy in a step over the whole drop", gain, 0.0, 1e-9, "implicit Euler")
    names = (
        "vertical reactions over the weight",
        "share of the first corner",
        "height of the lowest vertex over the side",
    )
    return [energies, *once_reached(result, HANGS, names, lambda: hanging(result, names))]


def hanging(result, names) -> list[ddg.Check]:
    """Return the checks of a sheet at rest."""
    model, state = result.model, result.state
    weight = MATERIAL.density * THICKNESS * SIDE**2 * GRAVITY
    first, second = (reaction.force[2] for reaction in model.reactions(state))
    lowest = result.series["lowest"][-1] / SIDE
    return [
        ddg.Check(names[0], float(first + second) / weight, 1.0, 1e-3, BALANCE),
        ddg.Check(names[1], float(first / (first + second)), 0.5, 1e-3, BALANCE),
        ddg.Check(names[2], lowest, LOWEST, 3e-3, "this scene with 32 cells"),
    ]


def benchmark() -> ddg.bench.Study:
    """Study free corners and the middle of the free side after 0.2 s, against the same sheet at a finer mesh and a shorter step.

    Implicit Euler is of first order in the step, the midpoint rule of second; mesh and tolerance are separate lines.
    """
    return ddg.bench.Study(
        grid={
            "dt": (1 / 60, 1 / 120, 1 / 240),
            "cells": (8, 16),
            "scheme": ("implicit_euler", "implicit_midpoint"),
            "rtol": (1e-3, 1e-8),
        },
        fixed={"duration": 0.2, "damping": 0.0},
        measure=lambda result: result.state.points()[_marks(result.model)],
        reference={"dt": 1 / 960, "cells": 32, "scheme": "implicit_midpoint", "rtol": 1e-8},
        series=("scheme", "cells", "rtol"),
        unit="m",
    )


def _marks(model) -> list[int]:
    """Return vertices at the two free corners and in the middle of the free side."""
    rest = model.state().points()
    right = np.flatnonzero(rest[:, 0] == rest[:, 0].max())
    across = rest[right, 1]
    return [int(right[np.argmin(abs(across - y))]) for y in (across.min(), across.mean(), across.max())]

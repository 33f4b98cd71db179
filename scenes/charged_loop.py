"""Charged loop: beads that repel each other open a slack loop of thread to a circle.

n equal charges at the nodes of a closed thread repel each other by the Coulomb force, a user-defined force between all pairs of nodes.
At rest they form a regular polygon of radius R, at which the tension T of the thread balances the repulsion,

    2 T sin(a) = k Q^2 / (2 n R)^2 * sum of 1 / sin(j a) over j = 1 to n - 1,  T = EA (2 R sin(a) / l - 1),  a = pi / n,

with the total charge Q and the rest length l of an edge. All angles between edges are equal, so that bending adds no radial force.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.check import once_reached

RADIUS = 0.1  # m, of the circle without charge
EA = 0.05  # N
COULOMB = 8.9875517923e9  # N m^2/C^2
ASPECT = 0.15  # of the ellipse at the start
SETTLED = 1.0  # s
SOURCE = "balance of tension and Coulomb forces of a regular polygon"


@cache
def repulsion(real):
    """Return the Coulomb force [N] between two charges."""
    V = wp.types.vector(3, real)

    @wp.func
    def force(d: V, p: Any, q: Any):
        r = wp.length(d)
        return -d * (p.coulomb * p.charge * q.charge / (r * r * r))

    return force


@cache
def energy(real):
    """Return the potential energy [J] of two charges."""
    V = wp.types.vector(3, real)

    @wp.func
    def potential(d: V, p: Any, q: Any):
        return p.coulomb * p.charge * q.charge / wp.length(d)

    return potential


def build(charge: float = 1.5e-7, n: int = 64, dt: float = 2e-3, duration: float = 1.0) -> ddg.Scene:
    """Build the loop at rest; the run starts from a flat ellipse of the same length.

    Args:
        charge: total charge [C]
        n: beads, a multiple of four
        dt: time step [s]
        duration: duration of the run [s]
    """
    if n < 8 or n % 4:
        raise ValueError(f"n = {n}; it is a multiple of four, 8 at least")
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0), mass_damping=20.0, initial=flat, analysis=ddg.Dynamics(dt=dt, duration=duration)
    )
    angle = 2.0 * np.pi * np.arange(n) / n
    points = RADIUS * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    section = ddg.Stiffness(EA=EA, EI1=1e-9, EI2=1e-9, GJ=1e-9, mass_per_length=1e-3, rotary_inertia=1e-9, radius=1e-3)
    scene.add_rod(points, section=section, closed=True, natural="straight", name="thread", curvature="angle")
    parameters = {"charge": charge / n, "coulomb": COULOMB}
    scene.add_pair_force("coulomb", repulsion, potential=energy, parameters=parameters)
    return scene


def flat(model) -> ddg.State:
    """Return the loop as an ellipse of the rest length."""
    points = model.state().points()
    n, fine = len(points), np.linspace(0.0, 2.0 * np.pi, 20_001)
    ellipse = np.stack([np.cos(fine), ASPECT * np.sin(fine)], axis=1)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ellipse, axis=0), axis=1))])
    phase = np.interp(arc[-1] * np.arange(n) / n, arc, fine)
    scale = n * np.linalg.norm(points[1] - points[0]) / arc[-1]
    return model.state(scale * np.stack([np.cos(phase), ASPECT * np.sin(phase), 0.0 * phase], axis=1))


def radius(charge: float, n: int) -> float:
    """Return the radius of the charged circle [m]."""
    a = np.pi / n
    rest, sums = 2.0 * RADIUS * np.sin(a), (1.0 / np.sin(a * np.arange(1, n))).sum()

    low, high = RADIUS, 100.0 * RADIUS
    for _ in range(100):  # bisection
        R = 0.5 * (low + high)
        tension = EA * (2.0 * R * np.sin(a) / rest - 1.0)
        inward = 2.0 * tension * np.sin(a) - COULOMB * (charge / (2.0 * n * R)) ** 2 * sums
        low, high = (low, R) if inward > 0.0 else (R, high)
    return R


def _radii(state) -> np.ndarray:
    points = state.points().reshape(-1, 3)
    return np.linalg.norm(points - points.mean(axis=0), axis=1)


def observe(model, state) -> dict[str, float]:
    """Return the mean radius [m] and the largest over the smallest radius."""
    radii = _radii(state)
    return {"radius": float(radii.mean()), "aspect": float(radii.max() / radii.min())}


def check(result) -> list[ddg.Check]:
    """Check the radius at rest against the balance of forces, and that the loop is round."""
    force, n = result.scene.user_forces[0], result.model.points_count
    exact = radius(n * float(force.parameters["charge"]), n)
    return once_reached(
        result,
        SETTLED,
        ["radius [m]", "largest over smallest radius"],
        lambda: [
            ddg.Check("radius [m]", result.series["radius"][-1], exact, 2e-3, SOURCE, relative=True),
            ddg.Check("largest over smallest radius", result.series["aspect"][-1], 1.0, 5e-3, SOURCE),
        ],
    )

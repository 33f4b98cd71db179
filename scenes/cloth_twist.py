"""Cloth twist: both ends of a cloth cylinder rotate by 360 degrees a second until folds are in contact.

The clamped ends rotate in opposite directions; the cloth between folds into self-contact. Nothing interpenetrates, by either
contact law. The couples at both ends balance except for the inertia of the cloth.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scenes import _many_rods

RADIUS, LENGTH = 0.1, 0.3  # m
THICKNESS = 1e-3  # m
MATERIAL = ddg.Material(young=1e5, poisson=0.3, density=500.0, viscosity=1e-2)
RANGE = 1e-3  # m, activation distance
RATE = 2.0 * np.pi  # rad/s, of each end


def build(
    around: int = 40,
    along: int = 20,
    turns: float = 0.5,
    dt: float = 1.0 / 200.0,
    friction: float = 0.2,
    law: str = "barrier",
    seed: int = -1,
) -> ddg.Scene:
    """Build the cylinder about the axis z.

    Args:
        around: cells around the cylinder
        along: cells along it
        turns: revolutions of each end, at the end of the run
        dt: time step [s]
        friction: Coulomb friction coefficient
        law: barrier or penalty
        seed: seed of the initial jitter of vertices, a fifth of the activation distance; no jitter below 0
    """
    points, triangles = meshes.cylinder(around, along, RADIUS, LENGTH, "alternating")
    axis = int(np.argmin(np.abs(np.ptp(points, axis=0) - LENGTH)))
    points = np.roll(points, 2 - axis, axis=1)
    duration = round(turns * 2.0 * np.pi / RATE / dt) * dt
    scene = ddg.Scene(
        gravity=(0.0, 0.0, 0.0),
        mass_damping=2.0,
        analysis=ddg.Dynamics(dt=dt, duration=duration),
        initial=lambda model: _many_rods.jittered(model, seed),
    )
    shell = scene.add_shell(points, triangles, thickness=THICKNESS, material=MATERIAL, bending="hinge", name="cloth")
    for end, sign in ((points[:, 2].min(), -1.0), (points[:, 2].max(), 1.0)):
        ring = np.flatnonzero(np.abs(points[:, 2] - end) < 1e-9)
        scene.hold(shell, ring, motion=ddg.Motion(angle=lambda t, sign=sign: sign * RATE * t))
    scene.contact(law=law, range=RANGE, **_many_rods.friction_options(friction, velocity=1e-2))
    return scene


def observe(model, state) -> dict[str, float]:
    """Return pairs in contact, least distance from the axis over the radius, and couples at both ends [N m]."""
    points = state.points()
    low, high = model.reactions(state, point=(0.0, 0.0, 0.0))
    return {
        "contacts": float(len(model.contacts(state))),
        "waist": float(np.hypot(points[:, 0], points[:, 1]).min() / RADIUS),
        "couple": float(high.moment[2]),
        "couple_low": float(low.moment[2]),
    }


def check(result) -> list[ddg.Check]:
    """Check that nothing interpenetrates, and that the couples of both ends balance."""
    couples = np.array([result.series["couple"], result.series["couple_low"]])[:, 1:]
    ratio = float(couples[0].sum() / -couples[1].sum())
    return [
        *_many_rods.checks(result),
        ddg.Check("couples of both ends, mean over the run", ratio, 1.0, 0.05, "balance of moments", True),
    ]


def picture(result, frames) -> dict:
    """Draw the cylinder before, halfway and at the end, side by side."""
    times = list(frames)
    return {
        "points_by_time": {t: frames[t] for t in (times[0], times[len(times) // 3], times[-1])},
        "side_by_side": True,
    }

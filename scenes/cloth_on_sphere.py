"""Cloth on a ball: a cloth falls over a ball onto the floor, in folds with self-contact.

The cloth, a square of rubber foil, is thin: its weight folds it within (D / rho h g)^(1/3) = 3 cm. Implicit Euler only loses energy.
At rest, ball and floor carry its weight.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _many_rods

SIDE = 1.0  # m
THICKNESS = 2e-3  # m
MATERIAL = ddg.Material(young=3e5, poisson=0.3, density=500.0, viscosity=5e-3)
RADIUS = 0.2  # m, of the ball
RANGE = 2e-3  # m, activation distance
RESTS = 1.0  # s, time at which the damped cloth is at rest
REFUSED = 20  # pairs: the straight motion of a vertex that slides around a fold cuts the fold


def build(
    cells: int = 16,
    dt: float = 1.0 / 100.0,
    duration: float = 1.0,
    friction: float = 0.3,
    damping: float = 3.0,
    law: str = "barrier",
    seed: int = -1,
) -> ddg.Scene:
    """Build the cloth a little above the ball.

    Args:
        cells: cells along a side of the cloth, of two triangles each
        dt: time step [s]
        duration: duration of the run [s]
        friction: Coulomb friction coefficient everywhere
        damping: mass-proportional damping by the air [1/s]
        law: barrier or penalty
        seed: seed of the initial jitter of vertices, a fifth of the activation distance; no jitter below 0
    """
    points, triangles = meshes.rectangle(cells, cells, (SIDE, SIDE), "alternating")
    points = points - [0.5 * SIDE, 0.5 * SIDE, 0.0]
    points[:, 2] = 2.0 * RADIUS + THICKNESS + 2.0 * RANGE
    scene = ddg.Scene(
        mass_damping=damping,
        analysis=ddg.Dynamics(dt=dt, duration=duration),
        initial=lambda model: _many_rods.jittered(model, seed),
    )
    scene.add_shell(points, triangles, thickness=THICKNESS, material=MATERIAL, bending="hinge", name="cloth")
    scene.contact(law=law, range=RANGE, **_many_rods.friction_options(friction, velocity=1e-2))
    scene.add_obstacle(ddg.Sphere((0.0, 0.0, RADIUS), RADIUS), name="ball")
    scene.add_obstacle(ddg.Plane(), name="floor")
    return scene


def observe(model, state) -> dict[str, float]:
    """Return `_many_rods.observe` with the lowest vertex and the largest speed."""
    speed = np.linalg.norm(state.velocities().reshape(-1, 3), axis=1).max()
    return _many_rods.observe(model, state) | {"lowest": state.points()[:, 2].min(), "speed": float(speed)}


def check(result) -> list[ddg.Check]:
    """Check that nothing interpenetrates, and that ball and floor carry the weight at rest, partly by friction."""
    names = ("force of obstacles less inertia over weight",)
    checks = _many_rods.checks(result, REFUSED)
    return checks + once_reached(result, RESTS, names, lambda: [_many_rods.weight_check(result, 0.1)])


def picture(result, frames) -> dict:
    """Draw the cloth before the fall, on the ball, and in folds, side by side."""
    times = list(frames)
    return {
        "points_by_time": {t: frames[t] for t in (times[0], times[len(times) // 3], times[-1])},
        "side_by_side": True,
    }

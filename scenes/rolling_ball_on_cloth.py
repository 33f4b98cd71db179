"""Rolling ball on cloth: a ball is thrown along a taut cloth, sinks into it, slides, and comes to roll.

Friction on a ball of mass m, radius R and moment of inertia I acts at its lowest point, about which its angular momentum stays. So
whatever the law of friction, a ball that is thrown with the speed v0 and no spin rolls in the end with

    v = v0 / (1 + I / (m R^2)) ,   w R = v ,

5/7 v0 for a uniform ball. The cloth under it is a spring: it takes and returns energy as the ball sinks in and bounces.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.check import once_reached
from ddg_warp.scenes import _bodies, _many_rods

LONG, WIDE = 0.6, 0.2  # m, of the cloth
THICKNESS = 1e-3  # m
CLOTH = ddg.Material(young=3e7, poisson=0.3, density=100.0, viscosity=1e-3)
RADIUS = 0.03  # m, of the ball
DENSITY = 200.0  # kg/m^3, of the ball
START, RANGE, STIFFNESS, SLIP = 0.12, 1e-3, 5e3, 5e-3  # m, m, N/m, m/s
ROLLS = 0.3  # s, after which the ball rolls at the default speed and friction
NAMES = ("speed over that of the throw", "speed of the surface over that of the ball")


def build(
    speed: float = 1.0, friction: float = 0.5, cells: int = 12, dt: float = 2e-3, duration: float = 0.4
) -> ddg.Scene:
    """Build the cloth in the plane z = 0, fixed along the edges, the ball a little above it.

    Args:
        speed: speed of the throw [m/s]
        friction: Coulomb friction coefficient
        cells: cells across the cloth, three times as many along it
        dt: time step [s]
        duration: duration of the run [s]
    """
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=dt, duration=duration))
    points, triangles = meshes.rectangle(3 * cells, cells, (LONG, WIDE), "alternating")
    cloth = scene.add_shell(points, triangles, thickness=THICKNESS, material=CLOTH, bending="hinge", name="cloth")
    x, y = points[:, 0], points[:, 1]
    edge = np.flatnonzero((x < 1e-9) | (x > LONG - 1e-9) | (y < 1e-9) | (y > WIDE - 1e-9))
    scene.hold(cloth, edge, name="frame")
    center = (START, 0.5 * WIDE, RADIUS + 0.5 * THICKNESS + RANGE)
    scene.add_body(ddg.Sphere(center, RADIUS), density=DENSITY, velocity=(speed, 0.0, 0.0), name="ball")
    scene.contact(range=RANGE, stiffness=STIFFNESS, **_many_rods.friction_options(friction, velocity=SLIP))
    return scene


def observe(model, state) -> dict[str, float]:
    """Return position and speed of the ball [m, m/s], speed of its surface relative to its centre, energy [J] and contacts."""
    ball = state.body("ball")
    return {
        "x": float(ball.position[0]),
        "z": float(ball.position[2]),
        "speed": float(ball.velocity[0]),
        "surface": float(RADIUS * ball.angular_velocity[1]),
        "energy": _bodies.energy(model, state),
        "contacts": float(len(model.contacts(state))),
    }


def check(result) -> list[ddg.Check]:
    """Check that the ball rolls with the speed of the law, and that energy is not created."""
    checks = [*_many_rods.checks(result, 10), _many_rods.energy_check(result, tolerance=0.01)]
    return checks + once_reached(result, ROLLS, NAMES, lambda: _checks(result))


def _checks(result) -> list[ddg.Check]:
    ball, last = result.scene.bodies[0], slice(-len(result.times) // 4, None)
    exact = 1.0 / (1.0 + ball.moments.mean() / (ball.mass * RADIUS**2))
    speed, surface = (np.mean(result.series[name][last]) for name in ("speed", "surface"))
    return [
        ddg.Check(NAMES[0], speed / ball.velocity[0], exact, 0.02, "angular momentum about the lowest point"),
        ddg.Check(NAMES[1], surface / speed, 1.0, 0.01, "rolling without slip"),
    ]


def picture(result, frames) -> dict:
    """Draw the ball on the cloth at three times."""
    times = sorted(frames)
    return {"points_by_time": {t: frames[t] for t in (times[0], times[2], times[-1])}, "side_by_side": True}


def benchmark() -> ddg.bench.Study:
    """Study the final speed over steps and cells."""
    return ddg.bench.Study({"dt": (4e-3, 2e-3, 1e-3), "cells": (8, 12, 16)}, NAMES[0], one_by_one=True)

"""Blades that rotate about z, as every kind of support and obstacle, and rods across the plane of rotation."""

import numpy as np

import ddg_warp as ddg
from ddg_warp.solve.collision.support_arcs import PART

FIRST, LAST, HALF = 0.05, 0.2, 1e-3  # m, of a blade along x: nearest and farthest from the axis, half its thickness
RADIUS = 1e-3  # m, of the rod
BALL = 0.02  # m, radius of a ball
DT, DAMPING = 1.0, 1e3  # s, 1/s
RANGE, THICKNESS = 0.5 * RADIUS, RADIUS + HALF
CELLS = np.array([[0, 1, 2], [0, 2, 3]])
STIFF, RIGID = ddg.Material(young=1e10, density=1000.0), ddg.Material(young=1e13, density=1000.0)


def line(first: float = FIRST) -> np.ndarray:
    return np.linspace((first, 0.0, 0.0), (LAST, 0.0, 0.0), 7)


def plate(first: float = FIRST) -> np.ndarray:
    return np.array([[first, 0, -0.1], [LAST, 0, -0.1], [LAST, 0, 0.1], [first, 0, 0.1]])


def obstacles(first: float = FIRST) -> dict:
    return {
        "mesh": ddg.Mesh(plate(first), CELLS, HALF),
        "box": ddg.Box((0.5 * (first + LAST), 0.0, 0.0), (0.5 * (LAST - first), HALF, 0.1)),
        "capsule": ddg.Capsule(tuple(line(first)[0]), tuple(line(first)[-1]), HALF),
        "half-space": ddg.Plane((first, 0.0, 0.0), (0.0, 1.0, 0.0)),
        "ball": ddg.Sphere((LAST - BALL, 0.0, 0.0), BALL),
    }


OBSTACLES = obstacles()
SUPPORTS = ("clamp", "fix", "hold")
KINDS = (*OBSTACLES, *SUPPORTS)


def scene(
    kind: str, motion, centres, search_distance: float | None = None, first: float = FIRST, **contact
) -> ddg.Scene:
    """Return a scene of a moving blade from radius `first` on and short rods along z, through `centres` (n, 2).

    Strong damping stops the rods wherever contact ends.
    """
    made = ddg.Scene(gravity=(0.0, 0.0, 0.0), mass_damping=DAMPING)
    across = np.linspace((0.0, 0.0, -0.05), (0.0, 0.0, 0.05), 11)
    for x, y in np.atleast_2d(centres):
        made.add_rod(across + [x, y, 0.0], section=ddg.Circle(RADIUS), material=STIFF, name="rod")
    section = {"section": ddg.Circle(HALF), "material": RIGID}
    if kind in OBSTACLES:
        made.add_obstacle(obstacles(first)[kind], motion=motion, name="blade")
    elif kind == "hold":
        shell = made.add_shell(plate(first), CELLS, thickness=2.0 * HALF, material=STIFF, name="blade")
        made.hold(shell, np.arange(4), motion=motion)
    else:
        blade = made.add_rod(line(first), **section, name="blade")
        if kind == "fix":
            made.fix(blade, np.arange(7), motion=motion)
        else:
            made.clamp_end(blade, "first", motion=motion)
    made.contact(stiffness=1e4, range=search_distance, **contact)
    return made


def polar_point(radius: float, angle: float) -> np.ndarray:
    return radius * np.array([np.cos(angle), np.sin(angle)])


def angles_ahead(points: np.ndarray, angle: float) -> np.ndarray:
    """Return the angles of points ahead of a blade, between -pi and pi."""
    return (np.arctan2(points[:, 1], points[:, 0]) - angle + np.pi) % (2.0 * np.pi) - np.pi


def rotation_control(turns: float) -> ddg.Controls:
    return ddg.Controls(poses=np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 2.0 * np.pi * turns]]))


def substeps_needed(angle: float, radius: float, thickness: float = THICKNESS) -> int:
    """Return 2^k >= angle / a, where the sagitta R (1 - cos(a / 2)) is `SEGMENT` of range and thickness."""
    a = 2.0 * np.arccos(1.0 - PART * min(RANGE, thickness) / radius)
    return 2 ** int(np.ceil(np.log2(angle / a)))

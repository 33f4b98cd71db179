"""Helical spring: a spring of wire stretched far from its natural height.

A helix whose ends carry a force and a moment along its axis stays a helix (Kirchhoff; Love, Mathematical Theory of Elasticity,
1927, art. 271). With curvature k and twist t, natural ones k0 and t0, and w^2 = k^2 + t^2,

    F = (C (t - t0) - B t (k - k0) / k) w ,  moment about the axis = (B (k - k0) k + C (t - t0) t) / w .

The first and last edge are fixed on the exact helix, as rigid arms from its axis would do; the wrench on the last is measured.
"""

import numpy as np

import ddg_warp as ddg
from ddg_warp.geometry import polyline

B, C = 1.0, 2.0 / 3.0  # bending and twisting stiffness [N m^2] at a Poisson's ratio of 0.5
EA = 1.0e5  # N; nearly inextensible: EA L^2 / B = 4e8
RADIUS = 1.0  # m
PITCH = np.radians(10.0)
TURNS = 10.0
WIRE = 2.0 * np.pi * TURNS * RADIUS / np.cos(PITCH)  # m, length of the wire
HEIGHT = WIRE * np.sin(PITCH)  # m
SOURCE = "uniform helix (Love 1927)"


def build(stretch: float = 2.0, turns: float = TURNS, n: int = 400, curvature: str = "tangent") -> ddg.Scene:
    """Build the spring along z.

    Args:
        stretch: height over height at rest
        turns: turns of the wire; 10 at rest
        n: edges of the wire
        curvature: curvature measure, tangent or angle
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=1))
    points, normals = wire(stretch, turns, n)
    rod = scene.add_rod(
        points,
        section=ddg.Stiffness(EA=EA, EI1=B, GJ=C, radius=0.1),
        director=normals,
        natural=natural(n, curvature == "angle"),
        curvature=curvature,
        name="spring",
    )
    scene.clamp(rod, edges=[0, -1])
    return scene


def helix(stretch: float, turns: float) -> tuple[float, float]:
    """Return radius [m] and pitch angle [rad] of the wire at a height and number of turns."""
    pitch = np.arcsin(stretch * HEIGHT / WIRE)
    return WIRE * np.cos(pitch) / (2.0 * np.pi * turns), pitch


def wire(stretch: float, turns: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (n + 1, 3) [m] on a helix with edges as long as at rest, and normals on the edges (n, 3)."""
    angle = np.linspace(0.0, 2.0 * np.pi * turns, n + 1)
    rise = np.linspace(0.0, stretch * HEIGHT, n + 1)
    square = (2.0 * RADIUS * np.sin(np.pi * TURNS / n)) ** 2 + (HEIGHT / n) ** 2  # of an edge length
    radius = np.sqrt(square - (stretch * HEIGHT / n) ** 2) / (2.0 * np.sin(np.pi * turns / n))
    middle = 0.5 * (angle[1:] + angle[:-1])
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), rise], axis=1)
    return points, -np.stack([np.cos(middle), np.sin(middle), np.zeros(n)], axis=1)


def natural(n: int, by_angle: bool = False) -> tuple[float, float, float]:
    """Return curvatures and twist of the discrete rest helix [1/m], the stress-free state."""
    points, normals = wire(1.0, TURNS, n)
    edges = polyline.edge_vectors(points[None, :3], False)
    tangents, length = polyline.unit(edges), np.linalg.norm(edges[0, 0])
    first, second = polyline.curvatures(tangents, normals[None, :2], False, by_angle)
    twist = polyline.reference_twist(tangents, normals[None, :2], False)
    return first.item() / length, second.item() / length, twist.item() / length


def strains(radius: float, pitch: float) -> tuple[float, float]:
    """Return curvature and torsion of a helix [1/m]."""
    return np.cos(pitch) ** 2 / radius, np.sin(pitch) * np.cos(pitch) / radius


def exact(stretch: float, turns: float) -> tuple[float, float]:
    """Return force [N] and moment [N m] along the axis."""
    k, t = strains(*helix(stretch, turns))
    k0, t0 = strains(RADIUS, PITCH)
    w = np.hypot(k, t)
    return (C * (t - t0) - B * t * (k - k0) / k) * w, (B * (k - k0) * k + C * (t - t0) * t) / w


def measure(model, state) -> tuple[float, float]:
    """Return force [N] and moment [N m] along the axis, from reactions on the last two nodes and the last twist angle."""
    from ddg_warp.solve.equilibrium.tangent import Tangent

    points = state.points()[-2:]
    reactions = Tangent(model).gradient(state).reshape(-1, 4)[-2:]
    tangent = points[1] - points[0]
    moment = np.cross(points, reactions[:, :3]).sum(axis=0) + reactions[0, 3] * tangent / np.linalg.norm(tangent)
    return reactions[:, 2].sum(), moment[2]


def check(result) -> list[ddg.Check]:
    """Check force and moment against the exact helix, within the discretisation error."""
    first, last = result.state.points()[[0, -1]]
    added = np.arctan2(last[1], last[0]) / (2.0 * np.pi)
    stretch, turns = (last[2] - first[2]) / HEIGHT, TURNS + added
    force, moment = exact(stretch, turns)
    tolerance = min(ddg.Check.COARSEST, 0.012 * (400.0 / (result.model.curves.counts[0] - 1)) ** 2) * max(
        abs(force), 1e-3
    )
    measured = measure(result.model, result.state)
    return [
        ddg.Check("axial force [N]", measured[0], force, tolerance, SOURCE),
        ddg.Check("axial moment [N m]", measured[1], moment, tolerance * RADIUS, SOURCE),
    ]


def picture(result, frames) -> dict:
    """Draw the spring at rest and stretched, side by side."""
    n = int(result.model.curves.counts[0]) - 1
    return {
        "points_by_time": [(0.0, wire(1.0, TURNS, n)[0]), (1.0, result.state.points())],
        "names": ["natural shape", "stretched between clamps"],
        "side_by_side": True,
    }


def benchmark() -> ddg.bench.Study:
    """Study the axial force over the nodes of ten turns."""
    return ddg.bench.Study({"n": (100, 200, 400, 800)}, "axial force")

"""Contact of two rods through parallel positions and past rod ends: continuous, with no point counted twice."""

import numpy as np
import pytest
from pair_cases import LAWS, move, psi, terms

from ddg_warp.solve.collision.collision_mesh import CollisionMesh

RADIUS, GAP = 0.003, 0.001
each_law = pytest.mark.parametrize("law", LAWS)


def two_rods(first: np.ndarray, second: np.ndarray) -> tuple[CollisionMesh, np.ndarray]:
    points = np.concatenate([first, second])
    shapes = CollisionMesh(points)
    shapes.rod(np.arange(len(first)), RADIUS)
    shapes.rod(len(first) + np.arange(len(second)), RADIUS)
    return shapes, points


def straight(edges: int, length: float, height: float = 0.0) -> np.ndarray:
    x = np.linspace(-0.5 * length, 0.5 * length, edges + 1)
    return np.stack([x, 0.0 * x, np.full_like(x, height)], 1)


def rotated(points: np.ndarray, angle: float) -> np.ndarray:
    """Return points rotated about z."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def height(law: str) -> float:
    return GAP + (2.0 * RADIUS if law == "penalty" else 0.0)


PATHS = {
    "turning": lambda s: (rotated, 0.1 * s),
    "turning, off its middle": lambda s: (lambda p, a: rotated(p + [0.013, 0.0, 0.0], a), 0.1 * s),
    "sliding past the ends": lambda s: (lambda p, a: rotated(p, 0.01) + [a, 0.0, 0.0], 0.12 * s),
    "sliding past the ends, parallel": lambda s: (lambda p, a: p + [a, 0.0, 0.0], 0.12 * s),
    "sliding across, parallel": lambda s: (lambda p, a: p + [0.007, a, 0.0], 0.01 * s),
    "rolling into parallel, tilted": lambda s: (
        lambda p, a: rotated(p, 0.5 * a) + [0.0, 0.0, 1.0] * p[:, :1] * a,
        0.02 * s,
    ),
}


@each_law
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("edges", [(1, 1), (3, 4)])
def test_energy_and_forces_are_continuous(device, law, path, edges):
    """An eighth of the step length has an eighth of the largest force change; energies change by the work of the forces."""
    lower, upper = straight(edges[0], 0.1), straight(edges[1], 0.08, height(law))
    shapes, _ = two_rods(lower, upper)

    def along(count: int):
        """Return energies, forces and positions along the path, one world per position."""
        motions = (PATHS[path](s) for s in np.linspace(-1.0, 1.0, count))
        positions = np.array([np.concatenate([lower, motion(upper, a)]) for motion, a in motions])
        result, _ = terms(shapes, positions.reshape(-1, 3), device, law, count)
        return result.energy.numpy(), result.forces.numpy().reshape(positions.shape), positions

    jumps = []
    for count in (1001, 8001):
        energies, forces, positions = along(count)
        jumps.append(np.abs(np.diff(forces, axis=0)).max())
    work = -(0.5 * (forces[1:] + forces[:-1]) * np.diff(positions, axis=0)).sum((1, 2))
    assert np.abs(np.diff(energies) - work).max() < 0.01 * np.abs(np.diff(energies)).max()
    assert jumps[1] < 0.14 * jumps[0]


@each_law
@pytest.mark.parametrize("edges", [1, 2, 5])
def test_nodes_along_an_edge_count_once(device, law, edges):
    """n edges lie along the middle of a longer edge: n - 1 interior nodes count whole, two ends half."""
    shapes, points = two_rods(straight(1, 0.5), straight(edges, 0.1, height(law)))
    result, _ = terms(shapes, points, device, law)
    one = LAWS[law][1]["stiffness"] * float(psi(law, np.array(GAP)))
    assert result.energy.numpy()[0] == pytest.approx(edges * one, rel=1e-12)
    forces = result.forces.numpy()[2:, 2]
    assert forces[0] == pytest.approx(forces[1:-1].mean() / 2 if edges > 1 else forces[-1], rel=1e-11)


@each_law
def test_parallel_rods_count_each_node_once(device, law):
    """n - 1 nodes of the upper rod count whole and the ends half, at any shift; nodes of the lower rod count within reach."""
    lower, upper = straight(20, 0.4), straight(5, 0.1, height(law))
    shapes, points = two_rods(lower, upper)
    result, positions = terms(shapes, points, device, law)
    one = LAWS[law][1]["stiffness"] * float(psi(law, np.array(GAP)))
    for shift in np.linspace(0.0, 0.02, 21):
        move(result, positions, np.concatenate([lower, upper + [shift, 0.0, 0.0]]))
        x = lower[:, 0] - shift
        beyond = np.maximum(np.abs(x) - 0.05, 0.0)
        gaps = np.hypot(beyond, height(law)) - (height(law) - GAP)
        wanted = 5.0 * one + LAWS[law][1]["stiffness"] * psi(law, gaps).sum()
        assert result.energy.numpy()[0] == pytest.approx(wanted, rel=1e-9)


@each_law
def test_crossing_edges_count_once(device, law):
    shapes, points = two_rods(straight(1, 0.1), rotated(straight(1, 0.1, height(law)), 0.3))
    result, _ = terms(shapes, points, device, law)
    one = LAWS[law][1]["stiffness"] * float(psi(law, np.array(GAP)))
    assert result.energy.numpy()[0] == pytest.approx(one, rel=1e-12)


@each_law
def test_collinear_rods_interact_at_their_ends(device, law):
    """The mollifier of collinear rods is zero: two ends count half each."""
    first = straight(1, 0.1)
    shapes, points = two_rods(first, first + [0.1 + height(law), 0.0, 0.0])
    result, _ = terms(shapes, points, device, law)
    one = LAWS[law][1]["stiffness"] * float(psi(law, np.array(GAP)))
    assert result.energy.numpy()[0] == pytest.approx(one, rel=1e-9)


@each_law
@pytest.mark.parametrize("first", [0, 1, 7])
def test_closed_rods_may_begin_at_any_node(device, law, first):
    """Rings of 240 edges, 1.5 degrees apart, one above the other."""
    n = 240
    angle = 2.0 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
    points = np.concatenate([ring, ring + [0.0, 0.0, height(law)]])
    shapes = CollisionMesh(points)
    shapes.rod(np.roll(np.arange(n), first), RADIUS, closed=True)
    shapes.rod(n + np.arange(n), RADIUS, closed=True)
    result, _ = terms(shapes, points, device, law)
    forces = result.forces.numpy()
    assert np.abs(forces[n:] - forces[n]).max(0)[2] < 1e-10 * forces[n, 2]
    assert np.abs(forces[:n, 2] + forces[n, 2]).max() < 1e-10 * forces[n, 2]

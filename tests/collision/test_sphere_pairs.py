"""Balls and obstacles: candidate pairs, stopping of rods, energies and derivatives."""

import numpy as np
import pytest
import warp as wp
from brute_force import SIDES, admissible_pairs, candidate_pairs, distances, near_pairs, scene, upload
from motion_cases import MARGIN, REACH, Motion
from pair_cases import LAWS, central, psi

from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import BALLS, CollisionMesh
from ddg_warp.solve.collision.contact_potential import ContactPotential


def rods_shell_and_balls(seed: int) -> tuple[CollisionMesh, np.ndarray]:
    """Return rods, a shell and thirty balls, ten of which ignore a rod."""
    shapes, points = scene(seed, 0.3, rods=30, triangles=30)
    rng = np.random.default_rng(seed)
    n = len(points)
    points = np.concatenate([points, rng.uniform(0.0, 0.3, (30, 3))])
    shapes.points = points
    for k in range(30):
        number = shapes.ball(n + k, 0.03 + 0.001 * k, still=k % 2 == 0)
        if k % 3 == 0:
            shapes.ignore(number, k % 20)
    return shapes, points


def test_balls_pair_with_edges_of_rods(device):
    shapes, points = rods_shell_and_balls(18)
    search = BroadPhase(shapes, upload(points, device), search_distance=REACH, margin=MARGIN)
    assert [pairs.second.size for pairs in search.lists] == [2, 3, BALLS, BALLS]
    for candidates, side in zip(candidate_pairs(search), (*SIDES, (2, BALLS), (BALLS, BALLS)), strict=True):
        pairs = {tuple(pair) for pair in candidates.tolist()}
        assert (
            near_pairs(shapes, points, *side, REACH + MARGIN)
            <= pairs
            <= near_pairs(shapes, points, *side, REACH + 1.002 * MARGIN)
        )
        assert len(pairs) > 20
    one = candidate_pairs(search)[2][0]
    owner = shapes.names[shapes.primitives(2)[2][one[0]]]
    assert search.describe(search.lists[2], *one.tolist()) == (
        f"edge {one[0] % 20} of {owner} (nodes {', '.join(map(str, shapes.primitives(2)[0][one[0]]))}) and ball {35 + one[1]} "
        f"(node {len(points) - 30 + one[1]})"
    )


def test_rod_stops_at_a_ball(device):
    """The rod keeps between 1 % and 15 % of the gap; a rod that passes by is not stopped."""
    points = np.array([[-1.0, 0.1, 1.0], [1.0, 0.1, 1.0], [1.2, 0.0, 0.0], [2.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    shapes = CollisionMesh(points)
    shapes.rod([0, 1], 0.1)
    shapes.rod([2, 3], 0.1)
    shapes.ball(4, 0.5, still=True, name="head")
    motion = Motion(shapes, points, device)
    move = np.zeros_like(points)
    move[:2, 2] = -2.0
    move[2:4, 1] = -2.0
    landing = motion(move)
    edge = landing[:2]
    gap = np.hypot(edge[0, 1], edge[0, 2]) - 0.6
    start = np.hypot(1.0, 0.1) - 0.6
    assert 0.01 * start < gap < 0.15 * start
    assert motion.search.shares.numpy()[1] == 1.0
    assert landing[4].tolist() == [0.0, 0.0, 0.0]


def test_obstacles_form_no_pairs_with_each_other(device):
    shapes, points = scene(19, 0.3, rods=12, triangles=40)
    x = upload(points, device)
    everything = candidate_pairs(BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN))
    shapes.obstacle.update({0, 3, 4, 13, 14, 16})
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    still = np.array(sorted(shapes.obstacle))
    for candidates, every, (first, second) in zip(candidate_pairs(search), everything, SIDES, strict=True):
        owners = shapes.primitives(first)[2][every[:, 0]], shapes.primitives(second)[2][every[:, 1]]
        both = np.isin(owners[0], still) & np.isin(owners[1], still)
        assert candidates.tolist() == every[~both].tolist()
        assert both.sum() > 3
        i, j = admissible_pairs(shapes, first, second)
        d, thickness = distances(shapes, points, first, second, i, j)
        assert (d - thickness <= REACH + MARGIN).sum() <= len(candidates)


def rods_on_balls() -> tuple[CollisionMesh, np.ndarray]:
    """Return ten rods almost in contact with two balls each: one inside an edge, one next to an end."""
    rng = np.random.default_rng(1)
    _, points = scene(2, 5.0, rods=10, triangles=1)
    lines = points[:210].reshape(10, 21, 3)
    across = rng.normal(size=(10, 3))
    across /= np.linalg.norm(across, axis=1)[:, None]
    inside = 0.6 * lines[:, 7] + 0.4 * lines[:, 8] + 0.0241 * across
    ends = lines[:, 0] + 0.0241 * across
    shapes = CollisionMesh(np.concatenate([points[:210], inside, ends]))
    for r in range(10):
        shapes.rod(21 * r + np.arange(21), 0.004)
    for k in range(20):
        shapes.ball(210 + k, 0.02)
    return shapes, shapes.points


def test_energies_forces_and_products_of_ball_pairs(device):
    shapes, x = rods_on_balls()
    rng = np.random.default_rng(3)
    density, parameters = LAWS["penalty"]
    positions = upload(x, device)
    search = BroadPhase(shapes, positions, search_distance=REACH, margin=MARGIN)
    terms = ContactPotential(search, density, **parameters)

    def energy(y: np.ndarray) -> float:
        i, j = admissible_pairs(shapes, 2, BALLS)
        d, thickness = distances(shapes, y, 2, BALLS, i, j)
        return parameters["stiffness"] * psi("penalty", d - thickness).sum()

    def forces(y: np.ndarray) -> np.ndarray:
        positions.assign(y)
        terms.evaluate(positions)
        return terms.forces.numpy().copy()

    v = rng.normal(size=x.shape)
    force = forces(x)
    terms.search.update(positions)
    assert terms.energy.numpy()[0] == pytest.approx(energy(x), rel=1e-11)
    assert int(terms.lists[1].count.numpy()[0]) >= 20
    along = central(lambda s: energy(x + s * v), 1e-7)
    assert -(force * v).sum() == pytest.approx(along, rel=1e-6)
    assert np.abs(force.sum(0)).max() < 1e-12 * np.abs(force).max()
    exact = central(lambda s: -forces(x + s * v), 1e-7)
    forces(x)
    direction = upload(v, device)
    out = wp.zeros_like(direction)
    terms.product(direction, out, positions)
    assert out.numpy() == pytest.approx(exact, rel=1e-6, abs=1e-6 * np.abs(exact).max())

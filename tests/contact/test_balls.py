"""Balls and obstacles: what is a pair and what is not, where rods stop."""

import numpy as np
from brute_force import SIDES, allowed, distances, listed, near, scene, upload
from motion_cases import MARGIN, REACH, Motion

from ddg_warp.solve.contact.broad_phase import BroadPhase
from ddg_warp.solve.contact.shapes import BALLS, Shapes


def balls(seed: int) -> tuple[Shapes, np.ndarray]:
    """Rods, a shell and thirty balls, of which ten do not touch the rods beside them."""
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


def test_balls_are_paired_with_edges_of_rods_and_with_triangles(device):
    shapes, points = balls(18)
    search = BroadPhase(shapes, upload(points, device), reach=REACH, margin=MARGIN)
    assert [pairs.second.size for pairs in search.lists] == [2, 3, BALLS]
    for found, side in zip(listed(search), (*SIDES, (2, BALLS)), strict=True):
        pairs = {tuple(pair) for pair in found.tolist()}
        assert (
            near(shapes, points, *side, REACH + MARGIN) <= pairs <= near(shapes, points, *side, REACH + 1.002 * MARGIN)
        )
        assert len(pairs) > 20
    one = listed(search)[2][0]
    owner = shapes.names[shapes.things(2)[2][one[0]]]
    assert search.describe(search.lists[2], *one.tolist()) == (
        f"edge {one[0] % 20} of {owner} (nodes {', '.join(map(str, shapes.things(2)[0][one[0]]))}) and ball {35 + one[1]} "
        f"(node {len(points) - 30 + one[1]})"
    )


def test_a_rod_stops_at_a_ball(device):
    """By its closed form: of the gap a tenth is left, and of that another one; an end that goes past does not stop."""
    points = np.array([[-1.0, 0.1, 1.0], [1.0, 0.1, 1.0], [1.2, 0.0, 0.0], [2.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    shapes = Shapes(points)
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


def test_obstacles_are_no_pairs_of_their_own(device):
    shapes, points = scene(19, 0.3, rods=12, triangles=40)
    x = upload(points, device)
    everything = listed(BroadPhase(shapes, x, reach=REACH, margin=MARGIN))
    shapes.obstacle.update({0, 3, 4, 13, 14, 16})
    search = BroadPhase(shapes, x, reach=REACH, margin=MARGIN)
    still = np.array(sorted(shapes.obstacle))
    for found, every, (first, second) in zip(listed(search), everything, SIDES, strict=True):
        owners = shapes.things(first)[2][every[:, 0]], shapes.things(second)[2][every[:, 1]]
        both = np.isin(owners[0], still) & np.isin(owners[1], still)
        assert found.tolist() == every[~both].tolist()
        assert both.sum() > 3
        i, j = allowed(shapes, first, second)
        d, thickness = distances(shapes, points, first, second, i, j)
        assert (d - thickness <= REACH + MARGIN).sum() <= len(found)

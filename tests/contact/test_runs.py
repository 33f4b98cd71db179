"""Whether anything is near at all: never told wrongly, and told at once where rods are apart and do not curl up."""

import numpy as np
import pytest
import warp as wp
from brute_force import curves, listed, near, upload

from ddg_warp.solve.contact.broad_phase import BroadPhase
from ddg_warp.solve.contact.shapes import Shapes

REACH, MARGIN, RADIUS = 0.002, 0.004, 0.003
FAR = 3.0  # from what is then asked for, so that a search is due


def rods(points: np.ndarray, nodes: int, apart: float | None = None) -> Shapes:
    shapes = Shapes(points)
    for r in range(len(points) // nodes):
        shapes.rod(r * nodes + np.arange(nodes), RADIUS, apart=apart)
    return shapes


def search(shapes: Shapes, points: np.ndarray, device, worlds: int = 1, dtype=wp.vec3d) -> BroadPhase:
    elsewhere = upload(np.tile(points, (worlds, 1)) + FAR, device, dtype)
    result = BroadPhase(shapes, elsewhere, worlds, reach=REACH, margin=MARGIN)
    result.look_for_runs()
    return result


@pytest.mark.parametrize(("nodes", "spread"), [(5, 2.0), (12, 4.0), (30, 8.0), (90, 30.0)])
def test_what_is_told_to_be_apart_is_apart_on_the_way(device, spread, nodes):
    """By all pairs at places along the way; and where anything may be near the pairs are those of a search without."""
    found = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        points = curves(rng, 6, nodes, spread, 0.03)
        move = rng.normal(size=3) * 0.1 + 0.002 * rng.normal(size=points.shape)
        shapes = rods(points, nodes)
        x, end = upload(points, device), upload(points + move, device)
        plain, own = BroadPhase(shapes, x, reach=REACH, margin=MARGIN), search(shapes, points, device)
        plain.search(x, upload(move, device), plain.every)
        own.update(x, end, own.every)
        found.append(bool(own._runs.near.numpy()[0]))
        if found[-1]:
            np.testing.assert_array_equal(listed(own)[0], listed(plain)[0])
        else:
            assert len(listed(own)[0]) == 0
            for share in np.linspace(0.0, 1.0, 9):
                assert not near(shapes, points + share * move, 2, 2, REACH + MARGIN)
    assert any(found) and not all(found)


@pytest.mark.parametrize("dtype", [wp.vec3d, wp.vec3f])
def test_straight_and_gently_bent_rods_are_told_apart(device, dtype):
    """A circle of circumference 1.2 opens by 0.2; a step of translation, far beyond the margin, changes nothing."""
    turn = np.linspace(0.0, 2.0 * np.pi / 1.2, 81)
    arc = 1.2 / (2.0 * np.pi) * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], 1)
    line = np.stack([np.linspace(0.0, 1.0, 81), np.full(81, 1.0), np.zeros(81)], 1)
    points = np.concatenate([arc, line])
    x, end = upload(points, device, dtype), upload(points + 0.7, device, dtype)
    for given in ((x,), (x, end, "every"), (x, end)):
        own = search(rods(points, 81), points, device, dtype=dtype)
        own.update(*given[:2], *(getattr(own, name) for name in given[2:]))
        near = given == (x, end)  # by shares of their own nodes go anywhere between
        assert own._runs.near.numpy()[0] == near and (near or len(listed(own)[0]) == 0)


def test_rods_that_come_round_to_themselves_or_to_others_are_seen(device):
    turn = np.linspace(0.0, 1.99 * np.pi, 81)
    ring = 0.2 * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], 1)
    shapes = rods(ring, 81)
    own = search(shapes, ring, device)
    own.update(upload(ring, device))
    assert own._runs.near.numpy()[0] == 1 and len(listed(own)[0])
    shapes.ignore(0, 0)
    own = search(shapes, ring, device)
    own.update(upload(ring, device))
    assert own._runs.near.numpy()[0] == 0
    line = np.stack([np.linspace(0.0, 1.0, 81), np.zeros(81), np.zeros(81)], 1)
    two = np.concatenate([line, line + [0.0, 0.5, 0.0]])
    own, x = search(rods(two, 81), two, device, worlds=2), np.tile(two, (2, 1))
    own.update(upload(x, device))
    assert own._runs.near.numpy()[0] == 0
    x[-81:, 1] = 0.008
    own.update(upload(x, device))
    assert own._runs.near.numpy()[0] == 1
    assert {int(i) // 160 for i in listed(own)[0].ravel()} == {1}


@pytest.mark.parametrize("nodes", [5, 81, 140])
@pytest.mark.parametrize("rod", [1, 2])
def test_rods_beside_each_other_are_seen(device, nodes, rod):
    """The first, and one of two others, by its ends."""
    line = np.stack([np.linspace(0.0, 1.0, nodes), np.zeros(nodes), np.zeros(nodes)], 1)
    for gap, expected in ((0.9, 1), (1.1, 0)):
        places = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 1.0, 0.0]]
        places[rod] = [1.0, 2.0 * RADIUS + gap * (REACH + MARGIN), 0.0]
        points = np.concatenate([line + place for place in places])
        own = search(rods(points, nodes), points, device)
        own.update(upload(points, device))
        assert own._runs.near.numpy()[0] == expected


def test_triangles_are_searched_for_as_ever(device):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    shapes = Shapes(points)
    shapes.rod(np.arange(3), RADIUS)
    shapes.shell(np.array([[3, 4, 5]]), 0.01)
    assert search(shapes, points, device)._runs is None

"""Times of impact and crossings against dense sampling in time and closed forms."""

import brute_force
import numpy as np
import pytest
from brute_force import upload

from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import CollisionMesh

REACH, MARGIN = 0.004, 0.01
FRAMES = 2001
SIDES = {"edges": (2, 2), "point and triangle": (1, 3)}


def random_pairs(name: str, seed: int, count: int) -> tuple[CollisionMesh, np.ndarray, np.ndarray]:
    """Return one pair in each of `count` worlds, random in position and motion.

    A point is the end of an edge that is itself in no pair.
    """
    rng = np.random.default_rng(seed)
    nodes = 4 if name == "edges" else 5
    x, move = rng.normal(size=(2, count, nodes, 3))
    shapes = CollisionMesh(np.random.default_rng(0).normal(size=(nodes, 3)))
    shapes.rod([0, 1], 0.05)
    if name == "edges":
        shapes.rod([2, 3], 0.1)
    else:
        x[:, 1] = x[:, 0] + 100.0
        move[:, 1] = move[:, 0]
        shapes.shell([[2, 3, 4]], 0.2)
    return shapes, x, move


def gaps(shapes: CollisionMesh, name: str, x: np.ndarray) -> np.ndarray:
    """Return the gaps (pairs, worlds) of all pairs at x (worlds, nodes, 3)."""
    result = []
    for side in [SIDES["edges"]] + [SIDES["point and triangle"]] * (name != "edges"):
        for i, j in zip(*brute_force.admissible_pairs(shapes, *side), strict=True):
            nodes_a, radius_a, *_ = shapes.primitives(side[0])
            nodes_b, radius_b, *_ = shapes.primitives(side[1])
            corners = [*np.moveaxis(x[:, nodes_a[i]], 1, 0), *np.moveaxis(x[:, nodes_b[j]], 1, 0)]
            d = (brute_force.edge_edge if side[0] == 2 else brute_force.point_triangle)(*corners)
            result.append(d - radius_a[i] - radius_b[j])
    return np.array(result)


@pytest.mark.parametrize("name", SIDES)
def test_time_of_impact_is_conservative_and_tight(device, name):
    shapes, x, move = random_pairs(name, 1, 500)
    search = BroadPhase(shapes, upload(x.reshape(-1, 3), device), len(x), search_distance=REACH, margin=MARGIN)
    search.impact(upload(x.reshape(-1, 3), device), upload(move.reshape(-1, 3), device))
    time = search.time.numpy()
    gap = np.array([gaps(shapes, name, x + t * move) for t in np.linspace(0.0, 1.0, FRAMES)])
    overlap = (gap[0] <= 0.0).any(0)
    assert (time[overlap] == 0.0).all() and (time[~overlap] > 0.0).all()
    closed = (gap <= 0.0).any(1)
    hit = closed.any(0) & ~overlap
    first = closed.argmax(0) / (FRAMES - 1)
    assert hit.sum() > 50 and (time[hit] <= first[hit]).all()
    assert np.median((first - time)[hit] / first[hit]) < 0.25
    assert (gaps(shapes, name, x + time[:, None, None] * move)[:, ~overlap] > 0.0).all()
    # a motion is stopped wherever a pair would cross, and only where a pair would close a gap to a tenth
    stopped = np.flatnonzero((time < 1.0) & ~overlap)
    left = [(gap[int(time[k] * (FRAMES - 1)) :, :, k].min(0) / gap[0, :, k]).min() for k in stopped]
    assert max(left) <= 0.101
    assert (time[hit] < 1.0).all()


def test_head_on_impact_matches_its_closed_form(device):
    """Crossed edges at distance 1 with radii 0.1 approach by 2: contact is at 0.4, and a tenth of the gap of 0.8 is left at 0.36."""
    points = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 1.0, 1.0]])
    move = np.array([[0.0, 0.0, 1.0]] * 2 + [[0.0, 0.0, -1.0]] * 2)
    shapes = CollisionMesh(points)
    shapes.rod([0, 1], 0.1)
    shapes.rod([2, 3], 0.1)
    x = upload(points, device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    search.impact(x, upload(move, device))
    assert search.time.numpy()[0] == pytest.approx(0.36, rel=1e-12)
    search.impact(x, upload(move, device), min_separation_fraction=0.0)
    assert search.time.numpy()[0] == pytest.approx(0.45, rel=1e-12)
    search.impact(x, upload(0.35 * move, device))
    assert search.time.numpy()[0] == 1.0
    # a common translation is no relative motion
    search.impact(x, upload(np.broadcast_to([300.0, 5.0, -7.0], (4, 3)), device))
    assert search.time.numpy()[0] == 1.0
    # a gap of 0.003 within the reach may go down to a fifth, one little wider to a fifth of the reach
    for gap, least in ((0.003, 0.2 * 0.003), (0.006, 0.2 * REACH), (0.1, 0.1 * 0.1)):
        near = upload(points + np.outer([0.0, 0.0, 1.0, 1.0], [0.0, 0.0, gap - 0.8]), device)
        search.impact(near, upload(gap * move, device))
        assert search.time.numpy()[0] == pytest.approx(0.5 * (1.0 - least / gap), rel=1e-9)


@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_crossings_are_counted_exactly(device, offset):
    """Eight rods fall through eight others across: all 64 pairs cross once the layers have met, none before."""
    ends, offsets = np.array([-1.0, 1.0]), np.linspace(-0.8, 0.8, 8)
    lower = np.stack(np.broadcast_arrays(ends, offsets[:, None], 0.0), axis=-1).reshape(-1, 3)
    upper = np.stack(np.broadcast_arrays(offsets[:, None], ends, 0.3), axis=-1).reshape(-1, 3)
    points = np.concatenate([lower, upper]) + offset
    shapes = CollisionMesh(points)
    for k in range(16):
        shapes.rod([2 * k, 2 * k + 1], 0.01)
    x = upload(points, device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    for fall, crossed in ((0.2999, 0), (0.3001, 64), (0.6, 64), (5.0, 64)):
        move = np.zeros_like(points)
        move[16:, 2] = -fall
        move[:, 0] += 17.0
        search.crossings(x, upload(move, device))
        assert search.crossed.numpy()[0] == crossed
        assert search.first_crossing() == (
            "edge 0 of rod 0 (nodes 0, 1) and edge 0 of rod 8 (nodes 16, 17)" if crossed else ""
        )
    # rods in a plane that pass within it, where the volume of four nodes is zero all the time
    move = np.zeros_like(points)
    move[0:2, 1] = 0.8 * 2 / 7 + 0.01
    search.crossings(x, upload(move, device))
    assert search.crossed.numpy()[0] == 1


@pytest.mark.parametrize("distance", [1e-4, 0.0])
def test_close_sliding_is_no_crossing(device, distance):
    """A rod slides by ten thousand times the distance from another, across or along. Rods at no distance meet."""
    points = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-0.5, -1.0, distance], [-0.5, 1.0, distance]])
    shapes = CollisionMesh(points)
    shapes.rod([0, 1], 1e-5)
    shapes.rod([2, 3], 1e-5)
    x = upload(points, device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    for direction in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]):
        search.crossings(x, upload(np.outer([0, 0, 1, 1], direction), device))
        assert search.crossed.numpy()[0] == (distance == 0.0)


def test_crossings_are_found_without_a_new_search(device):
    """A rod falls past another, within half of the margin and farther, without a new search."""
    points = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 3e-3], [0.0, 1.0, 3e-3]])
    shapes = CollisionMesh(points)
    shapes.rod([0, 1], 1e-4)
    shapes.rod([2, 3], 1e-4)
    x = upload(points, device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    searches = search.counters.searches.numpy()[0]
    for fall in (2.9e-3, 3.1e-3, 4.9e-3, 5.1e-3, 2.0):
        search.check_crossings(x, upload(points - np.outer([0, 0, 1, 1], [0.0, 0.0, fall]), device))
        assert search.crossed.numpy()[0] == (fall > 3e-3)
    search.update(x)
    assert search.counters.searches.numpy()[0] == searches


def test_crossings_equal_roots_of_signed_volumes(device):
    """A pair crosses at a root of the volume of four nodes, a cubic in time, if the closest points are interior."""
    rng = np.random.default_rng(3)
    n = 2000
    x, move = rng.normal(size=(2, n, 4, 3))
    shapes = CollisionMesh(x[0])
    shapes.rod([0, 1], 0.01)
    shapes.rod([2, 3], 0.01)
    search = BroadPhase(shapes, upload(x.reshape(-1, 3), device), n, search_distance=REACH, margin=MARGIN)
    search.crossings(upload(x.reshape(-1, 3), device), upload(move.reshape(-1, 3), device))
    times = np.linspace(0.0, 1.0, 4)

    def volume(y):
        return np.linalg.det(y[..., 1:, :] - y[..., :1, :])

    cubics = np.linalg.solve(np.vander(times, 4), np.array([volume(x + t * move) for t in times]))
    wanted = []
    for k in range(n):
        roots = np.roots(cubics[:, k])
        roots = roots[np.abs(roots.imag) < 1e-9].real
        meets = False
        for t in roots[(roots >= 0.0) & (roots <= 1.0)]:
            y = x[k] + t * move[k]
            meets |= bool(brute_force.edge_edge(*y[:, None])[0] < 1e-7)
        wanted.append(int(meets))
    assert 50 < sum(wanted) < n
    assert search.crossed.numpy().tolist() == wanted

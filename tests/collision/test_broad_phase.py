"""Candidates of contact against all pairs: complete, without duplicates, and valid within the margin."""

import numpy as np
import pytest
import warp as wp
from brute_force import SIDES, candidate_pairs, near_pairs, scene, upload

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.kernels.core.prefix_sum import TILE
from ddg_warp.solve.collision import bvh
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.candidate_list import RunningSums
from ddg_warp.solve.collision.collision_mesh import CollisionMesh
from tests.pairwise import covering

REACH, MARGIN = 0.004, 0.01


def assert_complete(search: BroadPhase, x: np.ndarray, sides=SIDES) -> None:
    """Assert that lists have every near pair once, and no pair beyond the search distance."""
    for candidates, side in zip(candidate_pairs(search), sides, strict=True):
        pairs = [tuple(pair) for pair in candidates.tolist()]
        assert pairs == sorted(set(pairs))
        assert near_pairs(search.shapes, x, *side, REACH + MARGIN) <= set(pairs)
        assert set(pairs) <= near_pairs(search.shapes, x, *side, REACH + 1.002 * MARGIN)


@covering(1, dtype=(wp.vec3d, wp.vec3f), spread=(0.3, 1.0, 3.0))
def test_candidates_equal_those_of_all_pairs(device, spread, dtype):
    shapes, points = scene(1, spread)
    search = BroadPhase(shapes, upload(points, device, dtype), search_distance=REACH, margin=MARGIN)
    assert_complete(search, points.astype(np.float32) if dtype is wp.vec3f else points)
    assert all(len(candidates) > 10 for candidates in candidate_pairs(search)) or spread > 1.0


def test_ignored_objects_form_no_pairs(device):
    shapes, points = scene(2, 0.3)
    x = upload(points, device)
    before = candidate_pairs(BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN))
    for pair in ((0, 1), (7, 3), (5, 5), (50, 51), (2, 52), (54, 54)):
        shapes.ignore(*pair)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    assert_complete(search, points)
    assert all(len(after) < len(all_of) for after, all_of in zip(candidate_pairs(search), before, strict=True))


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("exclusion", [0.0, 0.35, 1.75, 3.45])
def test_edges_within_the_exclusion_distance_form_no_pairs(device, closed, exclusion):
    """A circle has 40 edges and circumference 4: edges k apart have (k - 1) / 10 of arc between them."""
    n = 40
    angle = 2.0 * np.pi * np.arange(n) / n
    radius = 0.05 / np.sin(np.pi / n)
    points = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    shapes = CollisionMesh(points)
    shapes.rod(np.arange(n), 0.01, closed=closed, exclusion_length=exclusion)
    (candidates,) = candidate_pairs(BroadPhase(shapes, upload(points, device), search_distance=1.0, margin=1.0))
    i, j = np.triu_indices(n if closed else n - 1, 1)
    steps = np.minimum(j - i, n - (j - i)) if closed else j - i
    wanted = (steps > 1) & (0.1 * (steps - 1) >= exclusion)
    assert candidates.tolist() == np.column_stack([i, j])[wanted].tolist()


@pytest.mark.parametrize("leaf_size", [1, 2, 3, 5])
def test_leaf_size_changes_no_pair_and_no_crossing(device, monkeypatch, leaf_size):
    """Any number of edges a leaf gives the same pairs and the same crossings, in two worlds."""
    shapes, points = scene(17, 0.3, rods=10, triangles=40)
    move = 0.05 * np.random.default_rng(18).normal(size=(2 * len(points), 3))
    results = []
    for bundle in (bvh.BUNDLE, (leaf_size, leaf_size)):
        monkeypatch.setattr(bvh, "BUNDLE", bundle)
        search = BroadPhase(shapes, upload(np.tile(points, (2, 1)), device), 2, search_distance=REACH, margin=MARGIN)
        x = upload(np.tile(points, (2, 1)), device)
        lists = [pairs.tolist() for pairs in candidate_pairs(search)]
        search.crossings(x, upload(move, device))
        assert not search.fit(x)
        results.append((lists, search.crossed.numpy().tolist(), search.first_crossing()))
    assert results[0] == results[1]
    assert min(results[0][1]) > 10


def test_worlds_form_no_pairs_with_each_other(device):
    shapes, points = scene(3, 0.3, rods=10, triangles=40)
    rng = np.random.default_rng(4)
    worlds = [points + 0.01 * rng.normal(size=points.shape) for _ in range(3)]
    together = BroadPhase(shapes, upload(np.concatenate(worlds), device), 3, search_distance=REACH, margin=MARGIN)
    for k, candidates in enumerate(candidate_pairs(together)):
        pairs, expected = together.lists[k], []
        for w, x in enumerate(worlds):
            alone = candidate_pairs(BroadPhase(shapes, upload(x, device), search_distance=REACH, margin=MARGIN))[k]
            expected.append(alone + w * np.array([pairs.first.count, pairs.second.count]))
        assert candidates.tolist() == np.concatenate(expected).tolist()
        assert min(map(len, expected)) > 5


def test_coincident_and_parallel_edges_are_found(device):
    """Sixty edges coincide, which no tree can separate, and twenty lie side by side."""
    stacked = np.tile([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], (60, 1))
    parallel = np.repeat(np.arange(20) * 0.01, 2)[:, None] * [0.0, 1.0, 0.0] + np.tile(
        [[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]], (20, 1)
    )
    points = np.concatenate([stacked, parallel])
    shapes = CollisionMesh(points)
    for k in range(80):
        shapes.rod([2 * k, 2 * k + 1], 0.003)
    search = BroadPhase(shapes, upload(points, device), search_distance=REACH, margin=MARGIN)
    assert_complete(search, points, SIDES[:1])
    assert search.lists[0].count.numpy()[0] == 60 * 59 // 2 + 19 + 18


@pytest.mark.parametrize("room", [(10,), (10_000, 10), (10, 10)])
def test_overflowing_lists_are_empty_until_they_grow(device, room):
    """The capacity is too small for pairs, for overlapping boxes, or for both."""
    shapes, points = scene(5, 0.3)
    x = upload(points, device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    whole = candidate_pairs(search)
    for pairs in search.lists:
        pairs.reserve(*room)
    search.search(x)
    assert search.counters.overflow.numpy()[0] == 1
    assert not any(len(candidates) for candidates in candidate_pairs(search))
    searches = search.counters.searches.numpy()[0]
    search.update(x)
    assert search.counters.searches.numpy()[0] == searches + 1  # candidates stay invalid until lists have room
    version = search.version
    assert search.fit(x)
    assert search.version > version
    assert [candidates.tolist() for candidates in candidate_pairs(search)] == [
        candidates.tolist() for candidates in whole
    ]
    assert not search.fit(x)


def test_nearly_full_lists_grow_with_overflowing_ones(device):
    """Graphs are then captured again once, not per list. Each list gets room for twice the pairs found."""
    shapes, points = scene(5, 0.3)
    x = upload(points, device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    short, full, *_ = sorted(search.lists, key=lambda pairs: -pairs.count.numpy()[0])
    counts = [int(pairs.count.numpy()[0]) for pairs in (short, full)]
    assert min(counts) > 10
    short.reserve(10)
    full.reserve(counts[1])
    search.search(x)
    assert search.fit(x)
    assert [pairs.capacity for pairs in (short, full)] == [2 * count for count in counts]


@pytest.mark.parametrize("excess", [-1e-6, 1e-6])
def test_candidates_are_valid_for_half_the_margin(device, excess):
    """Two edges approach from just beyond the search distance; the pair is found before the gap can fall below `search_distance`."""
    gap = REACH + 1.002 * MARGIN
    distance = 0.02 + gap
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, -0.5, distance], [0.5, 0.5, distance]])
    shapes = CollisionMesh(points)
    shapes.rod([0, 1], 0.01)
    shapes.rod([2, 3], 0.01)
    search = BroadPhase(shapes, upload(points, device), search_distance=REACH, margin=MARGIN)
    assert not len(candidate_pairs(search)[0])
    searches = search.counters.searches.numpy()[0]
    moved = points.copy()
    moved[:2, 2] += (0.5 + excess) * MARGIN
    moved[2:, 2] -= (0.5 + excess) * MARGIN
    search.update(upload(moved, device))
    assert search.counters.searches.numpy()[0] == searches + (excess > 0)
    assert len(candidate_pairs(search)[0]) == (excess > 0)
    # without a new search, pairs that are not listed are beyond the reach
    assert near_pairs(shapes, moved, 2, 2, REACH) <= {tuple(pair) for pair in candidate_pairs(search)[0].tolist()}


def test_dofs_of_no_primitive_trigger_no_search(device):
    """Dof blocks without a position, such as twist angles of edges, may have any value."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    shapes = CollisionMesh(points)
    shapes.rod([0, 1], 0.01)
    search = BroadPhase(shapes, upload(np.tile(points, (2, 1)), device), 2, search_distance=REACH, margin=MARGIN)
    for node, more in ((2, 0), (5, 0), (1, 1), (4, 1)):
        searches, x = search.counters.searches.numpy()[0], np.tile(points, (2, 1))
        x[node, 0] += 2.0 * MARGIN
        search.update(upload(x, device))
        assert search.counters.searches.numpy()[0] == searches + more
        search.search(upload(np.tile(points, (2, 1)), device))


def test_captured_update_searches_only_where_needed(device):
    shapes, points = scene(6, 0.5, rods=20, triangles=60)
    x = upload(points, device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    device_arrays.load_kernels(search.kernels, device)
    with wp.ScopedCapture(device=device) as capture:
        search.update(x)
    rng, position = np.random.default_rng(7), points.copy()
    velocity = rng.normal(size=points.shape)
    velocity *= 0.3 * MARGIN / np.linalg.norm(velocity, axis=1, keepdims=True)
    before = search.counters.searches.numpy()[0]
    for step in range(1, 7):
        position += velocity
        x.assign(position)
        wp.capture_launch(capture.graph)
        assert not search.fit(x)
        assert search.counters.searches.numpy()[0] == before + step // 2
        for candidates, side in zip(candidate_pairs(search), SIDES, strict=True):
            assert near_pairs(shapes, position, *side, REACH) <= {tuple(pair) for pair in candidates.tolist()}
    search.search(x)
    assert_complete(search, position)
    search.rebuild(x)
    search.search(x)
    assert_complete(search, position)


def test_captured_motion_equals_uncaptured(device):
    shapes, points = scene(13, 0.5, rods=20, triangles=60)
    rng = np.random.default_rng(14)
    x, move = upload(points, device), upload(0.02 * rng.normal(size=points.shape), device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    device_arrays.load_kernels([*search.kernels, *search._impacts], device)

    def step():
        search.rebuild(x)
        search.update(x)
        search.measure(x)
        search.impact(x, move, min_separation_fraction=0.5)
        search.crossings(x, move)

    def results() -> list[bytes]:
        numbers = (search.gap, search.time, search.crossed)
        return [part.tobytes() for part in (*candidate_pairs(search), *(array.numpy() for array in numbers))]

    step()
    plain = results()
    assert search.crossed.numpy()[0] > 0
    x.assign(points + 100.0)
    with wp.ScopedCapture(device=device) as capture:
        step()
    x.assign(points)
    wp.capture_launch(capture.graph)
    assert results() == plain


@pytest.mark.parametrize("count", [1, 64, 65, 1_025, 70_000, 1_100_000])
def test_prefix_sums(device, count):
    values = np.random.default_rng(15).integers(0, 9, count)
    sums = RunningSums(wp.array(values, dtype=int, device=device))
    if len(sums.tiles):  # on CUDA, as the kernel that writes the values does
        sums.tiles.assign(np.add.reduceat(values, np.arange(0, count, TILE)))
    sums()
    assert sums.starts.numpy().tolist() == (np.cumsum(values) - values).tolist()


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_boxes_contain_their_primitives(device, offset):
    """Boxes contain float64 positions that float32 cannot represent, and are larger by no more than rounding."""
    shapes, points = scene(16, 1.0, rods=20, triangles=60)
    points = points + offset
    x = upload(points, device)
    lost = wp.zeros(1, dtype=int, device=device)
    for size in shapes.sizes:
        nodes, radius, *_ = shapes.primitives(size)
        radii = wp.array([shapes.radii], dtype=wp.float64, device=device)
        primitives = bvh.Primitives(shapes, size, 1, wp.float64, wp.get_device(device), radii)
        primitives.enclose(x, wp.zeros_like(x), wp.zeros(1, dtype=wp.vec3d, device=device), 1.0, 0.002, lost)
        search_distance = (radius + 0.002)[:, None]
        below = points[nodes].min(1) - search_distance - primitives.lower.numpy().astype(float)
        above = primitives.upper.numpy().astype(float) - points[nodes].max(1) - search_distance
        assert min(below.min(), above.min()) > 0.0
        assert max(below.max(), above.max()) <= 5e-7 * (2.0 + offset)


def test_runs_agree_bitwise(device):
    shapes, points = scene(8, 0.5)
    x = upload(points, device)
    move = upload(0.01 * np.random.default_rng(9).normal(size=points.shape), device)

    def run() -> list[bytes]:
        search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
        search.measure(x)
        search.impact(x, move, min_separation_fraction=0.0)
        search.crossings(x, move)
        numbers = (search.gap, search.time, search.crossed)
        return [part.tobytes() for part in (*candidate_pairs(search), *(array.numpy() for array in numbers))]

    assert run() == run()


def test_order_of_objects_is_irrelevant(device):
    rng = np.random.default_rng(10)
    _, points = scene(11, 0.3, rods=12, triangles=30)
    rods = [range(21 * r, 21 * r + 21) for r in range(12)]
    triangles = 252 + np.arange(90).reshape(-1, 3)

    def pairs_of(order) -> set:
        shapes = CollisionMesh(points)
        for k in order:
            if k == 12:
                shapes.shell(triangles, 0.004)
            else:
                shapes.rod(np.array(rods[k]), 0.004)
        search = BroadPhase(shapes, upload(points, device), search_distance=REACH, margin=MARGIN)
        result = set()
        for pairs, candidates in zip(search.lists, candidate_pairs(search), strict=True):
            nodes = [shapes.primitives(side.size)[0] for side in (pairs.first, pairs.second)]
            result |= {
                frozenset((tuple(sorted(nodes[0][i])), tuple(sorted(nodes[1][j])))) for i, j in candidates.tolist()
            }
        return result

    first = pairs_of(range(13))
    assert len(first) > 50
    assert pairs_of(rng.permutation(13)) == first


def test_non_finite_positions_are_refused_by_name(device):
    shapes, points = scene(12, 1.0, rods=4, triangles=4)
    x = upload(np.concatenate([points, points]), device)
    search = BroadPhase(shapes, x, 2, search_distance=REACH, margin=MARGIN)
    broken = np.concatenate([points, points])
    broken[len(points) + 17, 1] = np.nan
    x.assign(broken)
    search.update(x)
    with pytest.raises(SolverError, match="node 17 of world 1"):
        search.check()
    x.assign(np.concatenate([points, points]))
    search.update(x)
    search.check()
    after = [candidates.tolist() for candidates in candidate_pairs(search)]
    assert after == [
        candidates.tolist()
        for candidates in candidate_pairs(BroadPhase(shapes, x, 2, search_distance=REACH, margin=MARGIN))
    ]


POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.mark.parametrize(
    ("describe", "message"),
    [
        (lambda s: s.rod([0, 1, 2, 3], 0.1, name="cable"), "edge 1 of cable has zero length"),
        (lambda s: s.rod([0], 0.1), "rod 0 has 1 nodes; it needs at least 2"),
        (lambda s: s.rod([0, 1], 0.0), "rod 0: radius = 0.0"),
        (lambda s: s.rod([0, 1], 0.1, exclusion_length=-1.0), "exclusion_length = -1.0"),
        (lambda s: s.rod([0, 5], 0.1), "rod 0 has node 5; nodes are 0 to 4"),
        (lambda s: s.rod([0.0, 1.0], 0.1), "whole numbers"),
        (lambda s: s.shell([[0, 1, 4], [0, 1, 3]], 0.1, name="sheet"), "triangle 1 of sheet has no area"),
        (lambda s: s.shell([[0, 1, 4, 2]], 0.1), r"of shape \(1, 4\)"),
        (lambda s: s.shell([[0, 1, 4]], float("nan")), "thickness = nan"),
        (lambda s: s.ball(5, 0.1, name="head"), "head has node 5"),
        (lambda s: s.ball(0.5, 0.1), "whole numbers"),
        (lambda s: s.ball(0, 0.0), "ball 0: radius = 0.0"),
        (lambda s: s.ignore(s.rod([0, 1], 0.1), 1), "there is no object 1"),
        (
            lambda s: s.spin(s.rod([0, 1], 0.1), [0, 1, 3, 4]),
            "rod 0 spins: only obstacles spin, given by 4 nodes",
        ),
        (lambda s: s.spin(s.ball(0, 0.1, still=True), [0, 1, 3, 4]), "ball 0 spins: markers are at right angles about"),
        (
            lambda s: BroadPhase(s, wp.zeros(5, dtype=wp.vec3d, device="cpu"), search_distance=1.0, margin=1.0),
            "no objects",
        ),
        (
            lambda s: BroadPhase(s, wp.zeros(4, dtype=wp.vec3d, device="cpu"), search_distance=1.0, margin=1.0),
            "5 vectors of 3",
        ),
        (
            lambda s: BroadPhase(s, wp.zeros(5, dtype=wp.vec3d, device="cpu"), search_distance=0.0, margin=1.0),
            "search_distance = 0.0",
        ),
    ],
)
def test_invalid_shapes_are_refused_by_name(describe, message):
    with pytest.raises(SceneError, match=message):
        describe(CollisionMesh(POINTS))

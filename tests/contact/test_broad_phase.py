"""Candidates of contact: all that are near, by comparison with all pairs, none twice, and as long as they hold."""

import numpy as np
import pytest
import warp as wp
from brute_force import SIDES, listed, near, scene, upload

from ddg_warp import arrays
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.solve.contact import tree
from ddg_warp.solve.contact.broad_phase import BroadPhase
from ddg_warp.solve.contact.pairs import RunningSums
from ddg_warp.solve.contact.shapes import Shapes
from tests.pairwise import covering

REACH, MARGIN = 0.004, 0.01


def agree(search: BroadPhase, x: np.ndarray, sides=SIDES) -> None:
    """All that is near is listed once, and nothing that is farther than was searched for."""
    for found, side in zip(listed(search), sides, strict=True):
        pairs = [tuple(pair) for pair in found.tolist()]
        assert pairs == sorted(set(pairs))
        assert near(search.shapes, x, *side, REACH + MARGIN) <= set(pairs)
        assert set(pairs) <= near(search.shapes, x, *side, REACH + 1.002 * MARGIN)


@covering(1, dtype=(wp.vec3d, wp.vec3f), spread=(0.3, 1.0, 3.0))
def test_candidates_are_those_of_all_pairs(device, spread, dtype):
    shapes, points = scene(1, spread)
    search = BroadPhase(shapes, upload(points, device, dtype), reach=REACH, margin=MARGIN)
    agree(search, points.astype(np.float32) if dtype is wp.vec3f else points)
    assert all(len(found) > 10 for found in listed(search)) or spread > 1.0


def test_objects_that_ignore_each_other_are_no_pairs(device):
    shapes, points = scene(2, 0.3)
    x = upload(points, device)
    before = listed(BroadPhase(shapes, x, reach=REACH, margin=MARGIN))
    for pair in ((0, 1), (7, 3), (5, 5), (50, 51), (2, 52), (54, 54)):
        shapes.ignore(*pair)
    search = BroadPhase(shapes, x, reach=REACH, margin=MARGIN)
    agree(search, points)
    assert all(len(after) < len(all_of) for after, all_of in zip(listed(search), before, strict=True))


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("apart", [0.0, 0.35, 1.75, 3.45])
def test_edges_within_an_arc_length_are_no_pairs(device, closed, apart):
    """Of a circle of 40 edges, circumference 4: edges k apart have (k - 1) / 10 of arc between them."""
    n = 40
    angle = 2.0 * np.pi * np.arange(n) / n
    radius = 0.05 / np.sin(np.pi / n)
    points = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    shapes = Shapes(points)
    shapes.rod(np.arange(n), 0.01, closed=closed, apart=apart)
    (found,) = listed(BroadPhase(shapes, upload(points, device), reach=1.0, margin=1.0))
    i, j = np.triu_indices(n if closed else n - 1, 1)
    steps = np.minimum(j - i, n - (j - i)) if closed else j - i
    wanted = (steps > 1) & (0.1 * (steps - 1) >= apart)
    assert found.tolist() == np.column_stack([i, j])[wanted].tolist()


@pytest.mark.parametrize("most", [1, 2, 3, 5])
def test_bundles_change_nothing(device, monkeypatch, most):
    """However many edges share a leaf: the same pairs, in two worlds, and the same that cross."""
    shapes, points = scene(17, 0.3, rods=10, triangles=40)
    move = 0.05 * np.random.default_rng(18).normal(size=(2 * len(points), 3))
    found = []
    for bundle in (tree.BUNDLE, (most, most)):
        monkeypatch.setattr(tree, "BUNDLE", bundle)
        search = BroadPhase(shapes, upload(np.tile(points, (2, 1)), device), 2, reach=REACH, margin=MARGIN)
        x = upload(np.tile(points, (2, 1)), device)
        lists = [pairs.tolist() for pairs in listed(search)]
        search.crossings(x, upload(move, device))
        assert not search.fit(x)
        found.append((lists, search.crossed.numpy().tolist(), search.first_crossing()))
    assert found[0] == found[1]
    assert min(found[0][1]) > 10


def test_worlds_do_not_meet(device):
    shapes, points = scene(3, 0.3, rods=10, triangles=40)
    rng = np.random.default_rng(4)
    worlds = [points + 0.01 * rng.normal(size=points.shape) for _ in range(3)]
    together = BroadPhase(shapes, upload(np.concatenate(worlds), device), 3, reach=REACH, margin=MARGIN)
    for k, found in enumerate(listed(together)):
        pairs, parts = together.lists[k], []
        for w, x in enumerate(worlds):
            alone = listed(BroadPhase(shapes, upload(x, device), reach=REACH, margin=MARGIN))[k]
            parts.append(alone + w * np.array([pairs.first.count, pairs.second.count]))
        assert found.tolist() == np.concatenate(parts).tolist()
        assert min(map(len, parts)) > 5


def test_edges_that_coincide_or_are_parallel_are_found(device):
    """Sixty edges at one place, which no tree can tell apart, and twenty that lie side by side."""
    stacked = np.tile([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], (60, 1))
    beside = np.repeat(np.arange(20) * 0.01, 2)[:, None] * [0.0, 1.0, 0.0] + np.tile(
        [[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]], (20, 1)
    )
    points = np.concatenate([stacked, beside])
    shapes = Shapes(points)
    for k in range(80):
        shapes.rod([2 * k, 2 * k + 1], 0.003)
    search = BroadPhase(shapes, upload(points, device), reach=REACH, margin=MARGIN)
    agree(search, points, SIDES[:1])
    assert search.lists[0].count.numpy()[0] == 60 * 59 // 2 + 19 + 18


@pytest.mark.parametrize("room", [(10,), (10_000, 10), (10, 10)])
def test_lists_that_are_too_short_are_empty_until_they_have_grown(device, room):
    """Too short for pairs, for those whose boxes meet, or for both."""
    shapes, points = scene(5, 0.3)
    x = upload(points, device)
    search = BroadPhase(shapes, x, reach=REACH, margin=MARGIN)
    whole = listed(search)
    for pairs in search.lists:
        pairs.reserve(*room)
    search.search(x)
    assert search.overflow.numpy()[0] == 1
    assert not any(len(found) for found in listed(search))
    searches = search.searches.numpy()[0]
    search.update(x)
    assert search.searches.numpy()[0] == searches + 1  # it is out of date until there is room
    version = search.version
    assert search.fit(x)
    assert search.version > version
    assert [found.tolist() for found in listed(search)] == [found.tolist() for found in whole]
    assert not search.fit(x)


def test_where_one_list_is_too_short_others_that_are_all_but_full_grow_with_it(device):
    """So that graphs are captured anew once, not list by list: there is room for twice as many pairs as were found in each."""
    shapes, points = scene(5, 0.3)
    x = upload(points, device)
    search = BroadPhase(shapes, x, reach=REACH, margin=MARGIN)
    short, full, *_ = sorted(search.lists, key=lambda pairs: -pairs.count.numpy()[0])
    counts = [int(pairs.count.numpy()[0]) for pairs in (short, full)]
    assert min(counts) > 10
    short.reserve(10)
    full.reserve(counts[1])
    search.search(x)
    assert search.fit(x)
    assert [pairs.capacity for pairs in (short, full)] == [2 * count for count in counts]


@pytest.mark.parametrize("excess", [-1e-6, 1e-6])
def test_candidates_hold_until_half_of_the_margin_is_used_up(device, excess):
    """Two edges that approach each other from just beyond what is searched for: found as soon as they could be nearer than `reach`."""
    gap = REACH + 1.002 * MARGIN
    distance = 0.02 + gap
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, -0.5, distance], [0.5, 0.5, distance]])
    shapes = Shapes(points)
    shapes.rod([0, 1], 0.01)
    shapes.rod([2, 3], 0.01)
    search = BroadPhase(shapes, upload(points, device), reach=REACH, margin=MARGIN)
    assert not len(listed(search)[0])
    searches = search.searches.numpy()[0]
    moved = points.copy()
    moved[:2, 2] += (0.5 + excess) * MARGIN
    moved[2:, 2] -= (0.5 + excess) * MARGIN
    search.update(upload(moved, device))
    assert search.searches.numpy()[0] == searches + (excess > 0)
    assert len(listed(search)[0]) == (excess > 0)
    # where no new search was needed, what is not listed is farther apart than the reach
    assert near(shapes, moved, 2, 2, REACH) <= {tuple(pair) for pair in listed(search)[0].tolist()}


def test_what_no_thing_has_may_be_anywhere(device):
    """Blocks that are no places, as twists of edges: they never ask for a search, whatever they are."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    shapes = Shapes(points)
    shapes.rod([0, 1], 0.01)
    search = BroadPhase(shapes, upload(np.tile(points, (2, 1)), device), 2, reach=REACH, margin=MARGIN)
    for node, more in ((2, 0), (5, 0), (1, 1), (4, 1)):
        searches, x = search.searches.numpy()[0], np.tile(points, (2, 1))
        x[node, 0] += 2.0 * MARGIN
        search.update(upload(x, device))
        assert search.searches.numpy()[0] == searches + more
        search.search(upload(np.tile(points, (2, 1)), device))


def test_a_captured_update_follows_motion_and_searches_only_where_it_must(device):
    shapes, points = scene(6, 0.5, rods=20, triangles=60)
    x = upload(points, device)
    search = BroadPhase(shapes, x, reach=REACH, margin=MARGIN)
    arrays.load_kernels(search.kernels, device)
    with wp.ScopedCapture(device=device) as capture:
        search.update(x)
    rng, position = np.random.default_rng(7), points.copy()
    velocity = rng.normal(size=points.shape)
    velocity *= 0.3 * MARGIN / np.linalg.norm(velocity, axis=1, keepdims=True)
    before = search.searches.numpy()[0]
    for step in range(1, 7):
        position += velocity
        x.assign(position)
        wp.capture_launch(capture.graph)
        assert not search.fit(x)
        assert search.searches.numpy()[0] == before + step // 2
        for found, side in zip(listed(search), SIDES, strict=True):
            assert near(shapes, position, *side, REACH) <= {tuple(pair) for pair in found.tolist()}
    search.search(x)
    agree(search, position)
    search.rebuild(x)
    search.search(x)
    agree(search, position)


def test_a_captured_motion_is_that_without_a_graph(device):
    shapes, points = scene(13, 0.5, rods=20, triangles=60)
    rng = np.random.default_rng(14)
    x, move = upload(points, device), upload(0.02 * rng.normal(size=points.shape), device)
    search = BroadPhase(shapes, x, reach=REACH, margin=MARGIN)
    arrays.load_kernels(search.kernels, device)

    def step():
        search.rebuild(x)
        search.update(x)
        search.measure(x)
        search.impact(x, move, keep=0.5)
        search.crossings(x, move)

    def results() -> list[bytes]:
        numbers = (search.gap, search.time, search.crossed)
        return [part.tobytes() for part in (*listed(search), *(array.numpy() for array in numbers))]

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
def test_running_sums(device, count):
    values = np.random.default_rng(15).integers(0, 9, count)
    sums = RunningSums(wp.array(values, dtype=int, device=device))
    sums()
    assert sums.starts.numpy().tolist() == (np.cumsum(values) - values).tolist()


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_boxes_hold_what_they_are_around(device, offset):
    """In exact numbers: a float64 that float32 can not have lies inside, and no farther than rounding."""
    shapes, points = scene(16, 1.0, rods=20, triangles=60)
    points = points + offset
    x = upload(points, device)
    lost = wp.zeros(1, dtype=int, device=device)
    for size in shapes.sizes:
        nodes, radius, *_ = shapes.things(size)
        radii = wp.array([shapes.radii], dtype=wp.float64, device=device)
        part = tree.Things(shapes, size, 1, wp.float64, wp.get_device(device), radii)
        part.enclose(x, wp.zeros_like(x), wp.zeros(1, dtype=wp.vec3d, device=device), 1.0, 0.002, lost)
        reach = (radius + 0.002)[:, None]
        below = points[nodes].min(1) - reach - part.lower.numpy().astype(float)
        above = part.upper.numpy().astype(float) - points[nodes].max(1) - reach
        assert min(below.min(), above.min()) > 0.0
        assert max(below.max(), above.max()) <= 5e-7 * (2.0 + offset)


def test_two_runs_are_the_same_to_the_bit(device):
    shapes, points = scene(8, 0.5)
    x = upload(points, device)
    move = upload(0.01 * np.random.default_rng(9).normal(size=points.shape), device)

    def run() -> list[bytes]:
        search = BroadPhase(shapes, x, reach=REACH, margin=MARGIN)
        search.measure(x)
        search.impact(x, move, keep=0.0)
        search.crossings(x, move)
        numbers = (search.gap, search.time, search.crossed)
        return [part.tobytes() for part in (*listed(search), *(array.numpy() for array in numbers))]

    assert run() == run()


def test_order_of_objects_is_irrelevant(device):
    rng = np.random.default_rng(10)
    _, points = scene(11, 0.3, rods=12, triangles=30)
    rods = [range(21 * r, 21 * r + 21) for r in range(12)]
    triangles = 252 + np.arange(90).reshape(-1, 3)

    def found(order) -> set:
        shapes = Shapes(points)
        for k in order:
            if k == 12:
                shapes.shell(triangles, 0.004)
            else:
                shapes.rod(np.array(rods[k]), 0.004)
        search = BroadPhase(shapes, upload(points, device), reach=REACH, margin=MARGIN)
        result = set()
        for pairs, part in zip(search.lists, listed(search), strict=True):
            nodes = [shapes.things(side.size)[0] for side in (pairs.first, pairs.second)]
            result |= {frozenset((tuple(sorted(nodes[0][i])), tuple(sorted(nodes[1][j])))) for i, j in part.tolist()}
        return result

    first = found(range(13))
    assert len(first) > 50
    assert found(rng.permutation(13)) == first


def test_positions_that_are_not_finite_are_refused_by_name(device):
    shapes, points = scene(12, 1.0, rods=4, triangles=4)
    x = upload(np.concatenate([points, points]), device)
    search = BroadPhase(shapes, x, 2, reach=REACH, margin=MARGIN)
    broken = np.concatenate([points, points])
    broken[len(points) + 17, 1] = np.nan
    x.assign(broken)
    search.update(x)
    with pytest.raises(SolverError, match="node 17 of world 1"):
        search.check()
    x.assign(np.concatenate([points, points]))
    search.update(x)
    search.check()
    after = [found.tolist() for found in listed(search)]
    assert after == [found.tolist() for found in listed(BroadPhase(shapes, x, 2, reach=REACH, margin=MARGIN))]


POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.mark.parametrize(
    ("describe", "message"),
    [
        (lambda s: s.rod([0, 1, 2, 3], 0.1, name="cable"), "edge 1 of cable has zero length"),
        (lambda s: s.rod([0], 0.1), "rod 0 has 1 nodes; it needs at least 2"),
        (lambda s: s.rod([0, 1], 0.0), "rod 0: radius = 0.0"),
        (lambda s: s.rod([0, 1], 0.1, apart=-1.0), "apart = -1.0"),
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
            "rod 0 spins: that is of an obstacle, and told by 4 nodes",
        ),
        (lambda s: s.spin(s.ball(0, 0.1, still=True), [0, 1, 3, 4]), "ball 0 spins: markers are at right angles about"),
        (lambda s: BroadPhase(s, wp.zeros(5, dtype=wp.vec3d, device="cpu"), reach=1.0, margin=1.0), "no objects"),
        (lambda s: BroadPhase(s, wp.zeros(4, dtype=wp.vec3d, device="cpu"), reach=1.0, margin=1.0), "5 vectors of 3"),
        (lambda s: BroadPhase(s, wp.zeros(5, dtype=wp.vec3d, device="cpu"), reach=0.0, margin=1.0), "reach = 0.0"),
    ],
)
def test_what_can_not_be_searched_is_refused_by_name(describe, message):
    with pytest.raises(SceneError, match=message):
        describe(Shapes(POINTS))

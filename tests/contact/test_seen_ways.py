"""How long candidates of a motion hold: all that is near is among them wherever on their ways, or beside them, nodes are."""

import numpy as np
import pytest
import warp as wp
from brute_force import SIDES, listed, near, scene, upload
from motion_cases import MARGIN, REACH, Motion, tangle

from ddg_warp.kernels.contact.motion import AHEAD
from ddg_warp.solve.contact.broad_phase import BroadPhase
from ddg_warp.solve.contact.shapes import Shapes
from tests.pairwise import covering


def beside(rng, count: int, most: float) -> np.ndarray:
    """Displacements (count, 3) of a length of `most`, in all directions."""
    way = rng.normal(size=(count, 3))
    return most * way / np.linalg.norm(way, axis=1, keepdims=True)


def searched(shapes: Shapes, x: wp.array, move: wp.array, together: int = 0) -> BroadPhase:
    """A search for a motion, with room for what it has found."""
    search = BroadPhase(shapes, x, reach=REACH, margin=MARGIN)
    flag = wp.full(1, together, dtype=int, device=x.device)
    search.search(x, move, flag)
    if search.fit(x):
        search.search(x, move, flag)
    return search


def held(search: BroadPhase, x: np.ndarray) -> int:
    """How many pairs are within reach at x, all of which are candidates."""
    count = 0
    for side, found in zip(SIDES, listed(search), strict=True):
        wanted = near(search.shapes, x, *side, REACH)
        assert wanted <= {tuple(pair) for pair in found.tolist()}
        count += len(wanted)
    return count


@covering(1, dtype=(wp.vec3d, wp.vec3f), kind=("node", "object"))
def test_a_motion_that_was_cut_goes_on_without_another_search(device, kind, dtype):
    """By ten margins, in pieces, with what was cut going on towards its end or beside it; nothing passes."""
    shapes, points = tangle(5)
    rng = np.random.default_rng(21)
    motion = Motion(shapes, points, device, kind, dtype=dtype)
    move = rng.normal(size=(motion.units, 3))[motion.unit.numpy()] * 6.0 * MARGIN
    at = motion(move).astype(float)
    assert (motion.search.shares.numpy() < 1.0).sum() > 3
    first = motion.search.searches.numpy()[0]
    alone = listed(BroadPhase(shapes, upload(at, device, dtype), reach=REACH, margin=MARGIN))
    for part in (0.05, 0.1, 0.2, 0.5, 1.0):
        motion.base.assign(at)
        at = motion(part * (points + move - at)).astype(float)
        assert not any(near(shapes, at, *side, 0.0) for side in SIDES)
        count = held(motion.search, at)
        wide = at + beside(rng, len(at), 0.49 * MARGIN)
        motion.search.update(upload(wide, device, dtype))
        count += held(motion.search, wide)
        assert count > 20
    assert motion.search.searches.numpy()[0] == first
    # what was near when the motion was cut would not do
    missed = [
        near(shapes, at, *side, REACH) - {tuple(p) for p in found.tolist()}
        for side, found in zip(SIDES, alone, strict=True)
    ]
    assert sum(map(len, missed)) > 2


def test_candidates_are_those_of_any_place_in_the_tubes(device):
    shapes, points = scene(22, 0.6, rods=20, triangles=60)
    rng = np.random.default_rng(23)
    move = 2.0 * MARGIN * rng.normal(size=points.shape)
    search = searched(shapes, upload(points, device), upload(move, device))
    searches = search.searches.numpy()[0]
    count = 0
    for k in range(20):
        shares = rng.uniform(size=(len(points), 1)) ** rng.choice([0.2, 1.0, 5.0])
        x = points + shares * move + beside(rng, len(points), (0.4999, 0.25)[k % 2] * MARGIN)
        search.update(upload(x, device))
        count += held(search, x)
    assert search.searches.numpy()[0] == searches
    assert count > 200


@pytest.mark.parametrize("excess", [-1e-6, 1e-6])
@pytest.mark.parametrize(
    ("share", "off"),
    [(0.3, [0.0, 0.6, 0.8]), (0.0, [-0.48, 0.6, 0.64]), (1.0, [1.0, 0.0, 0.0]), (1.0, [0.6, 0.8, 0.0])],
)
@pytest.mark.parametrize("place", ["base", "q"])
def test_a_node_beside_its_way_by_half_of_the_margin_asks_for_a_search(device, excess, share, off, place):
    """Off the middle of its way across it, or off an end of it to any side that leads away."""
    points = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    shapes = Shapes(points)
    shapes.rod([0, 1], 0.01)
    move = np.array([[5.0 * MARGIN, 0.0, 0.0]] * 2)
    search = searched(shapes, upload(points, device), upload(move, device))
    searches = search.searches.numpy()[0]
    there = points + share * move
    there[1] += (0.5 + excess) * MARGIN * np.array(off)
    at, other = upload(there, device), upload(points + 0.7 * move, device)
    search.update(*((at, other) if place == "base" else (other, at)))
    assert search.searches.numpy()[0] == searches + (excess > 0.0)


def test_what_goes_together_is_seen_where_it_has_come_to(device):
    """As other shares than one were not asked for: not at the start of a motion, nor beyond where a filter has cut it."""
    shapes, points = tangle(24)
    move = np.random.default_rng(25).normal(size=points.shape) * 4.0 * MARGIN
    x, end = upload(points, device), upload(points + move, device)
    for together in (0, 1):
        search = searched(shapes, x, upload(move, device), together)
        searches = search.searches.numpy()[0]
        search.update(end)
        assert search.searches.numpy()[0] == searches
        search.update(x)
        assert search.searches.numpy()[0] == searches + together
    motion = Motion(shapes, points, device, together=(0,))
    landing = motion(move)
    assert 0.0 < motion.search.time.numpy()[0] < 1.0
    searches = motion.search.searches.numpy()[0]
    motion.search.update(upload(landing, device))
    assert motion.search.searches.numpy()[0] == searches
    motion.search.update(end)
    assert motion.search.searches.numpy()[0] == searches + 1


@pytest.mark.parametrize("turn", [0.0, 0.02, 0.2])
def test_half_spaces_that_move_and_turn_are_seen_from_afar(device, turn):
    """Points up to 3 m from the nodes of a plane, which go along with it, each its own share, or stay."""
    rng = np.random.default_rng(26)
    _, points = scene(27, 3.0, rods=60, nodes=11, triangles=1)
    points = points[:660] * [1.0, 1.0, 0.1]
    frame = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    shapes = Shapes(np.concatenate([points, frame]))
    for r in range(60):
        shapes.rod(11 * r + np.arange(11), 0.004)
    shapes.plane([660, 661, 662])
    move = np.tile([0.0, 0.01, 0.05], (663, 1)) * rng.choice([0.0, 1.0], (663, 1))
    c, s = np.cos(turn), np.sin(turn)
    move[660:] = [0.0, 0.01, 0.05] + frame @ np.array([[c - 1.0, 0.0, -s], [0.0, 0.0, 0.0], [s, 0.0, c - 1.0]])
    search = searched(shapes, upload(shapes.points, device), upload(move, device))
    listing = search.lists[-1]
    found = {i for i, _ in listing.pairs.numpy()[: listing.count.numpy()[0]].tolist()}
    assert len(found) < 600
    count = 0
    for _ in range(30):
        shares = rng.uniform(size=(663, 1)) ** rng.choice([0.2, 1.0, 5.0])
        shares[660:] = rng.uniform()
        x = shapes.points + shares * move + beside(rng, 663, 0.5 * MARGIN)
        n = np.cross(x[661] - x[660], x[662] - x[660])
        gap = (x[:660] - x[660]) @ n / np.linalg.norm(n) - 0.004
        close = set(np.flatnonzero(gap <= REACH).tolist())
        assert close <= found
        count += len(close)
    assert count > 100


@pytest.mark.parametrize("dtype", [wp.vec3d, wp.vec3f])
def test_a_search_serves_the_next_motion(device, dtype):
    """What goes on as it went is not searched for again, and all that is near in the second motion is known; the third one is new."""
    shapes, points = scene(31, 0.6, rods=20, triangles=60)
    rng = np.random.default_rng(32)
    speed = 2.0 * MARGIN * rng.normal(size=points.shape)
    for together, expected in ((0, [1, 0, 1, 0]), (1, [1, 1, 1, 1])):
        search = BroadPhase(shapes, upload(points, device, dtype), reach=REACH, margin=MARGIN)
        flag, found, count = wp.full(1, together, dtype=int, device=device), [], 0
        for step in range(4):
            base, q = points + step * speed, points + (step + 1) * speed
            bends = beside(rng, len(points), 0.4 * MARGIN) if step == 1 else 0.0
            given = [upload(x, device, dtype) for x in (base, q + bends)]
            before = int(search.searches.numpy()[0])
            search.update(*given, flag)
            found.append(int(search.searches.numpy()[0]) - before)
            if search.fit(given[0]):  # there is room now
                search.search(given[0], upload(AHEAD * speed, device, dtype))
            if not together:
                for share in (0.3, 1.0):
                    count += held(search, base + share * (q + bends - base))
        assert found == expected
        assert together or count > 50

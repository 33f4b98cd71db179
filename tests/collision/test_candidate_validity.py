"""Validity of candidates of a motion: all near pairs, anywhere along the motion and up to half the margin away."""

import numpy as np
import pytest
import warp as wp
from brute_force import SIDES, candidate_pairs, near_pairs, scene, upload
from motion_cases import MARGIN, REACH, Motion, tangle

from ddg_warp.kernels.collision.broad_phase.candidate_validity import AHEAD
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import CollisionMesh
from tests.pairwise import covering


def random_offsets(rng, count: int, most: float) -> np.ndarray:
    """Return displacements (count, 3) of length `most` in random directions."""
    direction = rng.normal(size=(count, 3))
    return most * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def search_motion(shapes: CollisionMesh, x: wp.array, move: wp.array, together: int = 0) -> BroadPhase:
    """Return a search for a motion, with room for all pairs."""
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    flag = wp.full(1, together, dtype=int, device=x.device)
    search.search(x, move, flag)
    if search.fit(x):
        search.search(x, move, flag)
    return search


def count_near_pairs(search: BroadPhase, x: np.ndarray) -> int:
    """Assert that all pairs within reach at x are candidates, and return the number."""
    count = 0
    for side, candidates in zip(SIDES, candidate_pairs(search), strict=True):
        wanted = near_pairs(search.shapes, x, *side, REACH)
        assert wanted <= {tuple(pair) for pair in candidates.tolist()}
        count += len(wanted)
    return count


@covering(1, dtype=(wp.vec3d, wp.vec3f), kind=("node", "object"))
def test_cut_motion_continues_without_a_new_search(device, kind, dtype):
    """A motion of ten margins is cut, then continues in pieces towards the end or aside without a search; no pair crosses."""
    shapes, points = tangle(5)
    rng = np.random.default_rng(21)
    motion = Motion(shapes, points, device, kind, dtype=dtype)
    move = rng.normal(size=(motion.num_ccd_bodies, 3))[motion.ccd_body.numpy()] * 6.0 * MARGIN
    positions = motion(move).astype(float)
    assert (motion.search.shares.numpy() < 1.0).sum() > 3
    first = motion.search.counters.searches.numpy()[0]
    alone = candidate_pairs(BroadPhase(shapes, upload(positions, device, dtype), search_distance=REACH, margin=MARGIN))
    for fraction in (0.05, 0.1, 0.2, 0.5, 1.0):
        motion.base.assign(positions)
        positions = motion(fraction * (points + move - positions)).astype(float)
        assert not any(near_pairs(shapes, positions, *side, 0.0) for side in SIDES)
        count = count_near_pairs(motion.search, positions)
        wide = positions + random_offsets(rng, len(positions), 0.49 * MARGIN)
        motion.search.update(upload(wide, device, dtype))
        count += count_near_pairs(motion.search, wide)
        assert count > 20
    assert motion.search.counters.searches.numpy()[0] == first
    # candidates made where the motion was cut would not suffice
    missed = [
        near_pairs(shapes, positions, *side, REACH) - {tuple(p) for p in candidates.tolist()}
        for side, candidates in zip(SIDES, alone, strict=True)
    ]
    assert sum(map(len, missed)) > 2


def test_candidates_are_complete_within_half_the_margin_of_the_motion(device):
    shapes, points = scene(22, 0.6, rods=20, triangles=60)
    rng = np.random.default_rng(23)
    move = 2.0 * MARGIN * rng.normal(size=points.shape)
    search = search_motion(shapes, upload(points, device), upload(move, device))
    searches = search.counters.searches.numpy()[0]
    count = 0
    for k in range(20):
        fractions = rng.uniform(size=(len(points), 1)) ** rng.choice([0.2, 1.0, 5.0])
        x = points + fractions * move + random_offsets(rng, len(points), (0.4999, 0.25)[k % 2] * MARGIN)
        search.update(upload(x, device))
        count += count_near_pairs(search, x)
    assert search.counters.searches.numpy()[0] == searches
    assert count > 200


@pytest.mark.parametrize("excess", [-1e-6, 1e-6])
@pytest.mark.parametrize(
    ("fraction", "off"),
    [(0.3, [0.0, 0.6, 0.8]), (0.0, [-0.48, 0.6, 0.64]), (1.0, [1.0, 0.0, 0.0]), (1.0, [0.6, 0.8, 0.0])],
)
@pytest.mark.parametrize("argument", ["base", "q"])
def test_search_starts_beyond_half_the_margin_off_the_motion(device, excess, fraction, off, argument):
    """A node is aside of the middle of a motion, or off an end to any outward side."""
    points = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    shapes = CollisionMesh(points)
    shapes.rod([0, 1], 0.01)
    move = np.array([[5.0 * MARGIN, 0.0, 0.0]] * 2)
    search = search_motion(shapes, upload(points, device), upload(move, device))
    searches = search.counters.searches.numpy()[0]
    displaced = points + fraction * move
    displaced[1] += (0.5 + excess) * MARGIN * np.array(off)
    current, elsewhere = upload(displaced, device), upload(points + 0.7 * move, device)
    search.update(*((current, elsewhere) if argument == "base" else (elsewhere, current)))
    assert search.counters.searches.numpy()[0] == searches + (excess > 0.0)


def test_candidates_of_a_common_motion_hold_at_its_end_alone(device):
    """Candidates of a common motion hold neither at the start of the motion nor beyond the point of a cut."""
    shapes, points = tangle(24)
    move = np.random.default_rng(25).normal(size=points.shape) * 4.0 * MARGIN
    x, end = upload(points, device), upload(points + move, device)
    for together in (0, 1):
        search = search_motion(shapes, x, upload(move, device), together)
        searches = search.counters.searches.numpy()[0]
        search.update(end)
        assert search.counters.searches.numpy()[0] == searches
        search.update(x)
        assert search.counters.searches.numpy()[0] == searches + together
    motion = Motion(shapes, points, device, together=(0,))
    landing = motion(move)
    assert 0.0 < motion.search.time.numpy()[0] < 1.0
    searches = motion.search.counters.searches.numpy()[0]
    motion.search.update(upload(landing, device))
    assert motion.search.counters.searches.numpy()[0] == searches
    motion.search.update(end)
    assert motion.search.counters.searches.numpy()[0] == searches + 1


@pytest.mark.parametrize("angle", [0.0, 0.02, 0.2])
def test_moving_half_spaces_find_distant_points(device, angle):
    """Points up to 3 m from the nodes of a plane move along by separate fractions, or stay."""
    rng = np.random.default_rng(26)
    _, points = scene(27, 3.0, rods=60, nodes=11, triangles=1)
    points = points[:660] * [1.0, 1.0, 0.1]
    frame = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    shapes = CollisionMesh(np.concatenate([points, frame]))
    for r in range(60):
        shapes.rod(11 * r + np.arange(11), 0.004)
    shapes.plane([660, 661, 662])
    move = np.tile([0.0, 0.01, 0.05], (663, 1)) * rng.choice([0.0, 1.0], (663, 1))
    c, s = np.cos(angle), np.sin(angle)
    move[660:] = [0.0, 0.01, 0.05] + frame @ np.array([[c - 1.0, 0.0, -s], [0.0, 0.0, 0.0], [s, 0.0, c - 1.0]])
    search = search_motion(shapes, upload(shapes.points, device), upload(move, device))
    listing = search.lists[-1]
    candidates = {i for i, _ in listing.pairs.numpy()[: listing.count.numpy()[0]].tolist()}
    assert len(candidates) < 600
    count = 0
    for _ in range(30):
        fractions = rng.uniform(size=(663, 1)) ** rng.choice([0.2, 1.0, 5.0])
        fractions[660:] = rng.uniform()
        x = shapes.points + fractions * move + random_offsets(rng, 663, 0.5 * MARGIN)
        n = np.cross(x[661] - x[660], x[662] - x[660])
        gap = (x[:660] - x[660]) @ n / np.linalg.norm(n) - 0.004
        close = set(np.flatnonzero(gap <= REACH).tolist())
        assert close <= candidates
        count += len(close)
    assert count > 100


@pytest.mark.parametrize("dtype", [wp.vec3d, wp.vec3f])
def test_search_serves_the_next_motion(device, dtype):
    """A motion that continues as before needs no search, with all near pairs known; the third motion is new."""
    shapes, points = scene(31, 0.6, rods=20, triangles=60)
    rng = np.random.default_rng(32)
    speed = 2.0 * MARGIN * rng.normal(size=points.shape)
    for together, expected in ((0, [1, 0, 1, 0]), (1, [1, 1, 1, 1])):
        search = BroadPhase(shapes, upload(points, device, dtype), search_distance=REACH, margin=MARGIN)
        flag, counts, count = wp.full(1, together, dtype=int, device=device), [], 0
        for step in range(4):
            base, q = points + step * speed, points + (step + 1) * speed
            bends = random_offsets(rng, len(points), 0.4 * MARGIN) if step == 1 else 0.0
            motion_ends = [upload(x, device, dtype) for x in (base, q + bends)]
            before = int(search.counters.searches.numpy()[0])
            search.update(*motion_ends, flag)
            counts.append(int(search.counters.searches.numpy()[0]) - before)
            if search.fit(motion_ends[0]):  # there is room now
                search.search(motion_ends[0], upload(AHEAD * speed, device, dtype))
            if not together:
                for fraction in (0.3, 1.0):
                    count += count_near_pairs(search, base + fraction * (q + bends - base))
        assert counts == expected
        assert together or count > 50

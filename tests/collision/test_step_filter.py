"""CCD step fractions: no pair crosses, no motion is limited needlessly, and searches along motions find all pairs."""

import numpy as np
import pytest
import warp as wp
from brute_force import SIDES, candidate_pairs, near_pairs, scene, upload
from motion_cases import MARGIN, REACH, Motion, ccd_bodies, tangle
from test_additive_ccd import gaps, random_pairs

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.collision.ccd.additive_ccd import NEAR, REST
from ddg_warp.kernels.collision.ccd.step_fractions import ROUNDS
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import CollisionMesh
from tests.pairwise import covering


def allowed_closing(gap: float) -> float:
    """Return how far a gap may close at once [m]: to `SLEEP` of the gap, or to `NEAR` of gap or reach where that is more."""
    return gap - max(REST * gap, NEAR * min(gap, REACH))


def random_displacements(shapes: CollisionMesh, rng, size: float, kind: str) -> np.ndarray:
    """Return random displacements of nodes, or of objects with a tenth of node motion added."""
    move = rng.normal(size=shapes.points.shape)
    if kind != "node":
        ccd_body, num_ccd_bodies = ccd_bodies(shapes, "object")
        move = rng.normal(size=(num_ccd_bodies, 3))[ccd_body] + 0.1 * move
    return size * move


@covering(1, dtype=(wp.vec3d, wp.vec3f), size=(0.01, 0.5), kind=("node", "object", "world"))
def test_limited_motions_close_no_gap_and_never_cross(device, kind, size, dtype):
    """Three motions follow each other, each once to fifty times the margin."""
    shapes, points = tangle(5)
    motion, rng = Motion(shapes, points, device, kind, dtype=dtype), np.random.default_rng(6)
    rounding = 1e-12 if dtype is wp.vec3d else 1e-6
    for _ in range(3):
        base, move = motion.base.numpy().astype(float), random_displacements(shapes, rng, size, kind)
        landing = motion(move).astype(float)
        search, fractions = motion.search, motion.search.shares.numpy()
        assert (
            fractions.shape == (motion.num_ccd_bodies,)
            and 0.0 < fractions.min() == search.time.numpy()[0] <= fractions.max() <= 1.0
        )
        assert search.limited.numpy()[0] == (fractions < 1.0).sum()
        assert landing == pytest.approx(
            base + fractions[motion.ccd_body.numpy()][:, None] * move, rel=rounding, abs=rounding
        )
        for t in np.linspace(0.0, 1.0, 5):
            for side in SIDES:
                assert not near_pairs(shapes, base + t * (landing - base), *side, 0.0)
        search.crossings(motion.base, upload(landing - base, device, dtype))
        assert search.crossed.numpy()[0] == 0
        # candidates are valid at the end of the motion
        for side, candidates in zip(SIDES, candidate_pairs(search), strict=True):
            assert near_pairs(shapes, landing, *side, REACH) <= {tuple(pair) for pair in candidates.tolist()}
        searches = search.counters.searches.numpy()[0]
        search.update(upload(landing + 0.49 * MARGIN / np.sqrt(3.0), device, dtype))
        assert search.counters.searches.numpy()[0] == searches
        motion.base.assign(landing)
    if size == 0.5:
        assert fractions.min() < 0.1


@covering(1, name=("edges", "point and triangle"), kind=("node", "object", "world"))
def test_random_pairs_stop_in_time_and_close_by(device, name, kind):
    """Random pairs, one in each of 300 worlds, are sampled densely in time: pairs without initial overlap stay separate."""
    shapes, x, move = random_pairs(name, 2, 300)
    motion = Motion(shapes, x.reshape(-1, 3), device, kind, worlds=len(x))
    landing = motion(move.reshape(-1, 3)).reshape(x.shape)
    time = motion.search.time.numpy()
    gap = np.array([gaps(shapes, name, x + t * move) for t in np.linspace(0.0, 1.0, 501)])
    free = (gap[0] > 0.0).all(0)
    hit = (gap <= 0.0).any(1).any(0) & free
    shortened = np.array([gaps(shapes, name, x + t * (landing - x)) for t in np.linspace(0.0, 1.0, 501)])
    assert (shortened[..., free] > 0.0).all()
    assert hit.sum() > 30 and (time[hit] < 1.0).all() and (time[~free] == 0.0).all()
    left, start = (all_of[..., hit].min(0) for all_of in (shortened.min(0), gap[0]))
    assert np.median(left / start) < 0.4


@pytest.mark.parametrize("kind", ["node", "object", "world"])
def test_common_translation_is_not_limited(device, kind):
    """The translation is a thousand times the distance of objects, with small random node motion added."""
    shapes, points = tangle(7)
    rng = np.random.default_rng(8)
    motion = Motion(shapes, points, device, kind, together=(0,) if kind != "world" else ())
    wanted = np.array([3.0, -2.0, 1.0]) + 1e-7 * rng.normal(size=points.shape)
    landing = motion(wanted)
    assert landing.tobytes() == (points + wanted).tobytes()
    assert motion.search.time.numpy()[0] == 1.0 and motion.search.limited.numpy()[0] == 0


def test_common_motion_needs_no_more_candidates_than_rest(device):
    """Separate step fractions need more than 30 times as many candidates for a motion of fifty margins."""
    shapes, points = tangle(9)
    move = np.tile([0.3, 0.4, 0.0], (len(points), 1))
    x, step = upload(points, device), upload(move, device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    rest = [candidates.tolist() for candidates in candidate_pairs(search)]
    search.search(x, step, wp.ones(1, dtype=int, device=device))
    assert [candidates.tolist() for candidates in candidate_pairs(search)] == rest
    search.search(x, step)
    while search.fit(x):
        search.search(x, step)
    assert len(candidate_pairs(search)[0]) > 30 * len(rest[0])


def test_one_tight_pair_limits_no_other_body(device):
    """A thousand rods side by side sink by three spacings; the first two, crossed by a fixed rod, stop alone."""
    n, spacing = 1000, 0.05
    y = spacing * np.arange(n)
    points = np.array([[[-0.01, offset, 0.0], [0.01, offset, 0.0]] for offset in y]).reshape(-1, 3)
    points = np.concatenate([points, [[0.0, -0.5 * spacing, -0.03], [0.0, 1.5 * spacing, -0.03]]])
    shapes = CollisionMesh(points)
    for k in range(n + 1):
        shapes.rod([2 * k, 2 * k + 1], 0.005, still=k == n)
    motion = Motion(shapes, points, device)
    move = np.zeros_like(points)
    move[:-2, 2] = -3.0 * spacing
    landing = motion(move)
    fractions = motion.search.shares.numpy()
    # the gap of 0.02 may close by nine tenths
    assert fractions[:2] == pytest.approx(allowed_closing(0.02) / (3.0 * spacing), rel=1e-9)
    assert (fractions[2:n] == 1.0).all()
    assert motion.search.limited.numpy()[0] == 3
    assert (landing[4:] == (points + move)[4:]).all()


@pytest.mark.parametrize("layers", [40, ROUNDS + 10])
def test_falling_layers_stop_one_after_another(device, layers):
    """Crossed layers fall on the floor by five spacings: up to `ROUNDS` layers, upper layers go farther than the first."""
    spacing = 0.02
    ends = np.array([[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]])
    points = np.concatenate(
        [(ends[:, [1, 0, 2]] if k % 2 else ends) + [0.0, 0.0, spacing * (k + 1)] for k in range(layers)]
    )
    points = np.concatenate([points, [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]]])
    shapes = CollisionMesh(points)
    for k in range(layers):
        shapes.rod([2 * k, 2 * k + 1], 0.004)
    shapes.shell([[2 * layers, 2 * layers + 1, 2 * layers + 2]], 1e-3, still=True)
    motion = Motion(shapes, points, device)
    move = np.zeros_like(points)
    move[: 2 * layers, 2] = -5.0 * spacing
    landing = motion(move)
    fractions = motion.search.shares.numpy()[:layers]
    height = landing[: 2 * layers : 2, 2]
    assert (np.diff(height) > 0.008).all() and height[0] > 0.0045
    first = allowed_closing(spacing - 0.0045) / (5.0 * spacing)
    assert fractions[0] == motion.search.time.numpy()[0] == pytest.approx(first, rel=1e-9)
    if layers > ROUNDS:
        assert (fractions == fractions[0]).all()
    else:
        assert (fractions[1:] > 1.1 * fractions[0]).all() and fractions[-1] > 2.0 * fractions[0]


def test_worlds_have_separate_step_fractions(device):
    """A world with a common motion has the smallest fraction throughout; a world at rest has fraction 1."""
    shapes, points = tangle(10)
    move = random_displacements(shapes, np.random.default_rng(11), 0.05, "object")
    alone = Motion(shapes, points, device)
    landing = alone(move)
    everywhere = np.concatenate([move, move, 0.0 * move])
    motion = Motion(shapes, np.tile(points, (3, 1)), device, worlds=3, together=(1,))
    base = motion.base.numpy()
    result = motion(everywhere).reshape(3, -1, 3)
    fractions = motion.search.shares.numpy().reshape(3, -1)
    assert result[0].tobytes() == landing.tobytes()
    motion.search.impact(motion.base, upload(base + everywhere - base, device))
    first = motion.search.time.numpy()
    np.testing.assert_allclose(fractions[1], first[1], rtol=1e-14)
    assert (fractions[1] == fractions[1, 0]).all() and 0.0 < first[1] < 1.0
    assert first[1] <= (1.0 + 1e-14) * fractions[0].min() and fractions[0].max() == 1.0
    assert (fractions[2] == 1.0).all() and (result[2] == points).all()


@pytest.mark.parametrize("together", [False, True])
def test_search_along_a_motion_finds_pairs_of_any_step_fractions(device, together):
    shapes, points = scene(12, 0.6, rods=20, triangles=60)
    rng = np.random.default_rng(13)
    move = random_displacements(shapes, rng, 2.0 * MARGIN, "object")
    x, step = upload(points, device), upload(move, device)
    search = BroadPhase(shapes, x, search_distance=REACH, margin=MARGIN)
    flags = wp.full(1, int(together), dtype=int, device=device)
    search.search(x, step, flags)
    if search.fit(x):
        search.search(x, step, flags)
    candidates = [{tuple(pair) for pair in pairs.tolist()} for pairs in candidate_pairs(search)]
    for k in range(20):
        fractions = (
            np.full((1, 1), k / 19.0) if together else rng.uniform(size=(len(points), 1)) ** rng.choice([0.2, 1.0, 5.0])
        )
        for side, pairs in zip(SIDES, candidates, strict=True):
            assert near_pairs(shapes, points + fractions * move, *side, REACH + MARGIN) <= pairs


def test_captured_filter_equals_uncaptured(device):
    shapes, points = tangle(14)
    small, large = (random_displacements(shapes, np.random.default_rng(15), size, "object") for size in (1e-3, 0.05))

    def run(captured: bool) -> list:
        motion = Motion(shapes, points, device)
        motion(large)  # let lists grow for the large motion
        motion.search.rebuild(motion.base)
        motion.search.search(motion.base)
        step = motion.launch
        if captured:
            device_arrays.load_kernels(motion.search.kernels, device)
            with wp.ScopedCapture(device=device) as capture:
                motion.launch()
            step = lambda: wp.capture_launch(capture.graph)  # noqa: E731
        result = []
        for move in (small, large, 0.5 * small):
            motion.q.assign(motion.base.numpy() + move)
            step()
            result += motion.results() + [part.tobytes() for part in candidate_pairs(motion.search)]
            motion.base.assign(motion.q.numpy())
        assert not motion.search.counters.overflow.numpy()[0]
        return [*result, motion.search.counters.searches.numpy()[0]]

    plain = run(False)
    assert run(False) == plain
    assert run(True) == plain


def test_overflowing_lists_stop_all_motion(device):
    shapes, points = tangle(16)
    motion = Motion(shapes, points, device)
    for pairs in motion.search.lists:
        pairs.reserve(10)
    motion.q.assign(points + random_displacements(shapes, np.random.default_rng(17), 0.05, "object"))
    motion.launch()
    used = motion.ccd_body.numpy() >= 0
    assert (motion.q.numpy()[used] == points[used]).all()
    assert motion.search.time.numpy()[0] == 0.0 and motion.search.counters.overflow.numpy()[0] == 1


def test_smallest_gaps(device):
    gap = np.array([1e-6, 1e-3, 1.0])
    points = []
    for k, g in enumerate(gap):
        points += [[0, 10 * k, 0], [1, 10 * k, 0], [0, 10 * k, 0.02 + g], [1, 10 * k, 0.02 + g]]
    shapes = CollisionMesh(np.array(points, float))
    for k in range(6):
        shapes.rod([2 * k, 2 * k + 1], 0.01)
    x = upload(np.concatenate([shapes.points, 2.0 * shapes.points]), device)
    search = BroadPhase(shapes, x, 2, search_distance=REACH, margin=MARGIN)
    search.measure(x)
    assert search.gap.numpy() == pytest.approx([gap[0], REACH], rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"min_separation_fraction": -0.1}, r"min_separation_fraction = -0\.1"),
        ({"num_ccd_bodies": 0}, "num_ccd_bodies = 0 of a motion; they are 1 to"),
        ({"ccd_body": 7}, "ccd_body of a motion: one int32 for each of 72 nodes, not"),
        ({"together": 2}, r"together of a motion: one int32 for each of 1 world\(s\), not"),
    ],
)
def test_invalid_filter_arguments_are_refused_by_name(device, change, message):
    shapes, points = scene(12, 1.0, rods=3, nodes=20, triangles=4)
    motion = Motion(shapes, points, device)
    arguments = {
        "ccd_body": motion.ccd_body,
        "together": motion.together,
        "num_ccd_bodies": motion.num_ccd_bodies,
        "min_separation_fraction": 1.0,
    }
    for name, value in change.items():
        arguments[name] = wp.zeros(value, dtype=int, device=device) if name in ("ccd_body", "together") else value
    with pytest.raises(SceneError, match=message):
        motion.search.filter(motion.base, motion.q, **arguments)

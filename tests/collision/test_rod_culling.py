"""Rod culling: never wrong, and immediate for rods that are apart and do not curl up."""

from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from brute_force import curves, near_pairs, upload

from ddg_warp.kernels.collision.broad_phase.rod_culling import AHEAD, STEPS
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import CollisionMesh
from ddg_warp.solve.collision.rod_culling import RodCulling

REACH, MARGIN, RADIUS = 0.002, 0.004, 0.003


def rods(points: np.ndarray, nodes: int) -> CollisionMesh:
    shapes = CollisionMesh(points)
    for r in range(len(points) // nodes):
        shapes.rod(r * nodes + np.arange(nodes), RADIUS)
    return shapes


class Culling:
    """Rod culling of some worlds: a call with the ends of a motion returns the doubt of each world."""

    def __init__(self, shapes: CollisionMesh, points: np.ndarray, device, worlds: int = 1, dtype=wp.vec3d):
        self.device, self.worlds, self.dtype = device, worlds, dtype
        self.search = BroadPhase(shapes, self._upload(points), worlds, search_distance=REACH, margin=MARGIN)
        self.runs = RodCulling(self.search)

    def __call__(self, x: np.ndarray, y: np.ndarray | None = None, tried=1) -> np.ndarray:
        """Advance by a step as `DecoupledStep` does: test by the existing bounds, and by new ones where these leave doubt."""
        self.looked = 0
        x, y = self._upload(x), self._upload(x if y is None else y)
        tried = wp.array(np.resize(tried, self.worlds).astype(np.int32), device=self.device)
        self.runs.known.assign(self.runs.known.numpy() + (np.arange(len(self.runs.known)) >= STEPS)[:, None])
        before = self.runs.doubt.numpy()
        self.runs.hold(x, y, tried)
        assert (self.runs.doubt.numpy() >= before).all()
        if (self.runs.doubt.numpy() * tried.numpy()).any():
            looks = self.runs.looks.numpy()[0]
            self.runs.look(x, y, tried)
            self.looked = self.runs.looks.numpy()[0] - looks
        return self.runs.doubt.numpy()

    def _upload(self, points: np.ndarray) -> wp.array:
        return upload(points, self.device, self.dtype)


def within_reach(shapes: CollisionMesh, x: np.ndarray, y: np.ndarray) -> bool:
    """Return True if any pair is within reach at one of five positions along the motion."""
    return any(near_pairs(shapes, x + fraction * (y - x), 2, 2, REACH) for fraction in np.linspace(0.0, 1.0, 5))


@pytest.mark.parametrize(("nodes", "spread"), [(5, 2.0), (12, 4.0), (30, 8.0), (90, 30.0)])
def test_culled_rods_stay_out_of_reach_during_the_motion(device, spread, nodes):
    doubts = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        points = curves(rng, 6, nodes, spread, 0.03)
        move = rng.normal(size=3) * 0.1 + 0.002 * rng.normal(size=points.shape)
        shapes = rods(points, nodes)
        doubts.append(bool(Culling(shapes, points, device)(points, points + move)[0]))
        assert doubts[-1] or not within_reach(shapes, points, points + move)
    assert any(doubts) and not all(doubts)


@pytest.mark.parametrize("dtype", [wp.vec3d, wp.vec3f])
def test_straight_and_gently_bent_rods_are_culled(device, dtype):
    """A circle of circumference 1.2 opens by 0.2. A translation far beyond the margin changes nothing."""
    angle = np.linspace(0.0, 2.0 * np.pi / 1.2, 81)
    arc = 1.2 / (2.0 * np.pi) * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
    line = np.stack([np.linspace(0.0, 1.0, 81), np.full(81, 1.0), np.zeros(81)], 1)
    points = np.concatenate([arc, line])
    culling = Culling(rods(points, 81), points, device, dtype=dtype)
    assert culling(points)[0] == 0 and culling(points, points + 0.7)[0] == 0


def swarm(rng, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of six arcs that fly past a moving centre, rotating, bending and stretching, in 20 steps."""
    length, (along, bend) = 0.03 * (nodes - 1), rng.normal(size=(2, 6, 1, 3))
    middle = length * rng.uniform(-2.0, 2.0, (6, 1, 3)).repeat(nodes, axis=1).reshape(-1, 3)
    edges = along + bend * np.linspace(-0.5, 0.5, nodes)[:, None]
    steps = 0.03 * edges / np.linalg.norm(edges, axis=2, keepdims=True)
    points = middle + (steps.cumsum(axis=1) - 0.5 * steps.sum(axis=1, keepdims=True)).reshape(-1, 3)
    spin, aside = (rng.normal(size=(6, 3)).repeat(nodes, axis=0) for _ in range(2))
    drift = -0.05 * middle + 0.01 * length * aside + length * rng.normal(size=3)
    return points, drift + 0.02 * np.cross(spin, points - middle) + 1e-4 * rng.normal(size=points.shape)


@pytest.mark.parametrize(
    ("nodes", "dtype"),
    [
        (6, wp.vec3d),
        (20, wp.vec3f),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((6, wp.vec3f), (20, wp.vec3d), (70, wp.vec3d))),
    ],
)
def test_bounds_are_reused_and_never_wrong(device, nodes, dtype):
    """Near pairs always leave doubt, and many steps without near pairs need no new bounds."""
    updates, doubts, nears = [], [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        points, velocity = swarm(rng, nodes)
        shapes = rods(points, nodes)
        culling = Culling(shapes, points, device, dtype=dtype)
        for _ in range(40):
            velocity = velocity + 1e-5 * rng.normal(size=velocity.shape)
            after = points + velocity
            doubts.append(bool(culling(points, after)[0]))
            nears.append(within_reach(shapes, points, after))
            updates.append(culling.looked)
            assert doubts[-1] or not nears[-1]
            points = after
    quiet = ~np.array(doubts)
    assert any(nears) and np.mean(doubts) < 0.8
    assert np.mean(np.array(updates)[quiet] > 0) < 0.7


def test_culling_depends_on_positions_alone(device):
    """The age of bounds and earlier motions do not matter."""
    line = np.stack([np.linspace(0.0, 1.0, 81), np.zeros(81), np.zeros(81)], 1)
    points = np.concatenate([line, line + [0.0, 0.2, 0.0]])
    culling = Culling(rods(points, 81), points, device)
    assert culling(points)[0] == 0 and culling.looked
    assert culling(points)[0] == 0 and not culling.looked
    together = points * [1.0, 0.03, 1.0]
    for _ in range(3):
        assert culling(together)[0] == 1
        assert culling(points)[0] == 0
    # the second passes through the first and is as far beyond
    assert culling(points, points * [1.0, -1.0, 1.0])[0] == 1
    assert culling(np.full_like(points, np.nan))[0] == 1
    assert culling(points)[0] == 0


def test_close_rods_get_smaller_bounds(device):
    line = np.stack([np.linspace(0.0, 1.0, 81), np.zeros(81), np.zeros(81)], 1)
    points = np.concatenate([line, line + [0.0, 2.0 * RADIUS + 1.1 * REACH, 0.0]])
    culling, still = Culling(rods(points, 81), points, device), []
    for _ in range(12):
        assert culling(points)[0] == 0
        still.append(culling.runs.known.numpy()[AHEAD, 0])
    assert max(still) <= 1


def test_winding_rod_is_in_doubt_shortly_before_self_contact(device):
    """A line winds into a ring until the ends meet: doubt begins before the ends are near, but not long before."""
    s = np.linspace(0.0, 1.0, 81)

    def wound(turns: float) -> np.ndarray:
        radius = 1.0 / (2.0 * np.pi * turns)
        return np.stack([radius * np.sin(s / radius), radius * (1.0 - np.cos(s / radius)), 0.0 * s], 1)

    shapes, doubts = rods(wound(0.2), 81), []
    culling = Culling(shapes, wound(0.2), device)
    turns = np.linspace(0.2, 1.1, 181)
    for start, end in pairwise(turns):
        doubts.append(bool(culling(wound(start), wound(end))[0]))
        assert doubts[-1] or not within_reach(shapes, wound(start), wound(end))
    first = turns[doubts.index(True)]
    assert 0.9 < first < 1.0


def test_closing_rings_and_approaching_rods_are_in_doubt(device):
    angle = np.linspace(0.0, 1.99 * np.pi, 81)
    ring = 0.2 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
    assert Culling(rods(ring, 81), ring, device)(ring)[0] == 1
    two = np.concatenate([ring[:60], ring[:60] + [0.0, 0.5, 0.0]])
    culling, x = Culling(rods(two, 60), np.tile(two, (2, 1)), device, 2), np.tile(two, (2, 1))
    assert culling(x).tolist() == [0, 0]
    x[-60:, 1] -= 0.495
    assert culling(x).tolist() == [0, 1]
    assert culling(np.tile(two, (2, 1)), tried=[1, 0]).tolist() == [0, 1]
    assert culling(np.tile(two, (2, 1))).tolist() == [0, 0]


@pytest.mark.parametrize("nodes", [5, 81, 140])
@pytest.mark.parametrize("rod", [1, 2])
def test_rods_end_to_end_are_in_doubt_within_reach(device, nodes, rod):
    """The first rod and one of two others are end to end, at 0.9 and 1.1 of the reach."""
    line = np.stack([np.linspace(0.0, 1.0, nodes), np.zeros(nodes), np.zeros(nodes)], 1)
    for gap, expected in ((0.9, 1), (1.1, 0)):
        offsets = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 1.0, 0.0]]
        offsets[rod] = [1.0, 2.0 * RADIUS + gap * REACH, 0.0]
        points = np.concatenate([line + offset for offset in offsets])
        assert Culling(rods(points, nodes), points, device)(points)[0] == expected

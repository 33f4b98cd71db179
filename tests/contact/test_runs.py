"""Whether anything is near at all: never told wrongly, and told at once where rods are apart and do not curl up."""

from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from brute_force import curves, near, upload

from ddg_warp.kernels.contact.runs import AHEAD, STEPS
from ddg_warp.solve.contact.broad_phase import BroadPhase
from ddg_warp.solve.contact.runs import Runs
from ddg_warp.solve.contact.shapes import Shapes

REACH, MARGIN, RADIUS = 0.002, 0.004, 0.003


def rods(points: np.ndarray, nodes: int) -> Shapes:
    shapes = Shapes(points)
    for r in range(len(points) // nodes):
        shapes.rod(r * nodes + np.arange(nodes), RADIUS)
    return shapes


class Asked:
    """Runs of some worlds at points; called with the ends of a motion, whether they leave it in doubt, world by world."""

    def __init__(self, shapes: Shapes, points: np.ndarray, device, worlds: int = 1, dtype=wp.vec3d):
        self.device, self.worlds, self.dtype = device, worlds, dtype
        self.search = BroadPhase(shapes, self._upload(points), worlds, reach=REACH, margin=MARGIN)
        self.runs = Runs(self.search)

    def __call__(self, x: np.ndarray, y: np.ndarray | None = None, tried=1) -> np.ndarray:
        """In steps one after the other, as `Alone` takes them: by the boxes that there are, and where they do not do by new ones."""
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


def close(shapes: Shapes, x: np.ndarray, y: np.ndarray) -> bool:
    """Whether any pair is, by all pairs at places along the way."""
    return any(near(shapes, x + share * (y - x), 2, 2, REACH) for share in np.linspace(0.0, 1.0, 5))


@pytest.mark.parametrize(("nodes", "spread"), [(5, 2.0), (12, 4.0), (30, 8.0), (90, 30.0)])
def test_what_is_told_to_be_apart_is_apart_on_the_way(device, spread, nodes):
    found = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        points = curves(rng, 6, nodes, spread, 0.03)
        move = rng.normal(size=3) * 0.1 + 0.002 * rng.normal(size=points.shape)
        shapes = rods(points, nodes)
        found.append(bool(Asked(shapes, points, device)(points, points + move)[0]))
        assert found[-1] or not close(shapes, points, points + move)
    assert any(found) and not all(found)


@pytest.mark.parametrize("dtype", [wp.vec3d, wp.vec3f])
def test_straight_and_gently_bent_rods_are_told_apart(device, dtype):
    """A circle of circumference 1.2 opens by 0.2; a step of translation, far beyond the margin, changes nothing."""
    turn = np.linspace(0.0, 2.0 * np.pi / 1.2, 81)
    arc = 1.2 / (2.0 * np.pi) * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], 1)
    line = np.stack([np.linspace(0.0, 1.0, 81), np.full(81, 1.0), np.zeros(81)], 1)
    points = np.concatenate([arc, line])
    asked = Asked(rods(points, 81), points, device, dtype=dtype)
    assert asked(points)[0] == 0 and asked(points, points + 0.7)[0] == 0


def swarm(rng, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Places and velocities of six arcs that fly past a middle, which moves, each turning, bending and stretching, in 20 steps."""
    length, (along, bend) = 0.03 * (nodes - 1), rng.normal(size=(2, 6, 1, 3))
    middle = length * rng.uniform(-2.0, 2.0, (6, 1, 3)).repeat(nodes, axis=1).reshape(-1, 3)
    edges = along + bend * np.linspace(-0.5, 0.5, nodes)[:, None]
    steps = 0.03 * edges / np.linalg.norm(edges, axis=2, keepdims=True)
    points = middle + (steps.cumsum(axis=1) - 0.5 * steps.sum(axis=1, keepdims=True)).reshape(-1, 3)
    turn, aside = (rng.normal(size=(6, 3)).repeat(nodes, axis=0) for _ in range(2))
    way = -0.05 * middle + 0.01 * length * aside + length * rng.normal(size=3)
    return points, way + 0.02 * np.cross(turn, points - middle) + 1e-4 * rng.normal(size=points.shape)


@pytest.mark.parametrize(
    ("nodes", "dtype"),
    [
        (6, wp.vec3d),
        (20, wp.vec3f),
        *(pytest.param(*of, marks=pytest.mark.slow) for of in ((6, wp.vec3f), (20, wp.vec3d), (70, wp.vec3d))),
    ],
)
def test_boxes_serve_step_after_step_and_tell_nothing_wrongly(device, nodes, dtype):
    """Nothing that is near is told to be apart, and many of the steps in which nothing is need no new boxes."""
    looked, doubts, nears = [], [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        points, velocity = swarm(rng, nodes)
        shapes = rods(points, nodes)
        asked = Asked(shapes, points, device, dtype=dtype)
        for _ in range(40):
            velocity = velocity + 1e-5 * rng.normal(size=velocity.shape)
            after = points + velocity
            doubts.append(bool(asked(points, after)[0]))
            nears.append(close(shapes, points, after))
            looked.append(asked.looked)
            assert doubts[-1] or not nears[-1]
            points = after
    quiet = ~np.array(doubts)
    assert any(nears) and np.mean(doubts) < 0.8
    assert np.mean(np.array(looked)[quiet] > 0) < 0.7


def test_boxes_serve_wherever_a_state_comes_from(device):
    """What counts is where things are: not when boxes were made, nor what was done since."""
    line = np.stack([np.linspace(0.0, 1.0, 81), np.zeros(81), np.zeros(81)], 1)
    points = np.concatenate([line, line + [0.0, 0.2, 0.0]])
    asked = Asked(rods(points, 81), points, device)
    assert asked(points)[0] == 0 and asked.looked
    assert asked(points)[0] == 0 and not asked.looked
    together = points * [1.0, 0.03, 1.0]
    for _ in range(3):
        assert asked(together)[0] == 1
        assert asked(points)[0] == 0
    # the second passes through the first and is as far beyond
    assert asked(points, points * [1.0, -1.0, 1.0])[0] == 1
    assert asked(np.full_like(points, np.nan))[0] == 1
    assert asked(points)[0] == 0


def test_rods_too_near_for_the_widest_boxes_have_smaller_ones(device):
    line = np.stack([np.linspace(0.0, 1.0, 81), np.zeros(81), np.zeros(81)], 1)
    points = np.concatenate([line, line + [0.0, 2.0 * RADIUS + 1.1 * REACH, 0.0]])
    asked, still = Asked(rods(points, 81), points, device), []
    for _ in range(12):
        assert asked(points)[0] == 0
        still.append(asked.runs.known.numpy()[AHEAD, 0])
    assert max(still) <= 1


def test_a_rod_that_winds_up_is_followed(device):
    """From a line into a ring and on, until its ends meet: in doubt before they are near, but not long before."""
    s = np.linspace(0.0, 1.0, 81)

    def wound(turns: float) -> np.ndarray:
        radius = 1.0 / (2.0 * np.pi * turns)
        return np.stack([radius * np.sin(s / radius), radius * (1.0 - np.cos(s / radius)), 0.0 * s], 1)

    shapes, told = rods(wound(0.2), 81), []
    asked = Asked(shapes, wound(0.2), device)
    turns = np.linspace(0.2, 1.1, 181)
    for one, other in pairwise(turns):
        told.append(bool(asked(wound(one), wound(other))[0]))
        assert told[-1] or not close(shapes, wound(one), wound(other))
    first = turns[told.index(True)]
    assert 0.9 < first < 1.0


def test_rods_that_come_round_to_themselves_or_to_others_are_seen(device):
    turn = np.linspace(0.0, 1.99 * np.pi, 81)
    ring = 0.2 * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], 1)
    assert Asked(rods(ring, 81), ring, device)(ring)[0] == 1
    two = np.concatenate([ring[:60], ring[:60] + [0.0, 0.5, 0.0]])
    asked, x = Asked(rods(two, 60), np.tile(two, (2, 1)), device, 2), np.tile(two, (2, 1))
    assert asked(x).tolist() == [0, 0]
    x[-60:, 1] -= 0.495
    assert asked(x).tolist() == [0, 1]
    assert asked(np.tile(two, (2, 1)), tried=[1, 0]).tolist() == [0, 1]
    assert asked(np.tile(two, (2, 1))).tolist() == [0, 0]


@pytest.mark.parametrize("nodes", [5, 81, 140])
@pytest.mark.parametrize("rod", [1, 2])
def test_rods_beside_each_other_are_seen(device, nodes, rod):
    """The first, and one of two others, by its ends."""
    line = np.stack([np.linspace(0.0, 1.0, nodes), np.zeros(nodes), np.zeros(nodes)], 1)
    for gap, expected in ((0.9, 1), (1.1, 0)):
        places = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 1.0, 0.0]]
        places[rod] = [1.0, 2.0 * RADIUS + gap * REACH, 0.0]
        points = np.concatenate([line + place for place in places])
        assert Asked(rods(points, nodes), points, device)(points)[0] == expected

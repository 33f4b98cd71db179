"""Static steps of rods: edges turn at their length, held nodes stay, and what misses between them is closed by turning."""

import numpy as np
import pytest

from ddg_warp.geometry.turning import turned

BOW = np.stack([np.linspace(-1.0, 1.0, 21), 0.0 * np.ones(21), 0.5 * np.cos(np.linspace(-1.5, 1.5, 21))], axis=1)


def stretch(x, dx, held, given=None, closed=False) -> float:
    """Largest change of an edge's length, over its length."""
    moved = x + dx + turned(x, dx, held, np.zeros_like(x) if given is None else given, closed)
    before, after = (np.linalg.norm(np.diff(points, axis=0), axis=1) for points in (x, moved))
    return np.abs(after / before - 1.0).max()


def inextensible(x: np.ndarray, size: float, closing: bool) -> np.ndarray:
    """A step that stretches no edge to first order, of edges turned at random, up to `size` [rad]; with both ends still or not."""
    e, rng = np.diff(x, axis=0), np.random.default_rng(5)
    turns = rng.uniform(-1.0, 1.0, e.shape)
    if closing:  # the least change of the turns for which the edges' changes add up to nothing
        cross = -np.concatenate([np.cross(edge, np.eye(3)).T for edge in e], axis=1)
        turns -= (np.linalg.pinv(cross) @ (cross @ turns.ravel())).reshape(turns.shape)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(np.cross(size * turns, e), axis=0)])


def test_free_end_turns_without_stretch():
    held = np.zeros((21, 3), bool)
    held[0] = True
    dx = inextensible(BOW, 0.7, False)
    straight = np.linalg.norm(np.diff(BOW + dx, axis=0), axis=1) / np.linalg.norm(np.diff(BOW, axis=0), axis=1)
    assert (straight - 1.0).max() > 0.1
    assert stretch(BOW, dx, held) < 1e-12


@pytest.mark.parametrize("slides", [False, True])
def test_between_held_ends_stretch_is_of_higher_order(slides):
    """Spread evenly it would be of order two, as that of a straight step."""
    held = np.zeros((21, 3), bool)
    held[[0, -1]] = True
    held[-1, 1] = not slides
    sizes, found = np.array([0.1, 0.2, 0.4]), []
    for size in sizes:
        dx = inextensible(BOW, size, True)
        np.testing.assert_allclose(dx[-1], 0.0, atol=1e-12)
        extra = turned(BOW, dx, held, np.zeros_like(BOW), False)
        assert not extra[held].any()
        assert extra[-1].any() == slides
        found.append(stretch(BOW, dx, held))
    assert np.polyfit(np.log(sizes), np.log(found), 1)[0] > 1.9
    assert found[0] < 2e-4


def test_prescribed_additions_are_met():
    """Some nodes of all components, some of one: to the last bit; a component that is held everywhere takes what it is given."""
    rng = np.random.default_rng(2)
    held = np.zeros((21, 3), bool)
    held[[0, 1]] = True
    held[[7, 15], 2] = True
    held[:, 1] = True
    given = 0.01 * rng.uniform(-1.0, 1.0, held.shape)
    extra = turned(BOW, inextensible(BOW, 0.2, False), held, given, False)
    np.testing.assert_array_equal(extra[held], given[held])
    assert np.abs(extra[20, [0, 2]]).min() > 0.0


def test_closed_rod_stays_closed():
    """In its ovalling mode, cos(2 a) outwards and -sin(2 a) / 2 along, which stretches no edge to first order."""
    angle = 2.0 * np.pi * np.arange(48) / 48
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    dx = 0.2 * (np.cos(2.0 * angle)[:, None] * ring - 0.5 * np.sin(2.0 * angle)[:, None] * along)
    held = np.zeros((48, 2), bool)
    held[4] = True
    extra = turned(ring, dx, held, np.zeros_like(ring), True)
    np.testing.assert_allclose(extra[4], 0.0, atol=1e-15)
    moved, lengths = ring + dx + extra, []
    for points in (ring, moved, ring + dx):
        lengths.append(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1))
    assert np.ptp(lengths[1]) < 0.1 * np.ptp(lengths[2])

"""Edge-rotation update of static steps: edges keep their lengths, fixed nodes stay, gaps are closed by rotation."""

import numpy as np
import pytest

from ddg_warp.geometry.edge_rotation import turned

BOW = np.stack([np.linspace(-1.0, 1.0, 21), 0.0 * np.ones(21), 0.5 * np.cos(np.linspace(-1.5, 1.5, 21))], axis=1)


def stretch(x, dx, fixed, additions=None, closed=False) -> float:
    """Return the largest relative change of an edge length."""
    moved = x + dx + turned(x, dx, fixed, np.zeros_like(x) if additions is None else additions, closed)
    before, after = (np.linalg.norm(np.diff(points, axis=0), axis=1) for points in (x, moved))
    return np.abs(after / before - 1.0).max()


def inextensible(x: np.ndarray, size: float, closing: bool) -> np.ndarray:
    """Return an increment that stretches no edge to first order, from random edge rotations up to `size` [rad].

    `closing` keeps both ends fixed.
    """
    e, rng = np.diff(x, axis=0), np.random.default_rng(5)
    rotations = rng.uniform(-1.0, 1.0, e.shape)
    if closing:  # least change of the rotations for which edge increments sum to zero
        cross = -np.concatenate([np.cross(edge, np.eye(3)).T for edge in e], axis=1)
        rotations -= (np.linalg.pinv(cross) @ (cross @ rotations.ravel())).reshape(rotations.shape)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(np.cross(size * rotations, e), axis=0)])


def test_free_end_rotates_without_stretch():
    fixed = np.zeros((21, 3), bool)
    fixed[0] = True
    dx = inextensible(BOW, 0.7, False)
    straight = np.linalg.norm(np.diff(BOW + dx, axis=0), axis=1) / np.linalg.norm(np.diff(BOW, axis=0), axis=1)
    assert (straight - 1.0).max() > 0.1
    assert stretch(BOW, dx, fixed) < 1e-12


@pytest.mark.parametrize("slides", [False, True])
def test_stretch_between_fixed_ends_is_of_second_order(slides):
    """The fitted order exceeds 1.9, and small rotations leave a stretch below 2e-4."""
    fixed = np.zeros((21, 3), bool)
    fixed[[0, -1]] = True
    fixed[-1, 1] = not slides
    sizes, stretches = np.array([0.1, 0.2, 0.4]), []
    for size in sizes:
        dx = inextensible(BOW, size, True)
        np.testing.assert_allclose(dx[-1], 0.0, atol=1e-12)
        extra = turned(BOW, dx, fixed, np.zeros_like(BOW), False)
        assert not extra[fixed].any()
        assert extra[-1].any() == slides
        stretches.append(stretch(BOW, dx, fixed))
    assert np.polyfit(np.log(sizes), np.log(stretches), 1)[0] > 1.9
    assert stretches[0] < 2e-4


def test_prescribed_additions_are_met():
    """Nodes with all or one component fixed get exact additions; a component fixed at all nodes keeps its input."""
    rng = np.random.default_rng(2)
    fixed = np.zeros((21, 3), bool)
    fixed[[0, 1]] = True
    fixed[[7, 15], 2] = True
    fixed[:, 1] = True
    additions = 0.01 * rng.uniform(-1.0, 1.0, fixed.shape)
    extra = turned(BOW, inextensible(BOW, 0.2, False), fixed, additions, False)
    np.testing.assert_array_equal(extra[fixed], additions[fixed])
    assert np.abs(extra[20, [0, 2]]).min() > 0.0


def test_closed_rod_stays_closed():
    """The ovalling mode, cos(2 a) radially and -sin(2 a) / 2 tangentially, stretches no edge to first order."""
    angle = 2.0 * np.pi * np.arange(48) / 48
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    dx = 0.2 * (np.cos(2.0 * angle)[:, None] * ring - 0.5 * np.sin(2.0 * angle)[:, None] * along)
    fixed = np.zeros((48, 2), bool)
    fixed[4] = True
    extra = turned(ring, dx, fixed, np.zeros_like(ring), True)
    np.testing.assert_allclose(extra[4], 0.0, atol=1e-15)
    moved, lengths = ring + dx + extra, []
    for points in (ring, moved, ring + dx):
        lengths.append(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1))
    assert np.ptp(lengths[1]) < 0.1 * np.ptp(lengths[2])

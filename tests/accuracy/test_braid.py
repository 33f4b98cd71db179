"""Constants of `scenes.overhand_knot`: the braid of a loose knot, by finite differences and a barrier that is made ever steeper."""

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

from ddg_warp.scenes import overhand_knot

MOST = 0.1  # by which points turn about the axis in an iteration, at most: the winding is kept


def braid(turns: int, count: int) -> tuple[float, float]:
    """Force of the unit disc on v(s), and the energy over that of two straight strands that cross; ends are held at first only."""
    reach = 5.0 + 4.5 * turns
    s, step = np.linspace(-reach, reach, count + 1, retstep=True)
    second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(count - 1, count + 1)) / step**2
    bend = sparse.kron(second.T @ second * step, sparse.eye_array(2))
    ends, held = np.zeros((count + 1, 2)), np.zeros((count + 1, 2))
    ends[[1, -1], 1], ends[[0, -2], 1], held[[0, -1], 0] = 0.5 / step, -0.5 / step, 100.0
    wound = 0.5 + 1.9 * turns
    angle = np.pi * ((2 * turns + 1) * np.clip(0.5 * (s / wound + 1.0), 0.0, 1.0) - 0.5)
    away = 1.05 + np.maximum(abs(s) - wound, 0.0) ** 2 / 4.0
    v = away[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def state(v, law, barrier):
        """Energy and its slope, infinite within the disc."""
        r = np.linalg.norm(v, axis=1)
        if r.min() <= 1.0:
            return np.inf, np.inf
        force = law @ v.ravel()
        slope = force - (ends + (barrier * step / (r - 1.0) / r)[:, None] * v).ravel()
        return 0.5 * v.ravel() @ force - (ends * v).sum() - barrier * step * np.log(r - 1.0).sum(), slope

    barrier = 0.05
    while barrier > 1e-7:
        law = bend + sparse.diags_array(held.ravel() * (barrier > 1e-3))
        for _ in range(500):
            r = np.linalg.norm(v, axis=1)
            normal, push = v / r[:, None], barrier * step / (r - 1.0)
            outward = normal[:, :, None] * normal[:, None, :]
            now, slope = state(v, law, barrier)
            for around in (1.0, 0.0):  # without what is not convex, where the direction would go up
                own = (push / (r - 1.0))[:, None, None] * outward - around * (push / r)[:, None, None] * (
                    np.eye(2) - outward
                )
                matrix = (law + sparse.block_diag(list(own))).tocsc()
                move = -spsolve(matrix, slope)
                if move @ slope < 0.0 and move @ (matrix @ move) > 0.0:
                    break
            shift = move.reshape(-1, 2)
            part = min(1.0, MOST * (r / np.maximum(np.linalg.norm(shift, axis=1), 1e-12)).min())
            while part > 1e-9:
                then, left = state(v + part * shift, law, barrier)
                # differences of energies that drown in rounding say nothing
                drowned = abs(then - now) < 1e-9 * (1.0 + abs(now))
                if then <= now + 1e-4 * part * (move @ slope) or (
                    drowned and np.linalg.norm(left) < np.linalg.norm(slope)
                ):
                    break
                part *= 0.5
            v = v + part * shift
            if np.abs(shift).max() < 1e-6:
                break
        force = barrier / (np.linalg.norm(v, axis=1) - 1.0)
        barrier *= 0.25
    whole = 0.5 * v.ravel() @ (bend @ v.ravel()) - (ends * v).sum()
    return force.sum() * step, whole + 0.25 * reach


@pytest.mark.slow
@pytest.mark.parametrize("turns", overhand_knot.SIGMA)
def test_normal_force_and_energy_of_a_braid(turns):
    # the energy over B is 2 h^(1/2) R^(-3/2) times that of v; F = -dU / d(2 pi R)
    force, energy = braid(turns, 300 * (turns + 1))
    assert force == pytest.approx(overhand_knot.SIGMA[turns], rel=5e-3)
    assert energy * 3.0 / (2.0 * np.pi) == pytest.approx(overhand_knot.BRAID[turns], rel=5e-3)

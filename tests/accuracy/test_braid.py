"""Constants and laws of `scenes.overhand_knot`: the braid of a loose knot, by finite differences and a barrier that is made ever
steeper, and what long braids tend to."""

from functools import cache

import numpy as np
import pytest
from scipy import sparse
from scipy.integrate import quad
from scipy.sparse.linalg import spsolve

from ddg_warp.scenes import _knots, overhand_knot

MOST = 0.1  # by which points turn about the axis in an iteration, at most: the winding is kept
TURN = 2.0 * np.pi / 12**0.75  # what a turn adds to sigma


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


@cache
def found(turns: int) -> tuple[float, float]:
    """The same by some 60 nodes a turn and more at the ends."""
    return braid(turns, 300 * (turns + 1))


@pytest.mark.slow
@pytest.mark.parametrize("turns", overhand_knot.SIGMA)
def test_normal_force_and_energy_of_a_braid(turns):
    # the energy over B is 2 h^(1/2) R^(-3/2) times that of v; F = -dU / d(2 pi R)
    force, energy = found(turns)
    assert force == pytest.approx(overhand_knot.SIGMA[turns], rel=5e-3)
    assert energy * 3.0 / (2.0 * np.pi) == pytest.approx(overhand_knot.BRAID[turns], rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("turns", [2, 3, 4])
def test_another_turn_of_a_braid_is_one_of_a_helix(turns):
    """Of the force, from the first turn on but for half a turn at the ends; of the energy too, 3 / pi times that as c."""
    (force, energy), (before, less) = found(turns), found(turns - 1)
    assert force - before == pytest.approx(TURN, rel=4e-3)
    assert force == pytest.approx((turns - 0.5) * TURN, rel=6e-3)
    assert (energy - less) * 3.0 / (2.0 * np.pi) == pytest.approx(3.0 / np.pi * TURN, rel=1e-3)


@pytest.mark.parametrize("m", [1e-3, 0.3, 0.9, 0.999])
def test_the_loop_is_an_elastica(m):
    """Its integrals by quadrature; at m = 0 a circle that ends where it begins, at 1 a braid of eight radii less than the loop."""
    length, apart = _knots.elastica(m)
    # sharp where the loop is farthest from the braid
    pieces = {"points": np.pi - np.sqrt(1.0 - m) * np.array([1.0, 10.0]), "epsabs": 1e-13, "epsrel": 1e-12}

    def bent(theta):
        return np.sqrt(1.0 - m * np.sin(0.5 * theta) ** 2)

    assert length == pytest.approx(2.0 * quad(lambda theta: 1.0 / bent(theta), 0.0, np.pi, **pieces)[0], rel=1e-10)
    assert apart == pytest.approx(-2.0 * quad(lambda t: np.cos(t) / bent(t), 0.0, np.pi, **pieces)[0], rel=1e-9)


def test_ends_of_the_range_of_loops():
    m = 1e-4
    length, apart = _knots.elastica(m)
    assert length == pytest.approx(2.0 * np.pi * (1.0 + m / 4.0), rel=m**2)
    assert apart == pytest.approx(np.pi * m / 4.0 * (1.0 + 0.75 * m), rel=m**2)
    # 8 is 4 int_0^(pi / 2) cos, of 1 + cos(theta) over cos(theta / 2)
    length, apart = _knots.elastica(1.0 - 1e-9)
    assert length - apart == pytest.approx(8.0, rel=1e-7)


@pytest.mark.parametrize("turns", [0.5, 1.5, 2.5])
def test_long_knots_are_loose_ones_in_the_end(turns):
    """Jawed's law tends to sigma of a helix, and what tails that bend make of it; without friction the latter to the energy's c.

    What is left is of order epsilon, but of its root where friction's traction, of epsilon^3, bends the tails.
    """
    slack = np.array([1e8, 1e9])
    epsilon = np.sqrt(2.0 * np.pi / slack)
    law = np.array([_knots.jawed(turns, each, 0.1) for each in slack]) / 0.1 / epsilon**3
    bent = np.array([_knots.drawn(turns, each, 0.1)[1] for each in slack]) / epsilon**3
    elastic = np.array([_knots.drawn(turns, each, 0.0)[0] for each in slack])
    elastic = (elastic - 0.5 * epsilon**4) / epsilon**5
    for values, limit, order, most in (
        (law, 1.0, 1.0, 2e-3),
        (bent, 1.0, 0.5, 5e-2),
        (elastic, 3.0 / np.pi, 1.0, 1e-3),
    ):
        off = values / limit / TURN / turns - 1.0
        assert 0.0 < off[1] < most
        assert np.log(off[0] / off[1]) / np.log(epsilon[0] / epsilon[1]) == pytest.approx(order, abs=0.03)


def test_friction_in_long_knots():
    """Jawed's law is n^-2 mu times a function of n^2 h / e; tails that bend press more, the more so the more friction there is."""
    law = _knots.jawed(3.0, 1e4, 0.1)
    assert _knots.jawed(6.0, 4e4, 0.2) == pytest.approx(0.5 * law, rel=1e-10)
    pressed = [_knots.drawn(3.0, 1e4, friction)[1] for friction in (0.0, 0.02, 0.1, 0.3)]
    assert (np.diff(pressed) > 0.0).all() and pressed[-1] > 1.4 * pressed[0]

"""Constants and laws of `scenes.overhand_knot`: the braid of a loose knot, and the limits of long braids.

The braid is solved by finite differences with a barrier of increasing steepness.
"""

from functools import cache

import numpy as np
import pytest
from scipy import sparse
from scipy.integrate import quad
from scipy.sparse.linalg import spsolve

from ddg_warp.scenes import _knots, overhand_knot

MOST = 0.1  # largest rotation of a point about the axis per iteration: keeps the winding
TURN = 2.0 * np.pi / 12**0.75  # increment of sigma per winding


def braid(turns: int, count: int) -> tuple[float, float]:
    """Return the force of the unit disc on v(s), and the energy relative to two straight crossing strands.

    Ends are fixed during the first barriers only.
    """
    reach = 5.0 + 4.5 * turns
    s, step = np.linspace(-reach, reach, count + 1, retstep=True)
    second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(count - 1, count + 1)) / step**2
    bend = sparse.kron(second.T @ second * step, sparse.eye_array(2))
    ends, springs = np.zeros((count + 1, 2)), np.zeros((count + 1, 2))
    ends[[1, -1], 1], ends[[0, -2], 1], springs[[0, -1], 0] = 0.5 / step, -0.5 / step, 100.0
    wound = 0.5 + 1.9 * turns
    angle = np.pi * ((2 * turns + 1) * np.clip(0.5 * (s / wound + 1.0), 0.0, 1.0) - 0.5)
    radius = 1.05 + np.maximum(abs(s) - wound, 0.0) ** 2 / 4.0
    v = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def state(v, law, barrier):
        """Return energy and gradient, infinite within the disc."""
        r = np.linalg.norm(v, axis=1)
        if r.min() <= 1.0:
            return np.inf, np.inf
        force = law @ v.ravel()
        slope = force - (ends + (barrier * step / (r - 1.0) / r)[:, None] * v).ravel()
        return 0.5 * v.ravel() @ force - (ends * v).sum() - barrier * step * np.log(r - 1.0).sum(), slope

    barrier = 0.05
    while barrier > 1e-7:
        law = bend + sparse.diags_array(springs.ravel() * (barrier > 1e-3))
        for _ in range(500):
            r = np.linalg.norm(v, axis=1)
            normal, push = v / r[:, None], barrier * step / (r - 1.0)
            outward = normal[:, :, None] * normal[:, None, :]
            energy, slope = state(v, law, barrier)
            for around in (1.0, 0.0):  # second try without the non-convex term, if the direction ascends
                blocks = (push / (r - 1.0))[:, None, None] * outward - around * (push / r)[:, None, None] * (
                    np.eye(2) - outward
                )
                matrix = (law + sparse.block_diag(list(blocks))).tocsc()
                move = -spsolve(matrix, slope)
                if move @ slope < 0.0 and move @ (matrix @ move) > 0.0:
                    break
            shift = move.reshape(-1, 2)
            step_length = min(1.0, MOST * (r / np.maximum(np.linalg.norm(shift, axis=1), 1e-12)).min())
            while step_length > 1e-9:
                trial, trial_slope = state(v + step_length * shift, law, barrier)
                # below the rounding floor of the energy, compare gradients
                below_rounding = abs(trial - energy) < 1e-9 * (1.0 + abs(energy))
                if trial <= energy + 1e-4 * step_length * (move @ slope) or (
                    below_rounding and np.linalg.norm(trial_slope) < np.linalg.norm(slope)
                ):
                    break
                step_length *= 0.5
            v = v + step_length * shift
            if np.abs(shift).max() < 1e-6:
                break
        force = barrier / (np.linalg.norm(v, axis=1) - 1.0)
        barrier *= 0.25
    whole = 0.5 * v.ravel() @ (bend @ v.ravel()) - (ends * v).sum()
    return force.sum() * step, whole + 0.25 * reach


@cache
def braid_constants(turns: int) -> tuple[float, float]:
    """Return force and energy with some 60 nodes per winding, and more at the ends."""
    return braid(turns, 300 * (turns + 1))


@pytest.mark.slow
@pytest.mark.parametrize("turns", overhand_knot.SIGMA)
def test_force_and_energy_of_braids(turns):
    # the energy over B is 2 h^(1/2) R^(-3/2) times that of v; F = -dU / d(2 pi R)
    force, energy = braid_constants(turns)
    assert force == pytest.approx(overhand_knot.SIGMA[turns], rel=5e-3)
    assert energy * 3.0 / (2.0 * np.pi) == pytest.approx(overhand_knot.BRAID[turns], rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("turns", [2, 3, 4])
def test_each_winding_adds_that_of_a_helix(turns):
    """Each winding adds the force of a helix, except for half a winding at the ends, and the energy 3 / pi times that."""
    (force, energy), (previous_force, previous_energy) = braid_constants(turns), braid_constants(turns - 1)
    assert force - previous_force == pytest.approx(TURN, rel=4e-3)
    assert force == pytest.approx((turns - 0.5) * TURN, rel=6e-3)
    assert (energy - previous_energy) * 3.0 / (2.0 * np.pi) == pytest.approx(3.0 / np.pi * TURN, rel=1e-3)


@pytest.mark.parametrize("m", [1e-3, 0.3, 0.9, 0.999])
def test_loop_length_and_end_distance(m):
    """Length and end distance by quadrature, from a circle at m = 0 to a braid eight radii shorter than the loop at m = 1."""
    length, distance = _knots.elastica(m)
    # the integrand peaks at the far end of the loop
    pieces = {"points": np.pi - np.sqrt(1.0 - m) * np.array([1.0, 10.0]), "epsabs": 1e-13, "epsrel": 1e-12}

    def root(theta):
        return np.sqrt(1.0 - m * np.sin(0.5 * theta) ** 2)

    assert length == pytest.approx(2.0 * quad(lambda theta: 1.0 / root(theta), 0.0, np.pi, **pieces)[0], rel=1e-10)
    assert distance == pytest.approx(-2.0 * quad(lambda t: np.cos(t) / root(t), 0.0, np.pi, **pieces)[0], rel=1e-9)


def test_loop_limits_at_circle_and_braid():
    m = 1e-4
    length, distance = _knots.elastica(m)
    assert length == pytest.approx(2.0 * np.pi * (1.0 + m / 4.0), rel=m**2)
    assert distance == pytest.approx(np.pi * m / 4.0 * (1.0 + 0.75 * m), rel=m**2)
    # 8 is 4 int_0^(pi / 2) cos, of 1 + cos(theta) over cos(theta / 2)
    length, distance = _knots.elastica(1.0 - 1e-9)
    assert length - distance == pytest.approx(8.0, rel=1e-7)


@pytest.mark.parametrize("turns", [0.5, 1.5, 2.5])
def test_long_knots_tend_to_helices(turns):
    """Jawed's law and the one with bent tails tend to sigma of a helix, the frictionless one to c of the energy.

    The remainder is of order epsilon, but sqrt(epsilon) where friction of order epsilon^3 bends the tails.
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


def test_friction_scaling_of_long_knots():
    """Jawed's law is n^-2 mu times a function of n^2 h / e; bent tails increase the pressure, the more so with more friction."""
    law = _knots.jawed(3.0, 1e4, 0.1)
    assert _knots.jawed(6.0, 4e4, 0.2) == pytest.approx(0.5 * law, rel=1e-10)
    pressed = [_knots.drawn(3.0, 1e4, friction)[1] for friction in (0.0, 0.02, 0.1, 0.3)]
    assert (np.diff(pressed) > 0.0).all() and pressed[-1] > 1.4 * pressed[0]

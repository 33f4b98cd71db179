"""Decisions of the line search of a rod: Armijo's rule, the residual test below the rounding floor, and failures."""

import numpy as np
import pytest
import warp as wp

from ddg_warp.kernels.core import islands, outcome
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.newton.line_search import decide_kernels

STEP, DECREASE, MAX_BACKTRACKS = 0.5, 2.0, 3  # length of the step; predicted decrease of a whole step [J]
ROUNDING, SQUARE = 1e-6, 9.0  # rounding floor of the energy [J]; squared residual of the last iterate
LIMIT = -1e-4 * STEP * DECREASE  # Armijo's [J], without rounding
CASES = {  # name -> change of the energy [J], predicted decrease [J], squared residual, accepted
    "sufficient decrease": (LIMIT, DECREASE, 1e9, True),
    "half the sufficient decrease": (0.5 * LIMIT, DECREASE, 0.0, False),
    "no change": (0.0, DECREASE, 0.0, False),
    "increase": (-LIMIT, DECREASE, 0.0, False),
    "increase below rounding, residual less than doubled": (1.0, 10.0 * ROUNDING, 3.9 * SQUARE, True),
    "decrease below rounding, residual more than doubled": (-1.0, 10.0 * ROUNDING, 4.1 * SQUARE, False),
    "infinite energy": (np.inf, DECREASE, 0.0, False),
}


def decided(device, backtracks: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return flags and scalars after the decision on an iterate of each case, a rod each."""
    decide_action, _ = decide_kernels(RodKind(3, False, False, ()), wp.float64, False)
    change, predicted, square, _ = np.array(list(CASES.values()), float).T
    flags = np.zeros((len(islands.FLAGS), len(CASES)), np.int32)
    scalars = np.zeros((len(islands.SCALARS), len(CASES)))
    flags[islands.NOT_CONVERGED] = flags[islands.ITERATION] = 1
    flags[islands.BACKTRACKS] = backtracks
    scalars[islands.STEP_LENGTH], scalars[islands.PREDICTED_DECREASE] = STEP, predicted
    scalars[islands.RESIDUAL_NORM_SQ] = SQUARE
    sums = np.stack([change, np.full(len(CASES), ROUNDING), square, np.sqrt(square)])[:, None]
    flags = wp.array(flags, device=device)
    sums, scalars = (wp.array(values, dtype=wp.float64, device=device) for values in (sums, scalars))
    wp.launch(decide_action, len(CASES), [sums, 1, 1.0, 9, MAX_BACKTRACKS, flags, scalars], device=device)
    return flags.numpy(), scalars.numpy()


@pytest.mark.parametrize("case", CASES)
def test_iterates_are_accepted_or_backtracked(device, case):
    flags, scalars = decided(device)
    accepted, rod = CASES[case][-1], list(CASES).index(case)
    assert flags[islands.ITERATION, rod] == 1 + accepted
    assert flags[islands.NEEDS_DIRECTION, rod] == accepted
    assert flags[islands.BACKTRACKS, rod] == 1 - accepted
    length = scalars[islands.STEP_LENGTH, rod]
    assert length == STEP if accepted else 0.1 * STEP <= length <= 0.5 * STEP


def test_a_rod_without_backtracks_left_fails(device):
    flags, _ = decided(device, MAX_BACKTRACKS)
    failed = [not accepted for *_, accepted in CASES.values()]
    np.testing.assert_array_equal(flags[islands.STATUS] == outcome.LINE_SEARCH_FAILED, failed)

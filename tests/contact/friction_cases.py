"""What tests of friction on pairs share: scenes whose contact is lagged and then silent, moved on by some slip."""

import numpy as np
import pytest
import warp as wp
from pair_cases import CASES, bundle, central, terms, times

MU, RATE, VELOCITY = 0.4, 100.0, 0.01
SLIP = VELOCITY / RATE  # at which the polynomial law slides
SLIPS = {"logistic": 0.15 * SLIP, "polynomial": 0.7 * SLIP}  # where some of a scene stick and others slide
ROLLING = "rolling"  # the parallel ones, with angles
each_case = pytest.mark.parametrize("case", CASES)
each_form = pytest.mark.parametrize("form", ["logistic", "polynomial"])


def rates(result, *values) -> wp.array:
    return wp.array(values or [RATE], dtype=result.real, device=result.device)


def rubbed(case: str, device, form: str = "logistic", slip: float | None = None, seed: int = 1, **options):
    """Terms of friction alone, lagged and moved on by about `slip`: terms, positions on the device, and both positions."""
    shapes, x = bundle(rolls=True) if case == ROLLING else CASES[case]()
    result, at = terms(shapes, x, device, **{"friction": MU, "velocity": VELOCITY, "friction_law": form, **options})
    result.lag(at)
    result.law.stiffness.zero_()
    after = x + (slip or SLIPS[form]) * np.random.default_rng(seed).normal(size=x.shape)
    at.assign(after)
    result.evaluate(at, rates(result))
    return result, at, x, after


def hold_to_differences(result, at: wp.array, after: np.ndarray) -> None:
    """Forces and products with random vectors at positions `after`, which are at `at`, against central differences."""
    forces = result.forces.numpy().copy()
    for seed in range(5):
        v = np.random.default_rng(seed).normal(size=after.shape)
        product, exact = times(result, v), times(result, v, at)
        assert (product == exact).all()

        def quantities(s, v=v):
            at.assign(after + s * v)
            result.evaluate(at, rates(result))
            return np.append(result.energy.numpy()[0], result.forces.numpy().ravel())

        slopes = central(quantities, 2e-8)
        at.assign(after)
        result.evaluate(at, rates(result))
        assert slopes[0] == pytest.approx(-(forces * v).sum(), rel=1e-6)
        assert np.abs(product.ravel() + slopes[1:]).max() < 1e-6 * np.abs(product).max()

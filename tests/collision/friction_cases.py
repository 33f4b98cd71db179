"""Cases for tests of pair friction: scenes with lagged, then silent contact, moved by some slip."""

import numpy as np
import pytest
import warp as wp
from pair_cases import CASES, bundle, central, hessian_product, terms

MU, RATE, VELOCITY = 0.4, 100.0, 0.01
SLIP = VELOCITY / RATE  # slip at which the polynomial law slides [m]
SLIPS = {"logistic": 0.15 * SLIP, "polynomial": 0.7 * SLIP}  # slips at which some pairs stick and others slide [m]
ROLLING = "rolling"  # parallel rods with twist angles, among surfaces of rigid bodies
each_case = pytest.mark.parametrize("case", CASES)
each_form = pytest.mark.parametrize("form", ["logistic", "polynomial"])


def rates(result, *values) -> wp.array:
    return wp.array(values or [RATE], dtype=result.real, device=result.device)


def friction_terms(case: str, device, form: str = "logistic", slip: float | None = None, seed: int = 1, **options):
    """Return terms of friction alone, lagged and moved by about `slip`: terms, device positions, positions before and after."""
    shapes, x = bundle(rolls=True) if case == ROLLING else CASES[case]()
    result, positions = terms(
        shapes, x, device, **{"friction": MU, "velocity": VELOCITY, "friction_law": form, **options}
    )
    result.lag(positions)
    result.law.stiffness.zero_()
    after = x + (slip or SLIPS[form]) * np.random.default_rng(seed).normal(size=x.shape)
    positions.assign(after)
    result.evaluate(positions, rates(result))
    return result, positions, x, after


def assert_central_differences(result, positions: wp.array, after: np.ndarray) -> None:
    """Assert that forces and products with random vectors equal central differences.

    The positions are `after`, on the host, and `positions` on the device.
    """
    forces = result.forces.numpy().copy()
    for seed in range(5):
        v = np.random.default_rng(seed).normal(size=after.shape)
        product, exact = hessian_product(result, v), hessian_product(result, v, positions)
        assert (product == exact).all()

        def quantities(s, v=v):
            positions.assign(after + s * v)
            result.evaluate(positions, rates(result))
            return np.append(result.energy.numpy()[0], result.forces.numpy().ravel())

        slopes = central(quantities, 2e-8)
        positions.assign(after)
        result.evaluate(positions, rates(result))
        assert slopes[0] == pytest.approx(-(forces * v).sum(), rel=1e-6)
        assert np.abs(product.ravel() + slopes[1:]).max() < 1e-6 * np.abs(product).max()

"""What tests of friction on pairs share: scenes whose contact is lagged and then silent, moved on by some slip."""

import numpy as np
import pytest
import warp as wp
from pair_cases import CASES, terms

MU, RATE, VELOCITY = 0.4, 100.0, 0.01
SLIP = VELOCITY / RATE  # at which the polynomial law slides
SLIPS = {"logistic": 0.15 * SLIP, "polynomial": 0.7 * SLIP}  # where some of a scene stick and others slide
each_case = pytest.mark.parametrize("case", CASES)
each_form = pytest.mark.parametrize("form", ["logistic", "polynomial"])


def rates(result, *values) -> wp.array:
    return wp.array(values or [RATE], dtype=result.real, device=result.device)


def rubbed(case: str, device, form: str = "logistic", slip: float | None = None, seed: int = 1, **options):
    """Terms of friction alone, lagged and moved on by about `slip`: terms, positions on the device, and both positions."""
    shapes, x = CASES[case]()
    result, at = terms(shapes, x, device, **{"friction": MU, "velocity": VELOCITY, "friction_law": form, **options})
    result.lag(at)
    result.law.stiffness.zero_()
    after = x + (slip or SLIPS[form]) * np.random.default_rng(seed).normal(size=x.shape)
    at.assign(after)
    result.evaluate(at, rates(result))
    return result, at, x, after

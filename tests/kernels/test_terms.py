"""Every derivative of every term, open and closed, in both precisions, against something else that computes it."""

from functools import cache

import numpy as np
import pytest

from ddg_warp.kernels.terms import REGISTRY
from ddg_warp.run import derivatives

# Each has kernels of its own in each sort of chain: every day edges and vertices, with damping, in space and in the plane, and one
# of them in closed chains. (A stretch has its measure in common with the damped one, and its density with bending.)
DAILY = ("rod_stretch_damped", "rod_bend_twist", "planar_bend")
CLOSED = ("planar_bend",)
CASES = [
    pytest.param(
        *(precision, name, closed, check),
        marks=[] if precision == "float64" and name in (CLOSED if closed else DAILY) else pytest.mark.slow,
        id="-".join((precision, name, "closed" if closed else "open", check)),
    )
    for precision in ("float64", "float32")
    for name, term in REGISTRY.items()
    for closed in (False, True)
    for check in derivatives.checks_of(term, closed, precision)
]


@cache
def rows(term: str, closed: bool, precision: str, device: str) -> dict:
    """The derivative table of a term in one chain, by check."""
    table = derivatives.table(term, precision, device, chains=(closed,))
    return {row["check"]: row for row in table}


@pytest.mark.parametrize(("precision", "term", "closed", "check"), CASES)
def test_derivative(device, precision, term, closed, check):
    row = rows(term, closed, precision, device)[check]
    assert row["passed"], f"error {row['error']:.2e}, tolerance {row['tolerance']:.0e}"


def test_nothing_is_left_out():
    """Each term meets every check in one chain at least, in float64."""
    for term in REGISTRY.values():
        assert derivatives.checks_of(term, False, "float64") == list(derivatives.CHECKS)


@pytest.mark.parametrize("term", ["rod_bend_twist", "rod_stretch_damped"])
def test_sample_is_general(term):
    """Nothing of the state is zero, frames are old, and twist has passed several turns: no check passes by accident."""
    case = derivatives.Case(REGISTRY[term], derivatives.chain_of(REGISTRY[term], True), "float64", "cpu")
    sample = case.sample
    inside = np.arange(6)[:, None] < sample.count
    for name, values in sample.data.items():
        assert np.all(values[..., inside] if values.shape[-2:] == inside.shape else values), name
    t, t0 = sample.edges(), np.moveaxis(sample.data["frame"][3:6], 0, -1)
    age = np.arccos(np.sum(t * t0, -1) / np.linalg.norm(t, axis=-1))
    np.testing.assert_allclose(age[inside], np.radians(25.0), rtol=1e-12)
    assert np.abs(sample.data["frame"][6]).max() > 2.0 * np.pi

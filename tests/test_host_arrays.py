"""Passes over host arrays on several cores: results do not depend on the size of an array."""

import numpy as np
import pytest

from ddg_warp import host_arrays


@pytest.fixture(autouse=True)
def small_passes_are_shared(monkeypatch):
    """Split passes over arrays of any size."""
    monkeypatch.setattr(host_arrays, "LARGE", 0)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_all_finite(wrong):
    """A number that is not finite is found anywhere, and sums may overflow."""
    values = np.full((17, 3), 1e308)
    assert host_arrays.all_finite(values)
    assert host_arrays.all_finite(np.zeros((1, 0)))
    values[11, 1] = wrong
    assert not host_arrays.all_finite(values)


@pytest.mark.parametrize("shape", [(17, 2, 3), (1, 2, 3)])
def test_fill(shape):
    """All rows are filled once, in order, with values for all or for each of them."""
    out, values = np.zeros((17, 2, 3)), np.random.default_rng(0).normal(size=shape)
    rows = np.concatenate([np.arange(17)[part] for part in host_arrays.fill(out, values)])
    np.testing.assert_array_equal(rows, np.arange(17))
    np.testing.assert_array_equal(out, np.broadcast_to(values, out.shape))

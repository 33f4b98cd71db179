"""Sums over worlds on a device: equal to NumPy's around the borders of tiles, and to the bit in every launch."""

import numpy as np
import pytest
import warp as wp

from ddg_warp.kernels.linear.coupled_pcg import THREADS, TILE
from ddg_warp.solve.linear.sparse_system import Sums


@pytest.mark.parametrize("real", [wp.float32, wp.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("largest", [False, True], ids=["sum", "largest"])
@pytest.mark.parametrize(
    ("worlds", "n"),
    [(1, 1), (1, TILE - 1), (1, TILE), (2, TILE + 1), (300, 7), (50, 3 * TILE + 5), (1, TILE * (THREADS + 1) + 3)],
)
def test_sums_of_worlds(device, real, largest, worlds, n):
    values = np.random.default_rng(n).random((worlds, n)).astype(wp.dtype_to_numpy(real))
    sums, out = Sums(worlds, n, real, device, largest), wp.zeros(worlds, dtype=real, device=device)
    expected = values.max(1) if largest else values.astype(float).sum(1)
    results = []
    for _ in range(5):
        out.fill_(-1.0)
        sums(wp.array(values, dtype=real, device=device), out)
        results.append(out.numpy())
    tolerance = n * np.finfo(values.dtype).eps if wp.get_device(device).is_cpu else 50 * np.finfo(values.dtype).eps
    np.testing.assert_allclose(results[0], expected, rtol=0.0 if largest else tolerance, atol=0.0)
    assert all(result.tobytes() == results[0].tobytes() for result in results)

"""Further right-hand sides by stored factors of cyclic reduction, against dense solves."""

import numpy as np
import pytest
import warp as wp
from rod_system import system

from ddg_warp import device_arrays
from ddg_warp.solve.linear.cyclic_reduction import CyclicReduction

COUNTS = (2, 3, 4, 5, 17, 31, 32, 33, 50, 64)


@pytest.mark.parametrize("nb", [3, 4])
def test_further_right_hand_sides_match_dense_solves(device, nb):
    """Solve two systems in succession with two right-hand sides each; inactive columns keep their values."""
    rng, columns = np.random.default_rng(3), len(COUNTS)
    reduction = CyclicReduction(nb, max(COUNTS), columns, wp.float64, device, repeated=True)
    count, every = wp.array(COUNTS, dtype=int, device=device), wp.full(columns, 1, dtype=int, device=device)
    lost, active = wp.zeros(columns, dtype=int, device=device), np.arange(columns) % 5 != 0
    for _ in range(2):
        bands, matrices = system(nb, COUNTS, rng)
        matrix = device_arrays.upload(bands, wp.float64, device)
        rhs = rng.normal(size=(2, nb, max(COUNTS), columns))
        inputs = [device_arrays.upload(values, wp.float64, device) for values in rhs]
        solution = device_arrays.upload(np.full(rhs.shape[1:], 7.0), wp.float64, device)
        reduction.solve(matrix, inputs[0], count, every, inputs[0], lost)
        reduction.again(inputs[1], count, wp.array(np.where(active, 1, 2), dtype=int, device=device), 1, solution)
        assert (lost.numpy() == 0).all()
        first, second = device_arrays.download(inputs[0]), device_arrays.download(solution)
        for column, (n, H) in enumerate(zip(COUNTS, matrices, strict=True)):
            expected = np.linalg.solve(H, rhs[0, :, :n, column].T.ravel())
            np.testing.assert_allclose(
                first[:, :n, column].T.ravel(), expected, rtol=0, atol=1e-11 * abs(expected).max()
            )
            if not active[column]:
                assert (second[:, :, column] == 7.0).all()
                continue
            expected = np.linalg.solve(H, rhs[1, :, :n, column].T.ravel())
            np.testing.assert_allclose(
                second[:, :n, column].T.ravel(), expected, rtol=0, atol=1e-11 * abs(expected).max()
            )
            assert (second[:, n:, column] == 7.0).all()


def test_in_place_solve_skips_inactive_worlds(device):
    """Overwrite right-hand sides by solutions, for three rods in each of two worlds; the second world is inactive."""
    rng, nb, n = np.random.default_rng(4), 3, 40
    H = np.zeros((3, nb, nb, n, 6))
    H[0] = 10.0 * np.eye(nb)[:, :, None, None]
    H[1:] = 0.5 * rng.normal(size=H[1:].shape)
    reduction = CyclicReduction(nb, n, 6, wp.float64, device, repeated=True)
    matrix = device_arrays.upload(H.reshape(3 * nb**2, n, 6), wp.float64, device)
    count, every = wp.full(6, n, dtype=int, device=device), wp.full(6, 1, dtype=int, device=device)
    rhs = rng.normal(size=(nb, n, 6))
    right_sides, lost = (
        (device_arrays.upload(rhs, wp.float64, device) for _ in range(2)),
        wp.zeros(6, dtype=int, device=device),
    )
    first, second = right_sides
    reduction.solve(matrix, first, count, every, first, lost)
    reduction.again(second, count, wp.array([1, 2], dtype=int, device=device), 3, second)
    first_solution, second_solution = device_arrays.download(first), device_arrays.download(second)
    np.testing.assert_allclose(second_solution[..., :3], first_solution[..., :3], rtol=1e-12, atol=1e-13)
    assert (second_solution[..., 3:] == rhs[..., 3:]).all()


def test_rods_of_two_nodes_match_dense_solve(device):
    """Rods of two nodes leave no level to reduce."""
    rng, nb = np.random.default_rng(5), 3
    L = rng.normal(size=(2 * nb, 2 * nb))
    H, rhs = L @ L.T + np.eye(2 * nb), rng.normal(size=(2, 2 * nb))
    bands = np.zeros((3, nb, nb, 2, 1))
    bands[0, :, :, 0, 0], bands[0, :, :, 1, 0], bands[1, :, :, 0, 0] = H[:nb, :nb], H[nb:, nb:], H[:nb, nb:]
    reduction = CyclicReduction(nb, 2, 1, wp.float64, device, repeated=True)
    matrix = device_arrays.upload(bands.reshape(3 * nb**2, 2, 1), wp.float64, device)
    count, wanted, lost = (wp.array([value], dtype=int, device=device) for value in (2, 1, 0))
    reduction.factorise(matrix, count, wanted, lost)
    for r in rhs:
        solution = device_arrays.upload(r.reshape(2, nb).T[..., None], wp.float64, device)
        reduction.again(solution, count, wanted, 1, solution)
        np.testing.assert_allclose(
            device_arrays.download(solution)[..., 0].T.ravel(), np.linalg.solve(H, r), rtol=1e-10
        )

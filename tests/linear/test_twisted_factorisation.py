"""Twisted factorisation (elimination from both ends) against dense solves."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from rod_system import system

from ddg_warp import device_arrays
from ddg_warp.kernels.linear.rod_dof_map import path_node_dofs
from ddg_warp.solve.linear.twisted_factorisation import TwistedFactorisation

COUNTS = (1, 2, 3, 4, 5, 6, 17, 32, 33)
LONGEST, WIDTH = max(COUNTS), len(COUNTS)
FROM = np.cumsum([0, *COUNTS])  # first node of each rod


def dof_map(twist: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the dof map (2, longest, rods) of consecutive rods, twist angles last, and fixed-dof bits (longest, rods)."""
    places, fixed = np.full((2, LONGEST, WIDTH), -1), np.zeros((LONGEST, WIDTH), np.uint8)
    for c, n in enumerate(COUNTS):
        places[0, :n, c] = np.arange(FROM[c], FROM[c] + n)
        if twist:
            places[1, : n - 1, c] = FROM[-1] + np.arange(FROM[c], FROM[c] + n - 1)
        fixed[n // 3, c] = 2  # y
    return places, fixed


def constrain_fixed_dofs(
    bands: np.ndarray, matrices: list, places: np.ndarray, fixed: np.ndarray, nb: int
) -> list[np.ndarray]:
    """Replace rows and columns of fixed and absent dofs by the identity in bands and matrices; return masks of free dofs."""
    free = []
    bands = bands.reshape(3, nb, nb, LONGEST, WIDTH)
    for c, (n, H) in enumerate(zip(COUNTS, matrices, strict=True)):
        is_free = np.array([[not fixed[k, c] >> d & 1 for d in range(nb)] for k in range(n)])
        if nb > 3:
            is_free[:, 3] &= places[1, :n, c] >= 0
        removed = ~is_free.ravel()
        H[removed] = H[:, removed] = 0.0
        H[removed, removed] = 1.0
        blocks = H.reshape(n, nb, n, nb)
        for k in range(n):
            for offset in range(min(3, n - k)):
                bands[offset, :, :, k, c] = blocks[k, :, k + offset]
        free.append(is_free)
    return free


@pytest.mark.parametrize(("twist", "span"), [(False, 1), (False, 2), (True, 2)])
@pytest.mark.parametrize("in_place", [False, True])
def test_solutions_match_dense_solves(device, twist, span, in_place):
    """Solve nine rods of two worlds; an inactive world and an inactive rod keep their values."""
    rng, nb, worlds, inactive = np.random.default_rng(5), path_node_dofs(twist), 2, 4
    places, fixed = dof_map(twist)
    bands, matrices = system(nb, COUNTS, rng, span)
    free = constrain_fixed_dofs(bands, matrices, places, fixed, nb)
    total = FROM[-1] * (2 if twist else 1)
    columns = worlds * WIDTH
    inputs = (
        device_arrays.upload(places.astype(np.int32), int, device),
        device_arrays.upload(fixed, wp.uint8, device),
        wp.array(COUNTS, dtype=int, device=device),
        wp.array(np.arange(columns) % WIDTH == inactive, dtype=int, device=device),
    )
    both = TwistedFactorisation(SimpleNamespace(twist=twist, span=span, block=nb), columns, wp.float64, device, 32)
    rows = np.concatenate([np.tile(bands, (1, 1, worlds)), np.zeros((nb, LONGEST, columns))])
    factors = device_arrays.upload(rows, wp.float64, device)
    matrix = factors if in_place else device_arrays.upload(rows[:-nb], wp.float64, device)
    wanted, lost = wp.array([1, 0], dtype=int, device=device), wp.zeros(worlds, dtype=int, device=device)
    residual = rng.normal(size=(worlds * total, 3))
    z = wp.array(np.full((worlds * total, 3), 7.0), dtype=wp.vec3d, device=device)
    dots = wp.array(np.full((worlds, total), 7.0), dtype=wp.float64, device=device)
    values = device_arrays.allocate((nb, LONGEST, columns), wp.float64, device)
    both.factorise(matrix, *inputs[2:], wanted, factors, lost)
    solve_inputs = wp.array(residual, dtype=wp.vec3d, device=device), *inputs, wanted, total
    both.solve(factors, solve_inputs, values, z, dots)
    z, dots = z.numpy(), dots.numpy()
    assert (lost.numpy() == 0).all()
    assert (z[total:] == 7.0).all()
    assert (dots[1] == 7.0).all()
    for c, (n, H) in enumerate(zip(COUNTS, matrices, strict=True)):
        nodes = np.arange(FROM[c], FROM[c] + n)
        if c == inactive:
            assert (z[nodes] == 7.0).all()
            continue
        rhs = np.zeros((n, nb))
        rhs[:, :3] = residual[nodes]
        if twist:
            rhs[:-1, 3] = residual[FROM[-1] + nodes[:-1], 0]
        expected = np.linalg.solve(H, (rhs * free[c]).ravel()).reshape(n, nb)
        np.testing.assert_allclose(z[nodes], expected[:, :3], rtol=0, atol=1e-11 * abs(expected).max())
        np.testing.assert_allclose(dots[0, nodes], (residual[nodes] * z[nodes]).sum(1), rtol=1e-12, atol=1e-14)
        if twist:
            angles = FROM[-1] + nodes[:-1]
            np.testing.assert_allclose(z[angles, 0], expected[:-1, 3], rtol=0, atol=1e-11 * abs(expected).max())
            np.testing.assert_allclose(dots[0, angles], residual[angles, 0] * z[angles, 0], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("node", [0, 3, 4, 7])
def test_negative_pivots_are_counted(device, node):
    """A negative pivot is counted on either side and at the two middle nodes."""
    n, nb = 8, 3
    bands = np.zeros((3 * nb**2 + nb, n, 1))
    bands[: nb**2 : nb + 1] = 1.0
    bands[nb + 1, node] = -1.0
    factors = device_arrays.upload(bands, wp.float64, device)
    both = TwistedFactorisation(SimpleNamespace(twist=False, span=2, block=nb), 1, wp.float64, device, 32)
    count, inactive = wp.full(1, n, dtype=int, device=device), wp.zeros(1, dtype=int, device=device)
    lost = wp.zeros(1, dtype=int, device=device)
    both.factorise(factors, count, inactive, wp.full(1, 1, dtype=int, device=device), factors, lost)
    assert lost.numpy()[0] == 1

"""Substitution along open chains by a thread each, however far ahead it reads."""

import numpy as np
import pytest
import warp as wp

from ddg_warp.kernels.matrix.block_band import factor_function, substitute_function

NB, SPAN = 4, 2  # dofs of a node, and nodes ahead that it is coupled with


def kernels(linear, deep: bool):
    factor, substitute = factor_function(NB, SPAN, linear), substitute_function(NB, SPAN, linear, deep=deep)

    @wp.kernel(module="unique", enable_backward=False)
    def factorise(blocks: wp.array3d(dtype=linear), factors: wp.array3d(dtype=linear), n: int):
        r = wp.tid()
        _lost = factor(blocks, factors, n, r)

    @wp.kernel(module="unique", enable_backward=False)
    def solve(factors: wp.array3d(dtype=linear), v: wp.array3d(dtype=linear), n: int):
        r = wp.tid()
        _total = substitute(factors, v, v, n, r, r)

    return factorise, solve


@pytest.mark.parametrize("nodes", [1, 2, 3, 9])
def test_one_node_ahead_and_two(device, nodes):
    """Both solve H x = v, of H made of the blocks as a full matrix, and agree to the bit."""
    rng, chains = np.random.default_rng(nodes), 3
    blocks = 0.3 * rng.normal(size=(3 * NB**2, nodes, chains))
    diagonal = blocks[: NB**2].reshape(NB, NB, nodes, chains)
    diagonal += diagonal.swapaxes(0, 1) + 6.0 * np.eye(NB)[:, :, None, None]
    v = rng.normal(size=(NB, nodes, chains))
    found = []
    for deep in (False, True):
        factorise, solve = kernels(wp.float64, deep)
        given, x = (wp.array(values, dtype=wp.float64, device=device) for values in (blocks, v))
        factors = wp.zeros((3 * NB**2 + NB, nodes, chains), dtype=wp.float64, device=device)
        wp.launch(factorise, chains, [given, factors, nodes], device=device)
        wp.launch(solve, chains, [factors, x, nodes], device=device)
        found.append(x.numpy())
    assert (found[0] == found[1]).all()
    for r in range(chains):
        full = np.zeros((nodes, NB, nodes, NB))
        for k in range(nodes):
            for ahead in range(min(SPAN + 1, nodes - k)):
                block = blocks[ahead * NB**2 : (ahead + 1) * NB**2, k, r].reshape(NB, NB)
                full[k, :, k + ahead], full[k + ahead, :, k] = block, block.T
        expected = np.linalg.solve(full.reshape(nodes * NB, -1), v[:, :, r].T.ravel())
        np.testing.assert_allclose(found[0][:, :, r].T.ravel(), expected, rtol=0, atol=1e-12)

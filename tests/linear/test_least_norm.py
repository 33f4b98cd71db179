"""Least-norm solutions by a sparse direct solver."""

import numpy as np
import pytest
from scipy.sparse import csc_matrix, csr_matrix

from ddg_warp.solve.linear import sparse_direct


def square_systems():
    """Yield (A, whether A without its empty columns is regular), with entries of very different size."""
    rng = np.random.default_rng(3)
    regular = (rng.normal(size=(12, 12)) + 4.0 * np.eye(12)) * 10.0 ** rng.uniform(-3, 3, 12)
    yield np.insert(regular, 4, 0.0, axis=1), True
    singular = regular.copy()
    singular[5] = singular[7]
    yield singular, False
    yield np.delete(regular, 3, axis=0), False


@pytest.mark.parametrize(("matrix", "is_regular"), [*square_systems()])
def test_shortest_solution(matrix, is_regular):
    """Square systems are factorised directly, and singular and wide ones have the least norm."""
    matrix = csr_matrix(matrix)
    rhs = matrix @ np.random.default_rng(4).normal(size=matrix.shape[1])
    assert (sparse_direct._square_solve(csc_matrix(matrix)) is not None) == is_regular
    solution = sparse_direct.shortest(matrix, rhs)
    expected = np.linalg.lstsq(matrix.toarray(), rhs, rcond=1e-14)[0]
    np.testing.assert_allclose(matrix @ solution, rhs, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(solution), np.linalg.norm(expected), rtol=1e-6)

"""Sparse direct solution of symmetric systems with their inertia (SuperLU), and of equations that leave a choice; of moderate size."""

from functools import cached_property

import numpy as np
from scipy.linalg import qr
from scipy.sparse import bmat, csc_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import norm, splu

SHIFTS = (1e-13, 1e-11, 1e-9)  # of a singular matrix, over its largest eigenvalue as its diagonal shows it

REPEATED = 1e-15  # of equations, over their size: so little keeps regular those that say the same twice
CORRECTIONS = 20  # at most, of what rounding and that leave


class SingularError(RuntimeError):
    """A matrix has no inverse."""


class Factorisation:
    """L U of a symmetric matrix with symmetric permutation, so that the signs of the pivots give its inertia (Sylvester).

    Rows and columns are scaled to a unit diagonal first: stretching and bending stiffness are many orders apart.

    Attributes:
        negative: number of negative pivots, which is that of negative eigenvalues.
        reliable: whether no row was exchanged, without which `negative` means nothing.

    Raises:
        SingularError: a pivot is exactly zero.
    """

    def __init__(self, matrix: csc_matrix):
        diagonal = np.abs(matrix.diagonal())
        self._scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        scaling = diags(self._scale)
        try:
            self._lu = splu(
                csc_matrix(scaling @ matrix @ scaling),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise SingularError("the tangent is singular: something can move without any stiffness") from error
        self.reliable = bool(np.array_equal(self._lu.perm_r, self._lu.perm_c))

    @cached_property
    def negative(self) -> int:
        """Number of negative pivots; read when it is asked for, as SuperLU copies all of U for it."""
        return int(self.negative_rows.sum())

    @cached_property
    def negative_rows(self) -> np.ndarray:
        """Whether the pivot of each row is negative (n,) bool."""
        return (self._lu.U.diagonal() < 0.0)[self._lu.perm_c]

    def solve(self, b: np.ndarray) -> np.ndarray:
        """x with A x = b, for a vector or for columns."""
        scale = self._scale if b.ndim == 1 else self._scale[:, None]
        return scale * self._lu.solve(scale * b)


def pinned(matrix: csc_matrix, known: np.ndarray) -> csc_matrix:
    """A symmetric matrix with null vectors (n, m), made regular by a spring at each of m dofs that together move in all of them.

    It has as many negative eigenvalues as before, and where the right side does no work along the null vectors its solution is one
    of the matrix without springs.
    """
    if not known.shape[1]:
        return matrix
    diagonal = np.abs(matrix.diagonal())
    diagonal = np.where(diagonal > 0.0, diagonal, diagonal.max(initial=0.0) or 1.0)
    chosen = qr((np.sqrt(diagonal)[:, None] * known).T, mode="r", pivoting=True)[1][: known.shape[1]]
    springs = np.zeros(len(diagonal))
    springs[chosen] = diagonal[chosen]
    return csc_matrix(matrix + diags(springs))


def regular(matrix: csc_matrix, mass: np.ndarray) -> tuple[Factorisation, float]:
    """Factors of K - s M and s, which is zero unless K is singular; then it is as little below zero as rounding lets it be.

    Args:
        matrix: K, symmetric.
        mass: diagonal of M; what has none is given a part of its own stiffness instead.
    """
    diagonal, massive = np.abs(matrix.diagonal()), mass > 0.0
    own = np.where(diagonal > 0.0, diagonal, diagonal.max(initial=0.0) or 1.0)
    rate = (own[massive] / mass[massive]).max(initial=0.0) or 1.0
    for part in (0.0, *SHIFTS):
        added = np.where(massive, part * rate * mass, part * own)
        try:
            return Factorisation(csc_matrix(matrix + diags(added))), -part * rate
        except SingularError:
            continue
    raise SingularError("the tangent is singular whatever is added to it: it is not finite")


def shortest(matrix: csr_matrix, right: np.ndarray) -> np.ndarray:
    """The shortest y with A y = b, by the augmented system [1, A^T; A, 0] (Bjorck, Numerical methods for least squares problems, 1996).

    Equations may say the same twice; of those that contradict each other something is left, for the caller to see.
    """
    size = norm(matrix, axis=1)
    scaling = diags(1.0 / np.where(size > 0.0, size, 1.0))
    matrix, right = scaling @ matrix, scaling @ right
    rows, columns = matrix.shape
    factors = splu(bmat([[identity(columns), matrix.T], [matrix, -REPEATED * identity(rows)]], format="csc"))
    found, left = np.zeros(columns), right
    for _ in range(CORRECTIONS):
        tried = found + factors.solve(np.concatenate([np.zeros(columns), left]))[:columns]
        now = right - matrix @ tried
        if not np.linalg.norm(now) < 0.5 * np.linalg.norm(left):
            break
        found, left = tried, now
    return found

"""Sparse direct solvers: symmetric systems with inertia (SuperLU), and least-norm solutions; moderate sizes."""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from scipy.linalg import qr
from scipy.sparse import bmat, csc_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import splu

SHIFTS = (1e-13, 1e-11, 1e-9)  # shifts of a singular matrix over its largest diagonal stiffness

SINGULAR = 1e10  # norm of the inverse of a scaled matrix, from which on it counts as singular
REPEATED = 1e-15  # relative regularisation of repeated equations
CORRECTIONS = 20  # limit of refinement steps of rounding and regularisation


class SingularError(RuntimeError):
    """Singular matrix."""


class Factorisation:
    """LU factors of a symmetric matrix with symmetric permutation: pivot signs give the inertia (Sylvester).

    Rows and columns are scaled to a unit diagonal first: stretching and bending stiffness are many orders apart.

    Attributes:
        negative: number of negative pivots, equal to that of negative eigenvalues.
        reliable: True if no row was exchanged; else `negative` is meaningless.

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
        """Number of negative pivots; evaluated on demand, since SuperLU copies all of U."""
        return int(self.negative_rows.sum())

    @cached_property
    def negative_rows(self) -> np.ndarray:
        """Mask of rows with a negative pivot (n,) bool."""
        return (self._lu.U.diagonal() < 0.0)[self._lu.perm_c]

    def solve(self, b: np.ndarray) -> np.ndarray:
        """Return x with A x = b, for a vector or for columns."""
        scale = self._scale if b.ndim == 1 else self._scale[:, None]
        return scale * self._lu.solve(scale * b)


def pinned(matrix: csc_matrix, null_vectors: np.ndarray) -> csc_matrix:
    """Return a symmetric matrix with null vectors (n, m) made regular by springs at m dofs that restrain all of them.

    The number of negative eigenvalues is unchanged. If the right-hand side does no work along the null vectors, the solution also
    solves the system without springs.
    """
    if not null_vectors.shape[1]:
        return matrix
    diagonal = np.abs(matrix.diagonal())
    diagonal = np.where(diagonal > 0.0, diagonal, diagonal.max(initial=0.0) or 1.0)
    chosen = qr((np.sqrt(diagonal)[:, None] * null_vectors).T, mode="r", pivoting=True)[1][: null_vectors.shape[1]]
    springs = np.zeros(len(diagonal))
    springs[chosen] = diagonal[chosen]
    return csc_matrix(matrix + diags(springs))


def regular(matrix: csc_matrix, mass: np.ndarray) -> tuple[Factorisation, float]:
    """Return the factors of K - s M and s: zero for a regular K, else the smallest effective negative shift.

    Args:
        matrix: K, symmetric.
        mass: diagonal of M; massless dofs take their own stiffness instead.
    """
    diagonal, massive = np.abs(matrix.diagonal()), mass > 0.0
    stiffness = np.where(diagonal > 0.0, diagonal, diagonal.max(initial=0.0) or 1.0)
    rate = (stiffness[massive] / mass[massive]).max(initial=0.0) or 1.0
    for shift in (0.0, *SHIFTS):
        added = np.where(massive, shift * rate * mass, shift * stiffness)
        try:
            return Factorisation(csc_matrix(matrix + diags(added))), -shift * rate
        except SingularError:
            continue
    raise SingularError("the tangent is not finite, and stays singular with any shift")


def shortest(matrix: csr_matrix, rhs: np.ndarray) -> np.ndarray:
    """Return the least-norm y with A y = b.

    A regular square matrix is factorised as it is. Others take the augmented system [1, A^T; A, 0], see Bjorck, Numerical methods for
    least squares problems, 1996. Equations may be repeated; contradictory ones leave a residual for the caller to test.
    """
    matrix = csr_matrix(matrix, copy=True)
    matrix.eliminate_zeros()
    rhs = _unit_vectors(matrix) * rhs
    solve = _square_solve(csc_matrix(matrix)) or _augmented_solve(matrix)
    solution, remaining = np.zeros(matrix.shape[1]), rhs
    for _ in range(CORRECTIONS):
        tried = solution + solve(remaining)
        residual = rhs - matrix @ tried
        if not np.linalg.norm(residual) < 0.5 * np.linalg.norm(remaining):
            break
        solution, remaining = tried, residual
    return solution


def _square_solve(matrix: csc_matrix) -> Callable | None:
    """Return the solution y of A y = b as a function of b; None if the nonzero columns of A are not square or nearly singular."""
    rows, columns = matrix.shape
    used = np.flatnonzero(np.diff(matrix.indptr))
    if len(used) != rows:
        return None
    square = csc_matrix((matrix.data, matrix.indices, matrix.indptr[np.append(used, columns)]), shape=(rows, rows))
    scale = _unit_vectors(square)
    try:
        factors = splu(square)
    except RuntimeError:  # exactly singular
        return None
    tried = np.random.default_rng(0).normal(size=rows)
    if not np.linalg.norm(factors.solve(tried)) < SINGULAR * np.linalg.norm(tried):
        return None

    def solve(b: np.ndarray) -> np.ndarray:
        result = np.zeros(columns)
        result[used] = scale * factors.solve(b)
        return result

    return solve


def _unit_vectors(matrix: csr_matrix | csc_matrix) -> np.ndarray:
    """Scale the rows of a CSR, or the columns of a CSC matrix to length 1, in place; return the factors, 1 for empty ones."""
    counts = np.diff(matrix.indptr)
    size = np.sqrt(np.bincount(np.repeat(np.arange(len(counts)), counts), matrix.data**2, len(counts)))
    factors = 1.0 / np.where(size > 0.0, size, 1.0)
    matrix.data *= np.repeat(factors, counts)
    return factors


def _augmented_solve(matrix: csr_matrix) -> Callable:
    """Return the least-norm solution y of A y = b as a function of b."""
    rows, columns = matrix.shape
    factors = splu(bmat([[identity(columns), matrix.T], [matrix, -REPEATED * identity(rows)]], format="csc"))
    return lambda b: factors.solve(np.concatenate([np.zeros(columns), b]))[:columns]

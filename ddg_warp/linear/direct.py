"""Sparse direct solution of symmetric systems with their inertia (SuperLU), for problems of moderate size."""

from functools import cached_property

import numpy as np
from scipy.sparse import csc_matrix, diags
from scipy.sparse.linalg import splu


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
        return int((self._lu.U.diagonal() < 0.0).sum())

    def solve(self, b: np.ndarray) -> np.ndarray:
        """x with A x = b."""
        return self._scale * self._lu.solve(self._scale * b)

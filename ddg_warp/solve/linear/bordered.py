"""Sparse direct solution of K dq - f dl = r with one more condition, regular where K alone is singular (limit points)."""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ddg_warp.solve.linear.sparse_direct import SingularError


class Bordered:
    """LU factors of the bordered system [[K, -f], [e_k, 0]]: equilibrium with one prescribed unknown k.

    All solutions of K dq - f dl = r are a particular one plus a multiple of the tangent of the path. So one sparse factorisation serves
    load, displacement and arc-length control alike, if the unknown k changes along the path (Rheinboldt and Burkardt, ACM Trans. Math.
    Softw. 9, 1983).

    Args:
        matrix: K (n, n), symmetric or not.
        load: f (n,), derivative of the external forces by the load parameter.
        unknown: k; n is the load parameter.

    Raises:
        SingularError: no unique tangent of the path (a bifurcation), or the unknown does not change along it.
    """

    def __init__(self, matrix: sparse.csc_matrix, load: np.ndarray, unknown: int):
        n = matrix.shape[0]
        diagonal = np.abs(matrix.diagonal())
        self._scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, max(1e-300, diagonal.max(initial=1.0))))
        scaling = sparse.diags(self._scale)
        column = self._scale * load
        self._load_scale = 1.0 / max(1e-300, np.abs(column).max(initial=0.0))
        self._unknown_scale = np.append(self._scale, self._load_scale)[unknown]
        row = sparse.csr_matrix(([1.0], ([0], [unknown])), shape=(1, n + 1))
        top = sparse.hstack([scaling @ matrix @ scaling, sparse.csc_matrix(-self._load_scale * column[:, None])])
        try:
            self._lu = splu(sparse.csc_matrix(sparse.vstack([top, row])))
        except RuntimeError as error:
            raise SingularError("the path of equilibria has no single tangent here") from error

    def particular(self, rhs: np.ndarray) -> np.ndarray:
        """Return (dq, dl) (n + 1,) of K dq - f dl = right, with zero change of the unknown k."""
        return self._unscaled(self._lu.solve(np.append(self._scale * rhs, 0.0)))

    def tangent(self) -> np.ndarray:
        """Return (dq, dl) (n + 1,) of K dq - f dl = 0, with unit change of the unknown k."""
        rhs = np.zeros(len(self._scale) + 1)
        rhs[-1] = 1.0 / self._unknown_scale
        return self._unscaled(self._lu.solve(rhs))

    def _unscaled(self, z: np.ndarray) -> np.ndarray:
        return z * np.append(self._scale, self._load_scale)

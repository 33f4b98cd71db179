"""Monolithic friction Newton: sparse factors on the host, with the consistent, unsymmetric friction tangent."""

from collections.abc import Callable

import numpy as np
import warp as wp
from scipy import sparse
from scipy.sparse.linalg import splu

from ddg_warp.model.state import State
from ddg_warp.solve.equilibrium.friction_jacobian import FrictionJacobian
from ddg_warp.solve.linear.exact_contact import ExactContact

STEPS, HALVINGS = 30, 3
SLOW = 0.5  # residual ratio of a step above which the iterate is too far off
SPIN = 1e-10  # relative shift of the diagonal: twist angles of straight free rods have no stiffness
FAR = 0.25  # activation distances: largest displacement of a step


class FrictionNewton:
    """Newton's method for balance with friction by normal forces and tangents of the state itself.

    Lagged normal forces converge linearly at best, slowly where many contacts are about to slide. This takes a few steps; from far
    away it may fail.

    Args:
        `residuals`: residual tests of the model's tangent.
        `share`: returns the CCD step fraction between two dof vectors.
        `reach`: activation distance of contact [m].
    """

    def __init__(self, model, residuals, share: Callable[[np.ndarray, np.ndarray], float], reach: float):
        self.model, self.residuals, self.tangent = model, residuals, residuals.tangent
        self._share, self._longest, self._friction_jacobian = share, FAR * reach, None

    def __call__(self, state: State, load_factor: float, write_sliding: Callable[[State], None]) -> str:
        """Move the state into balance and return the outcome; without balance the state stays, and the outcome is empty.

        Args:
            load_factor: load parameter.
            write_sliding: writes the `Sliding` of a state.
        """
        tangent, free = self.tangent, np.flatnonzero(self.tangent.free)
        trial = state.copy()
        write_sliding(trial)
        matrix = self._matrix(trial, load_factor)
        residual, size, excess, outcome = self._unbalanced(trial, load_factor, write_sliding, matrix)
        for _ in range(STEPS):
            if excess <= 0.0:
                state.assign(trial)
                state.sliding = trial.sliding
                return outcome
            q, step = tangent.dofs(trial), np.zeros(tangent.size)
            try:
                step[free] = splu(matrix[free][:, free]).solve(residual[free])
            except RuntimeError:  # singular matrix
                return ""
            longest = np.abs(np.where(tangent.angle, 0.0, step)).max()
            if not np.isfinite(longest):
                return ""
            fraction, last = min(1.0, self._longest / longest) if longest else 1.0, trial
            for _ in range(HALVINGS):
                trial = last.copy()
                tangent.assign(trial, q + fraction * step)
                if self._share(q, tangent.dofs(trial)) == 1.0:
                    residual, new_size, excess, outcome = self._unbalanced(trial, load_factor, write_sliding, matrix)
                    if new_size < size or excess <= 0.0:
                        break
                fraction *= 0.5
            else:
                return ""
            if excess > 0.0 and new_size > SLOW * size:
                return ""
            size, matrix = new_size, self._matrix(trial, load_factor)
        return ""

    def _unbalanced(
        self, state: State, load_factor: float, write_sliding: Callable, matrix
    ) -> tuple[np.ndarray, float, float, str]:
        """Return the residual (size,), its norm, its excess over the tolerance, and the outcome if there is none.

        The matrix bounds the rounding floor.
        """
        write_sliding(state)
        tangent, residuals, q = self.tangent, self.residuals, self.tangent.dofs(state)
        outer, gradient = tangent.loads(load_factor, q), tangent.gradient(state)
        residual = outer - gradient + tangent.friction(state)
        excess, outcome = residuals.excess(residual, gradient, matrix, q, residuals.load_scale(outer, gradient))
        return residual, float(np.linalg.norm(residuals.scaled(residual)[tangent.free])), excess, outcome

    def _matrix(self, state: State, load_factor: float) -> sparse.csc_matrix:
        coupled, tangent_block, sliding = self.model.coupled, self.tangent.parts[-1], state.sliding
        if self._friction_jacobian is None:
            self._friction_jacobian = FrictionJacobian(coupled, ExactContact(coupled))
        rate = wp.full(coupled.worlds, 1.0 / sliding.increment, dtype=coupled.real, device=coupled.device)
        friction_jacobian = self._friction_jacobian.matrix(state.coupled.q, sliding.begun(state.coupled.q), rate)
        matrix = tangent_block.potential_hessian(state) + tangent_block.matrix(friction_jacobian)
        following = self.tangent.load_stiffness(load_factor, self.tangent.dofs(state))
        matrix = sparse.csc_matrix(matrix if following is None else matrix + following)
        return matrix + sparse.diags(SPIN * np.abs(matrix.diagonal()))

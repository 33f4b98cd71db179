"""The last part of the way to an equilibrium with friction: Newton's method by sparse factors on the host, normal forces included."""

from collections.abc import Callable

import numpy as np
import warp as wp
from scipy import sparse
from scipy.sparse.linalg import splu

from ddg_warp.model.state import State
from ddg_warp.solve.net.exact_contact import ExactContact
from ddg_warp.solve.net.rubbing import Rubbing

STEPS, HALVINGS = 30, 3
SLOW = 0.5  # of what a step leaves: this is not near
SPIN = 1e-10  # of its diagonal that the matrix has more: nothing holds the angles of straight rods that lie about
FAR = 0.25  # of the range of contact, that a step goes at most


class Polish:
    """Forces balance with friction whose normal forces and directions are those of the state itself, by a matrix of all that, which is
    not symmetric.

    What lags normal forces comes there by a linear rate, which is slow where much is about to slide, if at all; this takes a few
    steps. From afar it may find nothing.

    Args:
        residuals: what is small, of the model's tangent.
        share: the part of the way between dofs in which nothing passes through anything.
        reach: range of contact [m].
    """

    def __init__(self, model, residuals, share: Callable[[np.ndarray, np.ndarray], float], reach: float):
        self.model, self.residuals, self.tangent = model, residuals, residuals.tangent
        self._share, self._longest, self._rubbing = share, FAR * reach, None

    def __call__(self, state: State, at: float, put: Callable[[State], None]) -> str:
        """Outcome where all balances in the state, which then is another one; else it is empty, and the state as it was.

        Args:
            at: load parameter.
            put: writes the `Sliding` of a state.
        """
        tangent, free = self.tangent, np.flatnonzero(self.tangent.free)
        trial = state.copy()
        put(trial)
        matrix = self._matrix(trial, at)
        residual, size, excess, outcome = self._unbalanced(trial, at, put, matrix)
        for _ in range(STEPS):
            if excess <= 0.0:
                state.assign(trial)
                state.sliding = trial.sliding
                return outcome
            q, step = tangent.dofs(trial), np.zeros(tangent.size)
            try:
                step[free] = splu(matrix[free][:, free]).solve(residual[free])
            except RuntimeError:  # it is singular
                return ""
            longest = np.abs(np.where(tangent.angle, 0.0, step)).max()
            if not np.isfinite(longest):
                return ""
            part, last = min(1.0, self._longest / longest) if longest else 1.0, trial
            for _ in range(HALVINGS):
                trial = last.copy()
                tangent.assign(trial, q + part * step)
                if self._share(q, tangent.dofs(trial)) == 1.0:
                    residual, less, excess, outcome = self._unbalanced(trial, at, put, matrix)
                    if less < size or excess <= 0.0:
                        break
                part *= 0.5
            else:
                return ""
            if excess > 0.0 and less > SLOW * size:
                return ""
            size, matrix = less, self._matrix(trial, at)
        return ""

    def _unbalanced(self, state: State, at: float, put: Callable, matrix) -> tuple[np.ndarray, float, float, str]:
        """What is left of forces (size,), how large it is, by how much more than it may be, where a matrix tells what rounds, and the
        outcome if that is none."""
        put(state)
        tangent, residuals, q = self.tangent, self.residuals, self.tangent.dofs(state)
        outer, gradient = tangent.loads(at, q), tangent.gradient(state)
        residual = outer - gradient + tangent.friction(state)
        excess, outcome = residuals.excess(residual, gradient, matrix, q, residuals.load_scale(outer, gradient))
        return residual, float(np.linalg.norm(residuals.scaled(residual)[tangent.free])), excess, outcome

    def _matrix(self, state: State, at: float) -> sparse.csc_matrix:
        net, part, sliding = self.model.net, self.tangent.parts[-1], state.sliding
        if self._rubbing is None:
            self._rubbing = Rubbing(net, ExactContact(net))
        rate = wp.full(net.worlds, 1.0 / sliding.increment, dtype=net.real, device=net.device)
        rubbing = self._rubbing.matrix(state.net.q, sliding.begun(state.net.q), rate)
        matrix = part.potential_hessian(state) + part.matrix(rubbing)
        following = self.tangent.load_stiffness(at, self.tangent.dofs(state))
        matrix = sparse.csc_matrix(matrix if following is None else matrix + following)
        return matrix + sparse.diags(SPIN * np.abs(matrix.diagonal()))

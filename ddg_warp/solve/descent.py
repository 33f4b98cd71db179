"""Equilibria by Newton on the exact tangent, which is factored, with a line search. See `ddg_warp.solve.statics`."""

import numpy as np
from scipy import sparse

from ddg_warp.errors import SolverError
from ddg_warp.model.state import State
from ddg_warp.solve.direct import Factorisation, SingularError


class Descent:
    """Equilibria of a model for `Equilibrium`, whose tangent, residuals and options it uses.

    In contact its steps are cut by `NetEquilibrium.share`.
    """

    def __init__(self, owner):
        self.owner, self.tangent, self.options = owner, owner.tangent, owner.options

    def solve(self, state: State, at: float) -> State:
        """The equilibrium at load parameter `at` from a state with its supports in place, by Newton with a line search."""
        owner, tangent, options = self.owner, self.tangent, self.options
        free = tangent.free
        energies, q = tangent.element_energies(state), tangent.dofs(state)
        outer = tangent.loads(at, q)
        gradient = tangent.gradient(state)
        first, polished = owner.residuals.first_scale(outer, gradient), False
        for _ in range(options.max_iterations):
            residual = outer - gradient
            hessian = tangent.stiffness(state, at)
            if not np.isfinite(residual).all() or not np.isfinite(hessian.data).all():
                raise SolverError(owner.residuals.where("non_finite", residual, at), state=state, outcome="non_finite")
            scale = np.maximum(first, owner.residuals.load_scale(outer, gradient))
            excess, owner.outcome = owner.residuals.excess(residual, gradient, hessian, q, scale)
            owner.stiffness = hessian
            if excess <= 0.0 and (owner.outcome == "converged" or polished):
                return owner.found(state, outer, residual, at)
            polished = excess <= 0.0  # the floor is a bound: one more iteration gives what rounding allows
            owner.iterations += 1
            direction, decrease = self._direction(hessian, residual)
            shortened = min(1.0, options.rotation_cap / max(1e-300, tangent.rotation(q, direction)))
            direction, decrease = shortened * direction, shortened * decrease
            taken, found = 1.0, False
            merit = np.linalg.norm(owner.residuals.scaled(residual)[free])
            for _ in range(30):
                trial = tangent.retract(q, taken * direction)
                if owner.net:
                    share = owner.net.share(q, trial)
                    taken, trial = share * taken, q + share * (trial - q)
                candidate = state.copy()
                tangent.assign(candidate, trial)
                new_gradient = tangent.gradient(candidate)
                new_energies = tangent.element_energies(candidate)
                new_outer = tangent.loads(at, trial)
                change = (new_energies - energies).sum() - 0.5 * (outer + new_outer) @ (trial - q)
                noise = 64 * owner.model.types.eps * (np.abs(energies).sum() + np.abs(gradient) @ np.abs(q))
                new_merit = np.linalg.norm(owner.residuals.scaled(new_outer - new_gradient)[free])
                if not np.isfinite(change) or not np.isfinite(new_merit):
                    found = False
                elif options.mode == "follow":
                    found = new_merit < (1.0 - 1e-4 * taken) * merit or (taken == 1.0 and new_merit < 10.0 * merit)
                elif taken * decrease > 10.0 * noise:
                    found = change <= -1e-4 * taken * decrease + noise
                else:
                    found = new_merit <= 2.0 * merit
                if found:
                    break
                taken *= 0.5
            if not found and polished:
                return owner.found(state, outer, residual, at)
            if not found:
                raise SolverError(
                    owner.residuals.where("line_search_failed", residual, at), state=state, outcome="line_search_failed"
                )
            state, q, energies, gradient, outer = (
                candidate,
                tangent.dofs(candidate),
                new_energies,
                new_gradient,
                new_outer,
            )
        raise SolverError(
            owner.residuals.where("max_iterations", outer - gradient, at), state=state, outcome="max_iterations"
        )

    def following(self, state: State, step: np.ndarray, at: float) -> np.ndarray | None:
        """How the free dofs follow held ones that make a `step` (size,), by the tangent; None if there is no answer."""
        tangent = self.tangent
        hessian = tangent.stiffness(state, at)
        if not np.isfinite(hessian.data).all():
            return None
        outer = tangent.loads(at, tangent.dofs(state))
        return self._direction(hessian, outer - tangent.gradient(state) - hessian @ step)[0]

    def _direction(self, hessian, residual: np.ndarray) -> tuple[np.ndarray, float]:
        """Newton direction on the free dofs and the decrease of energy it promises."""
        free = np.flatnonzero(self.tangent.free)
        matrix, right = hessian[free][:, free], residual[free]
        solution = self._factor(matrix).solve(right)
        direction = np.zeros(self.tangent.size)
        direction[free] = solution
        return direction, float(right @ solution)

    def _factor(self, matrix) -> Factorisation:
        """The tangent's factors; shifted until it is definite, or in mode "follow" until it is regular."""
        diagonal = sparse.diags(np.abs(matrix.diagonal()) + 1e-12 * np.abs(matrix.diagonal()).max())
        for self.owner.shift in (0.0, *np.geomspace(1e-6, 16.0, 13)):
            try:
                factor = Factorisation((matrix + self.owner.shift * diagonal).tocsc())
            except SingularError:
                continue
            if self.options.mode == "follow" or (factor.reliable and not factor.negative):
                break
        return factor

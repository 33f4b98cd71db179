"""Mixed Newton (MIP) with independent stresses: few iterations and long steps for thin shells.

With displacements as the only unknowns, the rotation of an element in an iteration stretches it at second order, and that stress spoils
the next tangent. Here stress and displacement are both unknowns (Hellinger-Reissner), as in the mixed integration point method of
Magisano, Leonetti and Garcea (Int. J. Numer. Meth. Eng. 109, 2017). Stresses are condensed element by element. This leaves the residual
r of the displacements and one change in the tangent. The geometric stiffness takes the stress s of the last linear step instead of the
stress of the present strains,

    (J^T C J + s : d2e) d = r ,   s <- psi'(e + J d) .

Equilibrium and convergence rate are unchanged. There is no decreasing merit function: steps are full, and callers fall back on the
search if the iteration does not converge.
"""

import numpy as np

from ddg_warp.model.state import State
from ddg_warp.solve.linear.sparse_direct import Factorisation, SingularError

MAX_ITERATIONS = 20  # limit; beyond it the load step is too long
UNBALANCED = 1e-3  # residual over load scale above which a start is no equilibrium
ROTATION_CAP = 4.0  # guard against divergence [rad]


def newton(solver, state: State, before: float, load_factor: float) -> State | None:
    """Return the equilibrium at `load_factor` from a state at load parameter `before`; None without convergence.

    In mode "minimise" only a minimum of the energy is taken. `solver` is an `Equilibrium`; its counters and outcome are updated.
    """
    tangent = solver.tangent
    free = np.flatnonzero(tangent.free)
    jump = tangent.support_step(state, before, load_factor)
    q, gradient, stress = tangent.dofs(state), tangent.gradient(state), None
    first = solver.residuals.first_scale(tangent.loads(load_factor, q), gradient)
    if (np.abs(tangent.loads(before, q) - gradient) > UNBALANCED * solver.residuals.allowed(first))[free].any():
        # a crumpled start, or a new rest shape: stresses out of equilibrium are no estimate
        stress = [0.0 * part for part in tangent.linear_stress(state, jump)]
    state, factor, polished = tangent.with_prescribed(state, load_factor), None, False
    for iteration in range(MAX_ITERATIONS):
        q = tangent.dofs(state)
        outer, gradient = tangent.loads(load_factor, q), tangent.gradient(state)
        hessian = tangent.stiffness(state, load_factor, stress)
        residual = outer - gradient
        if not np.isfinite(residual).all() or not np.isfinite(hessian.data).all():
            return None
        if iteration:
            scale = np.maximum(first, solver.residuals.load_scale(outer, gradient))
            excess, small = solver.residuals.by_island(residual, gradient, hessian, q, scale)
            within = bool((excess <= 0.0).all())
            if within and (small.all() or polished):
                if not (factor.reliable and not factor.negative) and solver.options.mode == "minimise":
                    return None
                solver.stiffness = hessian
                return solver.found(state, outer, residual, load_factor, small)
            polished = within
        else:
            residual = residual - hessian @ jump
        try:
            factor = Factorisation(hessian[free][:, free])
        except SingularError:
            return None
        solver.iterations += 1
        step = np.zeros(tangent.size)
        step[free] = factor.solve(residual[free])
        if iteration:
            step *= min(1.0, ROTATION_CAP / max(1e-300, tangent.rotation(q, step)))
        else:
            step += jump
        stress = tangent.linear_stress(state, step)
        state = state.copy()
        tangent.assign(state, q + step)
    return None

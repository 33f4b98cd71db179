"""Remedies in messages of failed equilibrium searches, by tests of the failed state."""

import numpy as np

from ddg_warp.solve.equilibrium.rigid_modes import rigid_modes
from ddg_warp.solve.linear.solver_selection import large_static

LOADED = 1e-6  # relative residual along an unresisted motion above which loads drive it
LIMP = 1e-3  # bending stiffness over load times length squared below which it only hinders the search
IN_TIME = "step the scene in time (Integrator, with mass_damping) and begin from where it comes to rest"


def search_remedies(equilibrium, error, before, load_factor: float) -> str:
    """Return remedies for a failed search at a load parameter from a state `before`.

    `equilibrium` is the `Equilibrium` of the search.
    """
    if error.outcome == "non_finite":
        return "begin nearer to rest, or take parameters of a smaller range"
    free = ""
    if _factored(equilibrium.model):
        free = unresisted(equilibrium.tangent, error.state, load_factor) or unresisted(
            equilibrium.tangent, before, load_factor
        )
    longer = "take a larger max_iterations" if error.gaining and not free else ""
    return ", or ".join(
        remedy for remedy in (free, limp(equilibrium, error.state, load_factor), longer, IN_TIME) if remedy
    )


def _factored(model) -> bool:
    return model.touch is None and not (model.coupled is not None and large_static(model))


def unresisted(tangent, state, load_factor: float) -> str:
    """Return the advice to fix a dof that loads drive along an unresisted motion; empty without."""
    q = tangent.dofs(state)
    residual = np.where(tangent.free, tangent.loads(load_factor, q) - tangent.gradient(state), 0.0)
    stiffness = tangent.stiffness(state, load_factor)
    if not np.isfinite(stiffness.data).all() or not np.isfinite(residual).all():
        return ""
    for mode in rigid_modes(tangent, state, stiffness).T:
        if abs(mode @ residual) > LOADED * np.linalg.norm(mode) * np.linalg.norm(residual):
            return f"support {tangent.where(int(np.argmax(np.abs(mode))))}, which can move freely"
    return ""


def limp(equilibrium, state, load_factor: float) -> str:
    """Return the advice to omit the bending of the first rod with negligible stiffness; empty without."""
    tangent = equilibrium.tangent
    loads = np.abs(np.where(tangent.angle, 0.0, tangent.loads(load_factor, tangent.dofs(state)))).sum()
    for batch in equilibrium.model.scene.batches:
        stiffest = max(np.max(batch.section.EI1), np.max(batch.section.EI2)) if batch.bend else np.inf
        length = np.linalg.norm(np.diff(batch.points, axis=1), axis=2).sum(1).max()
        if stiffest < LIMP * loads * length**2:
            return f"leave out the bending of rod {batch.first}, which is too limp to matter: add_rod(..., bend=False)"
    return ""

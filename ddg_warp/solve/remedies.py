"""Remedies that the message of a failed search for an equilibrium names, of which each one helps where it is named."""

import numpy as np

from ddg_warp.solve.choice import large_static
from ddg_warp.solve.rigid import rigid_modes

PUSHED = 1e-6  # of the norm of the residual along a motion that nothing resists, at which it is pushed
LIMP = 1e-3  # bending stiffness over load times length squared, below which it decides nothing but the search
IN_TIME = "step the scene in time (Integrator, with mass_damping) and begin from where it comes to rest"


def of_search(equilibrium, error, before, at: float) -> str:
    """What would help a search at load parameter `at` from a state `before` that has ended with an error.

    `equilibrium` is the `Equilibrium` that searched.
    """
    if error.outcome == "non_finite":
        return "begin nearer to rest, or take parameters that are less far apart"
    free = ""
    if _factored(equilibrium.model):
        free = unresisted(equilibrium.tangent, error.state, at) or unresisted(equilibrium.tangent, before, at)
    longer = "take a larger max_iterations" if error.gaining and not free else ""
    return ", or ".join(remedy for remedy in (free, limp(equilibrium, error.state, at), longer, IN_TIME) if remedy)


def _factored(model) -> bool:
    return model.touch is None and not (model.net is not None and large_static(model))


def unresisted(tangent, state, at: float) -> str:
    """Advice to hold what loads push along a motion that neither supports nor stiffness resist; empty without one."""
    q = tangent.dofs(state)
    residual = np.where(tangent.free, tangent.loads(at, q) - tangent.gradient(state), 0.0)
    stiffness = tangent.stiffness(state, at)
    if not np.isfinite(stiffness.data).all() or not np.isfinite(residual).all():
        return ""
    for mode in rigid_modes(tangent, state, stiffness).T:
        if abs(mode @ residual) > PUSHED * np.linalg.norm(mode) * np.linalg.norm(residual):
            return f"hold {tangent.where(int(np.argmax(np.abs(mode))))}, which nothing keeps from moving"
    return ""


def limp(equilibrium, state, at: float) -> str:
    """Advice to leave out the bending of the first rod that is too limp for it to matter; empty without one."""
    tangent = equilibrium.tangent
    loads = np.abs(np.where(tangent.angle, 0.0, tangent.loads(at, tangent.dofs(state)))).sum()
    for batch in equilibrium.model.scene.batches:
        stiffest = max(np.max(batch.section.EI1), np.max(batch.section.EI2)) if batch.bend else np.inf
        length = np.linalg.norm(np.diff(batch.points, axis=1), axis=2).sum(1).max()
        if stiffest < LIMP * loads * length**2:
            return f"leave out the bending of rod {batch.first}, which is too limp to matter: add_rod(..., bend=False)"
    return ""

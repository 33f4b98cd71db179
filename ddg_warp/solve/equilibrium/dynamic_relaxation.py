"""Dynamic relaxation with kinetic damping: a static solver without a regular tangent, for cases in which Newton fails.

The structure moves from rest under residual forces, with fictitious masses. At every maximum of the kinetic energy it is stopped
(Barnes, Int. J. Space Struct. 14, 1999). The masses are row sums of the magnitudes of the tangent stiffness, which makes explicit steps
of length one stable (Gershgorin). A point takes the largest mass over its directions, since a soft direction becomes stiff by rotation.
Convergence is cheap from afar and slow near a minimum: complete it by `statics.solve`.
"""

import numpy as np

from ddg_warp.errors import SceneError, SolverError
from ddg_warp.model.state import State
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions


def relax(
    model,
    state: State | None = None,
    *,
    at: float = 1.0,
    residual: float = 1e-6,
    max_steps: int = 20_000,
    rotation_cap: float = 0.1,
) -> State:
    """Return a state near an equilibrium at load parameter `at`.

    Args:
        model: model to equilibrate.
        state: start, with supports at load parameter `at`; the rest state by default. It stays unchanged.
        at: load parameter.
        residual: tolerance of free dofs over the load scale; moments over an edge length.
        max_steps: limit of steps.
        rotation_cap: largest edge rotation in a step [rad].

    Raises:
        SceneError: there is contact.
        SolverError: `max_steps` or `non_finite`; carries the last state.
    """
    if model.touch:
        raise SceneError("contact: dynamic relaxation has no contact; use statics.solve, which has")
    equilibrium = Equilibrium(model, StaticsOptions())
    tangent = equilibrium.tangent
    model.fields.to(at)
    state = tangent.with_prescribed((state or model.state()).copy(), at)
    state.time = at
    lever = np.where(tangent.angle, tangent.edge_length(), 1.0)
    velocity, peak, mass, first = np.zeros(tangent.size), 0.0, None, None
    for _ in range(max_steps):
        q = tangent.dofs(state)
        outer, gradient = tangent.loads(at, q), tangent.gradient(state)
        force = np.where(tangent.free, outer - gradient, 0.0)
        if not np.isfinite(force).all():
            raise SolverError(
                "relaxation: forces are not finite; begin nearer to rest", state=state, outcome="non_finite"
            )
        first = equilibrium.residuals.first_scale(outer, gradient) if first is None else first
        scale = np.maximum(first, equilibrium.residuals.load_scale(outer, gradient))
        if (np.abs(force) <= residual * equilibrium.residuals.allowed(scale)).all():
            model.update_strains(state)
            return state
        if mass is None:
            mass = _masses(tangent, state)
        velocity = velocity + force / mass
        kinetic = float(mass @ velocity**2)
        if kinetic < peak:
            velocity, peak, mass = np.zeros(tangent.size), 0.0, None  # stiffness has changed: update the masses
            continue
        peak = kinetic
        turn = tangent.rotation(q, velocity)
        if turn > rotation_cap:
            velocity = velocity * (rotation_cap / turn)
            peak = float(mass @ velocity**2)
        tangent.assign(state, q + velocity)
    worst = int(np.argmax(np.abs(force / lever)))
    raise SolverError(
        f"relaxation: max_steps, largest residual {force[worst]:.3g} at {tangent.where(worst)}; allow more steps, or let "
        "statics.solve go on from the state of this error",
        state=state,
        outcome="max_steps",
    )


def _masses(tangent, state) -> np.ndarray:
    """Return fictitious masses of all dofs (size,)."""
    rows = np.asarray(abs(tangent.hessian(state)).sum(axis=1)).ravel()
    dofs = tangent.point_dofs()
    of_points = np.where(dofs >= 0, rows[dofs], 0.0).max(axis=1)
    for axis in range(3):
        real = dofs[:, axis] >= 0
        rows[dofs[real, axis]] = of_points[real]
    return np.where(rows > 0.0, rows, rows.max())

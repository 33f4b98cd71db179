"""Support requirements of static solves."""

import numpy as np
from scipy.sparse import csgraph

from ddg_warp.errors import SceneError, SolverError


def require_supports(model) -> None:
    """Refuse structures that can translate rigidly: a component without a fixed dof. Rotations are allowed."""
    for group in model.groups:
        host, axes = group.host, "xz" if group.kind.dim == 2 else "xyz"
        fixed = np.bitwise_or.reduce(host.fixed, axis=0)
        for d, axis in enumerate(axes):
            loose = np.flatnonzero((fixed >> d) & 1 == 0)
            if loose.size:
                raise SceneError(
                    f"rod {host.rods[loose[0]]} is not supported along {axis}: a static solve needs supports; "
                    "add scene.clamp(...) or scene.fix(...)"
                )
    if model.coupled is not None:
        host = model.coupled.host
        for i, shell in enumerate(host.meridians):
            if not host.fixed[shell.nodes, 2].any():
                raise SceneError(
                    f"axisymmetric shell {i} is not supported along z: a static solve needs scene.hold_ring(...) or "
                    "scene.clamp_ring(...)"
                )
        carried = host.rigid_bodies.carried if host.rigid_bodies else ()
        excluded = [*(node for shell in host.meridians for node in shell.nodes), *carried]
        spatial = np.setdiff1d(np.arange(host.nodes), excluded)
        loose = np.flatnonzero(~host.holds[spatial].any(0)) if spatial.size else spatial
        if loose.size:
            raise SceneError(
                f"no node of the shells{', rigid bodies' * bool(model.scene.bodies)} and joined rods is supported along "
                f"{'xyz'[loose[0]]}: a static solve needs supports; add scene.hold(...), scene.clamp_boundary(...) or scene.fix(...)"
            )


def unsupported_dof(tangent, state) -> int | None:
    """Return a dof of a component without a fixed dof at a state without contact; None with contact or without such a component.

    Components are connected by nonzeros of the Hessian. Loads carry such a component so far that it converges to rounding.
    """
    touch = tangent.model.touch
    if touch is None:
        return None
    touch.evaluate(state.coupled.q)
    if touch.terms.active_pairs.numpy().any():
        return None
    _, component = csgraph.connected_components(tangent.hessian(state), directed=False)
    loose = np.flatnonzero(tangent.free & ~np.isin(component, component[~tangent.free]) & ~tangent.angle)
    return int(loose[0]) if loose.size else None


def adrift(where: str, load_factor: float, state) -> SolverError:
    """Return the error of a body that loads carry away."""
    return SolverError(
        f"no equilibrium at load parameter {load_factor:g}: adrift, {where} is carried away, as neither supports nor contact "
        "support it; fix it, or add an obstacle",
        state=state,
        outcome="adrift",
    )

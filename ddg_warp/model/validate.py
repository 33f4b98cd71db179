"""Checks of models for time stepping."""

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.scene import edge_forces

CARRIED = 1e-40  # smallest magnitude that float32, in its subnormal range, keeps to four digits


def refuse_underflow(model) -> None:
    """Refuse stiffnesses and squared triangle areas outside of the float32 range, unless rounding is allowed."""
    if model.precision != "float32" or model.allow_rounding:
        return
    values_by_name = {name: values for name, values in model.parameters().items() if "/stiffness" in name}
    for i, shell in enumerate(model.coupled.host.shells if model.coupled is not None else ()):
        values_by_name[f"shell {i}, squared area of a triangle"] = shell.plate.area**2
    for name, values in values_by_name.items():
        size = np.abs(values[np.nonzero(values)])
        if size.size and not (CARRIED <= size.min() and size.max() <= np.finfo(np.float32).max):
            worst = size.min() if size.min() < CARRIED else size.max()
            raise SceneError(
                f"precision 'float32': {name} is {worst:.3g}, and float32 goes from {CARRIED:g} to {np.finfo(np.float32).max:.3g}; "
                "take 'mixed' or 'float64', or other units"
            )


def refuse_curved_membranes(model) -> None:
    """Refuse dynamics of shells with membrane "curved".

    Their strains rotate with the normals, and the projected positive definite matrix of a time step is far from the tangent.
    """
    for i, shell in enumerate(model.scene.shells):
        if shell.membrane == "curved":
            raise SceneError(
                f"shell {i} ('{shell.name}'): membrane 'curved' serves statics and spectra; for dynamics add it with membrane='flat'"
            )


def refuse_friction(model) -> None:
    """Refuse frictional contact in analyses of equilibria that are independent of the load path."""
    contact = model.coupled.host.contact_parameters if model.coupled is not None else None
    pairs = zip(*contact.meeting, strict=True) if contact is not None else ()
    rough = next(((g, h) for g, h in pairs if contact.friction[g, h] > 0.0), None)
    if rough is None:
        return
    first, second = (contact.names[g] for g in rough)
    raise SceneError(
        f"contact: stability and paths of equilibria do not support friction, and it is {contact.friction[rough]:g} between {first!r} "
        f"and {second!r}, where equilibria depend on the load path; set friction=0, or compute single equilibria by "
        "statics.solve, and for their gradients"
    )


def require_mass(model) -> None:
    """Refuse free nodes of uncoupled rods without mass and without a force in all directions."""
    for group in model.groups:
        host, kind = group.host, group.kind
        positions = (1 << kind.dim) - 1
        k = np.arange(group.nodes)[:, None]
        nodes = (k >= host.first) & (k < host.first + host.own)
        massless = (host.mass <= 0.0) & ((host.fixed & positions) != positions) & nodes
        if kind.quadratic:
            first, last = edge_forces.holds(host.coefficients)  # of edges; the last node of an open rod begins none
            massless &= ~(first | np.roll(last, 1, axis=0))
        if massless.any():
            k, column = np.argwhere(massless)[0]
            raise SceneError(
                f"node {k - host.first[column]} of rod {host.rods[column]} is free and has no mass; {edge_forces.HOLD}"
            )

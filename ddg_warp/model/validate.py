"""Refusals of what is no model, or no state of one, and of models that cannot be stepped in time."""

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.scene import drag

CARRIED = 1e-40  # least magnitude of which float32, below its normal numbers, keeps four digits


def check_model(call: str, model) -> None:
    """Refuse what is no model, where one is asked for."""
    from ddg_warp.model.model import Model

    if not isinstance(model, Model):
        raise SceneError(f"{call}: the model is {type(model).__name__}; give what scene.build() returns")


def check_state(call: str, model, state) -> None:
    """Refuse what is no state of a model."""
    from ddg_warp.model.state import State

    if not isinstance(state, State):
        raise SceneError(
            f"{call}: the state is {arguments.shown(state)}; give one of this model, such as model.state()"
        )
    if state.model is not model:
        raise SceneError(f"{call}: the state is of another model; give one that this model made, such as model.state()")


def refuse_underflow(model) -> None:
    """Refuse stiffnesses, and squared areas of triangles, that float32 does not carry, unless rounding is allowed."""
    if model.precision != "float32" or model.allow_rounding:
        return
    given = {name: values for name, values in model.parameters().items() if "/stiffness" in name}
    for i, shell in enumerate(model.net.host.shells if model.net is not None else ()):
        given[f"shell {i}, squared area of a triangle"] = shell.plate.area**2
    for name, values in given.items():
        size = np.abs(values[np.nonzero(values)])
        if size.size and not (CARRIED <= size.min() and size.max() <= np.finfo(np.float32).max):
            worst = size.min() if size.min() < CARRIED else size.max()
            raise SceneError(
                f"precision 'float32': {name} is {worst:.3g}, and float32 goes from {CARRIED:g} to {np.finfo(np.float32).max:.3g}; "
                "take 'mixed' or 'float64', or other units"
            )


def refuse_curved_membranes(model) -> None:
    """Its strains turn with the normals, so that the matrix of a time step, which is made positive, is far from the tangent."""
    for i, shell in enumerate(model.scene.shells):
        if shell.membrane == "curved":
            raise SceneError(
                f"shell {i} ('{shell.name}'): membrane 'curved' serves statics and spectra; for dynamics add it with membrane='flat'"
            )


def refuse_friction(model) -> None:
    """Refuse contact with friction where something is asked of equilibria that the way there does not decide."""
    given = model.net.host.touching if model.net is not None else None
    pairs = zip(*given.meeting, strict=True) if given is not None else ()
    rough = next(((g, h) for g, h in pairs if given.friction[g, h] > 0.0), None)
    if rough is None:
        return
    one, other = (given.names[g] for g in rough)
    raise SceneError(
        f"contact: stability and paths of equilibria know no friction, and it is {given.friction[rough]:g} between {one!r} "
        f"and {other!r}, where the way there decides which equilibrium is found; set friction=0, or ask for equilibria alone by "
        "statics.solve, and for their gradients"
    )


def require_mass(model) -> None:
    """Refuse free nodes of rods on their own that nothing gives an equation of motion."""
    for group in model.groups:
        host, kind = group.host, group.kind
        positions = (1 << kind.dim) - 1
        k = np.arange(group.nodes)[:, None]
        own = (k >= host.first) & (k < host.first + host.own)
        bad = (host.mass <= 0.0) & ((host.fixed & positions) != positions) & own
        if kind.drag:
            first, last = drag.holds(host.drag)  # of edges; the last node of an open rod starts none
            bad &= ~(first | np.roll(last, 1, axis=0))
        if bad.any():
            k, column = np.argwhere(bad)[0]
            raise SceneError(
                f"node {k - host.first[column]} of rod {host.rods[column]} is free and has no mass; "
                "give the material a density, the section a mass_per_length, or the rod drag along and across"
            )

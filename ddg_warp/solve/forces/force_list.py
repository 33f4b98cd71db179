"""List of the forces of a step."""

from ddg_warp.solve.forces.drag import CoupledDrag, Drag, RodGroupDrag
from ddg_warp.solve.forces.force import Force
from ddg_warp.solve.forces.loads import Loads

WITH_PARAMETERS = (Drag,)  # classes of forces whose coefficients of edges have names


def forces_of(model, part, midpoint: bool, control_loads: Loads | None = None) -> list[Force]:
    """Return the forces on a rod group or on the coupled system, without constant loads, which a solver has from the start."""
    host, result = part.host, [control_loads] if control_loads else []
    if not result and (host.timed or host.followers):
        result.append(Loads(model, part, midpoint))
    if part is model.coupled:
        return [*result, CoupledDrag(model, midpoint)] if host.quadratic else result
    return [*result, RodGroupDrag(model, part, midpoint)] if part.kind.quadratic else result

"""Rest shapes with which rods are in equilibrium as they are: hair that hangs as it was drawn, a beam that is straight under its load.

Forces are linear in what is at rest: with strains e, their derivatives J by the dofs, rest measures w and stiffnesses K, the stresses
s = K (e - e0) of all elements balance the outer forces f where sum w J^T s = f on what is free to move. So stresses follow from the
shape alone, and rest strains e0 = e - s / K from them. A rod held by one edge is statically determinate: it has as many stresses as
equations. Where supports leave a choice, stresses are those of least elastic energy: the least squares of y = (w / K)^(1/2) s.

The equilibrium need not be stable; `ddg_warp.solve.stability` tells. What is solved here is the problem of Derouet-Jourdan,
Bertails-Descoubes, Daviet, Thollot, *Inverse dynamic hair modeling with frictional contact*, ACM ToG 32(6), 2013, and of Hsu, Wang,
Pan, Gao, Yuksel, Wu, *Sag-free initialization for strand-based hybrid hair simulation*, ACM ToG 42(4), 2023.
"""

from dataclasses import dataclass

import numpy as np

from ddg_warp import arguments
from ddg_warp.ask.inquiry import group_strains
from ddg_warp.errors import SceneError
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.model import validate
from ddg_warp.solve.direct import Factorisation, shortest
from ddg_warp.solve.rigid import rigid_modes
from ddg_warp.solve.stability import lowest_factors
from ddg_warp.solve.tangent import Tangent
from ddg_warp.threads import launches

RTOL = 1e-8  # of what may be left of the loads of a rod


@launches
def rest_strains(model, state=None, load: float = 1.0) -> dict[str, np.ndarray]:
    """Rest stretches, natural curvatures and natural twists with which rods are in equilibrium as they are.

        found = rest_strains(model)
        rest_shapes.set_rest_strains(model, found)  # or Simulator.equilibrium(...), Simulator.step(state, ...) with these as tensors

    Masses stay, as do the measures of elements (the lengths drawn), over which curvatures are taken.

    Args:
        model: open rods on their own, with stretch, and with bending and twist or in a plane; each so held that no load is left over.
        state: where they are to stay; by default the rest state, as they were drawn. Its velocities do not count, nor does drag.
        load: the load parameter of statics, which scales gravity and loads.

    Returns:
        Of every rest strain, "rod_stretch.rest" [1] or "rod_bend_twist.rest_1" [1/m], the values of all elements rod by rod, those of
        clamped ends included, in each world (worlds, elements).

    Raises:
        SceneError: a rod is closed, joined, glued or magnetised, has no twist in space, or another law than the quadratic one; there
            are shells; the model is in float32; or nothing balances the loads of a rod. The message names it.
    """
    validate.check_model("rest_strains", model)
    if state is not None:
        validate.check_state("rest_strains", model, state)
    state, load = state or model.state(), arguments.number("rest_strains: load", load)
    _refuse("rest_strains", model)
    tangent, result = Tangent(model), {}
    outer = tangent.loads(load, tangent.dofs(state))
    for part in tangent.parts:
        found = _of_group(part, state, Tangent.of(part, outer))
        for name, values in found.items():
            count, groups = model.order.elements(name)
            inside, numbers = next(own for group, *own in groups if group is part.group)
            every = result.setdefault(name, np.zeros((model.worlds, count)))
            every[:, numbers[inside]] = values.reshape(part.group.nodes, model.worlds, -1).swapaxes(0, 1)[:, inside]
    return result


@launches
def least_stiffness(model, state) -> np.ndarray:
    """What all stiffnesses of each rod may be multiplied by, with new rest strains for the same shape, before it is unstable in it.

    The stresses that bear the loads stay, and with them what they do to the tangent, while the rest of it is in proportion to the
    stiffnesses: K -> f K is stable for f above the largest f with det(f H + G) = 0. Beyond 1 a rod is unstable as it is.

    Args:
        model, state: an equilibrium, such as what has rest strains by `rest_strains`; rods as there.

    Returns:
        Factors (worlds, rods); 0, but for rounding, of a rod that is stable however soft it is.

    Raises:
        SceneError: as of `rest_strains`, or supports leave a rigid motion.
    """
    from scipy import sparse

    validate.check_model("least_stiffness", model)
    validate.check_state("least_stiffness", model, state)
    _refuse("least_stiffness", model)
    tangent, result = Tangent(model), np.zeros((model.worlds, model.scene.rod_count))
    forces = [_Elements.of(part, state).forces for part in tangent.parts]
    strained = sparse.block_diag([own @ own.T for own in forces], format="csr")
    loose = np.argwhere(rigid_modes(tangent, state, strained))
    if len(loose):
        raise SceneError(
            f"least_stiffness: supports leave a rigid motion of {tangent.where(loose[0, 0])}; clamp the rod"
        )
    softening = sparse.csr_matrix(strained - tangent.stiffness(state))
    for part in tangent.parts:
        group, size = part.group, part.size // part.group.columns
        for column in range(group.columns):
            first = part.offset + column * size
            dofs = first + np.flatnonzero(tangent.free[first : first + size])
            own, less = (sparse.csc_matrix(matrix[dofs][:, dofs]) for matrix in (strained, softening))
            found = lowest_factors(own, less, Factorisation(own), 1) if len(dofs) else dofs
            world, rod = divmod(column, group.rods)
            result[world, group.host.rods[rod]] = 1.0 / found[0] if len(found) else 0.0
    return result


def _refuse(call: str, model) -> None:
    """Refuse a model with other rods than such whose stresses are linear in rest strains that turn with them."""
    scene, start = model.scene, f"{call}: "
    if model.precision == "float32":
        raise SceneError(f"{start}float32 leaves too little of forces; build the model in 'mixed' or 'float64'")
    if model.net is not None:
        host, what = model.net.host, "a shell of revolution"
        if host.rods:
            rod = min(each.rod for each in host.rods)
            what = f"rod {rod} ('{model.curves.names[rod]}'), which is joined, glued or magnetised"
        elif scene.shells:
            what = f"shell 0 ('{scene.shells[0].name}')"
        raise SceneError(
            f"{start}the scene has {what}; rest strains are those of rods on their own, in a scene of these"
        )
    for group in model.groups:
        rod = int(group.host.rods[0])
        named = f"{start}rod {rod} ('{model.curves.names[rod]}')"
        if group.kind.closed:
            raise SceneError(f"{named} is closed; give open rods")
        for term in group.kind.terms:
            if (term.density.undamped or term.density) is not quadratic:
                raise SceneError(
                    f"{named} has the law {term.density.name!r} for {term.name}; give it the quadratic one"
                )
            if term.name == "rod_bend":
                raise SceneError(
                    f"{named} has no twist, and so no natural curvature that turns with it; add it with twist=True"
                )


@dataclass(frozen=True)
class _Elements:
    """Elements of a group of rods at a state, by their strains (strains, n, columns).

    Attributes:
        names: of the strains at rest.
        strains, measures, stiffness: of every element, 0 where a rod has none.
        forces: of stresses (K / w)^(1/2) on dofs (size, columns n strains), whose product with its transpose is the stiffness of
            what is strained, without that of stresses.
    """

    names: list
    strains: np.ndarray
    measures: np.ndarray
    stiffness: np.ndarray
    forces: object

    @classmethod
    def of(cls, part, state) -> "_Elements":
        group, terms = part.group, part.group.kind.terms
        strains = group_strains(part.model, group, part.data(state))[0].reshape(-1, group.nodes, group.columns)

        def each(names) -> np.ndarray:
            return np.stack([np.broadcast_to(group.parameters[name], strains.shape[1:]) for name in names])

        measures = each(f"{term.name}.measure" for term in terms for _ in term.rest)
        stiffness = each(f"{term.name}.{name}" for term in terms for name in term.stiffness)
        root = np.sqrt(_over(stiffness, measures))
        forces = part.unit_forces(state, strains).multiply(root.T.ravel()).tocsr()
        names = [f"{term.name}.{name}" for term in terms for name in term.rest]
        return cls(names, strains, measures, stiffness, forces)


def _of_group(part, state, outer: np.ndarray) -> dict[str, np.ndarray]:
    """Rest strains by name (n, columns) of a group of rods under outer forces (size,)."""
    own = _Elements.of(part, state)
    found = shortest(own.forces[part.free], outer[part.free])
    inner = own.forces @ found
    allowed = RTOL * part.allowed(part.body_loads(outer, inner))
    for dof in np.flatnonzero(part.free & ~(np.abs(outer - inner) <= allowed))[:1]:
        raise SceneError(
            f"rest_strains: whatever is at rest, nothing balances the loads at {part.where(dof)}; clamp an edge of the rod, or hold "
            "more of it"
        )
    root = np.sqrt(own.stiffness * own.measures)
    beyond = _over(found.reshape(own.strains.T.shape).T, root)
    return dict(zip(own.names, own.strains - beyond, strict=True))


def _over(values: np.ndarray, divisors: np.ndarray) -> np.ndarray:
    """Quotients, 0 where the divisor is."""
    return np.divide(values, divisors, out=np.zeros_like(values), where=divisors > 0.0)

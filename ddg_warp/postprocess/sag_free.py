"""Sag-free rest shapes: rest strains for which rods are in equilibrium in a given shape (hair as drawn, a straight loaded beam).

Stresses s = K (e - e0) of all elements balance the external forces f on free dofs if

    sum w J^T s = f.

e: strains, e0: rest strains, J: derivatives of e by the dofs, w: rest measures, K: stiffnesses. Forces are linear in e0: stresses
follow from the shape alone, then e0 = e - s / K. A rod clamped by one edge is statically determinate. Otherwise the solution has
the least elastic energy: least squares in y = (w / K)^(1/2) s.

The equilibrium need not be stable: test it by `ddg_warp.solve.equilibrium.stability`. Sources: Derouet-Jourdan, Bertails-Descoubes,
    Daviet, Thollot, *Inverse dynamic hair modeling with frictional contact*, ACM ToG 32(6), 2013. Hsu, Wang, Pan, Gao, Yuksel, Wu,
    *Sag-free initialization for strand-based hybrid hair simulation*, ACM ToG 42(4), 2023.
"""

from dataclasses import dataclass

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.capture_lock import launches
from ddg_warp.errors import SceneError
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.model.model import check_model
from ddg_warp.model.state import query
from ddg_warp.postprocess.element_strains import coupled_strains, group_strains
from ddg_warp.solve.equilibrium.rigid_modes import rigid_modes
from ddg_warp.solve.equilibrium.stability import lowest_factors
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.linear.sparse_direct import Factorisation, shortest

RTOL = 1e-8  # largest residual over the loads of a rod


@launches
def rest_strains(model, state=None, load: float = 1.0) -> dict[str, np.ndarray]:
    """Return rest stretches, natural curvatures and natural twists for which a shape is in equilibrium.

        strains = rest_strains(model)
        rest_shapes.set_rest_strains(model, strains)  # or as tensors: Simulator.equilibrium(...), Simulator.step(state, ...)

    Masses stay, as do the measures of elements (drawn lengths), over which curvatures are taken.

    Args:
        model: open uncoupled rods with stretch and with bending and twist, or planar; supports must balance all loads. Or rods that
            all carry rigid bodies, whose weight counts.
        state: the shape to keep; by default the rest state. Velocities are ignored.
        load: the load parameter of statics, which scales gravity and loads.

    Returns:
        Values (worlds, elements) by rest strain, such as "rod_stretch.rest" [1] or "rod_bend_twist.rest_1" [1/m]. Elements are
        numbered rod by rod, clamped ends included. With rigid bodies the numbers are of the coupled system, and "rigid_joint" has the
        ends at bodies.

    Raises:
        SceneError: a rod is closed, joined, glued or magnetised, has no twist in space, or a law that is not quadratic. Or there are
            shells, the model is in float32, or the loads of a rod cannot be balanced.
    """
    check_model("rest_strains", model)
    if state is not None:
        query("rest_strains", model, state)
    state, load = state or model.state(), argument_checks.number("rest_strains: load", load)
    _refuse("rest_strains", model)
    tangent, result = Tangent(model), {}
    outer = tangent.loads(load, tangent.dofs(state))
    if model.scene.bodies:
        return _of_coupled(tangent.parts[-1], state, outer)
    for part in tangent.parts:
        of_group = _of_group(part, state, Tangent.of(part, outer))
        for name, values in of_group.items():
            count, groups = model.order.elements(name)
            inside, numbers = next(selection for group, *selection in groups if group is part.group)
            every = result.setdefault(name, np.zeros((model.worlds, count)))
            every[:, numbers[inside]] = values.reshape(part.group.nodes, model.worlds, -1).swapaxes(0, 1)[:, inside]
    return result


@launches
def least_stiffness(model, state) -> np.ndarray:
    """Return for each rod the smallest stable factor on all stiffnesses, with rest strains that keep the shape.

    Stresses balance the loads and stay, and with them the geometric stiffness G. The Gauss-Newton matrix H scales with f: K -> f K is
    stable for f above the largest root of det(f H + G) = 0. A rod with a factor above 1 is unstable.

    Args:
        model, state: an equilibrium, such as one of `rest_strains`, of rods as there.

    Returns:
        Factors (worlds, rods); 0, up to rounding, for a rod that is stable at any stiffness.

    Raises:
        SceneError: as in `rest_strains`, or supports leave a rigid-body mode.
    """
    from scipy import sparse

    check_model("least_stiffness", model)
    query("least_stiffness", model, state)
    _refuse("least_stiffness", model)
    if model.scene.bodies:
        raise SceneError(
            f"least_stiffness: body 0 ('{model.scene.bodies[0].name}') is rigid; take `stability.spectrum` of a scene with bodies"
        )
    tangent, result = Tangent(model), np.zeros((model.worlds, model.scene.rod_count))
    forces = [_Elements.of(part, state).forces for part in tangent.parts]
    strained = sparse.block_diag([unit @ unit.T for unit in forces], format="csr")
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
            stiff, less = (sparse.csc_matrix(matrix[dofs][:, dofs]) for matrix in (strained, softening))
            factors = lowest_factors(stiff, less, Factorisation(stiff), 1) if len(dofs) else dofs
            world, rod = divmod(column, group.rods)
            result[world, group.host.rods[rod]] = 1.0 / factors[0] if len(factors) else 0.0
    return result


def _refuse(call: str, model) -> None:
    """Refuse models other than uncoupled open rods with quadratic laws and, in space, twist."""
    scene, start = model.scene, f"{call}: "
    if model.precision == "float32":
        raise SceneError(f"{start}float32 leaves too little of forces; build the model in 'mixed' or 'float64'")
    if model.coupled is not None and not _carries_bodies_alone(model):
        host, body = model.coupled.host, "a shell of revolution"
        if scene.bodies:
            body = "rigid bodies, and other objects or joints"
        elif host.rods:
            rod = min(each.rod for each in host.rods)
            body = f"rod {rod} ('{model.curves.names[rod]}'), which is joined, attached to a shell or magnetised"
        elif scene.shells:
            body = f"shell 0 ('{scene.shells[0].name}')"
        raise SceneError(
            f"{start}the scene has {body}; sag-free rest strains need a scene of uncoupled rods, or of rods that all carry bodies"
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
                    f"{named} has no twist, and so no natural curvature that rotates with it; add it with twist=True"
                )


def _carries_bodies_alone(model) -> bool:
    """Return True if all rods carry rigid bodies, and nothing else has energy."""
    parts = model.coupled.sets
    quadratic_rods = all(
        part.term.rest and (part.term.density.undamped or part.term.density) is quadratic for part in parts
    )
    rest_of_scene = model.groups or model.scene.shells or model.scene.joints or model.scene.body_joints or model.touch
    return bool(model.scene.bodies and quadratic_rods and not rest_of_scene)


@dataclass(frozen=True)
class _Elements:
    """Strains, stiffnesses and unit forces of the elements of a rod group at a state.

    Attributes:
        names: names of rest strains.
        strains, measures, stiffness: (strains, n, columns), 0 outside of a rod.
        forces: F (size, columns n strains), nodal forces of stresses (K / w)^(1/2). F F^T is the Gauss-Newton matrix.
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
    """Return rest strains by name (n, columns) of a rod group under external forces (size,)."""
    elements = _Elements.of(part, state)
    scaled_stress = shortest(elements.forces[part.free], outer[part.free])
    _refuse_unbalanced(part, outer, elements.forces @ scaled_stress)
    root = np.sqrt(elements.stiffness * elements.measures)
    beyond = _over(scaled_stress.reshape(elements.strains.T.shape).T, root)
    return dict(zip(elements.names, elements.strains - beyond, strict=True))


def _of_coupled(part, state, outer: np.ndarray) -> dict[str, np.ndarray]:
    """Return rest strains by name (worlds, elements) of rods with rigid bodies under external forces (size,)."""
    from scipy import sparse

    forces, roots, strains = [], [], []
    for index, elements in enumerate(part.coupled.sets):
        values = coupled_strains(part.coupled, state, index)[0]
        each = [np.broadcast_to(elements.parameters[name], values.shape[1:]) for name in elements.term.stiffness]
        measure = np.broadcast_to(elements.parameters["measure"], values.shape[1:])
        scale = np.sqrt(_over(np.stack(each), np.broadcast_to(measure, values.shape)))
        forces.append(part.unit_forces(state, index, values) @ sparse.diags(scale.ravel()))
        roots.append(np.sqrt(np.stack(each) * measure))
        strains.append(values)
    forces = sparse.hstack(forces, format="csr")
    scaled_stress = shortest(forces[part.free], outer[part.free])
    _refuse_unbalanced(part, outer, forces @ scaled_stress)
    result, first = {}, 0
    for elements, root, values in zip(part.coupled.sets, roots, strains, strict=True):
        beyond = _over(scaled_stress[first : first + root.size].reshape(root.shape), root)
        first += root.size
        for name, rest in zip(elements.term.rest, values - beyond, strict=True):
            result[f"{elements.term.name}.{name}"] = rest
    return result


def _refuse_unbalanced(part, outer: np.ndarray, inner: np.ndarray) -> None:
    """Refuse external forces that internal forces (size,) do not balance on free dofs."""
    allowed = RTOL * part.allowed(part.body_loads(outer, inner))
    for dof in np.flatnonzero(part.free & ~(np.abs(outer - inner) <= allowed))[:1]:
        raise SceneError(
            f"rest_strains: no rest strains balance the loads at {part.where(dof)}; clamp an edge of the rod, or support "
            "more of it"
        )


def _over(values: np.ndarray, divisors: np.ndarray) -> np.ndarray:
    """Return quotients, 0 where the divisor is 0."""
    return np.divide(values, divisors, out=np.zeros_like(values), where=divisors > 0.0)

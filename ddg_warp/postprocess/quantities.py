"""Post-processing of a state: energies, reactions, drag, stresses, fields of surfaces, writhe, twist."""

from dataclasses import dataclass

import numpy as np

from ddg_warp import argument_checks, device_arrays
from ddg_warp.capture_lock import launches
from ddg_warp.kernels.terms import AXISYMMETRIC, BODY_JOINTS, MAGNETS, SHELLS
from ddg_warp.model.model import Model, check_model
from ddg_warp.model.rigid_bodies import body_energies
from ddg_warp.model.state import State, query
from ddg_warp.postprocess import end_moments
from ddg_warp.postprocess.element_strains import coupled_strains, group_strains
from ddg_warp.postprocess.resultants import Stresses
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.forces.drag import CoupledDrag, RodGroupDrag
from ddg_warp.solve.stepping.wrenches import Reaction, Reactions
from ddg_warp.typing import Floats, Numbers, Vector

TWIST = 2  # index of the twist among the strains of rod vertices and of half cells at joints


@launches
def energies(model: Model, state: State) -> dict[str, float | Floats]:
    """Return elastic energies by term, kinetic and gravitational energy [J]; arrays (worlds,) of several worlds.

    The potential of gravity is zero at the origin. User-defined forces with a potential have energies by name.
    """
    _check("energies", model, state)
    tangent = Tangent(model)
    result, kinetic, potential = tangent.energy(state), np.zeros(model.worlds), np.zeros(model.worlds)
    for part in tangent.parts:
        q, v = (values.reshape(model.worlds, -1) for values in (part.back(part.dofs(state)), part.rates(state)))
        kinetic += 0.5 * (part.mass.reshape(v.shape) * v * v).sum(1)
        potential -= (q * part.weight()).sum(1)
    if model.scene.bodies:
        rotational, more = body_energies(state)
        kinetic, potential = kinetic + rotational, potential + more
    for force in model.coupled.user_forces if model.coupled is not None else ():
        if force.force.potential:
            result[force.name] = force.energy(state.coupled.q, state.time, model.coupled.blocks)
    every = result | {"kinetic": kinetic, "gravity": potential}
    return {name: values if model.worlds > 1 else float(values[0]) for name, values in every.items()}


@launches
def reactions(model: Model, state: State, point: Vector | None = None, factor: float = 1.0) -> Reactions:
    """Return the reaction of every support of the scene at a state; `Integrator.wrenches` is for a step.

    Supports are ordered as added: of rods, then of shells, rings and obstacles. `reactions(...)["left"]` is that of a support or
    obstacle by name; the handle that `clamp`, `fix`, `hold` or `add_obstacle` returned is an index, too.

    Reactions balance internal forces and loads on fixed dofs, and the normals of clamped mesh edges and planes of symmetry. Forces of
    strain-rate damping are left out, as are inertia of and drag on a fixed node, which a moving support would have to add. The
    support of an obstacle carries its contact and friction forces, see `contacts`. Of a ring, x is the radial force summed around
    it, and moments do not hold the direction of the meridian. A dof fixed by several supports counts for the first, so that
    reactions add up.

    Args:
        point: reference point of moments (3,); by default the first node of a support.
        factor: the load parameter in statics.
    """
    _check("reactions", model, state)
    point = None if point is None else np.array(argument_checks.vector("reactions: point", point))
    factor = argument_checks.number("reactions: factor", factor)
    tangent = Tangent(model)
    forces = tangent.back(tangent.loads(factor, tangent.dofs(state)) + tangent.friction(state))
    loads = [Tangent.of(part, forces) for part in tangent.parts]
    if model.touch:
        model.touch.evaluate(state.coupled.q, state.coupled.rate)
        loads[-1] = loads[-1] + model.touch.terms.forces.numpy().astype(float).ravel()
    result = model.static_wrenches.at(state, loads)
    if point is None:
        return result
    about = [
        Reaction(
            each.force,
            each.moment + np.cross(each.point - point, each.force),
            np.broadcast_to(point, each.point.shape),
        )
        for each in result
    ]
    return Reactions(about, model.scene)


@dataclass(frozen=True)
class Drag:
    """Drag of the fluid on rods; see `kernels.forces.drag`.

    All fields have an axis (worlds, ...) in front for several worlds.

    Attributes:
        force: on points (P, 3) [N], in the order of `State.points`; split equally between rows of one node.
        moment: about edges (edges,) [N m], in the order of `State.angles`; None if no rod has twist.
        power: of force and moment [W]; negative in a fluid at rest.
    """

    force: Floats
    moment: Floats | None
    power: float | Floats


@launches
def drag(model: Model, state: State) -> Drag:
    """Return the drag at a state, from velocities and flow.

    Massless rods have the velocities of the last step: with implicit Euler at its end. With the midpoint rule, velocities are means
    over a step and are extrapolated by half a step from the last two. An initial state has its given velocities.
    """
    _check("drag", model, state)
    forces, moments, power, blocks, turns = [], [], np.zeros(model.worlds), None, None
    for group, data in zip(model.groups, state.groups, strict=True):
        v, omega = (device_arrays.download(array).astype(float) for array in (data.v, data.omega))
        force, moment = np.zeros_like(v), np.zeros_like(omega)
        if group.kind.quadratic:
            resisted = RodGroupDrag(model, group)
            v, omega = resisted.rates(data, state.lead)
            inertia, force = resisted.at(data, state.time, v)
            moment = -inertia["spin"] * omega if group.kind.twist else moment
        work = (force * v).sum((0, 2)) + (moment * omega).sum(0)
        power += work.reshape(group.worlds, group.rods).sum(1)
        forces.append(force)
        moments.append(moment)
    if model.coupled is not None:
        force = np.zeros((model.worlds, model.coupled.blocks, 3))
        v = force
        if model.coupled.host.quadratic:
            resisted = CoupledDrag(model)
            v = resisted.rates(state.coupled, state.lead)
            force = resisted.at(state.coupled, state.time, v)
        power += (force * v).sum((1, 2))
        _, places = model.order.coupled_rows
        turns = force[:, model.coupled.angle_start :, 0]
        blocks = force / np.maximum(1, np.bincount(places, minlength=force.shape[1]))[:, None]
    force, moment = model.order.nodes(forces, blocks), model.order.edges(moments, turns)
    return Drag(force, moment, power if model.worlds > 1 else float(power[0]))


def _check(call: str, model, state) -> None:
    """Refuse arguments that are no model, or no state of the model."""
    check_model(call, model)
    query(call, model, state)


def _each_world(values: np.ndarray) -> np.ndarray:
    """Return values (worlds, ...), without the axis if there is one world."""
    return values[0] if len(values) == 1 else values


@launches
def stresses(model: Model, state: State) -> Stresses:
    """Return conjugate stresses of every rod and shell by term (elements, strains), or (worlds, elements, strains).

    `stresses(...).rod(rod)` has axial force, shear, moments and torque of one rod in space, `stresses(...).shell(shell)` membrane
    forces, moments and equivalent stress of one shell; see `postprocess.resultants`.

    Rods: axial force [N] of edges, moments [N m] of vertices about their directors. These are means of both edges, and at clamped
    ends, which are included, the directors of the clamp. Moments next to rigid joints are in "rigid_joint", about the directors of
    the rod at the joint. Moments per length [N] of edges glued to a shell are in "glued_edge".

    Joints of rigid bodies: forces [N] at their points are in "ball_joint" and "hinge", the latter with moments [N m] about both
    normals of the axis and about it.

    Shells: second Piola-Kirchhoff stress of triangles, components (11, 22, 12) along the first edge at rest and across. Forces per
    length [N/m] are in "shell_stretch", moments per length [N] in "shell_bend" and "shell_bend_dof". A moment is positive if it
    raises the second fundamental form. Hinges have moments per weight.

    Shells of revolution: components (11, 22, 12) along and around. Forces of edges are in "axisymmetric_stretch", moments of inner
    nodes in "axisymmetric_bend", of both ends in "axisymmetric_rim".

    The entry of a rod or shell without a term is None.
    """
    _check("stresses", model, state)
    result: dict[str, list] = {}
    for group, data in zip(model.groups, state.groups, strict=True):
        values = group_strains(model, group, data)[1]
        for term, place in zip(group.kind.terms, group.kind.places(), strict=True):
            rows = slice(place[3], place[3] + len(term.measure.strains))
            missing = 0 if group.kind.closed else term.measure.span
            rods = result.setdefault(term.name, [None] * model.scene.rod_count)
            if term.measure.angles:
                end_moments.of_group(group, data, values[rows])
            for column, rod in enumerate(group.host.rods):
                of_rod = values[rows, : group.host.count[column] - missing, :, column]
                rods[rod] = _each_world(np.moveaxis(of_rod, (2, 1), (0, 1)))
    for index, part in enumerate(model.coupled.sets if model.coupled is not None else ()):
        if part.term.name not in MAGNETS:
            _add_coupled_stresses(model, state, index, result)
    return Stresses(result, model, state)


@launches
def triangle_fields(model: Model, state: State) -> dict[str, Floats]:
    """Return scalar fields of triangles (worlds, triangles) by name, in the order of `model.surfaces`.

    - "strain": largest principal value in magnitude of Green's strain.
    - "curvature" [1/m]: likewise of the change of curvature, for shells with mid-edge normals.
    - "energy" [J/m^2]: elastic energy of membrane and mid-edge bending per rest area.

    Raises:
        ValueError: there are no surfaces, or a shell has a user-defined law.
    """
    _check("triangle_fields", model, state)
    coupled, surfaces = model.coupled, model.surfaces
    if surfaces is None:
        raise ValueError("the model has no surfaces to color")
    for number, shell in enumerate(model.scene.shells):
        for term, law in shell.laws.items():
            raise ValueError(
                f"triangle_fields: {term} of shell {number} ('{shell.name}') has the law {law.density.name!r}, and the fields know "
                "that of its material; see quantities.energies"
            )
    fields = {name: np.zeros((model.worlds, len(surfaces.triangles))) for name in ("strain", "curvature", "energy")}
    for index, part in enumerate(coupled.sets):
        if not (part.term.name.startswith("shell") and part.term.density.coupled):
            continue
        E, W = part.elements, coupled.worlds
        values, slope = coupled_strains(coupled, state, index)
        change = np.moveaxis(
            values - np.stack([np.broadcast_to(part.parameters[name], (W, E)) for name in part.term.rest]), 0, -1
        )
        metric = _metric(part, W)
        principal = _principal(change.reshape(-1, 3), metric).reshape(W, E)
        row = surfaces.first[part.host.owner[0]] + part.host.owner[1]
        fields["strain" if part.term.measure.tensions else "curvature"][:, row] = principal
        fields["energy"][:, row] += 0.5 * np.einsum("cwe,wec->we", slope, change)  # quadratic laws
    return fields


def _metric(part, worlds: int) -> list[np.ndarray]:
    """Return components (11, 12, 22) of the rest metric of an element set, world after world."""
    names = [parameter.name for parameter in part.term.parameters if parameter.family == "metric"]
    return [np.broadcast_to(part.parameters[name], (worlds, part.elements)).ravel() for name in names]


def _principal(covariant: np.ndarray, metric) -> np.ndarray:
    """Return the largest |eigenvalue| of covariant tensors (n, 3) relative to the rest metric."""
    a11, a12, a22 = metric
    e11, e12, e22 = covariant.T
    area = a11 * a22 - a12**2
    mean = 0.5 * (a22 * e11 - 2.0 * a12 * e12 + a11 * e22) / area  # half the trace of metric^-1 e
    root = np.sqrt(np.maximum(mean**2 - (e11 * e22 - e12**2) / area, 0.0))
    return np.abs(mean) + root


def _add_coupled_stresses(model, state, index: int, result: dict[str, list]) -> None:
    """Add the stresses of an element set to `result`, by rod or shell."""
    coupled, part, scene = model.coupled, model.coupled.sets[index], model.scene
    term = part.term
    values = coupled_strains(coupled, state, index)[1]
    if term.measure.twists:
        end_moments.of_coupled(coupled, state.coupled, index, values)
    values = np.moveaxis(values, 0, -1)
    if term.density.coupled:
        metric = _metric(part, coupled.worlds)
        values = _resultants(values.reshape(-1, values.shape[-1]), metric).reshape(values.shape)
    of_shells = (
        scene.shells if term.name in SHELLS else scene.axisymmetric_shells if term.name in AXISYMMETRIC else None
    )
    count = scene.rod_count if of_shells is None else len(of_shells)
    if term.name in BODY_JOINTS:
        count = len(scene.body_joints)
    owners = result.setdefault(term.name, [None] * count)
    for owner in np.unique(part.host.owner[0]):
        owners[owner] = _each_world(values[:, part.host.owner[0] == owner])


def _resultants(slope: np.ndarray, metric) -> np.ndarray:
    """Transform slopes (s11, 2 s12, s22) of two edges to orthonormal components (11, 22, 12)."""
    a11, a12, a22 = metric
    basis = np.zeros((len(slope), 2, 2))
    basis[:, 0, 0], basis[:, 0, 1] = np.sqrt(a11), a12 / np.sqrt(a11)
    basis[:, 1, 1] = np.sqrt(a22 - a12**2 / a11)
    s = np.stack([slope[:, 0], 0.5 * slope[:, 1], 0.5 * slope[:, 1], slope[:, 2]], -1).reshape(-1, 2, 2)
    n = basis @ s @ basis.transpose(0, 2, 1)
    return np.stack([n[:, 0, 0], n[:, 1, 1], n[:, 0, 1]], -1)


def writhe(points: Numbers) -> float:
    """Return the writhe of a closed polygon (n, 3) by the exact Gauss integral (Klenin, Langowski 2000, method 1a)."""
    points = argument_checks.array("writhe: points", points, "give (n, 3)")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3 or not np.isfinite(points).all():
        raise ValueError(f"writhe: points have shape {points.shape}; give three finite points at least, (n, 3)")
    a, b = points, np.roll(points, -1, axis=0)
    i, j = np.triu_indices(len(points), 2)
    distant = (i > 0) | (j < len(points) - 1)  # first and last edge are adjacent: their solid angle is 0 up to rounding
    i, j = i[distant], j[distant]
    r13, r14, r23, r24 = a[j] - a[i], b[j] - a[i], a[j] - b[i], b[j] - b[i]
    normals = [np.cross(r13, r14), np.cross(r14, r24), np.cross(r24, r23), np.cross(r23, r13)]
    lengths = [np.linalg.norm(n, axis=1, keepdims=True) for n in normals]
    n1, n2, n3, n4 = (n / np.where(s > 0.0, s, 1.0) for n, s in zip(normals, lengths, strict=True))
    pairs = ((n1, n2), (n2, n3), (n3, n4), (n4, n1))
    # arcsin(p . q), without the loss of half the digits for parallel p and q
    solid = sum(np.arctan2((p * q).sum(1), np.linalg.norm(np.cross(p, q), axis=1)) for p, q in pairs)
    sign = np.sign((np.cross(b[j] - a[j], b[i] - a[i]) * r13).sum(1))
    return float((sign * solid).sum() / (2.0 * np.pi))


@launches
def total_twist(model: Model, state: State, rod: int = 0) -> float | Floats:
    """Return the total twist of a rod in revolutions; an array (worlds,) of several worlds.

    Total twist is the sum of angles between adjacent directors after parallel transport. Full revolutions between neighbours count as
    they were wound. Total twist plus `writhe` of a closed rod is the linking number of centreline and director, an integer
    (Calugareanu, White, Fuller), exact for polygons. Half cells at a rigid joint count for their rod.

    Raises:
        ValueError: there is no such rod, or it has no twist.
    """
    _check("total_twist", model, state)
    if not 0 <= argument_checks.index("total_twist: rod", rod) < model.scene.rod_count:
        raise ValueError(f"total_twist: rod {rod} does not exist; the scene has {model.scene.rod_count} rods")
    turns, has_twist = np.zeros(model.worlds), False
    for group, data in zip(model.groups, state.groups, strict=True):
        (column,) = np.nonzero(group.host.rods == rod)
        if column.size and group.kind.twist:
            index, column = next(i for i, term in enumerate(group.kind.terms) if term.measure.angles), column[0]
            row, measure = group.kind.places()[index][3], group.parameters[f"{group.kind.terms[index].name}.measure"]
            values = group_strains(model, group, data)[0][row + TWIST, :, :, column]
            weight = np.broadcast_to(measure, (group.nodes, group.columns))[:, column :: group.rods]
            vertices = group.host.count[column] - (0 if group.kind.closed else 2)
            turns += (values * weight)[:vertices].sum(0)
            has_twist = True
    for index, part in enumerate(model.coupled.sets if model.coupled is not None else ()):
        of_rod = part.host.owner[0] == rod
        if part.term.measure.twists and of_rod.any():
            weight = np.broadcast_to(part.parameters["measure"], (model.worlds, part.elements))
            turns += (coupled_strains(model.coupled, state, index)[0][TWIST] * weight)[:, of_rod].sum(1)
            has_twist = True
    if not has_twist or model.scene.dimension == 2:
        raise ValueError(f"rod {rod} has no twist")
    return turns / (2.0 * np.pi) if model.worlds > 1 else float(turns[0] / (2.0 * np.pi))

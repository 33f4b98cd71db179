"""What can be asked of a model at a state: energies, reactions, drag, internal forces, fields of surfaces, link, writhe, twist."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ddg_warp import arguments, arrays
from ddg_warp.ask import end_moments
from ddg_warp.compile.storage import gathered
from ddg_warp.kernels.terms import AXISYMMETRIC, MAGNETS, SHELLS
from ddg_warp.model import validate
from ddg_warp.solve.drag import ChainDrag, NetDrag
from ddg_warp.solve.tangent import Tangent
from ddg_warp.threads import launches

TWIST = 2  # place of the twist among the strains of rod vertices and of the half cells beside joints


@dataclass(frozen=True)
class Reaction:
    """What one support exerts on all that it holds together; supports given one by one have one each.

    Attributes:
        force: (3,) [N]; moment: (3,) about `point` [N m]; all three (worlds, 3) of several worlds.
    """

    force: np.ndarray
    moment: np.ndarray
    point: np.ndarray


@launches
def energies(model, state) -> dict:
    """Energies by term [J]: elastic terms, kinetic, gravity (zero at the origin). Of several worlds arrays (worlds,)."""
    _check("energies", model, state)
    tangent = Tangent(model)
    result, kinetic, potential = tangent.energy(state), np.zeros(model.worlds), np.zeros(model.worlds)
    for part in tangent.parts:
        q, v = (values.reshape(model.worlds, -1) for values in (part.back(part.dofs(state)), part.rates(state)))
        kinetic += 0.5 * (part.mass.reshape(v.shape) * v * v).sum(1)
        potential -= (q * part.weight()).sum(1)
    every = result | {"kinetic": kinetic, "gravity": potential}
    return {name: values if model.worlds > 1 else float(values[0]) for name, values in every.items()}


@launches
def reactions(model, state, point=None, factor: float = 1.0) -> list[Reaction]:
    """Force and moment of every support of the scene: of rods in the order they were added, then of shells, rings and obstacles.

    What holds an obstacle takes what is pushed against it and what rubs on it, by the velocities of the state, or of the way to an
    equilibrium; see `contacts`. They balance the internal forces, without those of strain-rate damping, and the loads on held dofs,
    and hold the normals of clamped mesh edges and of planes of symmetry; the inertia of a held node itself is left out, and drag on
    it, which a moving support would have to add. Of a ring, x is the radial force summed around it, and moments do not hold the
    direction of the meridian. A dof that several supports hold counts with the first of them, so that the reactions add up.

    Args:
        point: what moments are about (3,); by default the first node that a support holds.
        factor: the load parameter in statics.
    """
    _check("reactions", model, state)
    point = None if point is None else np.array(arguments.vector("reactions: point", point))
    factor = arguments.number("reactions: factor", factor)
    tangent = Tangent(model)
    q = tangent.dofs(state)
    gradient = tangent.gradient(state) - tangent.friction(state)
    force = tangent.back(np.where(tangent.free, 0.0, gradient - tangent.loads(factor, q)))
    q = tangent.back(q)
    scene = model.scene
    first, shells = len(scene.supports), len(scene.shell_supports)
    turns = np.zeros((model.worlds, first + shells + len(scene.ring_supports) + len(scene.obstacles), 3))
    if shells:
        turns[:, first : first + shells] = _normal_moments(tangent.parts[-1], state)
    result = []
    for i in range(turns.shape[1]):
        worlds = []
        for world in range(model.worlds):
            parts = [part for part in tangent.parts if i < len(part.host.held)]
            found = [_taken(part, Tangent.of(part, q), Tangent.of(part, force), i, world) for part in parts]
            here, push, twist = (np.concatenate(values) for values in zip(*found, strict=True))
            about = np.concatenate([here, np.zeros((1, 3))])[0] if point is None else point
            moment = (np.cross(here - about, push) + twist).sum(0) + turns[world, i]
            worlds.append((push.sum(0), moment, about))
        result.append(Reaction(*(_each_world(np.array(values)) for values in zip(*worlds, strict=True))))
    return result


@dataclass(frozen=True)
class Drag:
    """What the fluid exerts on rods; see `kernels.drag`.

    Attributes:
        force: on points (P, 3) [N], in the order of `State.points`; rows that share a node have equal parts.
        moment: about edges (edges,) [N m], in the order of `State.angles`; None if no rod has twist.
        power: of both on the rods [W]; in a fluid at rest negative, what it takes out of them.

    All with an axis (worlds, ...) in front of several worlds.
    """

    force: np.ndarray
    moment: np.ndarray | None
    power: float | np.ndarray


@launches
def drag(model, state) -> Drag:
    """Drag at a state, by its velocities and the flow at its time: zero at rest in a fluid at rest.

    Rods without mass move as in the last step: by implicit Euler at its end; by the midpoint rule, whose velocities are means over a
    step, half a step after that, as in the last two steps. A first state has the velocities that it is given.
    """
    _check("drag", model, state)
    forces, moments, power, blocks, turns = [], [], np.zeros(model.worlds), None, None
    for group, data in zip(model.groups, state.groups, strict=True):
        v, omega = (arrays.download(array).astype(float) for array in (data.v, data.omega))
        force, moment = np.zeros_like(v), np.zeros_like(omega)
        if group.kind.drag:
            resisted = ChainDrag(model, group)
            v, omega = resisted.rates(data, state.lead)
            inertia, u = resisted.at(data, state.time)
            force = np.einsum("krij,krj->kri", inertia["resistance"], u - v)
            moment = -inertia["spin"] * omega if group.kind.twist else moment
        work = (force * v).sum((0, 2)) + (moment * omega).sum(0)
        power += work.reshape(group.worlds, group.rods).sum(1)
        forces.append(force)
        moments.append(moment)
    if model.net is not None:
        force = np.zeros((model.worlds, model.net.blocks, 3))
        v = force
        if model.net.host.drag:
            resisted = NetDrag(model)
            v = resisted.rates(state.net, state.lead)
            inertia, u = resisted.at(state.net, state.time)
            force = np.einsum("wkij,wkj->wki", inertia["resistance"], u - v)
        power += (force * v).sum((1, 2))
        _, places = model.order.net_rows
        turns = force[:, model.net.angle_start :, 0]
        blocks = force / np.maximum(1, np.bincount(places, minlength=force.shape[1]))[:, None]
    force, moment = model.order.nodes(forces, blocks), model.order.edges(moments, turns)
    return Drag(force, moment, power if model.worlds > 1 else float(power[0]))


def _check(call: str, model, state) -> None:
    """Refuse what is no model, or no state of it."""
    validate.check_model(call, model)
    validate.check_state(call, model, state)


def _each_world(values: np.ndarray) -> np.ndarray:
    """Values (worlds, ...) as they are given out: without their first axis of one world."""
    return values[0] if len(values) == 1 else values


def _taken(part, q: np.ndarray, force: np.ndarray, support: int, world: int) -> tuple:
    """Where a support holds a part in a world (n, 3), and the forces and moments there (n, 3), which are taken from `force`."""
    host = part.host
    held, x, f = host.held[support], *(values.reshape(part.model.worlds, -1)[world] for values in (q, force))
    dofs, turns = host.dofs(held.places), held.places >= host.nodes
    if held.normal is not None:
        push = np.outer(f[dofs] @ held.normal, held.normal)
        f[dofs] -= push
        return x[dofs], push, 0.0 * push
    own = dofs[np.arange(len(dofs)), held.components]
    size, once = np.zeros(len(own)), np.unique(own, return_index=True)[1]
    size[once] = gathered(f, own[once])
    f[own[own >= 0]] = 0.0
    ends = host.dofs(host.edge_ends(held.places[turns]))
    dofs[turns] = ends[:, 0]
    directions, edges = np.eye(3)[held.components], gathered(x, ends[:, 1]) - gathered(x, ends[:, 0])
    directions[turns] = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    vectors = size[:, None] * directions
    return gathered(x, dofs), vectors * ~turns[:, None], vectors * turns[:, None]


def _normal_moments(part, state) -> np.ndarray:
    """Moments that the shell supports exert by the normals they give (worlds, supports, 3).

    An element's energy does not change if its nodes and these normals turn together: the moment of the normals is minus that of
    the forces on its nodes. Where several supports share an element, each has the part along its own edge.
    """
    worlds, count = part.net.worlds, len(part.model.scene.shell_supports)
    result, x = np.zeros((worlds, count, 3)), part.back(part.dofs(state)).reshape(worlds, -1, 3)
    for index, device in enumerate(part.net.sets):
        host, measure = device.host, device.term.measure
        element, row, support = host.normals[:, host.normals[2] < count]
        if not element.size:
            continue
        least, most = np.full(len(host), count), np.full(len(host), -1)
        np.minimum.at(least, element, support)
        np.maximum.at(most, element, support)
        alone = least == most
        forces = part.forces(state, index)[: measure.nodes].reshape(measure.nodes, worlds, len(host), 3)
        for world in range(worlds):
            corners = x[world, host.slots[: measure.nodes]]
            moments = -np.cross(corners, forces[:, world]).sum(0)
            np.add.at(result[world], least[alone], moments[alone])
            for e in np.flatnonzero(least < most):
                own = element == e
                corner = (row[own] - 3) // 3  # opposite to the edge
                edges = corners[(corner + 2) % 3, e] - corners[(corner + 1) % 3, e]
                shares = edges * np.linalg.lstsq(edges.T, moments[e], rcond=None)[0][:, None]
                np.add.at(result[world], support[own], shares)
    return result


@launches
def stresses(model, state) -> dict[str, list[np.ndarray]]:
    """Conjugate stresses of every rod and shell by term (elements, strains); of several worlds (worlds, elements, strains).

    Of rods: axial force [N] of edges, moments [N m] of vertices about the directors there: means of those of both edges, and at
    clamped ends, which are included, the directors that the clamp holds. Those beside rigid joints are in "rigid_joint", about
    the directors of the rod at the joint. What edges glued to a shell turn it with, a moment per length [N], is in "glued_edge". Of
    shells: forces per length [N/m] ("shell_stretch") and moments per length [N] ("shell_bend", "shell_bend_dof") of triangles,
    components (11, 22, 12) along the first edge at rest and across it, second Piola and Kirchhoff's; a moment is positive where it
    raises the second fundamental form. Hinges have moments per their weight. Of shells of revolution: the same along and around
    (11, 22, 12), forces of edges ("axisymmetric_stretch"), moments of inner nodes ("axisymmetric_bend") and of both ends
    ("axisymmetric_rim"). What a rod or shell has not is None.
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
    for index, part in enumerate(model.net.sets if model.net is not None else ()):
        if part.term.name not in MAGNETS:
            _add_net_stresses(model, state, index, result)
    return result


def group_strains(model, group, data) -> tuple[np.ndarray, np.ndarray]:
    """Strains and stresses of a group's elements (strains, nodes, worlds, rods)."""
    shape = (group.kind.strain_rows, group.nodes, group.columns)
    strain, stress = (arrays.allocate(shape, model.types.real, model.wp_device) for _ in range(2))
    model.strains(group, data, strain, stress)
    split = (*shape[:2], group.worlds, group.rods)
    return arrays.download(strain).reshape(split), arrays.download(stress).reshape(split)


def net_strains(net, state, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Strains and stresses of a set of the net (strains, worlds, elements)."""
    part = net.sets[index]
    shape = (len(part.term.measure.strains), net.worlds * part.elements)
    strain, stress = (wp.zeros(shape, dtype=net.real, device=net.device) for _ in range(2))
    net.strains(state.net, index, strain, stress)
    split = (shape[0], net.worlds, part.elements)
    return strain.numpy().astype(float).reshape(split), stress.numpy().astype(float).reshape(split)


@launches
def triangle_fields(model, state) -> dict[str, np.ndarray]:
    """Numbers to color surfaces by (worlds, triangles), in the order of `model.surfaces`.

    "strain": Green's strain, its largest principal value in magnitude. "curvature" [1/m]: the same of the change of curvature, of
    shells with mid-edge normals. "energy" [J/m^2]: elastic energy of membrane and mid-edge bending per rest area.
    """
    _check("triangle_fields", model, state)
    net, surfaces = model.net, model.surfaces
    if surfaces is None:
        raise ValueError("the model has no surfaces to color")
    fields = {name: np.zeros((model.worlds, len(surfaces.triangles))) for name in ("strain", "curvature", "energy")}
    for index, part in enumerate(net.sets):
        if not (part.term.name.startswith("shell") and part.term.density.coupled):
            continue
        E, W = part.elements, net.worlds
        values, slope = net_strains(net, state, index)
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
    """Components (11, 12, 22) of the rest metric of a set's elements, of all worlds one after the other."""
    names = [parameter.name for parameter in part.term.parameters if parameter.family == "metric"]
    return [np.broadcast_to(part.parameters[name], (worlds, part.elements)).ravel() for name in names]


def _principal(covariant: np.ndarray, metric) -> np.ndarray:
    """Largest |eigenvalue| of symmetric tensors (n, 3) in the basis of two edges, relative to their rest metric."""
    a11, a12, a22 = metric
    e11, e12, e22 = covariant.T
    area = a11 * a22 - a12**2
    mean = 0.5 * (a22 * e11 - 2.0 * a12 * e12 + a11 * e22) / area  # half the trace of metric^-1 e
    root = np.sqrt(np.maximum(mean**2 - (e11 * e22 - e12**2) / area, 0.0))
    return np.abs(mean) + root


def _add_net_stresses(model, state, index: int, result: dict[str, list]) -> None:
    """Stresses of a set of the net, rod by rod or shell by shell."""
    net, part, scene = model.net, model.net.sets[index], model.scene
    term = part.term
    values = net_strains(net, state, index)[1]
    if term.measure.twists:
        end_moments.of_net(net, state.net, index, values)
    values = np.moveaxis(values, 0, -1)
    if term.density.coupled:
        metric = _metric(part, net.worlds)
        values = _resultants(values.reshape(-1, values.shape[-1]), metric).reshape(values.shape)
    of_shells = (
        scene.shells if term.name in SHELLS else scene.axisymmetric_shells if term.name in AXISYMMETRIC else None
    )
    count = scene.rod_count if of_shells is None else len(of_shells)
    owners = result.setdefault(term.name, [None] * count)
    for owner in np.unique(part.host.owner[0]):
        owners[owner] = _each_world(values[:, part.host.owner[0] == owner])


def _resultants(slope: np.ndarray, metric) -> np.ndarray:
    """Components (11, 22, 12) in an orthonormal basis of slopes (s11, 2 s12, s22) in that of two edges with this rest metric."""
    a11, a12, a22 = metric
    basis = np.zeros((len(slope), 2, 2))
    basis[:, 0, 0], basis[:, 0, 1] = np.sqrt(a11), a12 / np.sqrt(a11)
    basis[:, 1, 1] = np.sqrt(a22 - a12**2 / a11)
    s = np.stack([slope[:, 0], 0.5 * slope[:, 1], 0.5 * slope[:, 1], slope[:, 2]], -1).reshape(-1, 2, 2)
    n = basis @ s @ basis.transpose(0, 2, 1)
    return np.stack([n[:, 0, 0], n[:, 1, 1], n[:, 0, 1]], -1)


def writhe(points: np.ndarray) -> float:
    """Writhe of a closed polygon (n, 3): the exact Gauss integral over pairs of edges (Klenin and Langowski 2000, method 1a)."""
    points = arguments.array("writhe: points", points, "give (n, 3)")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3 or not np.isfinite(points).all():
        raise ValueError(f"writhe: points have shape {points.shape}; give three finite points at least, (n, 3)")
    a, b = points, np.roll(points, -1, axis=0)
    i, j = np.triu_indices(len(points), 2)
    apart = (i > 0) | (
        j < len(points) - 1
    )  # the first and last edge meet: their solid angle is zero, up to a sign of rounding
    i, j = i[apart], j[apart]
    r13, r14, r23, r24 = a[j] - a[i], b[j] - a[i], a[j] - b[i], b[j] - b[i]
    normals = [np.cross(r13, r14), np.cross(r14, r24), np.cross(r24, r23), np.cross(r23, r13)]
    lengths = [np.linalg.norm(n, axis=1, keepdims=True) for n in normals]
    n1, n2, n3, n4 = (n / np.where(s > 0.0, s, 1.0) for n, s in zip(normals, lengths, strict=True))
    pairs = ((n1, n2), (n2, n3), (n3, n4), (n4, n1))
    # arcsin(p . q), without its loss of half the digits where p and q are parallel
    solid = sum(np.arctan2((p * q).sum(1), np.linalg.norm(np.cross(p, q), axis=1)) for p, q in pairs)
    sign = np.sign((np.cross(b[j] - a[j], b[i] - a[i]) * r13).sum(1))
    return float((sign * solid).sum() / (2.0 * np.pi))


@launches
def total_twist(model, state, rod: int = 0) -> float | np.ndarray:
    """Turns of a rod's directors about its centreline: the sum of the angles between neighbours, after parallel transport.

    Full turns between neighbours count as they were wound. Of a closed rod, this plus `writhe` is the link of its centreline and
    a first director's edge, a whole number (Calugareanu, White, Fuller), exactly so for polygons. The half cells beside a rigid
    joint count with the rod they belong to. Of several worlds an array (worlds,).

    Raises:
        ValueError: there is no such rod, or it has no twist.
    """
    _check("total_twist", model, state)
    if not 0 <= arguments.index("total_twist: rod", rod) < model.scene.rod_count:
        raise ValueError(f"total_twist: rod {rod} does not exist; the scene has {model.scene.rod_count} rods")
    turns, found = np.zeros(model.worlds), False
    for group, data in zip(model.groups, state.groups, strict=True):
        (column,) = np.nonzero(group.host.rods == rod)
        if column.size and group.kind.twist:
            index, column = next(i for i, term in enumerate(group.kind.terms) if term.measure.angles), column[0]
            row, measure = group.kind.places()[index][3], group.parameters[f"{group.kind.terms[index].name}.measure"]
            values = group_strains(model, group, data)[0][row + TWIST, :, :, column]
            weight = np.broadcast_to(measure, (group.nodes, group.columns))[:, column :: group.rods]
            vertices = group.host.count[column] - (0 if group.kind.closed else 2)
            turns += (values * weight)[:vertices].sum(0)
            found = True
    for index, part in enumerate(model.net.sets if model.net is not None else ()):
        of_rod = part.host.owner[0] == rod
        if part.term.measure.twists and of_rod.any():
            weight = np.broadcast_to(part.parameters["measure"], (model.worlds, part.elements))
            turns += (net_strains(model.net, state, index)[0][TWIST] * weight)[:, of_rod].sum(1)
            found = True
    if not found or model.scene.dimension == 2:
        raise ValueError(f"rod {rod} has no twist")
    return turns / (2.0 * np.pi) if model.worlds > 1 else float(turns[0] / (2.0 * np.pi))

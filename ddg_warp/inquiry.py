"""What can be asked of a model at a state: energies, support reactions, internal forces, link, writhe and twist."""

from dataclasses import dataclass

import numpy as np

from ddg_warp import arrays
from ddg_warp.tangent import Tangent


@dataclass(frozen=True)
class Reaction:
    """What one support exerts on the rods it holds.

    Attributes:
        force: (3,) [N]; moment: (3,) about `point` [N m].
    """

    force: np.ndarray
    moment: np.ndarray
    point: np.ndarray


def energies(model, state) -> dict[str, float]:
    """Energies by term [J]: elastic terms, kinetic, gravity (zero at the origin)."""
    tangent = Tangent(model)
    result = tangent.energy(state)
    kinetic, potential = 0.0, 0.0
    for group, data in zip(model.groups, state.groups, strict=True):
        mass = np.tile(group.host.mass, (1, group.worlds))
        x, v = arrays.download(data.x), arrays.download(data.v)
        kinetic += 0.5 * float((mass * (v * v).sum(-1)).sum())
        potential -= float((mass * (x @ group.gravity_host)).sum())
        if group.kind.twist:
            rotary = np.tile(group.host.rotary, (1, group.worlds))
            kinetic += 0.5 * float((rotary * arrays.download(data.omega) ** 2).sum())
    if model.net is not None:
        host = model.net.host
        q, v = (array.numpy().astype(float).reshape(model.worlds, -1, 3) for array in (state.net.q, state.net.v))
        kinetic += 0.5 * float((host.mass * v * v).sum())
        potential -= float((host.mass[: host.nodes] * q[:, : host.nodes] * np.asarray(model.scene.gravity)).sum())
    return result | {"kinetic": kinetic, "gravity": potential}


def reactions(model, state, point=None, factor: float = 1.0) -> list[Reaction]:
    """Force and moment of every support of the scene for one world: those of rods in the order they were added, then of shells.

    They balance the internal forces and the loads on held dofs; the inertia of a held node itself is left out, which a
    moving support would have to add.

    Args:
        point: what moments are about (3,); by default the first node that a support holds.
        factor: the load parameter in statics.
    """
    tangent = Tangent(model)
    q = tangent.dofs(state)
    force = np.where(tangent.free, 0.0, tangent.gradient(state) - tangent.loads(factor, q))
    net = model.net.host.held if model.net is not None else []
    result = []
    for i in range(max(len(model.held), len(net))):
        places = [*_chain_places(tangent, q, force, model.held[i] if i < len(model.held) else [])]
        if net:
            places += _net_places(tangent.parts[-1], q, force, net[i])
        about = places[0][0] if point is None and places else np.zeros(3) if point is None else np.asarray(point, float)
        total = sum((push for _, push, _ in places), np.zeros(3))
        moment = sum((np.cross(here - about, push) + twist for here, push, twist in places), np.zeros(3))
        result.append(Reaction(total, moment, about))
    return result


def _chain_places(tangent, q: np.ndarray, force: np.ndarray, support):
    """(place, force, moment) of the nodes and edges of chains that a support holds."""
    for held in support:
        part = tangent.parts[held.group]
        kind = part.group.kind
        axes = [0, 2] if kind.dim == 2 else [0, 1, 2]
        x, f = (part.blocks(tangent.of(part, values))[..., : kind.block] for values in (q, force))
        for node, column in zip(held.k, held.columns, strict=True):
            here, push, twist = np.zeros(3), np.zeros(3), np.zeros(3)
            here[axes] = x[column, node, : kind.dim]
            if not held.components and kind.twist:
                along = x[column, (node + 1) % part.group.nodes, : kind.dim] - x[column, node, : kind.dim]
                twist = f[column, node, kind.dim] * along / np.linalg.norm(along)
            else:
                push[axes] = f[column, node, : kind.dim] * [(held.components >> d) & 1 for d in range(kind.dim)]
            yield here, push, twist


def _net_places(part, q: np.ndarray, force: np.ndarray, held) -> list[tuple]:
    """(place, force, moment) of the blocks of the net that a support holds, in the first world."""
    host, places = part.host, []
    x, f = (Tangent.of(part, values).reshape(-1, 3) for values in (q, force))
    for block, component in zip(held.blocks, held.components, strict=True):
        if block < host.nodes:
            places.append((x[block], f[block] * np.eye(3)[component], np.zeros(3)))
        else:
            first, last = x[host.ends[block - host.nodes]]
            places.append((first, np.zeros(3), f[block, 0] * (last - first) / np.linalg.norm(last - first)))
    return places


def stresses(model, state) -> dict[str, list[np.ndarray]]:
    """Conjugate stresses of every rod by term: axial force [N] of edges, moments [N m] of vertices (elements, strains).

    Vertices of clamped ends are included, at the place of the end node.
    """
    result: dict[str, list] = {}
    for group, data in zip(model.groups, state.groups, strict=True):
        shape = (group.kind.strain_rows, group.nodes, group.columns)
        strain, stress = (arrays.allocate(shape, model.types.real, model.wp_device) for _ in range(2))
        model.strains(group, data, strain, stress)
        values = arrays.download(stress)
        for term, place in zip(group.kind.terms, group.kind.places(), strict=True):
            rows = slice(place[3], place[3] + len(term.measure.strains))
            missing = 0 if group.kind.closed else term.measure.span
            rods = result.setdefault(term.name.removesuffix("_damped"), [None] * model.scene.rod_count)
            for column, rod in enumerate(group.host.rods):
                rods[rod] = values[rows, : group.host.count[column] - missing, column].T
    return result


def writhe(points: np.ndarray) -> float:
    """Writhe of a closed polygon (n, 3): the exact Gauss integral over pairs of edges (Klenin and Langowski 2000, method 1a)."""
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


def total_twist(model, state, rod: int = 0) -> float:
    """Turns of a rod's directors about its centreline: the sum of the angles between neighbours, after parallel transport.

    Full turns between neighbours count as they were wound. Of a closed rod, this plus `writhe` is the link of its centreline and
    a first director's edge, a whole number (Calugareanu, White, Fuller), exactly so for polygons.
    """
    for group, data in zip(model.groups, state.groups, strict=True):
        column = np.flatnonzero(group.host.rods == rod)
        if column.size and group.kind.twist:
            shape = (group.kind.strain_rows, group.nodes, group.columns)
            strain = arrays.allocate(shape, model.types.real, model.wp_device)
            model.strains(group, data, strain)
            index = next(i for i, term in enumerate(group.kind.terms) if term.measure.angles)
            parameter, _, _, row = group.kind.places()[index]
            values = arrays.download(strain)[row + 2, :, column[0]]
            weight = np.broadcast_to(group.parameter(parameter), (group.nodes, group.columns))[:, column[0]]
            vertices = group.host.count[column[0]] - (0 if group.kind.closed else 2)
            return float((values * weight)[:vertices].sum() / (2.0 * np.pi))
    raise ValueError(f"rod {rod} has no twist")

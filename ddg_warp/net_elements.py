"""Elements of a net: of rods, rigid joints, shells and meridians, gathered by term."""

from collections import Counter

import numpy as np

from ddg_warp import axisymmetric, geometry, shell_geometry
from ddg_warp import shells as shell_terms
from ddg_warp.chains import Piece
from ddg_warp.elements import ElementSet
from ddg_warp.errors import SceneError
from ddg_warp.kernels.terms import JOINTS, term_key
from ddg_warp.net import Net, NetSet
from ddg_warp.net_glue import glue_sets


def element_sets(scene, net: Net) -> list[NetSet]:
    """Elements of a net by term; marks the dofs that none of them has."""
    joints = _joint_places(scene, net)
    rods = [*_rod_sets(net, joints), *_joint_sets(net, joints), *glue_sets(scene, net)]
    return _gather_sets([*rods, *_shell_sets(net, scene), *_meridian_sets(net, scene)])


def _joint_places(scene, net: Net) -> list[tuple[int, int, list]]:
    """Of each rigid joint: node, block of its rotation, and its edges as (rod, edge with ghosts, sign)."""
    by_rod = {rod.rod: rod for rod in net.rods}
    result = []
    for number, joint in enumerate(joint for joint in scene.joints if joint.rigid):
        members, node = [], -1
        for index, at in joint.members:
            rod = by_rod[index]
            if not rod.edges.size:
                raise SceneError(f"rigid joint {number}: rod {index} has no twist; join it with rigid=False")
            if "rod_bend_twist" in rod.piece.batch.laws:
                raise SceneError(
                    f"rigid joint {number}: rod {index} bends by a law of its own, and half cells at joints know the quadratic one; "
                    "join it with rigid=False"
                )
            k = rod.first + (at if at >= 0 else len(rod.nodes) + at)
            node = rod.all_nodes[k]
            count, closed = len(rod.all_nodes), rod.piece.kind.closed
            if closed or k < count - 1:
                members.append((rod, k, 1.0))
            if closed or k > 0:
                members.append((rod, (k - 1) % count, -1.0))
        result.append((node, net.nodes + net.angles + number, members))
    return result


def _rod_sets(net: Net, joints) -> list[NetSet]:
    """Stretch and bending of the rods; vertices at rigid joints are left to these."""
    skipped = {(member.rod, node) for node, _, members in joints for member, _, _ in members}
    sets = []
    for rod in net.rods:
        piece, row = rod.piece, rod.row
        kind, nodes, n = piece.kind, rod.all_nodes, len(rod.all_nodes)
        for term in kind.terms:
            span = term.measure.span
            count = n if kind.closed else n - span
            k = np.arange(count)
            if span == 2:
                k = k[np.array([(rod.rod, nodes[(i + 1) % n]) not in skipped for i in k], bool)]
            values = {
                name: _row(piece.parameters[f"{term.name}.{name}"], row, count)[k] for name in term.parameter_names
            }
            slots = [nodes[(k + i) % n] for i in range(span + 1)]
            lag = np.zeros((0, len(k)))
            if term.measure.angles:
                slots += [rod.all_edges[k], rod.all_edges[(k + 1) % n]]
                lag = piece.reference_twist[row][k][None]
            owner = np.array([np.full(len(k), rod.rod), k])
            sets.append(NetSet(term, np.array(slots), lag, np.zeros((0, len(k))), values, owner))
    return sets


def _row(values: np.ndarray, row: int, count: int) -> np.ndarray:
    values = values[row if len(values) > 1 else 0]
    return np.broadcast_to(values if len(values) == 1 else values[:count], (count,))


def _joint_sets(net: Net, joints) -> list[NetSet]:
    """Bending and twist of the half cells between rigid joints and the edges that meet them.

    The joint holds each rod by the frame that the rod has at the node: between its edges there, or extrapolated at an end.
    """
    sets = []
    for node, spin, members in joints:
        for rod, k, sign in members:
            piece, row, n = rod.piece, rod.row, len(rod.all_nodes)
            by_angle = piece.batch.by_angle
            term = JOINTS[term_key("rigid_joint", by_angle)]
            frames, tangents = piece.director[row], piece.tangent[row]
            points = net.rest[rod.all_nodes]
            edges = len(tangents)
            lengths = np.linalg.norm(np.roll(points, -1, 0)[:edges] - points[:edges], axis=1)
            other = rod.all_nodes[(k + 1) % n if sign > 0 else k]
            across = (
                k - 1 if sign > 0 else k + 1
            )  # the rod's edge on the other side of the node; at an end there is none
            if piece.kind.closed:
                across %= edges
            inside = 0 <= across < edges
            second = across if inside else k + (1 if sign > 0 else -1)
            ends = [(frames[e], tangents[e], lengths[e]) for e in (second, k)]
            tangent, director = geometry.frames_at_nodes(*ends, -1.0 if inside else 1.0)
            half = 0.5 * lengths[k]
            pair = [np.array([[sign * tangent, sign * tangents[k]]]), np.array([[director, frames[k]]])]
            twist = geometry.reference_twist(*pair, False)[0, 0]
            if isinstance(piece.batch.natural, str) and piece.batch.natural == "shape":
                bends = (value[0, 0] for value in geometry.curvatures(*pair, False, by_angle))
                rest = np.array([*bends, twist]) / half
            else:
                rest = _natural_at(piece, row, k if sign > 0 else k + 1) * [1.0, sign, 1.0]
            lag = np.concatenate([director, sign * tangent, [twist]])[:, None]
            stiffness = rod.stiffness(k)[:, None]
            parameters = term.bind(measure=[[half]], stiffness=[*stiffness], rest=[[value] for value in rest])
            slots = np.array([[node], [other], [rod.all_edges[k]], [spin]])
            sets.append(NetSet(term, slots, lag, np.array([[sign]]), parameters, np.array([[rod.rod], [k]])))
    return sets


def _natural_at(piece: Piece, row: int, node: int) -> np.ndarray:
    """Natural curvatures and twist of the rod's bending term at a node, at an end those of the vertex next to it [1/m]."""
    for term in piece.kind.terms:
        if term.measure.angles:
            rest = [piece.parameters[f"{term.name}.{name}"] for name in term.rest]
            vertices = len(piece.x[row]) - (0 if piece.kind.closed else 2)
            vertex = (node - 1) % vertices if piece.kind.closed else min(max(node - 1, 0), vertices - 1)
            return np.array([_row(value, row, vertices)[vertex] for value in rest])
    raise AssertionError("a rod of a rigid joint has a bending term")


def _shell_sets(net: Net, scene) -> list[NetSet]:
    sets, count = [], Counter()
    for index, (shell, description) in enumerate(zip(net.shells, scene.shells, strict=True)):
        models = description.bending, description.membrane
        for elements in shell_terms.shell_elements(shell.surface, shell.plate, shell.kinds, *models):
            sets.append(_bound(elements, shell.nodes, shell.edges, index))
            element, row, edge = elements.normals.T
            sets[-1].normals = np.array([element, row, shell.supports[edge]])
            shell.first[elements.term.name] = count[elements.term.name]
            count[elements.term.name] += len(elements)
        if description.bending in shell_geometry.TURNING:
            net.fixed[shell.edges[~shell_terms.turning(shell.kinds, description.bending)], 0] = True
    return sets


def _meridian_sets(net: Net, scene) -> list[NetSet]:
    none = np.zeros(0, int)
    sets = []
    for index, shell in enumerate(net.meridians):
        net.fixed[shell.nodes, 1] = True
        net.fixed[shell.nodes[shell.points[:, 0] == 0.0], 0] = True
        for elements in axisymmetric.element_sets(shell):
            sets.append(_bound(elements, shell.nodes, none, index))
            element, row, end = elements.normals.T
            sets[-1].normals = np.array([element, row, shell.supports[end] + len(scene.shell_supports)])
    return sets


def _bound(elements: ElementSet, nodes: np.ndarray, edges: np.ndarray, index: int) -> NetSet:
    count = len(elements.nodes)
    slots = np.concatenate([nodes[elements.nodes], edges[elements.angles]], axis=1).T
    parameters = {name: np.broadcast_to(p, (count,)) for name, p in elements.parameters.items()}
    owner = np.array([np.full(count, index), np.arange(count)])
    return NetSet(elements.term, slots, np.zeros((0, count)), elements.data.T, parameters, owner)


def _gather_sets(sets: list[NetSet]) -> list[NetSet]:
    """One set a term; damped where one of its parts is."""
    result = []
    for law in dict.fromkeys(s.term.law for s in sets if len(s)):
        same = [s for s in sets if s.term.law == law and len(s)]
        term = next((s.term for s in same if s.term.density.lagged), same[0].term)
        join = [np.concatenate([getattr(s, what) for s in same], axis=1) for what in ("slots", "lag", "data", "owner")]
        still = [np.zeros(len(s)) for s in same]
        parameters = {
            known.name: np.concatenate(
                [s.parameters.get(known.name, zero) for s, zero in zip(same, still, strict=True)]
            )
            for known in term.parameters
        }
        first = np.cumsum([0] + [len(s) for s in same])
        normals = [s.normals + [[at], [0], [0]] for s, at in zip(same, first, strict=False)]
        result.append(NetSet(term, *join[:3], parameters, join[3], np.concatenate(normals, axis=1)))
    return result

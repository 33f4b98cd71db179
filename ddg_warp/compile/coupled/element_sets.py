"""Element sets of the coupled system by term: rods, rigid joints, magnetised edges, shells, meridians."""

from collections import Counter
from collections.abc import Mapping
from functools import partial

import numpy as np

from ddg_warp.compile import axisymmetric, shells
from ddg_warp.compile.coupled.body_joints import joint_sets
from ddg_warp.compile.coupled.magnets import magnet_sets
from ddg_warp.compile.coupled.rod_shell_coupling import glue_sets
from ddg_warp.compile.coupled.system import CoupledRod, CoupledSet, CoupledSystem
from ddg_warp.compile.element_set import ElementSet
from ddg_warp.compile.laws import bind_law, check_laws
from ddg_warp.compile.rods import RodArrays
from ddg_warp.errors import SceneError
from ddg_warp.geometry import fundamental_forms, polyline
from ddg_warp.kernels.terms import JOINTS, term_key


def element_sets(scene, coupled: CoupledSystem, along: bool) -> list[CoupledSet]:
    """Return element sets by term, numbered `along` rods or not (`compile_coupled`); fix dofs without elements."""
    joints = _joint_indices(scene, coupled) + _clamped_indices(scene, coupled)
    rods = [*_rod_sets(coupled, joints, along), *_joint_sets(coupled, joints), *glue_sets(scene, coupled)]
    magnets = magnet_sets(scene, coupled) if scene.magnets else []
    magnets += joint_sets(scene, coupled) if scene.body_joints else []
    return _gather_sets([*rods, *magnets, *_shell_sets(coupled, scene), *_meridian_sets(coupled, scene)])


def _joint_indices(scene, coupled: CoupledSystem) -> list[tuple[int, int, list, Mapping]]:
    """Return (node, rotation block, edges, laws) of each rigid joint, edges as (rod, edge with ghosts, sign)."""
    by_rod = {rod.rod: rod for rod in coupled.rods}
    result = []
    for number, joint in enumerate(joint for joint in scene.joints if joint.rigid):
        check_laws(f"rigid joint {number}", joint.laws, ("rigid_joint",))
        members, node = [], -1
        for index, local_node in joint.members:
            rod = by_rod[index]
            if not rod.edges.size:
                raise SceneError(f"rigid joint {number}: rod {index} has no twist; join it with rigid=False")
            if "rod_bend_twist" in rod.piece.batch.laws and not joint.laws:
                raise SceneError(
                    f"rigid joint {number}: rod {index} bends by a law of its own, and half cells at joints know the quadratic one; "
                    "give the joint a law with join(laws={'rigid_joint': Law(...)}), or join it with rigid=False"
                )
            node, edges = _adjacent_edges(rod, local_node)
            members += edges
        result.append((node, coupled.nodes + coupled.angles + number, members, joint.laws))
    return result


def _adjacent_edges(rod: CoupledRod, local_node: int) -> tuple[int, list]:
    """Return the dof block of a node, and its edges as (rod, edge with ghosts, sign)."""
    k = rod.first + (local_node if local_node >= 0 else len(rod.nodes) + local_node)
    count, closed, edges = len(rod.all_nodes), rod.piece.kind.closed, []
    if closed or k < count - 1:
        edges.append((rod, k, 1.0))
    if closed or k > 0:
        edges.append((rod, (k - 1) % count, -1.0))
    return rod.all_nodes[k], edges


def _clamped_indices(scene, coupled: CoupledSystem) -> list[tuple[int, int, list, Mapping]]:
    """Return the nodes that rigid bodies clamp, as `_joint_indices` returns rigid joints."""
    by_rod = {rod.rod: rod for rod in coupled.rods}
    result = []
    for link in scene.body_attachments:
        for local_node in link.nodes.tolist() if link.clamped else ():
            rod = by_rod[link.index]
            for reason, holds in (
                ("has no twist", not rod.edges.size),
                ("bends by a law of its own", "rod_bend_twist" in rod.piece.batch.laws),
            ):
                if holds:
                    raise SceneError(
                        f"attach: rod {link.index} {reason}, and body {link.body} cannot clamp it; attach it with frame=False"
                    )
            node, edges = _adjacent_edges(rod, local_node)
            result.append((node, coupled.rigid_bodies.spins[link.body], edges, {}))
    return result


def _rod_sets(coupled: CoupledSystem, joints, along: bool) -> list[CoupledSet]:
    """Return stretch and bending of rods in the order of nodes, except vertices at rigid joints."""
    skipped = np.array([rod.rod * coupled.nodes + node for node, _, members, _ in joints for rod, _, _ in members], int)
    alike: dict[int, list[CoupledRod]] = {}
    for rod in coupled.rods:
        alike.setdefault(id(rod.piece), []).append(rod)
    sets = []
    for rods in alike.values():  # all rods of a piece
        piece, kind = rods[0].piece, rods[0].piece.kind
        nodes, edges = (np.array([getattr(rod, attribute) for rod in rods]) for attribute in ("all_nodes", "all_edges"))
        n = nodes.shape[1]
        for term in kind.terms:
            span = term.measure.span
            count = n if kind.closed else n - span
            k, row = np.indices((count, len(rods))).reshape(2, -1, order="F" if along else "C")
            if span == 2:
                joined = np.isin(piece.rods[row] * coupled.nodes + nodes[row, (k + 1) % n], skipped)
                row, k = row[~joined], k[~joined]
            values = {}
            for name in term.parameter_names:
                stored = piece.parameters[f"{term.name}.{name}"]
                values[name] = stored[row % len(stored), k % stored.shape[1]]
            blocks = [nodes[row, (k + i) % n] for i in range(span + 1)]
            lag = np.zeros((0, len(k)))
            if term.measure.angles:
                blocks += [edges[row, k], edges[row, (k + 1) % n]]
                lag = piece.reference_twist[row, k][None]
            sets.append(
                CoupledSet(
                    term,
                    np.array(blocks),
                    lag,
                    np.zeros((0, len(k))),
                    values,
                    np.array([piece.rods[row], k]),
                    along=True,
                )
            )
    return _gather_sets(sets)


def _joint_sets(coupled: CoupledSystem, joints) -> list[CoupledSet]:
    """Return bending and twist of the half cells between rigid joints and adjacent edges.

    A joint clamps each rod by the rod's frame at the node: between adjacent edges, or extrapolated at an end.
    """
    by_kind: dict[tuple, list] = {}  # (law, edges) by curvature measure and law
    for node, spin, edges, laws in joints:
        law = laws.get("rigid_joint")
        for member in edges:
            key = member[0].piece.batch.by_angle, None if law is None else id(law)
            by_kind.setdefault(key, (law, []))[1].append((node, spin, *member))
    kinds = sorted(by_kind.items(), key=lambda item: item[0][0])
    return [_half_cells(coupled, edges, by_angle, law) for (by_angle, _), (law, edges) in kinds]


def _half_cells(coupled: CoupledSystem, members: list, by_angle: bool, law) -> CoupledSet:
    """Return the half cells of rods with one curvature measure and one law, None for the quadratic one."""
    term = JOINTS[term_key("rigid_joint", by_angle)].of({} if law is None else {"rigid_joint": law})
    node, spin, rods, k, sign = zip(*members, strict=True)
    node, spin, k, sign = map(np.array, (node, spin, k, sign))
    edges = np.array([len(rod.all_edges) for rod in rods])
    closed = np.array([rod.piece.kind.closed for rod in rods])
    across = (k - sign).astype(int)  # edge on the other side of the node; none at an end
    across = np.where(closed, across % edges, across)
    inside = (across >= 0) & (across < edges)
    neighbour = np.where(inside, across, (k + sign).astype(int))
    angles, neighbour_angles = (
        np.array([rod.all_edges[e] for rod, e in zip(rods, e_k, strict=True)]) for e_k in (k, neighbour)
    )
    edge, neighbour_edge = angles - coupled.nodes, neighbour_angles - coupled.nodes
    frames, tangents = coupled.frame[:3].T, coupled.frame[3:].T
    lengths = polyline.length(np.diff(coupled.rest[coupled.ends], axis=1)[:, 0])
    ends = [(frames[e], tangents[e], lengths[e]) for e in (neighbour_edge, edge)]
    tangent, director = polyline.frames_at_nodes(*ends, np.where(inside, -1.0, 1.0))
    half, along = 0.5 * lengths[edge], sign[:, None]
    pair = np.stack([along * tangent, along * tangents[edge]], 1), np.stack([director, frames[edge]], 1)
    twist = polyline.reference_twist(*pair, False)[:, 0]
    rest = np.stack([*(value[:, 0] for value in polyline.curvatures(*pair, False, by_angle)), twist]) / half
    for i, rod in enumerate(rods):
        if not isinstance(rod.piece.batch.natural, str) or rod.piece.batch.natural != "shape":
            natural = _natural_at(rod.piece, rod.row, k[i] if sign[i] > 0 else k[i] + 1)
            rest[:, i] = natural * [1.0, sign[i], 1.0]
    lag = np.concatenate([director.T, (along * tangent).T, [twist]])
    where, count = f"rigid joint at rod {rods[0].rod}", len(half)
    if law is not None and not term.rest and (np.abs(rest) * half > 1e-9).any():
        raise SceneError(
            f"{where}: the law {term.density.name!r} has no strains at rest; join rods that are straight there"
        )
    defaults = {"measure": half, "stiffness": [*coupled.stiffness[:, edge]], "rest": [*rest]}
    parameters = bind_law(where, term, law, defaults, partial(_spread, count), f"{count} half cells")
    blocks = np.array([node, coupled.ends[edge, np.where(sign > 0, 1, 0)], angles, spin])
    return CoupledSet(term, blocks, lag, sign[None], parameters, np.array([[rod.rod for rod in rods], k]))


def _spread(count: int, family: str, value) -> np.ndarray:
    """Return values of a law at `count` half cells."""
    return np.broadcast_to(np.asarray(value, float), (count,))


def _natural_at(piece: RodArrays, row: int, node: int) -> np.ndarray:
    """Return natural curvatures and twist of a rod at a node, at an end of the adjacent vertex [1/m]."""
    for term in piece.kind.terms:
        if term.measure.angles:
            if not term.rest:  # straight rod with a law without strains at rest
                return np.zeros(len(term.measure.strains))
            rest = [piece.parameters[f"{term.name}.{name}"] for name in term.rest]
            vertices = len(piece.x[row]) - (0 if piece.kind.closed else 2)
            vertex = (node - 1) % vertices if piece.kind.closed else min(max(node - 1, 0), vertices - 1)
            return np.array([value[row % len(value), vertex % value.shape[1]] for value in rest])
    raise AssertionError("a rod of a rigid joint has a bending term")


def _shell_sets(coupled: CoupledSystem, scene) -> list[CoupledSet]:
    sets, count = [], Counter()
    for index, (shell, description) in enumerate(zip(coupled.shells, scene.shells, strict=True)):
        models = description.bending, description.membrane
        try:
            shell_sets = shells.shell_elements(shell.surface, shell.plate, shell.kinds, *models)
        except SceneError as error:
            raise SceneError(f"shell '{description.name}': {error}") from None
        for elements in shell_sets:
            sets.append(_bound(elements, shell.nodes, shell.edges, index))
            element, row, edge = elements.normals.T
            sets[-1].normals = np.array([element, row, shell.supports[edge]])
            shell.first[elements.term.name] = count[elements.term.law]
            count[elements.term.law] += len(elements)
        if description.bending in fundamental_forms.TURNING:
            coupled.fixed[shell.edges[~shells.turning(shell.kinds, description.bending)], 0] = True
    return sets


def _meridian_sets(coupled: CoupledSystem, scene) -> list[CoupledSet]:
    none = np.zeros(0, int)
    sets = []
    for index, shell in enumerate(coupled.meridians):
        coupled.fixed[shell.nodes, 1] = True
        coupled.fixed[shell.nodes[shell.points[:, 0] == 0.0], 0] = True
        for elements in axisymmetric.element_sets(shell):
            sets.append(_bound(elements, shell.nodes, none, index))
            element, row, end = elements.normals.T
            sets[-1].normals = np.array([element, row, shell.supports[end] + len(scene.shell_supports)])
    return sets


def _bound(elements: ElementSet, nodes: np.ndarray, edges: np.ndarray, index: int) -> CoupledSet:
    count = len(elements.nodes)
    blocks = np.concatenate([nodes[elements.nodes], edges[elements.angles]], axis=1).T
    parameters = {name: np.broadcast_to(p, (count,)) for name, p in elements.parameters.items()}
    owner = np.array([np.full(count, index), np.arange(count)])
    return CoupledSet(elements.term, blocks, np.zeros((0, count)), elements.data.T, parameters, owner)


def _gather_sets(sets: list[CoupledSet]) -> list[CoupledSet]:
    """Merge sets of one term; the merged set is damped if a member is."""
    result = []
    for law in dict.fromkeys(s.term.law for s in sets if len(s)):
        same = [s for s in sets if s.term.law == law and len(s)]
        term = next((s.term for s in same if s.term.density.lagged), same[0].term)
        join = [
            np.concatenate([getattr(s, attribute) for s in same], axis=1)
            for attribute in ("slots", "lag", "data", "owner")
        ]
        still = [np.zeros(len(s)) for s in same]
        parameters = {
            parameter.name: np.concatenate(
                [s.parameters.get(parameter.name, zero) for s, zero in zip(same, still, strict=True)]
            )
            for parameter in term.parameters
        }
        first = np.cumsum([0] + [len(s) for s in same])
        normals = [s.normals + [[offset], [0], [0]] for s, offset in zip(same, first, strict=False)]
        result.append(CoupledSet(term, *join[:3], parameters, join[3], np.concatenate(normals, axis=1), same[0].along))
    return result

"""What a scene puts on its net: masses, supports and loads."""

import numpy as np

from ddg_warp import axisymmetric
from ddg_warp.chains import component_bits, scene_motions
from ddg_warp.errors import SceneError
from ddg_warp.net import Net, NetHeld, NetRod
from ddg_warp.net_loads import NetCouple, NetLoad, NetPressure
from ddg_warp.validate import check_index


def add_masses(scene, net: Net) -> None:
    """Lump masses and rotary inertia at the dofs."""
    for rod in net.rods:
        np.add.at(net.mass, rod.all_nodes, rod.piece.mass[rod.row][:, None])
        if rod.all_edges.size:
            net.mass[rod.all_edges, 0] += np.broadcast_to(rod.piece.rotary[rod.row], rod.all_edges.shape)
    for shell, description in zip(net.shells, scene.shells, strict=True):
        weight = shell.plate.area * shell.plate.thickness * description.material.density / 3.0
        np.add.at(net.mass, shell.nodes[shell.surface.triangles], np.repeat(weight[:, None, None], 3, 1))
    for shell in net.meridians:
        axisymmetric.check_gravity(scene.gravity)
        net.mass[shell.nodes] += shell.mass[:, None]
    members = {rod.rod: rod for rod in net.rods}
    for rods, node, mass in scene.masses:
        for rod in rods:
            if rod in members:
                net.mass[members[rod].nodes[_own_node(members[rod], node)]] += mass


def hold(scene, net: Net) -> None:
    """Mark held dofs; remember what each support holds and what moves."""
    members = {rod.rod: rod for rod in net.rods}
    motions = scene_motions(scene)
    for support in scene.supports:
        bits = component_bits(support.components, 3)
        nodes, edges = [], []
        for index in support.rods:
            rod = members.get(int(index))
            if rod is None:
                continue
            for node in support.nodes:
                check_index("node", node, np.array([len(rod.nodes)]), np.array([rod.rod]))
                nodes.append(rod.nodes[node])
            for edge in support.edges:
                if rod.edges.size:
                    edges.append(rod.edges[edge])
            if support.end:
                last = support.end == "last"
                nodes += [rod.all_nodes[-1 if last else 0], rod.nodes[-1 if last else 0]]
                edges += [rod.all_edges[-1 if last else 0]] if rod.all_edges.size else []
        _mark(net, np.array(nodes, int), bits, np.array(edges, int), support.motion, motions)
    for support in scene.shell_supports:
        nodes = net.shells[support.shell].nodes[support.vertices]
        _mark(net, nodes, component_bits(support.components, 3), np.zeros(0, int), support.motion, motions)
    for support in scene.ring_supports:
        nodes = net.meridians[support.shell].nodes[support.nodes]
        _mark(net, nodes, component_bits(support.components, 3), np.zeros(0, int), support.motion, motions)


def _mark(net: Net, nodes, bits: int, edges, motion, motions) -> None:
    components = np.array([d for d in range(3) if (bits >> d) & 1])
    pairs = np.array([(n, d) for n in nodes for d in components] + [(e, 0) for e in edges], int).reshape(-1, 2)
    net.fixed[pairs[:, 0], pairs[:, 1]] = True
    net.held.append(NetHeld(pairs[:, 0], pairs[:, 1]))
    if motion is not None:
        index = next(i for i, m in enumerate(motions) if m is motion)
        held = np.isin(np.arange(3), components)
        for other, at, same in net.moving:
            if at != index and (held & same).any() and (twice := np.intersect1d(nodes, other)).size:
                place = ", ".join(f"{x:g}" for x in net.rest[twice[0]])
                raise SceneError(
                    f"the point at ({place}) m has two motions along {'xyz'[np.argmax(held & same)]}; "
                    "give it one that does both"
                )
        for other, at in net.turning:
            if at != index and (twice := np.intersect1d(edges, other)).size:
                rod = next(rod for rod in net.rods if twice[0] in rod.all_edges)
                edge = int(np.flatnonzero(rod.all_edges == twice[0])[0]) - rod.first
                raise SceneError(f"edge {edge} of rod {rod.rod} is turned by two motions; give it one that does both")
            edges = np.setdiff1d(edges, other)  # an angle is counted on from where it is: once
        net.moving.append((nodes, index, held))
        if len(edges):
            net.turning.append((np.unique(edges), index))


def load(scene, net: Net) -> None:
    """Sort loads into dead ones, those that change and those that follow."""
    members = {rod.rod: rod for rod in net.rods}
    for given in scene.loads:
        for index in given.rods:
            rod = members.get(int(index))
            if rod is None:
                continue
            if given.edge is None:
                place = rod.nodes[_own_node(rod, given.node)]
                _put(net, np.array([place]), np.asarray(given.force, float)[None], given.amplitude)
                continue
            places = _edge_places(rod, given.edge)
            if given.moment:
                _put(net, places[2:], np.array([[given.moment, 0.0, 0.0]]), given.amplitude)
            if np.any(given.couple):
                couple, length = np.asarray(given.couple, float), float(rod.piece.length[rod.row])
                net.couples.append(NetCouple(places[None], couple, given.amplitude, length))
    for given in scene.shell_loads:
        _put(net, net.shells[given.shell].nodes[given.vertices], given.force, given.amplitude)
    for pressure in scene.pressures:
        shell = net.shells[pressure.shell]
        triangles = shell.nodes[shell.surface.triangles[pressure.triangles]]
        if pressure.dead:
            x = net.rest[triangles]
            area = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) / 6.0 * pressure.pressure[:, None]
            _put(net, triangles.ravel(), np.repeat(area, 3, axis=0), pressure.amplitude)
        else:
            net.pressures.append(NetPressure(triangles, pressure.pressure, pressure.amplitude))
    for given in scene.ring_loads:
        force = np.column_stack([given.force[:, 0], 0.0 * given.force[:, 0], given.force[:, 1]])
        _put(net, net.meridians[given.shell].nodes[given.nodes], force, given.amplitude)
    for pressure in scene.ring_pressures:
        ends = net.meridians[pressure.shell].ends[pressure.edges]
        band = axisymmetric.NetBand(ends, pressure.pressure, pressure.amplitude)
        if pressure.dead:
            _put(net, ends.ravel(), band.forces(net.rest[ends]).reshape(-1, 3), pressure.amplitude)
        else:
            net.bands.append(band)


def _own_node(rod: NetRod, node: int) -> int:
    """A node of a rod, refused if the rod has none such."""
    check_index("node", node, np.array([len(rod.nodes)]), np.array([rod.rod]))
    return node


def _edge_places(rod: NetRod, edge: int) -> np.ndarray:
    """Blocks of an edge's nodes and, with twist, of its angle."""
    count = len(rod.nodes) - (0 if rod.piece.kind.closed else 1)
    check_index("edge", edge, np.array([count]), np.array([rod.rod]))
    k = edge % count
    return np.concatenate([rod.nodes[[k, (k + 1) % len(rod.nodes)]], rod.edges[k : k + 1]])


def _put(net: Net, blocks: np.ndarray, force: np.ndarray, amplitude) -> None:
    if amplitude is None:
        np.add.at(net.load, blocks, force)
    else:
        net.timed.append(NetLoad(blocks, force, amplitude))

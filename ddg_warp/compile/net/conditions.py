"""What a scene puts on its net: masses, supports and loads."""

import numpy as np

from ddg_warp.compile import axisymmetric, conditions
from ddg_warp.compile.conditions import Claims
from ddg_warp.compile.net.loads import NetCouple, NetEdgeCouple, NetLoad, NetPressure
from ddg_warp.compile.net.net import Net, NetRod
from ddg_warp.compile.net.planes import frames_of_planes
from ddg_warp.errors import SceneError
from ddg_warp.geometry.shell_forms import FREE as FREE_EDGE


def add_masses(scene, net: Net) -> None:
    """Lump masses and rotary inertia at the dofs."""
    for rod in net.rods:
        np.add.at(net.mass, rod.all_nodes, rod.piece.mass[rod.row][:, None])
        if rod.all_edges.size:
            net.mass[rod.all_edges, 0] += rod.piece.rotary[rod.row]
    for shell, description in zip(net.shells, scene.shells, strict=True):
        weight = shell.plate.area * shell.plate.thickness * description.material.density / 3.0
        np.add.at(net.mass, shell.nodes[shell.surface.triangles], np.repeat(weight[:, None, None], 3, 1))
    for shell in net.meridians:
        axisymmetric.check_gravity(scene.gravity)
        net.mass[shell.nodes] += shell.mass[:, None]
    conditions.add_masses(scene, net)


def hold(scene, net: Net) -> None:
    """Mark held dofs; remember what each support holds and what moves."""
    claims = Claims(scene, net)
    conditions.hold_rods(scene, net, claims)
    normals: dict[int, list] = {}
    for support in scene.shell_supports:
        nodes = net.shells[support.shell].nodes[support.vertices]
        claims.take(support, nodes, np.arange(len(nodes)))
        for node in nodes if not support.components else ():
            normals.setdefault(int(node), []).append(support.normal)
    for support in scene.ring_supports:
        nodes = net.meridians[support.shell].nodes[support.nodes]
        claims.take(support, nodes, np.arange(len(nodes)))
    claims.finish()
    frames_of_planes(net, normals)


def load(scene, net: Net) -> None:
    """Sort loads into dead ones, those that change and those that follow."""
    members = {rod.rod: rod for rod in net.rods}
    for given in scene.loads:
        for index in given.rods:
            rod = members.get(int(index))
            if rod is None:
                continue
            if given.edge is None:
                place = rod.nodes[given.node]
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
    for given in scene.edge_couples:
        net.edge_couples.append(_edge_couple(net.shells[given.shell], given))
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


def _edge_couple(shell, given) -> NetEdgeCouple:
    """A couple about boundary edges, which nothing may hold."""
    surface, edges = shell.surface, given.edges
    for edge in edges[shell.kinds.kind[edges] != FREE_EDGE][:1]:
        raise SceneError(
            "add_edge_couple: the normal at the edge between the vertices {} and {} of shell {} is held, by a clamp or a plane of "
            "symmetry, which would take the couple; load a free edge".format(*surface.edges[edge], given.shell)
        )
    side = np.where(surface.edge_triangles[edges, 0] >= 0, 0, 1)  # the triangle runs the edge forwards or backwards
    ends = np.where(side[:, None] == 0, surface.edges[edges], surface.edges[edges, ::-1])
    corners = np.column_stack([ends, surface.edge_opposite[edges, side]])
    length = np.linalg.norm(np.diff(surface.points[ends], axis=1)[:, 0], axis=1)
    places = np.column_stack([shell.nodes[corners], shell.edges[edges]])
    size = float(np.ptp(surface.points, axis=0).max())
    return NetEdgeCouple(places, given.couple * length, 1.0 - 2.0 * side, given.amplitude, size)


def _edge_places(rod: NetRod, edge: int) -> np.ndarray:
    """Blocks of an edge's nodes and, with twist, of its angle."""
    count = len(rod.nodes) - (0 if rod.piece.kind.closed else 1)
    k = edge % count
    return np.concatenate([rod.nodes[[k, (k + 1) % len(rod.nodes)]], rod.edges[k : k + 1]])


def _put(net: Net, blocks: np.ndarray, force: np.ndarray, amplitude) -> None:
    if amplitude is None:
        np.add.at(net.load, blocks, force)
    else:
        net.timed.append(NetLoad(blocks, force, amplitude))

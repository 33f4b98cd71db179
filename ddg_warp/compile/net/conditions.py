"""What a scene puts on its net: masses, supports and loads."""

import numpy as np

from ddg_warp.compile import axisymmetric
from ddg_warp.compile.chains import FREE, STILL, component_bits, disagreement, pose_starts, scene_motions
from ddg_warp.compile.net.loads import NetCouple, NetEdgeCouple, NetLoad, NetPressure
from ddg_warp.compile.net.net import Net, NetHeld, NetRod
from ddg_warp.compile.net.planes import frames_of_planes
from ddg_warp.errors import SceneError
from ddg_warp.geometry.shell_forms import FREE as FREE_EDGE
from ddg_warp.scene.validate import check_index

_NONE = np.zeros(0, int)


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
    members = {rod.rod: rod for rod in net.rods}
    for rods, node, mass in scene.masses:
        for rod in rods:
            if rod in members:
                net.mass[members[rod].nodes[_own_node(members[rod], node)]] += mass


def hold(scene, net: Net) -> None:
    """Mark held dofs; remember what each support holds and what moves."""
    members = {rod.rod: rod for rod in net.rods}
    claims = _Claims(net, scene_motions(scene))
    for support in scene.supports:
        nodes, edges, rows = [], [], []
        for place, index in enumerate(support.rods):
            rod = members.get(int(index))
            if rod is None:
                continue
            for nth, node in enumerate(support.nodes):
                nodes.append(rod.nodes[node])
                rows.append(place * len(support.nodes) + nth)
            for edge in support.edges:
                if rod.edges.size:
                    edges.append(rod.edges[edge])
            if support.end:
                last = support.end == "last"
                nodes += [rod.all_nodes[-1 if last else 0], rod.nodes[-1 if last else 0]]
                rows += [0, 0]
                edges += [rod.all_edges[-1 if last else 0]] if rod.all_edges.size else []
        claims.mark(np.array(nodes, int), np.array(rows, int), support, np.array(edges, int))
    normals: dict[int, list] = {}
    for support in scene.shell_supports:
        nodes = net.shells[support.shell].nodes[support.vertices]
        claims.mark(nodes, np.arange(len(nodes)), support)
        for node in nodes if not support.components else ():
            normals.setdefault(int(node), []).append(support.normal)
    for support in scene.ring_supports:
        nodes = net.meridians[support.shell].nodes[support.nodes]
        claims.mark(nodes, np.arange(len(nodes)), support)
    frames_of_planes(net, normals, (net.poses > STILL).any(1))


class _Claims:
    """Which pose moves each held dof of the net; a dof that two poses, or one and a still support, claim is refused."""

    def __init__(self, net: Net, motions: list):
        self.net, self.motions, self.start = net, motions, pose_starts(motions)

    def mark(self, nodes: np.ndarray, rows: np.ndarray, support, edges: np.ndarray = _NONE) -> None:
        """Hold nodes, the `rows` of their displacements where a motion has one for each, and angles of edges."""
        net, bits = self.net, component_bits(support.components, 3)
        components = np.array([d for d in range(3) if (bits >> d) & 1], int)
        pairs = np.array([(n, d) for n in nodes for d in components] + [(e, 0) for e in edges], int).reshape(-1, 2)
        net.fixed[pairs[:, 0], pairs[:, 1]] = True
        oblique = not support.components
        net.held.append(NetHeld(nodes, 0 * nodes, support.normal) if oblique else NetHeld(pairs[:, 0], pairs[:, 1]))
        if not self.motions:
            return
        index = next((i for i, m in enumerate(self.motions) if m is support.motion), STILL)
        rows = rows if index >= 0 and self.motions[index].count is not None else 0 * rows
        first = self.start[index] if index >= 0 else STILL
        pose = first + rows
        for d in components:
            self._take(nodes, d, pose)
        self._take(edges, 0, np.full(len(edges), first))

    def _take(self, blocks: np.ndarray, component: int, pose: np.ndarray) -> None:
        before = self.net.poses[blocks, component]
        for i in np.flatnonzero((before != FREE) & (before != pose))[:1]:
            block, axis = blocks[i], f" along {'xyz'[component]}"
            where = "the point at ({:g}, {:g}, {:g}) m".format(*self.net.rest[block])
            for rod in self.net.rods if block >= self.net.nodes else ():
                if block in rod.all_edges:
                    where, axis = f"edge {int(np.argmax(rod.all_edges == block)) - rod.first} of rod {rod.rod}", ""
            raise SceneError(disagreement(where, axis, min(before[i], pose[i]) == STILL))
        self.net.poses[blocks, component] = pose


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

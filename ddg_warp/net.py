"""From a scene to its net: shells, joined rods and what they share, as blocks of three dofs and element sets.

Nodes of joined rods and attached vertices become one. Blocks are numbered nodes first, then angles (of rod edges, then of mesh
edges), then rotations of rigid joints. In a scene of dimension 2 the net is the planar one of three-dimensional elements.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ddg_warp import axisymmetric, shell_geometry
from ddg_warp import shells as shell_terms
from ddg_warp.chains import Piece, component_bits, ghost_nodes, net_rods, pieces_of, scene_motions
from ddg_warp.elements import ElementSet
from ddg_warp.errors import SceneError
from ddg_warp.kernels.terms import JOINT
from ddg_warp.net_loads import NetCouple, NetLoad, NetPressure
from ddg_warp.precision import float32_error
from ddg_warp.surface import Surface
from ddg_warp.validate import check_index

COINCIDE = 1e-6  # how far joined nodes may lie apart, over the largest of their coordinates


@dataclass
class NetRod:
    """A rod of the net: blocks of its own nodes, angles of its own edges (indices of blocks; empty without twist)."""

    rod: int
    nodes: np.ndarray
    edges: np.ndarray
    first: int  # ghosts before its first node
    piece: Piece
    row: int  # of the piece
    all_nodes: np.ndarray  # with ghosts
    all_edges: np.ndarray


@dataclass
class NetShell:
    """A shell of the net: blocks of its vertices, block of the angle of each mesh edge (-1 without)."""

    surface: Surface
    nodes: np.ndarray
    edges: np.ndarray
    kinds: shell_geometry.EdgeKinds
    supports: np.ndarray  # place among the scene's of the support that gives the normal at each mesh edge, -1 without
    plate: shell_terms.Plate
    first: dict[str, int] = field(default_factory=dict)  # its first element in the set of each of its terms


@dataclass
class NetSet:
    """Elements of one term on blocks: slots (n, E), own lagged rows (m, E), data (d, E), parameters as of `ElementSet`.

    `owner` (2, E) is the rod or shell of each element, and its place in it: edge, vertex, triangle or hinge. `normals` (3, n) are
    element, first row of the data and support, counted over those of shells and then of rings, of every direction among the data
    that a support gives: the normal at a mesh edge, or the tangent of a meridian.
    """

    term: object
    slots: np.ndarray
    lag: np.ndarray
    data: np.ndarray
    parameters: list[np.ndarray]
    owner: np.ndarray
    normals: np.ndarray = field(default_factory=lambda: np.zeros((3, 0), int))

    def __len__(self) -> int:
        return self.slots.shape[1]


@dataclass(frozen=True)
class NetHeld:
    """Dofs that a support holds: (block, component) pairs."""

    blocks: np.ndarray
    components: np.ndarray


@dataclass(eq=False)
class Net:
    """A scene's net on the host: N blocks of three dofs.

    Attributes:
        rest: blocks at rest (N, 3): positions, then zeros.
        nodes, angles, spins: how many blocks of each kind; rod_edges: how many of the angles belong to rods.
        rods, shells, meridians: what the net was made from.
        sets: elements by term.
        ends: nodes of every rod edge (rod_edges, 2); frame: director and tangent of it (6, rod_edges).
        mass: of every dof (N, 3) [kg, kg m^2]; fixed: held dofs (N, 3).
        load: dead forces (N, 3); timed: those that change; pressures, bands, couples: loads that follow what they act on.
        held: what each support of `scene.supports`, then of `scene.shell_supports` and `scene.ring_supports`, holds here.
        moving: (blocks, motion, components (3,) bool) of nodes with a motion; turning: (angle blocks, motion) of rod edges.
    """

    rest: np.ndarray
    nodes: int
    angles: int
    spins: int
    rods: list[NetRod]
    shells: list[NetShell]
    sets: list[NetSet]
    ends: np.ndarray
    frame: np.ndarray
    mass: np.ndarray
    fixed: np.ndarray
    load: np.ndarray
    timed: list[NetLoad] = field(default_factory=list)
    pressures: list[NetPressure] = field(default_factory=list)
    held: list[NetHeld] = field(default_factory=list)
    moving: list[tuple[np.ndarray, int, np.ndarray]] = field(default_factory=list)
    turning: list[tuple[np.ndarray, int]] = field(default_factory=list)
    meridians: list[axisymmetric.NetMeridian] = field(default_factory=list)
    bands: list[axisymmetric.NetBand] = field(default_factory=list)
    couples: list[NetCouple] = field(default_factory=list)

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.rest)

    @property
    def followers(self) -> list:
        """Loads that follow what they act on, each with `places`, `forces` and their `derivative`."""
        return [*self.pressures, *self.bands, *self.couples]

    @cached_property
    def edges(self) -> np.ndarray:
        """Nodes of the edges whose turns limit a step (E, 2): of rods, meshes and meridians; of rods without twist, of all elements."""
        shells, meridians = (s.nodes[s.surface.edges] for s in self.shells), (m.ends for m in self.meridians)
        edges = np.concatenate([self.ends, *shells, *meridians])
        return edges if len(edges) else np.concatenate([part.slots[:2].T for part in self.sets])

    @cached_property
    def edge_lengths(self) -> np.ndarray:
        """Their lengths at rest (E,) [m]."""
        return np.linalg.norm(np.diff(self.rest[self.edges], axis=1)[:, 0], axis=1)

    def float32_error(self, s: float) -> float:
        """What float32 makes of the worst rod over a step of s [s]; see `precision.float32_error`. Zero without rods."""
        pieces = {id(rod.piece): rod.piece for rod in self.rods}.values()
        return max(
            (float32_error(p.kind, p.mass.mean(1), p.length, [v.T for v in p.parameters], s) for p in pieces),
            default=0.0,
        )

    @property
    def rod_edges(self) -> int:
        """Angles that belong to rod edges; they come first."""
        return len(self.ends)


def compile_net(scene) -> Net | None:
    """The net of a scene, None if it has none.

    Raises:
        SceneError: something cannot be joined, held or loaded as described; the message names it.
    """
    chosen = net_rods(scene)
    if not chosen.any() and not scene.shells and not scene.axisymmetric_shells:
        return None
    if scene.shells and scene.dimension == 2:
        raise SceneError("a scene with shells has dimension 3; leave dimension=2 to rods")
    builder, ghosts, spatial = _Builder(scene), ghost_nodes(scene), spatial_scene(scene)
    for batch in scene.batches:
        if chosen[batch.first : batch.first + batch.rods].any():
            if scene.dimension == 2:
                batch = _spatial(batch)
            for piece in pieces_of(spatial, batch, ghosts, chosen):
                for row, rod in enumerate(piece.rods):
                    builder.add_rod(piece, row, int(rod))
    for shell in scene.shells:
        builder.add_shell(shell)
    for shell in scene.axisymmetric_shells:
        builder.add_meridian(shell)
    return builder.finish()


def spatial_scene(scene):
    """The scene as one of dimension 3, for what is compiled as in space."""
    return replace(scene, dimension=3) if scene.dimension == 2 else scene


def _spatial(batch):
    """A planar batch as rods in space with twist, which the net holds in the plane."""
    section = batch.section
    natural = batch.natural
    if not isinstance(natural, str):
        zero = np.zeros(1)
        natural = (zero, np.asarray(natural[0]), zero)
    points = batch.points * [1.0, 0.0, 1.0]
    section = replace(section, EI2=section.EI1, GJ=section.EI1)
    return replace(
        batch, points=points, section=section, twist=batch.bend, natural=natural, director=np.array([0.0, 1.0, 0.0])
    )


class _Builder:
    """Collects raw nodes and elements, then merges what is shared."""

    def __init__(self, scene):
        self.scene = scene
        self.points: list[np.ndarray] = []
        self.count = 0
        self.rods: dict[int, NetRod] = {}
        self.shells: list[tuple] = []
        self.meridians: list[np.ndarray] = []
        self.rod_edges = 0
        self.frames: list[np.ndarray] = []
        self.ends: list[np.ndarray] = []

    def add_rod(self, piece: Piece, row: int, rod: int) -> None:
        """Number a rod's nodes and angles."""
        x = piece.x[row]
        nodes = self._number(x)
        closed = piece.kind.closed
        edges = len(x) - (0 if closed else 1)
        angles = np.zeros(0, int)
        if piece.kind.twist:
            angles = self.rod_edges + np.arange(edges)
            self.rod_edges += edges
            self.frames.append(np.concatenate([piece.director[row].T, piece.tangent[row].T]))
            self.ends.append(np.column_stack([nodes[:edges], np.roll(nodes, -1)[:edges]]))
        before, after = piece.ghosts
        own = slice(before, len(x) - after)
        own_edges = angles[before : edges - after] if angles.size else angles
        self.rods[rod] = NetRod(rod, nodes[own], own_edges, before, piece, row, nodes, angles)

    def add_shell(self, shell) -> None:
        """Number a shell's vertices."""
        surface = Surface(shell.points, shell.triangles)
        self.shells.append((surface, self._number(shell.points)))

    def add_meridian(self, shell) -> None:
        """Number the nodes of a shell of revolution."""
        radius, height = shell.points.T
        self.meridians.append(self._number(np.column_stack([radius, 0.0 * radius, height])))

    def _number(self, points: np.ndarray) -> np.ndarray:
        self.points.append(points)
        self.count += len(points)
        return np.arange(self.count - len(points), self.count)

    def finish(self) -> Net:
        """Everything joined and numbered for good."""
        scene, points = self.scene, np.concatenate(self.points)
        merged = self._merge(points)
        rest_nodes = np.zeros((merged.max() + 1, 3))
        rest_nodes[merged[::-1]] = points[::-1]  # the first of the merged nodes says where
        for rod in self.rods.values():
            rod.nodes, rod.all_nodes = merged[rod.nodes], merged[rod.all_nodes]
        nodes = len(rest_nodes)
        ends = merged[np.concatenate(self.ends)] if self.ends else np.zeros((0, 2), int)
        shells, mesh_edges = [], 0
        for (surface, numbers), shell in zip(self.shells, scene.shells, strict=True):
            kinds, supports = self._kinds(surface, len(shells))
            turning = shell.bending in shell_terms.TURNING
            first = nodes + self.rod_edges + mesh_edges
            angle = first + np.arange(len(surface.edges)) if turning else np.full(len(surface.edges), -1)
            mesh_edges += len(surface.edges) if turning else 0
            material = shell.material
            plate = shell_terms.plate(
                surface,
                shell.points,
                shell.thickness,
                material.young,
                material.poisson,
                kinds,
                rest=shell.rest,
                viscosity=material.viscosity if material.viscosity > 0.0 else None,
            )
            shells.append(NetShell(surface, merged[numbers], angle, kinds, supports, plate))
        angles = self.rod_edges + mesh_edges
        rigid = [joint for joint in scene.joints if joint.rigid]
        rods = sorted(self.rods.values(), key=lambda rod: rod.rod)
        for rod in rods:
            rod.edges, rod.all_edges = rod.edges + nodes, rod.all_edges + nodes
        blocks = nodes + angles + len(rigid)
        net = Net(
            rest=np.concatenate([rest_nodes, np.zeros((blocks - nodes, 3))]),
            nodes=nodes,
            angles=angles,
            spins=len(rigid),
            rods=rods,
            shells=shells,
            sets=[],
            ends=ends,
            frame=np.concatenate(self.frames, axis=1) if self.frames else np.zeros((6, 0)),
            mass=np.zeros((blocks, 3)),
            fixed=np.zeros((blocks, 3), bool),
            load=np.zeros((blocks, 3)),
            meridians=[
                axisymmetric.meridian(shell, i, scene.ring_supports, merged[numbers])
                for i, (shell, numbers) in enumerate(zip(scene.axisymmetric_shells, self.meridians, strict=True))
            ],
        )
        net.fixed[nodes : nodes + angles, 1:] = True
        joints = _joint_places(scene, net, rigid)
        net.sets = _gather_sets(
            [*_rod_sets(net, joints), *_joint_sets(net, joints), *_shell_sets(net, scene), *_meridian_sets(net, scene)]
        )
        _add_masses(scene, net)
        _hold(scene, net)
        _load(scene, net)
        if scene.dimension == 2:
            net.fixed[:nodes, 1] = True
            net.fixed[nodes : nodes + angles] = True
            net.fixed[nodes + angles :, [0, 2]] = True
        return net

    def _merge(self, points: np.ndarray) -> np.ndarray:
        """New number of every node; joined ones share theirs."""
        root = np.arange(len(points))

        def find(i):
            while root[i] != i:
                i = root[i]
            return i

        def unite(i, j, what):
            gap = np.linalg.norm(points[i] - points[j])
            if gap > COINCIDE * max(1e-300, np.abs(points[[i, j]]).max()):
                raise SceneError(f"{what} lie {gap:.3g} m apart at rest; what is joined starts at one point")
            a, b = find(i), find(j)
            root[max(a, b)] = min(a, b)

        for number, joint in enumerate(self.scene.joints):
            places = []
            for rod, node in joint.members:
                nodes = self.rods[rod].nodes
                check_index("node", node, np.array([len(nodes)]), np.array([rod]))
                places.append(nodes[node])
            for place in places[1:]:
                unite(places[0], place, f"joint {number}: its members")
        for link in self.scene.attachments:
            nodes, vertices = self.rods[link.rod].nodes, self.shells[link.shell][1]
            for node, vertex in zip(link.nodes, link.vertices, strict=True):
                check_index("node", int(node), np.array([len(nodes)]), np.array([link.rod]))
                unite(nodes[node], vertices[vertex], f"node {node} of rod {link.rod} and vertex {vertex}")
        flat = np.array([find(i) for i in range(len(points))]) if self.scene.joints or self.scene.attachments else root
        return np.unique(flat, return_inverse=True)[1]

    def _kinds(self, surface: Surface, index: int) -> tuple[shell_geometry.EdgeKinds, np.ndarray]:
        """What holds the normals at mesh edges, those whose two vertices a support names; and the place of that support."""
        clamped, symmetry, supports = {}, {}, np.full(len(surface.edges), -1)
        corners = surface.points[surface.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        for place, support in enumerate(self.scene.shell_supports):
            if support.shell != index or not support.edges:
                continue
            inside = np.isin(surface.edges, support.vertices).all(1)
            if support.edges == "symmetry":
                for edge in np.flatnonzero(inside & surface.boundary):
                    symmetry[int(edge)] = support.normal
                    if int(edge) not in clamped:
                        supports[edge] = place
            else:
                for edge in np.flatnonzero(inside):
                    sides = surface.edge_triangles[edge]
                    total = normals[sides[sides >= 0]].sum(0)
                    clamped[int(edge)] = total / np.linalg.norm(total)
                    supports[edge] = place
        for edge in set(clamped) & set(symmetry):
            del symmetry[edge]
        return shell_geometry.edge_kinds(surface, clamped, symmetry), supports


def _joint_places(scene, net: Net, rigid) -> list[tuple[int, int, list]]:
    """Of each rigid joint: node, block of its rotation, and its edges as (rod, edge with ghosts, sign)."""
    by_rod = {rod.rod: rod for rod in net.rods}
    result = []
    for number, joint in enumerate(rigid):
        members, node = [], -1
        for index, at in joint.members:
            rod = by_rod[index]
            if not rod.edges.size:
                raise SceneError(f"rigid joint {number}: rod {index} has no twist; join it with rigid=False")
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
        at = 0
        for term in kind.terms:
            span, size = term.measure.span, len(term.parameter_names)
            count = n if kind.closed else n - span
            k = np.arange(count)
            values = [_row(p, row, count) for p in piece.parameters[at : at + size]]
            at += size
            if span == 2:
                keep = np.array([(rod.rod, nodes[(i + 1) % n]) not in skipped for i in k], bool)
                k, values = k[keep], [value[keep] for value in values]
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
    """Bending and twist of the half cells between rigid joints and the edges that meet them."""
    sets = []
    for node, spin, members in joints:
        for rod, k, sign in members:
            piece, row = rod.piece, rod.row
            n = len(rod.all_nodes)
            other = rod.all_nodes[(k + 1) % n if sign > 0 else k]
            edge = net.rest[other] - net.rest[node]
            length = np.linalg.norm(edge)
            frame = net.frame[:, rod.all_edges[k] - net.nodes]
            section = piece.batch.section
            stiffness = [_edge_value(value, piece, row, k) for value in (section.EI1, section.EI2, section.GJ)]
            lag = np.concatenate([frame[:3], edge / length, [0.0]])[:, None]
            parameters = [np.array([0.5 * length])] + [np.array([v]) for v in (*stiffness, 0.0, 0.0, 0.0)]
            slots = np.array([[node], [other], [rod.all_edges[k]], [spin]])
            sets.append(NetSet(JOINT, slots, lag, np.array([[sign]]), parameters, np.array([[rod.rod], [k]])))
    return sets


def _edge_value(value, piece: Piece, row: int, edge: int) -> float:
    """A stiffness of the section on an edge with ghosts."""
    batch, (before, _) = piece.batch, piece.ghosts
    full = np.broadcast_to(np.asarray(value, float), (batch.rods, batch.edges))
    return float(full[piece.rods[row] - batch.first, np.clip(edge - before, 0, batch.edges - 1)])


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
        if description.bending in shell_terms.TURNING:
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
    parameters = [np.broadcast_to(np.asarray(p, float), (count,)) for p in elements.parameters]
    owner = np.array([np.full(count, index), np.arange(count)])
    return NetSet(elements.term, slots, np.zeros((0, count)), elements.data.T, parameters, owner)


def _gather_sets(sets: list[NetSet]) -> list[NetSet]:
    """One set a term."""
    result = []
    for name in dict.fromkeys(s.term.name for s in sets if len(s)):
        same = [s for s in sets if s.term.name == name and len(s)]
        join = [np.concatenate([getattr(s, what) for s in same], axis=1) for what in ("slots", "lag", "data", "owner")]
        parameters = [np.concatenate(values) for values in zip(*(s.parameters for s in same), strict=True)]
        first = np.cumsum([0] + [len(s) for s in same])
        normals = [s.normals + [[at], [0], [0]] for s, at in zip(same, first, strict=False)]
        result.append(NetSet(same[0].term, *join[:3], parameters, join[3], np.concatenate(normals, axis=1)))
    return result


def _add_masses(scene, net: Net) -> None:
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


def _hold(scene, net: Net) -> None:
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


def _load(scene, net: Net) -> None:
    members = {rod.rod: rod for rod in net.rods}
    for load in scene.loads:
        for index in load.rods:
            rod = members.get(int(index))
            if rod is None:
                continue
            if load.edge is None:
                place = rod.nodes[_own_node(rod, load.node)]
                _put(net, np.array([place]), np.asarray(load.force, float)[None], load.amplitude)
                continue
            places = _edge_places(rod, load.edge)
            if load.moment:
                _put(net, places[2:], np.array([[load.moment, 0.0, 0.0]]), load.amplitude)
            if np.any(load.couple):
                couple, length = np.asarray(load.couple, float), float(rod.piece.length[rod.row])
                net.couples.append(NetCouple(places[None], couple, load.amplitude, length))
    for load in scene.shell_loads:
        _put(net, net.shells[load.shell].nodes[load.vertices], load.force, load.amplitude)
    for pressure in scene.pressures:
        shell = net.shells[pressure.shell]
        triangles = shell.nodes[shell.surface.triangles[pressure.triangles]]
        if pressure.dead:
            x = net.rest[triangles]
            area = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) / 6.0 * pressure.pressure[:, None]
            _put(net, triangles.ravel(), np.repeat(area, 3, axis=0), pressure.amplitude)
        else:
            net.pressures.append(NetPressure(triangles, pressure.pressure, pressure.amplitude))
    for load in scene.ring_loads:
        force = np.column_stack([load.force[:, 0], 0.0 * load.force[:, 0], load.force[:, 1]])
        _put(net, net.meridians[load.shell].nodes[load.nodes], force, load.amplitude)
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

"""From a scene to its net: nodes of joined rods and attached vertices become one.

In a scene of dimension 2 the net is the planar one of three-dimensional elements.
"""

from dataclasses import replace

import numpy as np

from ddg_warp import axisymmetric, drag, net_conditions, net_elements, shell_geometry
from ddg_warp import shells as shell_terms
from ddg_warp.chains import Ghosts, Piece, net_rods, pieces_of
from ddg_warp.errors import SceneError
from ddg_warp.net import Net, NetRod, NetShell
from ddg_warp.structures import COINCIDE
from ddg_warp.surface import Surface


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
    builder, ghosts, spatial = _Builder(scene), Ghosts(scene), spatial_scene(scene)
    laws = drag.law_of_rods(scene)
    for batch in scene.batches:
        if chosen[batch.first : batch.first + batch.rods].any():
            if scene.dimension == 2:
                batch = _spatial(batch)
            for piece in pieces_of(spatial, batch, ghosts, laws, chosen):
                for row, rod in enumerate(piece.rods):
                    builder.add_rod(piece, row, int(rod))
    for shell in scene.shells:
        builder.add_shell(shell)
    for shell in scene.axisymmetric_shells:
        builder.add_meridian(shell)
    return builder.finish()


def spatial_scene(scene):
    """The scene as one of dimension 3, for what is compiled as in space."""
    return scene.copy(dimension=3) if scene.dimension == 2 else scene


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
        self.shells.append((shell.surface, self._number(shell.points)))

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
            turning = shell.bending in shell_geometry.TURNING
            first = nodes + self.rod_edges + mesh_edges
            angle = first + np.arange(len(surface.edges)) if turning else np.full(len(surface.edges), -1)
            mesh_edges += len(surface.edges) if turning else 0
            material = shell.material
            try:
                plate = shell_terms.plate(
                    surface,
                    shell.points,
                    shell.thickness,
                    material.young,
                    material.poisson,
                    kinds,
                    rest=shell.rest,
                    viscosity=material.viscosity if np.any(np.asarray(material.viscosity) > 0.0) else None,
                )
            except SceneError as error:
                raise SceneError(f"shell '{shell.name}': {error}") from None
            shells.append(NetShell(surface, merged[numbers], angle, kinds, supports, plate))
        angles = self.rod_edges + mesh_edges
        spins = sum(joint.rigid for joint in scene.joints)
        rods = sorted(self.rods.values(), key=lambda rod: rod.rod)
        for rod in rods:
            rod.edges, rod.all_edges = rod.edges + nodes, rod.all_edges + nodes
        blocks = nodes + angles + spins
        net = Net(
            rest=np.concatenate([rest_nodes, np.zeros((blocks - nodes, 3))]),
            nodes=nodes,
            angles=angles,
            spins=spins,
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
        net.sets = net_elements.element_sets(scene, net)
        net_conditions.add_masses(scene, net)
        net_conditions.hold(scene, net)
        net_conditions.load(scene, net)
        if scene.dimension == 2:
            net.fixed[:nodes, 1] = True
            net.fixed[nodes : nodes + angles] = True
            net.fixed[nodes + angles :, [0, 2]] = True
        return net

    def _merge(self, points: np.ndarray) -> np.ndarray:
        """New number of every node; joined ones share theirs."""
        pairs = []

        def unite(i, j, what):
            gap = np.linalg.norm(points[i] - points[j])
            if gap > COINCIDE * max(1e-300, np.abs(points[[i, j]]).max()):
                raise SceneError(f"{what} lie {gap:.3g} m apart at rest; what is joined starts at one point")
            pairs.append((i, j))

        for number, joint in enumerate(self.scene.joints):
            places = []
            for rod, node in joint.members:
                places.append(self.rods[rod].nodes[node])
            for place in places[1:]:
                unite(places[0], place, f"joint {number}: its members")
        for link in self.scene.attachments:
            nodes, vertices = self.rods[link.rod].nodes, self.shells[link.shell][1]
            for node, vertex in zip(link.nodes, link.vertices, strict=True):
                unite(nodes[node], vertices[vertex], f"node {node} of rod {link.rod} and vertex {vertex}")
        if not pairs:
            return np.arange(len(points))
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        first, second = np.array(pairs).T
        graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(points), len(points)))
        return connected_components(graph, directed=False)[1]

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

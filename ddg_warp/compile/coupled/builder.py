"""Compilation of a scene to the coupled system, with merged nodes of joined rods and attached vertices.

A scene of dimension 2 gives three-dimensional elements constrained to the plane.
"""

from dataclasses import replace

import numpy as np

from ddg_warp.compile import axisymmetric
from ddg_warp.compile import shells as shell_terms
from ddg_warp.compile.coupled import boundary_conditions, element_sets, rigid_bodies
from ddg_warp.compile.coupled.contact_parameters import contact_parameters
from ddg_warp.compile.coupled.system import CoupledRod, CoupledShell, CoupledSystem
from ddg_warp.compile.ghost_nodes import GhostNodes
from ddg_warp.compile.rods import RodArrays, alike, coupled_rods, piece_of
from ddg_warp.errors import SceneError
from ddg_warp.geometry import fundamental_forms
from ddg_warp.geometry.surface import Surface
from ddg_warp.scene import edge_forces
from ddg_warp.scene.contact import contact_names
from ddg_warp.scene.shells_and_joints import COINCIDE


def compile_coupled(scene, along: bool = False) -> CoupledSystem | None:
    """Return the coupled system of a scene, None without one.

    Args:
        along: number nodes, angles and elements rod by rod, for sequential access on a CPU. Else number the first of all rods, then
            the second, ..., for coalesced access on a GPU.

    Raises:
        SceneError: a joint, support or load is impossible; the message names the object.
    """
    chosen = coupled_rods(scene)
    if not chosen.any() and not scene.shells and not scene.axisymmetric_shells and not scene.bodies:
        return None
    if scene.shells and scene.dimension == 2:
        raise SceneError("a scene with shells has dimension 3; leave dimension=2 to rods")
    builder, ghosts, laws = _Builder(scene, along), GhostNodes(scene), edge_forces.laws_of(scene)
    for batch in scene.batches:
        if chosen[batch.first : batch.first + batch.rods].any():
            if scene.dimension == 2:
                batch = _spatial(batch)
            for run in (run for part in alike(3, batch, ghosts, laws, chosen) for run in part.runs):
                builder.add_rods(piece_of(run, ghosts, laws))
    for shell in scene.shells:
        builder.add_shell(shell)
    for shell in scene.axisymmetric_shells:
        builder.add_meridian(shell)
    for obstacle in scene.obstacles:
        builder.add_obstacle(obstacle)
    for body in scene.bodies:
        builder.add_body(body)
    for joint in scene.body_joints:
        builder.add_anchors(joint)
    return builder.finish()


def _spatial(batch):
    """Return a planar batch as rods in space with twist, to be constrained to the plane."""
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
    """Builder of the coupled system: collects raw nodes and elements, then merges common nodes."""

    def __init__(self, scene, along: bool):
        self.scene, self.along = scene, along
        self.points: list[np.ndarray] = []
        self.count = 0
        self.rods: dict[int, CoupledRod] = {}
        self.shells: list[tuple] = []
        self.meridians: list[np.ndarray] = []
        self.obstacles: list[np.ndarray] = []
        self.markers: list[np.ndarray] = []
        self.bodies: list[np.ndarray] = []
        self.anchors: list[np.ndarray] = []
        self.surfaces: list[list[np.ndarray]] = []
        self.numbers: list[tuple[np.ndarray, np.ndarray]] = []  # (nodes, angles) of some rods
        self.rod_edges = 0
        self.frames: list[np.ndarray] = []
        self.stiffness: list[np.ndarray] = []
        self.ends: list[np.ndarray] = []

    def add_rods(self, piece: RodArrays) -> None:
        """Number the nodes and twist angles of rods."""
        (rods, n, _), closed, (before, after) = piece.x.shape, piece.kind.closed, piece.ghosts
        order = "C" if self.along else "F"

        def rows(values):
            """Return values (R, n, c) as rows in the order of the numbering."""
            return (values if self.along else values.swapaxes(0, 1)).reshape(-1, values.shape[-1])

        nodes = self._number(rows(piece.x)).reshape(rods, n, order=order)
        edges = n - (0 if closed else 1)
        angles = np.zeros((rods, 0), int)
        if piece.kind.twist:
            angles = self.rod_edges + np.arange(rods * edges).reshape(rods, edges, order=order)
            self.rod_edges += angles.size
            stiffness = np.stack([np.broadcast_to(v, angles.shape) for v in piece.stiffness], -1)
            self.frames.append(np.concatenate([rows(piece.director).T, rows(piece.tangent).T]))
            self.stiffness.append(rows(stiffness).T)
            self.ends.append(rows(np.stack([nodes[:, :edges], np.roll(nodes, -1, axis=1)[:, :edges]], -1)))
        self.numbers.append((nodes, angles))
        rod_nodes, rod_edges = nodes[:, before : n - after], angles[:, before : edges - after]
        for row, rod in enumerate(piece.rods.tolist()):
            all_dofs = nodes[row], angles[row]
            self.rods[rod] = CoupledRod(rod, rod_nodes[row], rod_edges[row], before, piece, row, *all_dofs)

    def add_shell(self, shell) -> None:
        """Number the vertices of a shell."""
        self.shells.append((shell.surface, self._number(shell.points)))

    def add_meridian(self, shell) -> None:
        """Number the nodes of a shell of revolution."""
        radius, height = shell.points.T
        self.meridians.append(self._number(np.column_stack([radius, 0.0 * radius, height])))

    def add_obstacle(self, obstacle) -> None:
        """Number the points of an obstacle, and carried nodes of a rotating surface."""
        points, radius = obstacle.shape.points, obstacle.shape.radius
        self.obstacles.append(self._number(points))
        self.markers.append(self._number(points[0] + radius * np.eye(3 if obstacle.spins else 0, 3)))

    def add_body(self, body) -> None:
        """Number the centre of a rigid body, and the points of its shapes if it is in contact."""
        self.bodies.append(self._number(body.center[None]))
        shapes = body.shapes if body.name in contact_names(self.scene) else ()
        self.surfaces.append([self._number(shape.points) for shape in shapes])

    def add_anchors(self, joint) -> None:
        """Number the points of a joint between rigid bodies, which either body carries."""
        self.anchors.append(self._number(np.array([joint.point, joint.point])))

    def _number(self, points: np.ndarray) -> np.ndarray:
        self.points.append(points)
        self.count += len(points)
        return np.arange(self.count - len(points), self.count)

    def finish(self) -> CoupledSystem:
        """Merge joined nodes, number dof blocks and return the coupled system."""
        scene, points = self.scene, np.concatenate(self.points)
        merged = self._merge(points)
        rest_nodes = np.zeros((merged.max() + 1, 3))
        rest_nodes[merged[::-1]] = points[::-1]  # the first of the merged nodes gives the position
        nodes = len(rest_nodes)
        for numbers, angle_blocks in self.numbers:  # views in the rods
            numbers[:], angle_blocks[:] = merged[numbers], angle_blocks + nodes
        ends = merged[np.concatenate([np.zeros((0, 2), int), *self.ends])]
        shells, mesh_edges = [], 0
        for (surface, numbers), shell in zip(self.shells, scene.shells, strict=True):
            kinds, supports = self._kinds(surface, len(shells))
            turning = shell.bending in fundamental_forms.TURNING
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
                    laws=shell.laws,
                )
            except SceneError as error:
                raise SceneError(f"shell '{shell.name}': {error}") from None
            third = plate.area * plate.thickness * material.density / 3.0
            shells.append(CoupledShell(surface, merged[numbers], angle, kinds, supports, plate, third))
        angles = self.rod_edges + mesh_edges
        joints = sum(joint.rigid for joint in scene.joints)
        spins = joints + len(scene.bodies) + bool(scene.body_joints)
        rods = sorted(self.rods.values(), key=lambda rod: rod.rod)
        blocks = nodes + angles + spins
        coupled = CoupledSystem(
            rest=np.concatenate([rest_nodes, np.zeros((blocks - nodes, 3))]),
            nodes=nodes,
            angles=angles,
            spins=spins,
            rods=rods,
            shells=shells,
            sets=[],
            ends=ends,
            frame=np.concatenate([np.zeros((6, 0)), *self.frames], axis=1),
            stiffness=np.concatenate([np.zeros((3, 0)), *self.stiffness], axis=1),
            mass=np.zeros((blocks, 3)),
            fixed=np.zeros((blocks, 3), bool),
            meridians=[
                axisymmetric.meridian(shell, i, scene.ring_supports, merged[numbers])
                for i, (shell, numbers) in enumerate(zip(scene.axisymmetric_shells, self.meridians, strict=True))
            ],
            obstacles=[merged[numbers] for numbers in self.obstacles],
            markers=[merged[numbers] for numbers in self.markers],
        )
        if scene.shell_drags:
            triangles = (shells[drag.shell].nodes[scene.shells[drag.shell].triangles] for drag in scene.shell_drags)
            coupled.drag_triangles = np.concatenate(list(triangles))
            coupled.shell_coefficients = np.concatenate([drag.coefficients for drag in scene.shell_drags], axis=1)
        coupled.fixed[nodes : nodes + angles, 1:] = True
        if scene.bodies:
            centers, anchors = (
                merged[np.concatenate([np.zeros(0, int), *numbers])] for numbers in (self.bodies, self.anchors)
            )
            surfaces = [[merged[numbers] for numbers in each] for each in self.surfaces]
            places = centers, anchors.reshape(-1, 2), surfaces, nodes + angles + joints
            coupled.rigid_bodies = rigid_bodies.carried_nodes(scene, coupled, *places)
        coupled.sets = element_sets.element_sets(scene, coupled, self.along)
        boundary_conditions.add_masses(scene, coupled)
        boundary_conditions.hold(scene, coupled)
        if scene.bodies:
            rigid_bodies.take_masses(scene, coupled)
        boundary_conditions.load(scene, coupled)
        coupled.contact_parameters = contact_parameters(scene, coupled)
        if scene.dimension == 2:
            coupled.fixed[:nodes, 1] = True
            coupled.fixed[nodes : nodes + angles] = True
            coupled.fixed[nodes + angles :, [0, 2]] = True
        return coupled

    def _merge(self, points: np.ndarray) -> np.ndarray:
        """Return the new number of every node, equal for joined nodes."""
        pairs, labels = [], []
        for number, joint in enumerate(self.scene.joints):
            first, *partners = (self.rods[rod].nodes[node] for rod, node in joint.members)
            pairs += [(first, partner) for partner in partners]
            labels += [f"joint {number}: its members"] * len(partners)
        for link in self.scene.attachments:
            nodes, vertices = self.rods[link.rod].nodes[link.nodes], self.shells[link.shell][1][link.vertices]
            pairs += zip(nodes, vertices, strict=True)
            named = zip(link.nodes, link.vertices, strict=True)
            labels += [f"node {node} of rod {link.rod} and vertex {vertex}" for node, vertex in named]
        if not pairs:
            return np.arange(len(points))
        first, second = np.array(pairs).T
        gap = np.linalg.norm(points[first] - points[second], axis=1)
        size = np.abs(points[np.array(pairs)]).max(axis=(1, 2))
        for i in np.flatnonzero(gap > COINCIDE * np.maximum(1e-300, size))[:1]:
            raise SceneError(f"{labels[i]} lie {gap[i]:.3g} m apart at rest; joined nodes start at one point")
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(points), len(points)))
        return connected_components(graph, directed=False)[1]

    def _kinds(self, surface: Surface, index: int) -> tuple[fundamental_forms.EdgeKinds, np.ndarray]:
        """Return the kinds of mesh edges, and the support that prescribes the normal of an edge with both vertices."""
        clamped, symmetry, supports = {}, {}, np.full(len(surface.edges), -1)
        corners = surface.points[surface.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        for number, support in enumerate(self.scene.shell_supports):
            if support.shell != index or not support.edges:
                continue
            inside = np.isin(surface.edges, support.vertices).all(1)
            if support.edges == "symmetry":
                for edge in np.flatnonzero(inside & surface.boundary):
                    symmetry[int(edge)] = support.normal
                    if int(edge) not in clamped:
                        supports[edge] = number
            else:
                for edge in np.flatnonzero(inside):
                    sides = surface.edge_triangles[edge]
                    total = normals[sides[sides >= 0]].sum(0)
                    clamped[int(edge)] = total / np.linalg.norm(total)
                    supports[edge] = number
        for edge in set(clamped) & set(symmetry):
            del symmetry[edge]
        return fundamental_forms.edge_kinds(surface, clamped, symmetry), supports

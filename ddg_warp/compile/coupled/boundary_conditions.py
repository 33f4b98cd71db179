"""Boundary conditions, masses and loads of the coupled system."""

import numpy as np

from ddg_warp.compile import axisymmetric, boundary_conditions
from ddg_warp.compile.boundary_conditions import ConstraintRegistry
from ddg_warp.compile.coupled.skew_supports import frames_of_planes
from ddg_warp.compile.coupled.system import CoupledSystem
from ddg_warp.compile.loads import EdgeCouple, Pressure
from ddg_warp.errors import SceneError
from ddg_warp.geometry.fundamental_forms import FREE as FREE_EDGE


def add_masses(scene, coupled: CoupledSystem) -> None:
    """Lump masses and rotary inertia at the dofs."""
    lumps = [(np.zeros(0, int), np.zeros(0)), *((rod.all_nodes, rod.piece.mass[rod.row]) for rod in coupled.rods)]
    for shell in coupled.shells:
        lumps.append((shell.nodes[shell.surface.triangles].ravel(), np.repeat(shell.corner_mass, 3)))
    for shell in coupled.meridians:
        axisymmetric.check_gravity(scene.gravity)
        lumps.append((shell.nodes, shell.mass))
    blocks, lumped = (np.concatenate(values) for values in zip(*lumps, strict=True))
    coupled.mass += np.bincount(blocks, lumped, coupled.blocks)[:, None]
    for rod in coupled.rods:
        if rod.all_edges.size:
            coupled.mass[rod.all_edges, 0] += rod.piece.rotary[rod.row]
    boundary_conditions.add_masses(scene, coupled)


def hold(scene, coupled: CoupledSystem) -> None:
    """Fix dofs; record the dofs and the motion of each support."""
    claims = ConstraintRegistry(scene, coupled)
    boundary_conditions.fix_rods(scene, coupled, claims)
    normals: dict[int, list] = {}
    for support in scene.shell_supports:
        nodes = coupled.shells[support.shell].nodes[support.vertices]
        each = np.arange(len(nodes))
        claims.take(support, nodes, each, each)
        for node in nodes if not support.components else ():
            normals.setdefault(int(node), []).append(support.normal)
    for support in scene.ring_supports:
        nodes = coupled.meridians[support.shell].nodes[support.nodes]
        each = np.arange(len(nodes))
        claims.take(support, nodes, each, each)
    for obstacle, nodes, markers in zip(scene.obstacles, coupled.obstacles, coupled.markers, strict=True):
        each = np.append(np.arange(len(nodes)), 0 * markers)  # carried nodes move with the first point
        nodes = np.append(nodes, markers)
        claims.take(obstacle, nodes, each, each)
    claims.finish()
    frames_of_planes(coupled, normals)


def load(scene, coupled: CoupledSystem) -> None:
    """Add the loads of rods, shells and rings."""
    boundary_conditions.load_rods(scene, coupled)
    for description in scene.shell_loads:
        coupled.add_load(
            coupled.shells[description.shell].nodes[description.vertices], description.force, description.amplitude
        )
    for description in scene.pressures:
        shell = coupled.shells[description.shell]
        triangles = shell.nodes[shell.surface.triangles[description.triangles]]
        _press(coupled, Pressure(triangles, description.pressure, description.amplitude), description.dead)
    for description in scene.edge_couples:
        coupled.followers.append(_edge_couple(coupled.shells[description.shell], description))
    for description in scene.ring_loads:
        force = np.column_stack([description.force[:, 0], 0.0 * description.force[:, 0], description.force[:, 1]])
        coupled.add_load(coupled.meridians[description.shell].nodes[description.nodes], force, description.amplitude)
    for description in scene.ring_pressures:
        ends = coupled.meridians[description.shell].ends[description.edges]
        _press(coupled, axisymmetric.BandPressure(ends, description.pressure, description.amplitude), description.dead)


def _press(coupled: CoupledSystem, pressure, dead: bool) -> None:
    """Add a pressure as a follower load, or as a dead load with the forces at rest."""
    if dead:
        forces = pressure.forces(coupled.rest[pressure.places])
        coupled.add_load(pressure.places.ravel(), forces.reshape(-1, 3), pressure.amplitude)
    else:
        coupled.followers.append(pressure)


def _edge_couple(shell, description) -> EdgeCouple:
    """Return a couple about boundary edges; refuse clamped and symmetry edges."""
    surface, edges = shell.surface, description.edges
    for edge in edges[shell.kinds.kind[edges] != FREE_EDGE][:1]:
        raise SceneError(
            "add_edge_couple: the normal at the edge between the vertices {} and {} of shell {} is fixed, by a clamp or a plane of "
            "symmetry, which would take the couple; load a free edge".format(*surface.edges[edge], description.shell)
        )
    side = np.where(surface.edge_triangles[edges, 0] >= 0, 0, 1)  # orientation of the edge in its triangle
    ends = np.where(side[:, None] == 0, surface.edges[edges], surface.edges[edges, ::-1])
    corners = np.column_stack([ends, surface.edge_opposite[edges, side]])
    length = np.linalg.norm(np.diff(surface.points[ends], axis=1)[:, 0], axis=1)
    blocks = np.column_stack([shell.nodes[corners], shell.edges[edges]])
    size = float(np.ptp(surface.points, axis=0).max())
    return EdgeCouple(blocks, description.couple * length, 1.0 - 2.0 * side, size, description.amplitude)

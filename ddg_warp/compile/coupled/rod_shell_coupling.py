"""Rod-shell coupling: elements that tie the twist of a rod to the shell below, at common edges.

The stiffness per length against rotation over the surface is

    k = GLUE / (l^2 / S + 1 / (D_a / h_a + D_b / h_b)) ,

l the edge length, S the largest section stiffness of the rod, D and h the bending stiffness and height of the adjacent triangles. It is
GLUE times the stiffness of the rod edge and the triangles in series. A torque m per length rotates the rod over the surface by m / k.
This error is of second order in l for the rod, and of first order in h with a factor of 1 / GLUE for the plate, where moments jump by
m. The series keeps the coupling no stiffer than needed if one side is much softer.
"""

import numpy as np

from ddg_warp.compile import shells
from ddg_warp.compile.coupled.system import CoupledRod, CoupledSet, CoupledShell, CoupledSystem
from ddg_warp.geometry import polyline
from ddg_warp.geometry.fundamental_forms import SYMMETRY
from ddg_warp.kernels.terms import GLUE as TERM

GLUE = 10.0
"""Coupling stiffness over the stiffness of a rod edge and its adjacent triangles in series."""


def glue_sets(scene, coupled: CoupledSystem) -> list[CoupledSet]:
    """Return the rod-shell coupling elements; fix twist angles of edges on a symmetry plane."""
    rods, sets = {rod.rod: rod for rod in coupled.rods}, []
    for (index, shell_index), vertices in _attached(scene, rods).items():
        rod, shell = rods[index], coupled.shells[shell_index]
        edges, mesh_edges = _shared_edges(rod, shell, vertices)
        mirrored = shell.kinds.kind[mesh_edges] == SYMMETRY
        coupled.fixed[rod.edges[edges[mirrored]], 0] = True
        if not mirrored.all():
            sets.append(
                _elements(
                    coupled, rod, edges[~mirrored], shell, mesh_edges[~mirrored], scene.shells[shell_index].bending
                )
            )
    return sets


def _attached(scene, rods: dict[int, CoupledRod]) -> dict[tuple[int, int], np.ndarray]:
    """Return, by (rod with angles, shell), the attached vertex of each node of the rod, -1 without."""
    result = {}
    for link in scene.attachments:
        rod = rods[link.rod]
        if link.glued and rod.edges.size:
            vertices = result.setdefault((link.rod, link.shell), np.full(len(rod.nodes), -1))
            vertices[link.nodes] = link.vertices
    return result


def _shared_edges(rod: CoupledRod, shell: CoupledShell, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rod edges without ghosts that are mesh edges, and the mesh edges."""
    count = len(rod.edges)
    mesh_edges = shell.surface.find_edges(vertices[:count], np.roll(vertices, -1)[:count])
    edges = np.flatnonzero(mesh_edges >= 0)
    return edges, mesh_edges[edges]


def _elements(
    coupled: CoupledSystem, rod: CoupledRod, edges, shell: CoupledShell, mesh_edges, bending: str
) -> CoupledSet:
    surface, piece = shell.surface, rod.piece
    ends = np.stack([rod.nodes[edges], np.roll(rod.nodes, -1)[edges]])
    corners = surface.edge_opposite[mesh_edges].T
    lone = corners.min(0) < 0
    opposite = shell.nodes[np.where(lone, corners.max(0), corners)]
    vertices = coupled.rest[ends[0]], coupled.rest[ends[1]]
    e = vertices[1] - vertices[0]
    sides = coupled.rest[opposite] - vertices[0]
    length = np.linalg.norm(e, axis=1)
    heights = np.linalg.norm(np.cross(e, sides), axis=2) / length
    turns = shells.turning(shell.kinds, bending)[mesh_edges]
    fraction = np.where(lone, 0.0, np.where(turns, 0.5, heights[0] / heights.sum(0)))
    along = np.where(shell.nodes[surface.edges[mesh_edges, 0]] == ends[0], 1.0, -1.0)
    k = edges + rod.first
    frame, tangent = piece.director[rod.row][k], piece.tangent[rod.row][k]
    angle = np.stack([polyline.signed_angle(np.broadcast_to(frame, e.shape), side, tangent) for side in sides])
    rest = -(1.0 - fraction) * angle[0] - fraction * angle[1]
    section = coupled.stiffness[:, rod.edges[edges] - coupled.nodes].max(axis=0)
    stiffness = GLUE / (length**2 / section + 1.0 / _bending(shell, mesh_edges, heights))
    angles = rod.edges[edges], np.where(turns, shell.edges[mesh_edges], rod.edges[edges])
    owner = np.array([np.full(len(edges), rod.rod), k])
    data = np.stack([fraction, np.where(turns, along, 0.0)])
    law = TERM.bind(measure=length, stiffness=stiffness, rest=rest)
    return CoupledSet(TERM, np.stack([*ends, *opposite, *angles]), angle, data, law, owner)


def _bending(shell: CoupledShell, mesh_edges, heights) -> np.ndarray:
    """Return the sum of D / h over the triangles adjacent to mesh edges [N]."""
    sides = shell.surface.edge_triangles[mesh_edges].T
    return np.where(sides < 0, 0.0, shell.plate.bending_stiffness[sides] / heights).sum(0)

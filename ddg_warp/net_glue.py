"""What turns attached rods with the shells that they lie on: elements at rod edges that are mesh edges.

The glue of an edge of length l is GLUE S / l stiff against turning over the surface, S the largest stiffness of the rod's section: as a
short piece of it would be. Whatever the shell, a torque m per length, smooth along the rod, turns the one over the other by
m l^2 / (GLUE S), of second order in l, and the glue is no stiffer to solve for than the bending of the rod.
"""

import numpy as np

from ddg_warp import geometry
from ddg_warp import shells as shell_terms
from ddg_warp.kernels.terms import GLUE as TERM
from ddg_warp.net import Net, NetRod, NetSet, NetShell
from ddg_warp.shell_geometry import SYMMETRY

GLUE = 10.0
"""Torque that turns a rod edge by a radian over its surface, against that which twists or bends as much of the rod by as much."""


def glue_sets(scene, net: Net) -> list[NetSet]:
    """Elements of the rods that are glued to shells; edges on a symmetry plane, which keeps them from turning, are held."""
    rods, sets = {rod.rod: rod for rod in net.rods}, []
    for (index, at), vertices in _attached(scene, rods).items():
        rod, shell = rods[index], net.shells[at]
        edges, mesh_edges = _shared_edges(rod, shell, vertices)
        mirrored = shell.kinds.kind[mesh_edges] == SYMMETRY
        net.fixed[rod.edges[edges[mirrored]], 0] = True
        if not mirrored.all():
            sets.append(_elements(net, rod, edges[~mirrored], shell, mesh_edges[~mirrored], scene.shells[at].bending))
    return sets


def _attached(scene, rods: dict[int, NetRod]) -> dict[tuple[int, int], np.ndarray]:
    """Of every rod with angles and shell that it is glued to: the vertex of each node of the rod, -1 without."""
    result = {}
    for link in scene.attachments:
        rod = rods[link.rod]
        if link.glued and rod.edges.size:
            vertices = result.setdefault((link.rod, link.shell), np.full(len(rod.nodes), -1))
            vertices[link.nodes] = link.vertices
    return result


def _shared_edges(rod: NetRod, shell: NetShell, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges of a rod, without ghosts, that are edges of a mesh, and these."""
    surface = shell.surface
    first, second = vertices[: len(rod.edges)], np.roll(vertices, -1)[: len(rod.edges)]
    keys = surface.edges @ [len(surface.points), 1]
    wanted = np.minimum(first, second) * len(surface.points) + np.maximum(first, second)
    found = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    edges = np.flatnonzero((first >= 0) & (second >= 0) & (keys[found] == wanted))
    return edges, found[edges]


def _elements(net: Net, rod: NetRod, edges, shell: NetShell, mesh_edges, bending: str) -> NetSet:
    surface, piece = shell.surface, rod.piece
    ends = np.stack([rod.nodes[edges], np.roll(rod.nodes, -1)[edges]])
    corners = surface.edge_opposite[mesh_edges].T
    lone = corners.min(0) < 0
    opposite = shell.nodes[np.where(lone, corners.max(0), corners)]
    vertices = net.rest[ends[0]], net.rest[ends[1]]
    e = vertices[1] - vertices[0]
    sides = net.rest[opposite] - vertices[0]
    length = np.linalg.norm(e, axis=1)
    heights = np.linalg.norm(np.cross(e, sides), axis=2) / length
    turns = shell_terms.turning(shell.kinds, bending)[mesh_edges]
    share = np.where(lone, 0.0, np.where(turns, 0.5, heights[0] / heights.sum(0)))
    along = np.where(shell.nodes[surface.edges[mesh_edges, 0]] == ends[0], 1.0, -1.0)
    k = edges + rod.first
    frame, tangent = piece.director[rod.row][k], piece.tangent[rod.row][k]
    angle = np.stack([geometry.signed_angle(np.broadcast_to(frame, e.shape), side, tangent) for side in sides])
    rest = -(1.0 - share) * angle[0] - share * angle[1]
    stiffness = GLUE * rod.stiffness(k).max(axis=0) / length**2
    angles = rod.edges[edges], np.where(turns, shell.edges[mesh_edges], rod.edges[edges])
    owner = np.array([np.full(len(edges), rod.rod), k])
    data = np.stack([share, np.where(turns, along, 0.0)])
    return NetSet(TERM, np.stack([*ends, *opposite, *angles]), angle, data, [length, stiffness, rest], owner)

"""What turns attached rods with the shells that they lie on: elements at rod edges that are mesh edges.

Glue gives way as a short piece of what it joins would: against a turn over the surface, a length of it is as stiff as

    k = GLUE / (l^2 / S + 1 / (D_a / h_a + D_b / h_b)) ,

l the length of the edge, S the largest stiffness of the rod's section, D and h the bending stiffness and height of the triangles on
either side: a GLUE-th of the edge twisted or bent and of the triangles bent, one after the other. A torque m per length turns the rod
over the surface by m / k. The rod, which needs it to twist, keeps it of second order in l, and the plate, whose moments jump by it, of
first order in h with a factor of 1 / GLUE; and where one of them is much softer than the other, glue is no stiffer than that.
"""

import numpy as np

from ddg_warp.compile import shells as shell_terms
from ddg_warp.compile.net.net import Net, NetRod, NetSet, NetShell
from ddg_warp.geometry import polyline
from ddg_warp.geometry.shell_forms import SYMMETRY
from ddg_warp.kernels.terms import GLUE as TERM

GLUE = 10.0
"""Stiffness of the glue over that of an edge of the rod and the triangles beside it, which twist or bend one after the other."""


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
    count = len(rod.edges)
    found = shell.surface.find_edges(vertices[:count], np.roll(vertices, -1)[:count])
    edges = np.flatnonzero(found >= 0)
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
    angle = np.stack([polyline.signed_angle(np.broadcast_to(frame, e.shape), side, tangent) for side in sides])
    rest = -(1.0 - share) * angle[0] - share * angle[1]
    section = net.stiffness[:, rod.edges[edges] - net.nodes].max(axis=0)
    stiffness = GLUE / (length**2 / section + 1.0 / _bending(shell, mesh_edges, heights))
    angles = rod.edges[edges], np.where(turns, shell.edges[mesh_edges], rod.edges[edges])
    owner = np.array([np.full(len(edges), rod.rod), k])
    data = np.stack([share, np.where(turns, along, 0.0)])
    law = TERM.bind(measure=length, stiffness=stiffness, rest=rest)
    return NetSet(TERM, np.stack([*ends, *opposite, *angles]), angle, data, law, owner)


def _bending(shell: NetShell, mesh_edges, heights) -> np.ndarray:
    """D / h of the triangles beside mesh edges, added up [N]."""
    sides = shell.surface.edge_triangles[mesh_edges].T
    return np.where(sides < 0, 0.0, shell.plate.bending_stiffness[sides] / heights).sum(0)

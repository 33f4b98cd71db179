"""Moments at clamped ends and next to rigid joints, about the directors there.

Strains of a vertex are about the mean directors of its two edges. At an end, one of these is a ghost edge with the directors of the
node, so that the mean is taken a quarter of an edge inside. Moments about mean directors differ in first order from moments about
the directors at the node, which this module computes.
"""

import numpy as np

from ddg_warp import device_arrays
from ddg_warp.geometry import polyline


def of_group(group, data, moments: np.ndarray) -> None:
    """Refer moments (3, nodes, worlds, rods) at clamped ends of a rod group to the directors of the clamp."""
    host = group.host
    frame = device_arrays.download(data.frame).astype(np.float64)
    u, t = (np.moveaxis(frame[rows], 0, -1) for rows in (slice(0, 3), slice(3, 6)))
    first = polyline.material_directors(u, t, device_arrays.download(data.theta).astype(np.float64))
    after = host.count - host.own - host.first
    for clamped, vertex, ghost, edge in (
        (host.first == 1, 0 * host.count, 0, 1),
        (after == 1, host.count - 3, 1, 0),
    ):
        rods = np.flatnonzero(clamped)
        for world in range(group.worlds):
            k, column = vertex[rods], rods + world * group.rods
            at_node, inside = ((first[k + e, column], t[k + e, column]) for e in (ghost, edge))
            moments[:, k, world, rods] = _about(moments[:, k, world, rods], at_node, inside)


def of_coupled(coupled, state, index: int, moments: np.ndarray) -> None:
    """Refer moments (3, worlds, elements) of coupled rods or rigid joints to the directors at the node."""
    part, host, worlds = coupled.sets[index], coupled.host, coupled.worlds
    measure, slots = part.term.measure, part.host.slots
    frame = state.frame.numpy().astype(np.float64).reshape(6, worlds, -1)
    angle = state.q.numpy().astype(np.float64).reshape(worlds, -1, 3)[:, host.nodes :][:, : host.rod_edges, 0]
    u, t = (np.moveaxis(frame[rows], 0, -1) for rows in (slice(0, 3), slice(3, 6)))
    first = polyline.material_directors(u, t, angle)
    edges = slots[measure.nodes : measure.nodes + measure.angles] - host.nodes
    if measure.spins:
        # directed outwards from the joint: edges that end there have reversed tangents and second curvature
        sign = part.host.data[0][:, None]
        lag = np.moveaxis(state.lag[index].numpy().astype(np.float64).reshape(-1, worlds, part.elements), 0, -1)
        for world in range(worlds):
            at_node, inside = (
                (lag[world, :, :3], lag[world, :, 3:6]),
                (first[world, edges[0]], sign * t[world, edges[0]]),
            )
            moments[:, world] = _about(moments[:, world], at_node, inside)
            moments[1, world] *= sign[:, 0]
        return
    ends = {rod.rod: (rod.piece.ghosts, len(rod.all_nodes) - 3) for rod in host.rods}
    owner, path_node = part.host.owner
    ghosts = np.array([ends[rod][0] for rod in owner])
    last = np.array([ends[rod][1] for rod in owner])
    for clamped, (ghost, edge) in (
        ((ghosts[:, 0] == 1) & (path_node == 0), edges),
        ((ghosts[:, 1] == 1) & (path_node == last), edges[::-1]),
    ):
        for world in range(worlds):
            at_node, inside = ((first[world, e[clamped]], t[world, e[clamped]]) for e in (ghost, edge))
            moments[:, world, clamped] = _about(moments[:, world, clamped], at_node, inside)


def _about(moments: np.ndarray, node: tuple, edge: tuple) -> np.ndarray:
    """Refer moments (3, n) about the mean directors of two edges to the directors of the first.

    Args:
        node, edge: director and tangent (n, 3) of each edge.
    """
    (u0, t0), (u1, t1) = node, edge
    v0, v1 = np.cross(t0, u0), np.cross(t1, u1)
    # axis of twist: tilde t of Bergou et al. 2008
    along = (t0 + t1) / (1.0 + np.sum(t0 * t1, -1, keepdims=True))
    first, second, twist = moments[..., None]
    vector = 0.5 * first * (v0 + v1) - 0.5 * second * (u0 + u1) + twist * along
    return np.stack([np.sum(vector * v0, -1), -np.sum(vector * u0, -1), np.sum(vector * t0, -1)])

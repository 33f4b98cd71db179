"""Which blocks of a net are cut by one share of their motion: bodies, and what one motion moves."""

import numpy as np

from ddg_warp.compile.conditions import pose_starts


def number_bodies(host) -> tuple[np.ndarray, int]:
    """Rod or shell that every block belongs to, one for all that are joined, -1 for none; and how many there may be."""
    unit = np.full(host.blocks, -1, np.int32)
    count = 0
    for rod in host.rods:
        unit[rod.all_nodes], unit[rod.all_edges] = count, count
        count += 1
    for shell in host.shells:
        unit[shell.nodes], unit[shell.edges[shell.edges >= 0]] = count, count
        count += 1
    return _joined(unit, host), count


def number_units(body: np.ndarray, count: int, host, motions: list) -> tuple[np.ndarray, int]:
    """Unit of every block: what is cut together, a body or all that one motion moves; and how many there are."""
    unit, starts = body.copy(), pose_starts(motions)
    for places, poses in ((host.moving[:, 0], host.moving[:, 1:].max(1)), host.turning.T):
        unit[places] = count + np.searchsorted(starts, poses, side="right") - 1
    return unit, count + len(motions)


def _joined(unit: np.ndarray, host) -> np.ndarray:
    """The same with one unit for what shares nodes, so that joints stay whole."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = [(unit[rod.all_nodes], np.full(len(rod.all_nodes), i)) for i, rod in enumerate(host.rods)]
    first = len(host.rods)
    pairs += [(unit[shell.nodes], np.full(len(shell.nodes), first + i)) for i, shell in enumerate(host.shells)]
    if not pairs:
        return unit
    one, other = (np.concatenate(values) for values in zip(*pairs, strict=True))
    size = int(unit.max()) + 1
    graph = coo_array((np.ones(len(one)), (one, other)), shape=(size, size))
    number = connected_components(graph, directed=False)[1]
    joined = np.where(unit >= 0, number[unit], -1).astype(np.int32)
    for part in host.sets:  # rotations of joints move with what they join
        rows = np.flatnonzero((unit[part.slots] < 0).any(0))
        own = part.slots[:, rows]
        joined[np.where(unit[own] < 0, own, own[:1])] = joined[own[:1]]
    return joined

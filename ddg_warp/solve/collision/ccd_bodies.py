"""CCD bodies of the coupled system: blocks with one step fraction."""

import numpy as np

from ddg_warp.compile.boundary_conditions import pose_starts


def number_bodies(host) -> tuple[np.ndarray, int]:
    """Return the body of every block (a rod or shell, joined ones together; -1 for none), and the largest number of bodies."""
    ccd_body = np.full(host.blocks, -1, np.int32)
    count = 0
    for rod in host.rods:
        ccd_body[rod.all_nodes], ccd_body[rod.all_edges] = count, count
        count += 1
    for shell in host.shells:
        ccd_body[shell.nodes], ccd_body[shell.edges[shell.edges >= 0]] = count, count
        count += 1
    return _joined(ccd_body, host), count


def number_units(body: np.ndarray, count: int, host, motions: list) -> tuple[np.ndarray, int]:
    """Return the CCD body of every block, a body or all blocks that one motion moves, and the number of CCD bodies."""
    ccd_body, starts = body.copy(), pose_starts(motions)
    for blocks, poses in ((host.moving[:, 0], host.moving[:, 1:].max(1)), host.turning.T):
        ccd_body[blocks] = count + np.searchsorted(starts, poses, side="right") - 1
    return ccd_body, count + len(motions)


def _joined(ccd_body: np.ndarray, host) -> np.ndarray:
    """Return the body numbers with one number for bodies with common nodes, so that joints stay intact."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = [(ccd_body[rod.all_nodes], np.full(len(rod.all_nodes), i)) for i, rod in enumerate(host.rods)]
    first = len(host.rods)
    pairs += [(ccd_body[shell.nodes], np.full(len(shell.nodes), first + i)) for i, shell in enumerate(host.shells)]
    if not pairs:
        return ccd_body
    body, node = (np.concatenate(values) for values in zip(*pairs, strict=True))
    size = int(ccd_body.max()) + 1
    graph = coo_array((np.ones(len(body)), (body, node)), shape=(size, size))
    number = connected_components(graph, directed=False)[1]
    joined = np.where(ccd_body >= 0, number[ccd_body], -1).astype(np.int32)
    for element_set in host.sets:  # rotations of joints move with the joined bodies
        rows = np.flatnonzero((ccd_body[element_set.slots] < 0).any(0))
        nodes = element_set.slots[:, rows]
        joined[np.where(ccd_body[nodes] < 0, nodes, nodes[:1])] = joined[nodes[:1]]
    return joined

"""CCD bodies of the coupled system: blocks with one step fraction."""

import numpy as np

from ddg_warp.compile.boundary_conditions import pose_starts


def number_bodies(host) -> tuple[np.ndarray, int]:
    """Return the body of every block, and the largest number of bodies.

    A body is a rod, a shell or a rigid body. Joined bodies, and rigid bodies with the rods and shells that they carry, have one number;
    -1 for none.
    """
    ccd_body = np.full(host.blocks, -1, np.int32)
    count = 0
    for rod in host.rods:
        ccd_body[rod.all_nodes], ccd_body[rod.all_edges] = count, count
        count += 1
    for shell in host.shells:
        ccd_body[shell.nodes], ccd_body[shell.edges[shell.edges >= 0]] = count, count
        count += 1
    parts = [rod.all_nodes for rod in host.rods] + [shell.nodes for shell in host.shells]
    if (rigid := host.rigid_bodies) is not None:
        for body in range(len(rigid)):
            parts.append(np.append(rigid.carried[rigid.owner == body], [rigid.origins[body], rigid.spins[body]]))
            ccd_body[parts[-1]] = count
            count += 1
        parts += [blocks[~np.isin(blocks, rigid.world)] for blocks in rigid.anchors]
    return _joined(ccd_body, parts, host), count


def number_units(body: np.ndarray, count: int, host, motions: list) -> tuple[np.ndarray, int]:
    """Return the CCD body of every block, a body or all blocks that one motion moves, and the number of CCD bodies."""
    ccd_body, starts = body.copy(), pose_starts(motions)
    for blocks, poses in ((host.moving[:, 0], host.moving[:, 1:].max(1)), host.turning.T):
        ccd_body[blocks] = count + np.searchsorted(starts, poses, side="right") - 1
    return ccd_body, count + len(motions)


def _joined(ccd_body: np.ndarray, parts: list[np.ndarray], host) -> np.ndarray:
    """Return the body numbers with one number for bodies with common nodes of `parts`, so that joints stay intact."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = [(ccd_body[nodes], np.full(len(nodes), part)) for part, nodes in enumerate(parts)]
    if not pairs:
        return ccd_body
    body, node = (np.concatenate(values) for values in zip(*pairs, strict=True))
    size = max(int(ccd_body.max()) + 1, len(parts))
    graph = coo_array((np.ones(len(body)), (body, node)), shape=(size, size))
    number = connected_components(graph, directed=False)[1]
    joined = np.where(ccd_body >= 0, number[ccd_body], -1).astype(np.int32)
    for element_set in host.sets:  # rotations of joints move with the joined bodies
        rows = np.flatnonzero((ccd_body[element_set.slots] < 0).any(0))
        nodes = element_set.slots[:, rows]
        joined[np.where(ccd_body[nodes] < 0, nodes, nodes[:1])] = joined[nodes[:1]]
    return joined

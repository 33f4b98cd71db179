"""Which linear solver suits a group of rods, or a net."""

import numpy as np

# An iteration by the sweep takes about 2 us a node of the longest rod, however many rods run side by side; one by cyclic reduction
# takes about 40 launches, and some ns a node of all rods together.
LONG = 512  # nodes of a rod from which on cyclic reduction pays on a GPU ...
FEW = 256  # ... if there are no more rods than this

LARGE = 4096  # nodes of a net, those of rods apart, from which on fewer, longer iterations of conjugate gradients pay

# Rods between joints: block Jacobi takes iterations that grow with the square of their nodes (a gridshell, 1e-3: 250 at 8 edges, 2377
# at 32), the chain preconditioner does not (16), at twice the time of an iteration on the CPU. On a GPU four substitutions of
# serial places, about 0.35 us each, and eight launches add to the 15 us of an iteration of block Jacobi: an estimate.
BETWEEN = 4  # nodes of a rod between joints from which on chains pay
PLACES = 10  # places of a chain on a GPU that cost as much as an iteration of block Jacobi
LAUNCHES = 3  # the launches of an iteration with chains over those of block Jacobi


def automatic(group) -> str:
    """Name of the solver: "chain" (PCG) for closed rods, "partitioned" for few and long open ones on CUDA, else "sweep"."""
    if group.kind.closed:
        return "chain"
    if group.device.is_cuda and group.nodes >= LONG and group.columns <= FEW:
        return "partitioned"
    return "sweep"


def net_preconditioner(net) -> str:
    """Name of the preconditioner of a net: with "chain" where rods are long between joints, with "multilevel" where it is large."""
    host = net.host
    if not host.rods:
        return "multilevel" if host.nodes >= LARGE else "block_jacobi"
    own = np.concatenate([rod.all_nodes for rod in host.rods])
    joints = np.bincount(own, minlength=host.nodes) > 1
    rigid = np.zeros(host.nodes, bool)
    for part in host.sets:
        if part.term.measure.spins:
            rigid[part.slots[0]] = True
    between, places = (max(_longest_run(~at[rod.all_nodes]) for rod in host.rods) for at in (joints | rigid, rigid))
    pays = between >= BETWEEN
    if pays and net.device.is_cuda:
        pays = 0.25 * between**2 > LAUNCHES + places / PLACES
    rest = host.nodes - len(np.unique(own)) if pays else host.nodes
    names = ["chain"] * pays + ["multilevel"] * (rest >= LARGE)
    return "_".join(names) or "block_jacobi"


def _longest_run(flags: np.ndarray) -> int:
    """Length of the longest row of true ones."""
    ends = np.flatnonzero(~np.concatenate([[False], flags, [False]]))
    return int(np.diff(ends).max()) - 1

"""Which linear solver suits a group of rods, or a net."""

import numpy as np

# An iteration by the sweep takes about 2 us a node of the longest rod, however many rods run side by side; one by cyclic reduction
# takes about 40 launches, and some ns a node of all rods together.
LONG = 512  # nodes of a rod from which on cyclic reduction pays on a GPU ...
FEW = 256  # ... if there are no more rods than this
# Of one matrix and many right-hand sides, as in contact: a further one takes the sweep 1.3 us a node, and cyclic reduction one launch.
LONG_REPEATED, FEW_REPEATED = 24, 2048
# Nodes up to which that launch, a block of threads a chain, takes less than to eliminate anew with all multiprocessors: 94 us of 121
# chains of 961 nodes on an H200, growing with the nodes, where each of the 2 log2(n) launches takes 9 to 25.
LONGEST_REPEATED = 8192

LARGE = 4096  # nodes of a net, those of rods apart, from which on fewer, longer iterations of conjugate gradients pay

# Block Jacobi takes iterations that grow with the square of a rod's edges between joints (a gridshell, residual 1e-3: 250 at 8, 2378 at
# 32), the chain preconditioner takes 16 whatever their number, at about twice the time of an iteration on the CPU. On a GPU a chain is
# serial, and its launches count: an iteration of block Jacobi takes 41 us on an H200, one with chains of 8, 32 and 128 places takes
# 84, 144 and 330 us (tools/results/nets_cuda.csv).
BETWEEN = 4  # nodes of a rod between joints from which on chains pay
PLACES = 20  # places of a chain that take as long as an iteration of block Jacobi, on a GPU
REDUCED = 240  # places that take as long as the cyclic reduction of few, long chains
LAUNCHES = 1  # iterations of block Jacobi that take as long as what else one with chains launches, on a GPU


def automatic(group) -> str:
    """Name of the solver: "chain" (PCG) for closed rods, "partitioned" for few and long open ones on CUDA, else "sweep"."""
    if group.kind.closed:
        return "chain"
    return "partitioned" if long_and_few(group.nodes, group.columns, group.device) else "sweep"


def long_and_few(nodes: int, columns: int, device, repeated: bool = False) -> bool:
    """Whether chains of at most as many nodes are solved by cyclic reduction, many threads a chain.

    `repeated`: whether for many right-hand sides of one matrix.
    """
    long, few = (LONG_REPEATED, FEW_REPEATED) if repeated else (LONG, FEW)
    return device.is_cuda and nodes >= long and columns <= few


# Nodes from which on equilibria of a net take conjugate gradients, without and with CUDA. Where membrane forces carry the loads these
# are faster from some thousand triangles on, on the CPU, too; where bending does, one core factorises faster
# (tools/results/statics_cpu.csv). Without CUDA memory decides: factors of 1e5 triangles take some GB. On CUDA conjugate gradients are
# faster from the smallest size measured on, 2,048 triangles, by 8 to 80 times (statics_cuda.csv); below, factors see instabilities.
LARGE_STATIC = {False: 50_000, True: 4_000}


def static_solver(model) -> str:
    """Name of the solver of equilibria: "pcg" for contact and for large nets that it can serve, else "direct"."""
    net = model.net
    if net is not None and net.host.touching:
        return "pcg"
    if net is None or why_not_pcg(model):
        return "direct"
    return "pcg" if large_static(model) else "direct"


def large_static(model) -> bool:
    """Whether a net is too large for factors of its tangent."""
    return model.net.host.nodes * model.net.worlds >= LARGE_STATIC[model.wp_device.is_cuda]


def why_not_pcg(model) -> str:
    """What keeps equilibria of a model from being found by conjugate gradients; empty where nothing does."""
    if model.net is None or model.groups:
        return "it is for shells and joined rods alone, and the model has rods on their own"
    return ""


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
        reduced = long_and_few(places, len(host.rods) * net.worlds, net.device)
        pays = 0.25 * between**2 > LAUNCHES + (min(places, REDUCED) if reduced else places) / PLACES
    rest = host.nodes - len(np.unique(own)) if pays else host.nodes
    names = ["chain"] * pays + ["multilevel"] * (rest >= LARGE)
    return "_".join(names) or "block_jacobi"


def _longest_run(flags: np.ndarray) -> int:
    """Length of the longest row of true ones."""
    ends = np.flatnonzero(~np.concatenate([[False], flags, [False]]))
    return int(np.diff(ends).max()) - 1

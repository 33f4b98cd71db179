"""Solver selection for rod groups and the coupled system, by size and device."""

import numpy as np

# Cyclic reduction pays on a GPU for rods of at least LONG nodes, if there are at most FEW rods.
#
# Measured: an iteration by the sweep takes about 2 us a node of the longest rod, for any number of rods. An iteration by cyclic
# reduction takes about 40 launches, and some ns a node of all rods together.
LONG = 512
FEW = 256

# Thresholds for many right-hand sides of one matrix, as in contact.
#
# Measured: a further right-hand side takes the sweep 1.3 us a node, and cyclic reduction one launch.
LONG_REPEATED, FEW_REPEATED = 24, 2048

# Longest rod path, in nodes, for which that launch (a block of threads a path) is faster than a new elimination on all multiprocessors.
#
# Measured: 94 us for 121 paths of 961 nodes on an H200, growing with the nodes; each of the 2 log2(n) launches takes 9 to 25 us.
LONGEST_REPEATED = 8192

# Nodes of the coupled system outside rods from which multilevel iterations pay.
#
# Measured: on a CPU core a sheet of 16 x 16 cells by hinges takes 0.9 of block Jacobi's time, and 0.55 by edge angles; 32 x 32 cells
# take 0.67 and 0.37. In contact, levels are set up for every matrix: a cloth of 32 x 32 cells on a ball takes half the iterations and
# 1.2 of the time.
LARGE, LARGE_IN_CONTACT = 1024, 4096

# Substructuring of rods (preconditioner `"substructuring"`) against block Jacobi, see `coupled_preconditioner`. BETWEEN: nodes of a
# rod between joints from which substructuring pays. The time unit is a block Jacobi iteration on a GPU: a path node takes 1 /
# `PATH_NODES`, the remaining launches `LAUNCHES`. A cyclic reduction of few, long paths takes as much as REDUCED path nodes.
# Measured: iterations of block Jacobi grow with the square of the edges between joints (gridshell, residual 1e-3: 250 at 8 edges,
# 2378 at 32). Substructuring takes 16 at any number, at about twice the time each on the CPU. On a GPU a rod path is serial: an
# iteration of block Jacobi takes 41 us on an H200, with rod paths of 8, 32 and 128 nodes 84, 144 and 330 us
# (tools/results/nets_cuda.csv).
BETWEEN = 4
PATH_NODES = 20
REDUCED = 240
LAUNCHES = 1


def automatic(group) -> str:
    """Return the linear solver of a rod group: `"cyclic_reduction"` for few, long, open rods on CUDA, or `"sweep"`."""
    few = not group.kind.closed and long_and_few(group.nodes, group.columns, group.device)
    return "cyclic_reduction" if few else "sweep"


def long_and_few(nodes: int, columns: int, device, repeated: bool = False) -> bool:
    """Return True if `columns` rod paths of at most `nodes` nodes are solved by cyclic reduction.

    `repeated`: many right-hand sides of one matrix.
    """
    long, few = (LONG_REPEATED, FEW_REPEATED) if repeated else (LONG, FEW)
    return device.is_cuda and nodes >= long and columns <= few


# Nodes from which equilibria of the coupled system take conjugate gradients, without and with CUDA.
#
# Measured: if membrane forces carry the loads, conjugate gradients are faster from some thousand triangles, on the CPU, too. If bending
# carries them, one core factorises faster (tools/results/statics_cpu.csv). Without CUDA memory decides: factors of 1e5 triangles take
# some GB. On CUDA conjugate gradients are 8 to 80 times faster from the smallest size, 2,048 triangles (statics_cuda.csv). Below,
# factors detect instabilities.
LARGE_STATIC = {False: 50_000, True: 4_000}


# Nodes of a pair force whose stiffness, a full matrix, is factorised.
MOST_PAIRED = 1000


def static_solver(model) -> str:
    """Return the static solver: "pcg" for contact and for large supported coupled systems, else "direct"."""
    coupled = model.coupled
    if coupled is not None and coupled.host.contact_parameters:
        return "pcg"
    if coupled is None or why_not_pcg(model):
        return "direct"
    dense = any(part.force.pairs and len(part.blocks) > MOST_PAIRED for part in coupled.user_forces)
    return "pcg" if dense or large_static(model) else "direct"


def large_static(model) -> bool:
    """Return True if the coupled system is too large for a factorised tangent."""
    return model.coupled.host.nodes * model.coupled.worlds >= LARGE_STATIC[model.wp_device.is_cuda]


def why_not_pcg(model) -> str:
    """Return the reason against equilibria by conjugate gradients; empty without."""
    if model.coupled is None or model.groups:
        return "it is for shells and joined rods only, and the model has uncoupled rods"
    return ""


def coupled_preconditioner(coupled) -> str:
    """Return the preconditioner:

    `"substructuring"` for rods long between joints, `"multilevel"` for large systems, both, or block Jacobi.
    """
    host = coupled.host
    large = LARGE_IN_CONTACT if host.contact_parameters else LARGE
    carried = len(host.rigid_bodies.carried) if host.rigid_bodies else 0
    nodes = host.nodes - carried
    if not host.rods:
        return "multilevel" if nodes >= large else "block_jacobi"
    rod_nodes = np.concatenate([rod.all_nodes for rod in host.rods])
    joints = np.bincount(rod_nodes, minlength=host.nodes) > 1
    rigid = np.zeros(host.nodes, bool)
    for part in host.sets:
        if part.term.measure.spins:
            rigid[part.slots[0]] = True
    between, places = (max(_longest_run(~cuts[rod.all_nodes]) for rod in host.rods) for cuts in (joints | rigid, rigid))
    pays = between >= BETWEEN
    if pays and coupled.device.is_cuda:
        reduced = long_and_few(places, len(host.rods) * coupled.worlds, coupled.device)
        pays = 0.25 * between**2 > LAUNCHES + (min(places, REDUCED) if reduced else places) / PATH_NODES
    rest = nodes - len(np.unique(rod_nodes)) if pays else nodes
    names = ["substructuring"] * pays + ["multilevel"] * (rest >= large)
    return "_".join(names) or "block_jacobi"


def _longest_run(flags: np.ndarray) -> int:
    """Return the length of the longest run of true flags."""
    ends = np.flatnonzero(~np.concatenate([[False], flags, [False]]))
    return int(np.diff(ends).max()) - 1

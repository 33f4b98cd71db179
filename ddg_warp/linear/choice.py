"""Which linear solver suits a group of rods, or a net."""

# An iteration by the sweep takes about 2 us a node of the longest rod, however many rods run side by side; one by cyclic reduction
# takes about 40 launches, and some ns a node of all rods together.
LONG = 512  # nodes of a rod from which on cyclic reduction pays on a GPU ...
FEW = 256  # ... if there are no more rods than this

LARGE = 4096  # nodes of a net from which on fewer, longer iterations of conjugate gradients pay


def automatic(group) -> str:
    """Name of the solver: "chain" (PCG) for closed rods, "partitioned" for few and long open ones on CUDA, else "sweep"."""
    if group.kind.closed:
        return "chain"
    if group.device.is_cuda and group.nodes >= LONG and group.columns <= FEW:
        return "partitioned"
    return "sweep"


def net_preconditioner(net) -> str:
    """Name of the preconditioner of a net: "multilevel" where it is large, else "block_jacobi"."""
    return "multilevel" if net.host.nodes >= LARGE else "block_jacobi"

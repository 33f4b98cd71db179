"""Which linear solver suits a group of rods."""

# An iteration by the sweep takes about 2 us a node of the longest rod, however many rods run side by side; one by cyclic reduction
# takes about 40 launches, and some ns a node of all rods together.
LONG = 512  # nodes of a rod from which on cyclic reduction pays on a GPU ...
FEW = 256  # ... if there are no more rods than this


def automatic(group) -> str:
    """Name of the solver: "chain" (PCG) for closed rods, "partitioned" for few and long open ones on CUDA, else "sweep"."""
    if group.kind.closed:
        return "chain"
    if group.device.is_cuda and group.nodes >= LONG and group.columns <= FEW:
        return "partitioned"
    return "sweep"

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


# Nodes from which on equilibria of a net take conjugate gradients, without and with CUDA. Where membrane forces carry the loads these
# are faster from some thousand triangles on, on the CPU, too; where bending does, one core factorises faster
# (tools/results/statics_cpu.csv). Without CUDA memory decides: factors of 1e5 triangles take some GB. On CUDA an iteration takes a
# hundredth of the time (sheets_cuda.csv), and factors are made on the host all the same.
LARGE_STATIC = {False: 50_000, True: 10_000}


def static_solver(model) -> str:
    """Name of the solver of equilibria: "pcg" for large nets that it can serve, else "direct"."""
    net = model.net
    if net is None or why_not_pcg(model):
        return "direct"
    return "pcg" if net.host.nodes * net.worlds >= LARGE_STATIC[model.wp_device.is_cuda] else "direct"


def why_not_pcg(model) -> str:
    """What keeps equilibria of a model from being found by conjugate gradients; empty where nothing does."""
    if model.net is None or model.groups:
        return "it is for shells and joined rods alone, and the model has rods on their own"
    if model.net.host.bands:
        return "it knows no pressure that follows axisymmetric shells"
    return ""


def net_preconditioner(net) -> str:
    """Name of the preconditioner of a net: "multilevel" where it is large, else "block_jacobi"."""
    return "multilevel" if net.host.nodes >= LARGE else "block_jacobi"

"""Forces of quadratic potentials of nodes, and products with their stiffness; see `kernels.core.inertia`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import block_inertia, node_inertia
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.nodes import NodeStorage


@cache
def stiffness_kernel(nodes: NodeStorage, real):
    """Build the kernel `multiply`: write K (x - a) and the product of rotations, or with `relative` 0 the product K x."""
    V, twist = wp.types.vector(nodes.dim, real), nodes.twist
    Inertia = block_inertia(real) if nodes.coupled else node_inertia(nodes.dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def multiply(
        inertia: wp.array2d(dtype=Inertia),
        x: wp.array2d(dtype=V),
        rotation: wp.array2d(dtype=real),
        relative: real,
        out: wp.array2d(dtype=V),
        moment_out: wp.array2d(dtype=real),
    ):
        k, island = wp.tid()
        node = inertia[k, island]
        out[k, island] = node.stiffness * (x[k, island] - node.reference * relative)
        if wp.static(twist):
            moment_out[k, island] = node.spin * rotation[k, island]

    return multiply

"""Contact stiffness in the matrix bands of rod paths; see `ddg_warp.solve.linear.contact_bands`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import NEEDS_DIRECTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.linear.rod_band_assembly import layout_type
from ddg_warp.kernels.linear.rod_dof_map import path_node_dofs, path_node_functions
from ddg_warp.kernels.linear.rod_matrix import block_functions


@cache
def stiffen_kernel(twist: bool, linear, rolls: bool):
    """Build the kernel of bands with contact.

    `stiffen`: write the bands of rod paths plus the contact blocks of path nodes and of their edges.

    If friction `rolls` rods, these include twist angles.
    """
    nb = path_node_dofs(twist)
    K, M, Layout = wp.types.matrix((3, 3), linear), wp.types.matrix((nb, nb), linear), layout_type()
    V, t = wp.types.vector(3, linear), nb - 1
    load, store, _, _ = block_functions(nb, linear)
    free_of, _ = path_node_functions(twist, linear)

    @wp.func
    def wide(contact_block: K):
        m = M()
        for i in range(3):
            for j in range(3):
                m[i, j] = contact_block[i, j]
        return m

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def stiffen(
        bands: wp.array3d(dtype=linear),
        layout: Layout,
        edge_of: wp.array2d(dtype=int),
        edges: int,
        flags: wp.array2d(dtype=int),
        blocks: int,
        diagonal: wp.array(dtype=K),
        between: wp.array(dtype=K),
        rolling_edges: wp.array2d(dtype=int),
        first: wp.array(dtype=V),
        second: wp.array(dtype=V),
        next: wp.array(dtype=linear),
        stiffer: wp.array3d(dtype=linear),
    ):
        k, r = wp.tid()
        w = r / layout.count.shape[0]
        c = r - w * layout.count.shape[0]
        if flags[NEEDS_DIRECTION, w] == 0 or layout.idle[r] != 0 or k >= layout.count[c]:
            return
        f = free_of(layout.held[k, c])
        D = load(bands, 0, k, r)
        node = layout.places[0, k, c]
        if node >= 0:
            D += wp.cw_mul(wide(diagonal[node + w * blocks]), wp.outer(f, f))
        e = edge_of[k, c]
        rolling_edge = int(-1)
        if wp.static(rolls):
            rolling_edge = rolling_edges[k, c]
            if rolling_edge >= 0:
                contact_block = M()
                contact_block[t, t] = diagonal[layout.places[1, k, c] + w * blocks][0, 0]
                if node >= 0:
                    for d in range(3):
                        contact_block[d, t] = first[rolling_edge + w * edges][d]
                        contact_block[t, d] = contact_block[d, t]
                D += wp.cw_mul(contact_block, wp.outer(f, f))
        store(stiffer, 0, k, r, D)
        E = load(bands, wp.static(nb**2), k, r)
        if e >= 0:
            contact_block = wide(between[e + w * edges])
            if wp.static(rolls):
                if e == rolling_edge:
                    for d in range(3):
                        contact_block[t, d] = second[e + w * edges][d]
                    contact_block[t, t] = next[e + w * edges]
            E += wp.cw_mul(contact_block, wp.outer(f, free_of(layout.held[k + 1, c])))
        store(stiffer, wp.static(nb**2), k, r, E)
        for row in range(wp.static(2 * nb**2), wp.static(3 * nb**2)):
            stiffer[row, k, r] = bands[row, k, r]

    return stiffen

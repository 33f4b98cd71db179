"""Bands of H between path nodes of the coupled system: blocks D, E and F of `rod_band_assembly`, stored as in `rod_matrix`.

Blocks of H between two nodes of a path are stored here. The positions of `sliced_ell` hold all others.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import mass_type
from ddg_warp.kernels.core.islands import MAX_EDGE_STIFFNESS, NEEDS_DIRECTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS, TWO_BLOCKS, first_of, until_function
from ddg_warp.kernels.linear.rod_band_assembly import blocks_function, layout_type
from ddg_warp.kernels.linear.rod_dof_map import edge_behind_function, path_node_dofs, value_function
from ddg_warp.kernels.linear.rod_matrix import TILE, block_functions
from ddg_warp.kernels.linear.sliced_ell import ALL_INACTIVE, product_functions, settle_function
from ddg_warp.kernels.residual.coupled_residual_along_rods import along_type
from ddg_warp.kernels.terms import Term


@cache
def times_functions(nb: int, linear):
    """Return the device functions `along(m, u)` and `back(m, u)`, with one order of summation for all kernels.

    `along`: block times vector.
    `back`: transposed block times vector.
    """
    B, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)

    @wp.func
    def along(m: M, u: B):
        y = B()
        for i in range(wp.static(nb)):
            for j in range(wp.static(nb)):
                y[i] = y[i] + m[i, j] * u[j]
        return y

    @wp.func
    def back(m: M, u: B):
        y = B()
        for i in range(wp.static(nb)):
            for j in range(wp.static(nb)):
                y[i] = y[i] + m[j, i] * u[j]
        return y

    return along, back


@cache
def band_kernels(
    terms: tuple[Term, ...],
    twist: bool,
    span: int,
    real,
    linear,
    exact_from: tuple[int | None, ...],
    quadratic: bool,
    serial: bool,
    mixed_axial: bool = False,
):
    """Build the kernels of bands.

    `assemble`: write blocks of path nodes, see `blocks_function`.
    `clear`: zero the positions of H that moved to bands.
    `product`: compute H p on active dofs, and p . H p by block.
    """
    nb = path_node_dofs(twist, mixed_axial)
    H, B = wp.types.vector(3, linear), wp.types.vector(nb, linear)
    Mass, Layout, Along, until = (
        mass_type(real, quadratic),
        layout_type(),
        along_type(real, linear),
        until_function(serial),
    )
    load, store, _, _ = block_functions(nb, linear)
    along, back = times_functions(nb, linear)
    settle = settle_function(linear)
    blocks_at = blocks_function(terms, twist, span, real, linear, exact_from, quadratic, mixed_axial)
    value = value_function(twist, linear, mixed_axial)

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, launch_bounds=TWO_BLOCKS, module_options=CPU_OPTIONS
    )
    def assemble(
        matrix: wp.array2d(dtype=linear),
        mass: Mass,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        layout: Layout,
        sets: wp.array(dtype=Along),
        blocks_out: wp.array3d(dtype=linear),
    ):
        start, r = wp.tid()
        w = r / layout.count.shape[0]
        c = r - w * layout.count.shape[0]
        n = layout.count[c]
        if flags[NEEDS_DIRECTION, w] == 0 or layout.idle[r] != 0 or start >= n:
            return
        for k in range(start, until(start, n)):
            D, E, F = blocks_at(matrix, mass, flags, scalars, layout, sets, k, c, w)
            store(blocks_out, 0, k, r, D)
            store(blocks_out, wp.static(nb**2), k, r, E)
            if wp.static(span == 2):
                store(blocks_out, wp.static(2 * nb**2), k, r, F)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def clear(
        taken: wp.array(dtype=int), wanted: wp.array(dtype=int), positions: int, matrix: wp.array2d(dtype=linear)
    ):
        i, w = wp.tid()
        if wanted[w] != 0:
            for j in range(9):
                matrix[j, taken[i] + w * positions] = linear(0.0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def product(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        slices: wp.array(dtype=int),
        inactive_mask: wp.array(dtype=wp.uint8),
        p: wp.array(dtype=H),
        wanted: wp.array(dtype=int),
        blocks: int,
        positions: int,
        bands: wp.array3d(dtype=linear),
        places: wp.array3d(dtype=int),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        threads: int,
        separate_blocks: wp.array(dtype=int),
        product_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Write H p and p . H p by block.

        The first `threads` threads have path nodes, in tiles of `TILE` paths, so that neighbouring nodes are still cached. The others
        have `separate_blocks`.
        """
        tid = wp.tid()
        if tid >= threads:
            w = (tid - threads) / separate_blocks.shape[0]
            if wanted[w] == 1:
                b = separate_blocks[tid - threads - w * separate_blocks.shape[0]]
                settle(
                    matrix, columns, slices, inactive_mask, p, blocks, positions, 0, 0, b, w, H(), product_out, dots_out
                )
            return
        tile = tid / (bands.shape[1] * TILE)
        k = tid / TILE - tile * bands.shape[1]
        r = tile * TILE + tid % TILE
        w = r / count.shape[0]
        c = r - w * count.shape[0]
        if w >= wanted.shape[0] or k >= count[c]:
            return
        if wanted[w] != 1:
            return
        u, shift = B(), w * blocks
        if idle[r] == 0:
            u = along(load(bands, 0, k, r), value(p, places, k, c, shift))
            if k + 1 < count[c]:
                u += along(load(bands, wp.static(nb**2), k, r), value(p, places, k + 1, c, shift))
            if k > 0:
                u += back(load(bands, wp.static(nb**2), k - 1, r), value(p, places, k - 1, c, shift))
            if wp.static(span == 2):
                if k + 2 < count[c]:
                    u += along(load(bands, wp.static(2 * nb**2), k, r), value(p, places, k + 2, c, shift))
                if k > 1:
                    u += back(load(bands, wp.static(2 * nb**2), k - 2, r), value(p, places, k - 2, c, shift))
        node = places[0, k, c]
        if node >= 0:
            y = H(u[0], u[1], u[2])
            settle(
                matrix, columns, slices, inactive_mask, p, blocks, positions, 0, 0, node, w, y, product_out, dots_out
            )
        if wp.static(twist):
            angle = places[1, k, c]
            if angle >= 0:
                y = H(u[3], linear(0.0), linear(0.0))
                settle(
                    matrix,
                    columns,
                    slices,
                    inactive_mask,
                    p,
                    blocks,
                    positions,
                    0,
                    0,
                    angle,
                    w,
                    y,
                    product_out,
                    dots_out,
                )

    return assemble, clear, product


@cache
def product_walk_kernel(twist: bool, span: int, linear, mixed_axial: bool = False):
    """Build the kernel of the product on the CPU.

    `walk`: compute H p path by path; each block is read once, and its transposed product carried to later nodes.
    """
    nb = path_node_dofs(twist, mixed_axial)
    H, B = wp.types.vector(3, linear), wp.types.vector(nb, linear)
    load, _, _, _ = block_functions(nb, linear)
    along, back = times_functions(nb, linear)
    times, free = product_functions(linear)
    value = value_function(twist, linear, mixed_axial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def walk(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        slices: wp.array(dtype=int),
        inactive_mask: wp.array(dtype=wp.uint8),
        p: wp.array(dtype=H),
        wanted: wp.array(dtype=int),
        blocks: int,
        positions: int,
        bands: wp.array3d(dtype=linear),
        places: wp.array3d(dtype=int),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        product_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        for w in range(wanted.shape[0]):
            if wanted[w] != 1:
                continue
            shift = first_of(w, blocks)
            for b in range(blocks):
                y = H()
                if inactive_mask[b + shift] != ALL_INACTIVE:
                    y = times(matrix, columns, slices, p, b, w * positions, shift, 0, 0)
                product_out[b + shift] = y
            for c in range(count.shape[0]):
                r = w * count.shape[0] + c
                if idle[r] != 0:
                    continue
                n = count[c]
                u_here, u_ahead = value(p, places, 0, c, shift), B()
                if n > 1:
                    u_ahead = value(p, places, 1, c, shift)
                before, before2, next_before2 = B(), B(), B()  # products of E and F of nodes before; of F for the next
                for k in range(n):
                    u_beyond = B()
                    if k + 2 < n:
                        u_beyond = value(p, places, k + 2, c, shift)
                    E = load(bands, wp.static(nb**2), k, r)
                    u = along(load(bands, 0, k, r), u_here)
                    u += along(E, u_ahead)
                    u += before
                    before = back(E, u_here)
                    if wp.static(span == 2):
                        F = load(bands, wp.static(2 * nb**2), k, r)
                        u += along(F, u_beyond)
                        u += before2
                        before2 = next_before2
                        next_before2 = back(F, u_here)
                    u_here, u_ahead = u_ahead, u_beyond
                    node = places[0, k, c]
                    if node >= 0:
                        product_out[node + shift] += H(u[0], u[1], u[2])
                    if wp.static(twist):
                        angle = places[1, k, c]
                        if angle >= 0:
                            product_out[angle + shift] += H(u[3], linear(0.0), linear(0.0))
            for b in range(blocks):
                y = wp.cw_mul(product_out[b + shift], free(inactive_mask[b + shift]))
                product_out[b + shift] = y
                dots_out[w, b] = wp.dot(p[b + shift], y)

    return walk


@cache
def lengthen_kernel(terms: tuple[Term, ...], real, linear):
    """Build the kernel of edge lengthening.

    `lengthen`: write slack and lengthening of the edges behind path nodes, from solutions with tensions.
    """
    Layout, Along = layout_type(), along_type(real, linear)
    tension_behind = edge_behind_function(terms, real, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def lengthen(
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        layout: Layout,
        sets: wp.array(dtype=Along),
        values: wp.array3d(dtype=linear),
        longer_out: wp.array3d(dtype=linear),
    ):
        k, r = wp.tid()
        w = r / layout.count.shape[0]
        c = r - w * layout.count.shape[0]
        if flags[NEEDS_DIRECTION, w] == 0 or k >= layout.count[c]:
            return
        _t, slack = tension_behind(sets, k, c, w)
        longer_out[0, k, r] = slack
        longer_out[1, k, r] = (
            slack * values[values.shape[0] - 1, k, r] * linear(real(1.0) / wp.sqrt(scalars[MAX_EDGE_STIFFNESS, w]))
        )

    return lengthen

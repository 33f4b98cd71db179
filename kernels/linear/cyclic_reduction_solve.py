"""Further rhs_in-hand sides of a system eliminated by cyclic reduction, one thread block and one launch a rod.

A level that eliminates the odd blocks u keeps K1 = A_u^-1 B_j^T, K2 = A_u^-1 B_u and A_u^-1 (see `cyclic_reduction`). Each level is
then a product of small matrices, up to the last block and down again:

    r'_j = r_j - K2_l^T r_l - K1_u^T r_u ,    x_u = A_u^-1 r_u - K1_u x_j - K2_u x_j+2 .

Threads of a block synchronise between levels, which costs one or two microseconds where a launch takes four or more. Data of a rod is
contiguous: the rows of K1, K2 and A_u^-1 of odd blocks, level by level, then of the last block.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS, wait
from ddg_warp.kernels.linear.cyclic_reduction import block_functions
from ddg_warp.kernels.linear.rod_dof_map import angle_function, path_node_dofs, solve_functions


@cache
def pack_kernel(nb: int, linear, first: bool, tensions: int = 0):
    """Build the kernel that packs the last block.

    `pack`: write the inverse of the block that remains, one thread a column.
    """
    size = 2 * nb
    H = wp.types.vector(nb, linear)
    factor, solve, *_ = block_functions(nb, linear, first, tensions)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pack(
        matrix: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        packed_block: int,
        packed: wp.array3d(dtype=linear),
        lost_pivots: wp.array(dtype=int),
    ):
        r, c = wp.tid()
        if wanted[r] == 0:
            return
        n = int(1)
        if wp.static(first):
            n = count[r]
        a, b = H(), H()
        for d in range(wp.static(nb)):
            a[d] = wp.where(d == c, linear(1.0), linear(0.0))
            b[d] = wp.where(d + wp.static(nb) == c, linear(1.0), linear(0.0))
        L0, d0, Z, L1, d1, lost = factor(matrix, 0, n, r)
        a, b = solve(L0, d0, Z, L1, d1, a, b)
        for d in range(wp.static(nb)):
            packed[r, packed_block, wp.static(2 * size**2) + d * wp.static(size) + c] = a[d]
            packed[r, packed_block, wp.static(2 * size**2) + (d + wp.static(nb)) * wp.static(size) + c] = b[d]
        if c == 0 and lost > 0:
            wp.atomic_add(lost_pivots, r, lost)

    return pack


@cache
def again_functions(nb: int, linear):
    """Return the device function `solve(packed, r, t, threads, blocks, rhs, solution)` of rod r.

    All `threads` of a block call it, t being the number of the thread.
    """
    size = 2 * nb
    square = size**2

    @wp.func
    def times(packed: wp.array3d(dtype=linear), r: int, j: int, row: int, x: wp.array3d(dtype=linear), k: int):
        """Return a row of a packed matrix times block k."""
        total = linear(0.0)
        for d in range(wp.static(size)):
            total += packed[r, j, row + d] * x[r, k, d]
        return total

    @wp.func
    def times_turned(
        packed: wp.array3d(dtype=linear), r: int, j: int, column: int, x: wp.array3d(dtype=linear), k: int
    ):
        """Return a column of a packed matrix times block k."""
        total = linear(0.0)
        for d in range(wp.static(size)):
            total += packed[r, j, column + d * wp.static(size)] * x[r, k, d]
        return total

    @wp.func
    def solve(
        packed: wp.array3d(dtype=linear),
        r: int,
        t: int,
        threads: int,
        blocks: int,
        rhs: wp.array3d(dtype=linear),
        solution: wp.array3d(dtype=linear),
    ):
        """Write `solution` from `rhs` (rods, blocks, 2 nb), which is overwritten; all threads may read it afterwards."""
        wait()
        number, spacing, offset = int(blocks), int(1), int(0)
        while number > 1:
            for i in range(t, (number + 1) / 2 * wp.static(size), threads):
                j = i / wp.static(size)
                c = i - j * wp.static(size)
                value = rhs[r, 2 * j * spacing, c]
                if j > 0:
                    value -= times_turned(packed, r, offset + j - 1, wp.static(square) + c, rhs, (2 * j - 1) * spacing)
                if 2 * j + 1 < number:
                    value -= times_turned(packed, r, offset + j, c, rhs, (2 * j + 1) * spacing)
                rhs[r, 2 * j * spacing, c] = value
            wait()
            offset += number / 2
            number = (number + 1) / 2
            spacing *= 2
        for c in range(t, wp.static(size), threads):
            solution[r, 0, c] = times(packed, r, offset, wp.static(2 * square) + c * wp.static(size), rhs, 0)
        wait()
        while spacing > 1:
            spacing /= 2
            number = (blocks + spacing - 1) / spacing
            offset -= number / 2
            for i in range(t, number / 2 * wp.static(size), threads):
                j = i / wp.static(size)
                c = i - j * wp.static(size)
                k = (2 * j + 1) * spacing
                row = c * wp.static(size)
                value = times(packed, r, offset + j, wp.static(2 * square) + row, rhs, k)
                value -= times(packed, r, offset + j, row, solution, k - spacing)
                if 2 * j + 2 < number:
                    value -= times(packed, r, offset + j, wp.static(square) + row, solution, k + spacing)
                solution[r, k, c] = value
            wait()

    return solve


@cache
def again_kernel(nb: int, linear):
    """Build the kernel for another rhs_in-hand side.

    `again`: solve the wanted rods with one thread block each, of `threads` threads.
    """
    size = 2 * nb
    solve = again_functions(nb, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def again(
        packed: wp.array3d(dtype=linear),
        rhs_in: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        width: int,
        blocks: int,
        threads: int,
        rhs: wp.array3d(dtype=linear),
        block_solution: wp.array3d(dtype=linear),
        solution: wp.array3d(dtype=linear),
    ):
        """Solve; `wanted` has one flag for every `width` rods, and `rhs`, `block_solution` (rods, blocks, 2 nb) are work arrays."""
        tid = wp.tid()
        r = tid / threads
        t = tid - r * threads
        if wanted[r / width] != 1:
            return
        n = count[r]
        for i in range(t, blocks * wp.static(size), threads):
            j = i / wp.static(size)
            c = i - j * wp.static(size)
            half = c / wp.static(nb)
            k = 2 * j + half
            value = linear(0.0)
            if k < n:
                value = rhs_in[c - half * wp.static(nb), k, r]
            rhs[r, j, c] = value
        solve(packed, r, t, threads, blocks, rhs, block_solution)
        for i in range(t, blocks * wp.static(size), threads):
            j = i / wp.static(size)
            c = i - j * wp.static(size)
            half = c / wp.static(nb)
            k = 2 * j + half
            if k < n:
                solution[c - half * wp.static(nb), k, r] = block_solution[r, j, c]

    return again


@cache
def solve_at_path_nodes_kernel(twist: bool, linear):
    """Build the kernel for another rhs_in-hand side of rod paths in the coupled system.

    `again`: compute z from the residual r by dof block, and r . z; see `rod_dof_map`.
    """
    nb = path_node_dofs(twist)
    H, parts = wp.types.vector(3, linear), 1 + twist  # dof blocks of a path node: node, twist angle of the edge ahead
    solve, angle_of = again_functions(nb, linear), angle_function(twist)
    rhs_in, _ = solve_functions(twist, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def again(
        packed: wp.array3d(dtype=linear),
        residual: wp.array(dtype=H),
        places: wp.array3d(dtype=int),
        fixed_dofs: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        coupled_blocks: int,
        blocks: int,
        threads: int,
        rhs: wp.array3d(dtype=linear),
        block_solution: wp.array3d(dtype=linear),
        z: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        tid = wp.tid()
        r = tid / threads
        t = tid - r * threads
        w = r / count.shape[0]
        c = r - w * count.shape[0]
        if wanted[w] != 1 or idle[r] != 0:
            return
        n = count[c]
        first = w * coupled_blocks
        for k in range(t, 2 * blocks, threads):
            j = k / 2
            row = (k - 2 * j) * wp.static(nb)
            for d in range(wp.static(nb)):
                rhs[r, j, row + d] = linear(0.0)
            if k < n:
                u = rhs_in(residual, places[0, k, c], angle_of(places, k, c), fixed_dofs[k, c], first)
                for d in range(wp.static(nb)):
                    rhs[r, j, row + d] = u[d]
        solve(packed, r, t, threads, blocks, rhs, block_solution)
        for i in range(t, wp.static(parts) * n, threads):
            k = i / wp.static(parts)
            part = i - k * wp.static(parts)
            block = places[part, k, c]
            if block >= 0:
                j = k / 2
                row = (k - 2 * j) * wp.static(nb)
                y = H(block_solution[r, j, row + wp.static(nb - 1)], linear(0.0), linear(0.0))
                if part == 0:
                    y = H(block_solution[r, j, row], block_solution[r, j, row + 1], block_solution[r, j, row + 2])
                z[block + first] = y
                dots_out[w, block] = wp.dot(residual[block + first], y)

    return again

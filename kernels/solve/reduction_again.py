"""Right-hand sides of a system that cyclic reduction has eliminated, a block of threads a chain, in one launch each.

A level that eliminates the odd blocks u keeps K1 = A_u^-1 B_j^T, K2 = A_u^-1 B_u and A_u^-1 (see `cyclic_reduction`). So each level is
a product of small matrices, up to the last block and down again:

    r'_j = r_j - K2_l^T r_l - K1_u^T r_u ,    x_u = A_u^-1 r_u - K1_u x_j - K2_u x_j+2 .

Threads of a block wait for each other between levels, which costs a microsecond or two where a launch takes four or more. What a chain
needs lies together: of its odd blocks, level by level, and of the last one the rows of K1, of K2 and of A_u^-1.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.matrix.chain_places import angle_function, place_dofs, solve_functions
from ddg_warp.kernels.solve.cyclic_reduction import block_functions
from ddg_warp.kernels.threads import CPU_OPTIONS


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait(): ...


@cache
def pack_kernel(nb: int, linear, first: bool, tensions: int = 0):
    """pack(...) the inverse of the last block, which has neighbours no more: thread c of it has column c."""
    size = 2 * nb
    H = wp.types.vector(nb, linear)
    factor, solve, *_ = block_functions(nb, linear, first, tensions)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pack(
        matrix: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        at: int,
        packed: wp.array3d(dtype=linear),
        bad: wp.array(dtype=int),
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
            packed[r, at, wp.static(2 * size**2) + d * wp.static(size) + c] = a[d]
            packed[r, at, wp.static(2 * size**2) + (d + wp.static(nb)) * wp.static(size) + c] = b[d]
        if c == 0 and lost > 0:
            wp.atomic_add(bad, r, lost)

    return pack


@cache
def again_functions(nb: int, linear):
    """solve(packed, r, t, threads, blocks, rest, found) of chain r by the threads t of a block, all of which call it."""
    size = 2 * nb
    square = size**2

    @wp.func
    def times(packed: wp.array3d(dtype=linear), r: int, j: int, row: int, x: wp.array3d(dtype=linear), k: int):
        """A row of a packed matrix times block k."""
        total = linear(0.0)
        for d in range(wp.static(size)):
            total += packed[r, j, row + d] * x[r, k, d]
        return total

    @wp.func
    def times_turned(packed: wp.array3d(dtype=linear), r: int, j: int, at: int, x: wp.array3d(dtype=linear), k: int):
        """The same with a column."""
        total = linear(0.0)
        for d in range(wp.static(size)):
            total += packed[r, j, at + d * wp.static(size)] * x[r, k, d]
        return total

    @wp.func
    def solve(
        packed: wp.array3d(dtype=linear),
        r: int,
        t: int,
        threads: int,
        blocks: int,
        rest: wp.array3d(dtype=linear),
        found: wp.array3d(dtype=linear),
    ):
        """From what is in `rest` (chains, blocks, 2 nb), which is worked in, to `found`; every thread may read that afterwards."""
        wait()
        number, apart, at = int(blocks), int(1), int(0)
        while number > 1:
            for i in range(t, (number + 1) / 2 * wp.static(size), threads):
                j = i / wp.static(size)
                c = i - j * wp.static(size)
                value = rest[r, 2 * j * apart, c]
                if j > 0:
                    value -= times_turned(packed, r, at + j - 1, wp.static(square) + c, rest, (2 * j - 1) * apart)
                if 2 * j + 1 < number:
                    value -= times_turned(packed, r, at + j, c, rest, (2 * j + 1) * apart)
                rest[r, 2 * j * apart, c] = value
            wait()
            at += number / 2
            number = (number + 1) / 2
            apart *= 2
        for c in range(t, wp.static(size), threads):
            found[r, 0, c] = times(packed, r, at, wp.static(2 * square) + c * wp.static(size), rest, 0)
        wait()
        while apart > 1:
            apart /= 2
            number = (blocks + apart - 1) / apart
            at -= number / 2
            for i in range(t, number / 2 * wp.static(size), threads):
                j = i / wp.static(size)
                c = i - j * wp.static(size)
                k = (2 * j + 1) * apart
                row = c * wp.static(size)
                value = times(packed, r, at + j, wp.static(2 * square) + row, rest, k)
                value -= times(packed, r, at + j, row, found, k - apart)
                if 2 * j + 2 < number:
                    value -= times(packed, r, at + j, wp.static(square) + row, found, k + apart)
                found[r, k, c] = value
            wait()

    return solve


@cache
def again_kernel(nb: int, linear):
    """again(...): the solution of wanted chains for another right-hand side, by as many `threads` as a block has."""
    size = 2 * nb
    solve = again_functions(nb, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def again(
        packed: wp.array3d(dtype=linear),
        right: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        width: int,
        blocks: int,
        threads: int,
        rest: wp.array3d(dtype=linear),
        found: wp.array3d(dtype=linear),
        solution: wp.array3d(dtype=linear),
    ):
        """`wanted` (1) of every `width` chains; rest and found (chains, blocks, 2 nb) are to work in."""
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
                value = right[c - half * wp.static(nb), k, r]
            rest[r, j, c] = value
        solve(packed, r, t, threads, blocks, rest, found)
        for i in range(t, blocks * wp.static(size), threads):
            j = i / wp.static(size)
            c = i - j * wp.static(size)
            half = c / wp.static(nb)
            k = 2 * j + half
            if k < n:
                solution[c - half * wp.static(nb), k, r] = found[r, j, c]

    return again


@cache
def again_at_places_kernel(twist: bool, linear):
    """The same of a net's chains, from the residual r of its blocks to z, and r . z block by block; see `matrix.chain_places`."""
    nb = place_dofs(twist)
    H, parts = wp.types.vector(3, linear), 1 + twist  # blocks of a place: its node, and the angle of the edge ahead
    solve, angle_of = again_functions(nb, linear), angle_function(twist)
    right, _ = solve_functions(twist, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def again(
        packed: wp.array3d(dtype=linear),
        residual: wp.array(dtype=H),
        places: wp.array3d(dtype=int),
        held: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        net_blocks: int,
        blocks: int,
        threads: int,
        rest: wp.array3d(dtype=linear),
        found: wp.array3d(dtype=linear),
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
        first = w * net_blocks
        for k in range(t, 2 * blocks, threads):
            j = k / 2
            at = (k - 2 * j) * wp.static(nb)
            for d in range(wp.static(nb)):
                rest[r, j, at + d] = linear(0.0)
            if k < n:
                u = right(residual, places[0, k, c], angle_of(places, k, c), held[k, c], first)
                for d in range(wp.static(nb)):
                    rest[r, j, at + d] = u[d]
        solve(packed, r, t, threads, blocks, rest, found)
        for i in range(t, wp.static(parts) * n, threads):
            k = i / wp.static(parts)
            part = i - k * wp.static(parts)
            block = places[part, k, c]
            if block >= 0:
                j = k / 2
                at = (k - 2 * j) * wp.static(nb)
                y = H(found[r, j, at + wp.static(nb - 1)], linear(0.0), linear(0.0))
                if part == 0:
                    y = H(found[r, j, at], found[r, j, at + 1], found[r, j, at + 2])
                z[block + first] = y
                dots_out[w, block] = wp.dot(residual[block + first], y)

    return again

"""Block cyclic reduction: a block-pentadiagonal symmetric system solved in log2(n) parallel levels.

Two neighbouring nodes form one block of 2 nb dofs. The matrix of an open rod is then block-tridiagonal, with diagonal blocks A_i and
couplings B_i to block i + 1. A level eliminates every odd block and leaves a tridiagonal system of the even blocks (Heller 1976;
Gander and Golub, Cyclic Reduction - History and Applications, 1997). With l = j - 1 and u = j + 1 for an even j

    A'_j = A_j - B_l^T A_l^-1 B_l - B_j A_u^-1 B_j^T ,    B'_j = -B_j A_u^-1 B_u ,    r'_j = r_j - B_l^T A_l^-1 r_l - B_j A_u^-1 r_u ,
    x_u = A_u^-1 r_u - (A_u^-1 B_j^T) x_j - (A_u^-1 B_u) x_j+2 .

Pivots of a definite matrix are positive, as in the sweep, which eliminates in another order; lost pivots mean the same. Nodes past
the end of a rod are rows of the identity. The last dofs of a node may be tensions; see `mixed_pairs`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.linear import block_ldlt


def level_rows(nb: int) -> tuple[int, int, int]:
    """Return the numbers of rows of a level's matrix, of its right-hand side and of its kept data.

    The matrix has the blocks (A00, A01, A11, B00, B01, B10, B11). `nb`: dofs of a node, here and below.
    """
    return 7 * nb**2, 2 * nb, 8 * nb**2 + 2 * nb


@cache
def block_functions(nb: int, linear, first: bool, tensions: int):
    """Return the device functions `factor`, `solve`, `own_column`, `right_side`, `column` and `product` of a level.

    The first four concern diagonal blocks; `column` and `product` a coupling X, either B_i or, if `turned`, its transpose. So one
    code serves both neighbours of a block. Blocks are read from nodes if `first`, else from a level.
    """
    nb2 = nb**2
    H, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    factor_block, lower, _, lower_vector, upper_vector, congruence = block_ldlt.signed_functions(nb, tensions, linear)

    @wp.func
    def place(i: int, p: int):
        """Return the array index of half p of block i."""
        if wp.static(first):
            return 2 * i + p
        return i

    @wp.func
    def diagonal_row(p: int):
        if wp.static(first):
            return int(0)
        return p * wp.static(2 * nb2)

    @wp.func
    def coupling_row(p: int, q: int):
        """Return the row of B_pq; of nodes F for p = q, E for p > q, and -1 for p < q."""
        if wp.static(first):
            if p == q:
                return wp.static(2 * nb2)
            return wp.where(p > q, wp.static(nb2), -1)
        return (3 + 2 * p + q) * wp.static(nb2)

    @wp.func
    def block(A: wp.array3d(dtype=linear), row: int, down: int, across: int, k: int, n: int, r: int):
        """Return a block, given the strides of rows and columns."""
        m = M()
        if row >= 0 and k >= 0 and k < n:
            for i in range(wp.static(nb)):
                for j in range(wp.static(nb)):
                    m[i, j] = A[row + i * down + j * across, k, r]
        return m

    @wp.func
    def line(A: wp.array3d(dtype=linear), row: int, stride: int, k: int, n: int, r: int):
        v = H()
        if row >= 0 and k >= 0 and k < n:
            for i in range(wp.static(nb)):
                v[i] = A[row + i * stride, k, r]
        return v

    @wp.func
    def or_identity(m: M, k: int, n: int):
        if k >= 0 and k < n:
            return m
        return wp.identity(wp.static(nb), dtype=linear)

    @wp.func
    def factor(A: wp.array3d(dtype=linear), i: int, n: int, r: int):
        """Return L D L^T of diagonal block i in two by two blocks: (L0, D0^-1, Z, L1, D1^-1, lost pivots)."""
        k0 = place(i, 0)
        k1 = place(i, 1)
        L0, d0, lost0 = factor_block(or_identity(block(A, 0, wp.static(nb), 1, k0, n, r), k0, n))
        Z = lower(L0, block(A, wp.static(nb2), wp.static(nb), 1, k0, n, r))
        A11 = or_identity(block(A, diagonal_row(1), wp.static(nb), 1, k1, n, r), k1, n)
        L1, d1, lost1 = factor_block(A11 - congruence(Z, d0, Z))
        return L0, d0, Z, L1, d1, lost0 + lost1

    @wp.func
    def solve(L0: M, d0: H, Z: M, L1: M, d1: H, a: H, b: H):
        z0 = lower_vector(L0, a)
        u1 = upper_vector(L1, d1, lower_vector(L1, b - wp.cw_mul(z0, d0) * Z))
        u0 = upper_vector(L0, d0, z0 - Z * u1)
        return u0, u1

    @wp.func
    def own_column(A: wp.array3d(dtype=linear), i: int, q: int, c: int, n: int, r: int):
        """Return column c of half q of A_i; the lower half is zero for q = 0, where no kernel reads it."""
        k = place(i, q)
        top = line(A, q * wp.static(nb2) + c, wp.static(nb), place(i, 0), n, r)
        bottom = H()
        if q == 1:
            bottom = line(A, diagonal_row(1) + c, wp.static(nb), k, n, r)
        if k >= n:
            unit = H()
            for d in range(wp.static(nb)):
                unit[d] = wp.where(d == c, linear(1.0), linear(0.0))
            if q == 0:
                top = unit
            else:
                bottom = unit
        return top, bottom

    @wp.func
    def right_side(b: wp.array3d(dtype=linear), i: int, n: int, r: int):
        top = line(b, 0, 1, place(i, 0), n, r)
        return top, line(b, wp.static(0 if first else nb), 1, place(i, 1), n, r)

    @wp.func
    def column(A: wp.array3d(dtype=linear), i: int, turned: bool, q: int, c: int, n: int, r: int):
        """Return column c of half q of X."""
        if turned:
            k = place(i, q)
            top = line(A, coupling_row(q, 0) + c * wp.static(nb), 1, k, n, r)
            bottom = H()
            if coupling_row(q, 1) >= 0:
                bottom = line(A, coupling_row(q, 1) + c * wp.static(nb), 1, k, n, r)
        else:
            top = H()
            if coupling_row(0, q) >= 0:
                top = line(A, coupling_row(0, q) + c, wp.static(nb), place(i, 0), n, r)
            bottom = line(A, coupling_row(1, q) + c, wp.static(nb), place(i, 1), n, r)
        return top, bottom

    @wp.func
    def product(A: wp.array3d(dtype=linear), i: int, turned: bool, u0: H, u1: H, n: int, r: int):
        """Return X^T u."""
        down = wp.where(turned, wp.static(nb), 1)
        across = wp.where(turned, 1, wp.static(nb))
        k0 = place(i, 0)
        k1 = place(i, 1)
        top = block(A, coupling_row(0, 0), down, across, k0, n, r) * u0
        bottom = block(A, coupling_row(1, 1), down, across, k1, n, r) * u1
        low = block(A, coupling_row(1, 0), down, across, k1, n, r)
        high = block(A, coupling_row(0, 1), down, across, k0, n, r)
        if turned:
            return top + high * u1, bottom + low * u0
        return top + low * u1, bottom + high * u0

    return factor, solve, own_column, right_side, column, product


@cache
def reduce_kernel(nb: int, linear, first: bool, tensions: int = 0, packs: bool = False):
    """Build the kernel of one level.

    `reduce`: update even blocks, and keep data for the solution of odd blocks.

    The first level reads blocks of nodes. The last dofs of a node may be `tensions`, with negative pivots. Thread c of a block has
    column c of the matrix, then the right-hand side, then the columns of the coupling. Each thread factors both neighbours by itself,
    in a loop that is not unrolled to stay in registers. All threads of a block read the same data; threads of as many rods as fill a
    memory transaction are neighbours and hit the cache.

    If it `packs`, there is no right-hand side, and kept data is stored for many right-hand sides; see `cyclic_reduction_solve`.
    """
    nb2, sides = nb**2, 1 - packs
    H = wp.types.vector(nb, linear)
    factor, solve, own_column, right_side, column, product = block_functions(nb, linear, first, tensions)

    @wp.func
    def put(A: wp.array3d(dtype=linear), row: int, stride: int, k: int, r: int, v: H):
        for d in range(wp.static(nb)):
            A[row + d * stride, k, r] = v[d]

    @wp.func
    def keep(A: wp.array3d(dtype=linear), row: int, stride: int, k: int, offset: int, r: int, v: H, w: H):
        """Write both halves of a column."""
        for d in range(wp.static(nb)):
            if wp.static(packs):
                A[r, offset + k, row + d * stride] = v[d]
                A[r, offset + k, row + (d + wp.static(nb)) * stride] = w[d]
            else:
                A[row + d * stride, k, r] = v[d]
                A[row + (d + wp.static(nb)) * stride, k, r] = w[d]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def reduce(
        matrix: wp.array3d(dtype=linear),
        rhs: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        neighbours: int,
        kept_offset: int,
        together: int,
        matrix_out: wp.array3d(dtype=linear),
        right_out: wp.array3d(dtype=linear),
        kept_out: wp.array3d(dtype=linear),
        lost_pivots: wp.array(dtype=int),
    ):
        """Reduce one level.

        Args:
            blocks: number of blocks of the level.
            neighbours: 2, an argument so that the compiler does not unroll the loop.
            kept_offset: number of odd blocks packed before.
            together: rods of neighbouring threads.
        """
        j, group, c, r = wp.tid()
        r += group * together
        if r >= count.shape[0] or wanted[r] == 0:
            return
        n = blocks
        if wp.static(first):
            n = count[r]
        i = 2 * j
        diagonal = c < wp.static(2 * nb)
        outer = wp.static(sides) == 1 and c == wp.static(2 * nb)
        local_column = c
        if not (diagonal or outer):
            local_column = c - wp.static(2 * nb + sides)
        q = local_column // wp.static(nb)
        local_column -= q * wp.static(nb)
        o0 = H()
        o1 = H()
        start = int(0)
        if diagonal:
            o0, o1 = own_column(matrix, i, q, local_column, n, r)
        elif outer:
            o0, o1 = right_side(rhs, i, n, r)
        else:
            start = 1
        for side in range(start, neighbours):
            away = i - 1 + 2 * side
            L0, d0, Z, L1, d1, lost = factor(matrix, away, n, r)
            v0 = H()
            v1 = H()
            if outer:
                v0, v1 = right_side(rhs, away, n, r)
            else:
                v0, v1 = column(
                    matrix, wp.where(diagonal, i - 1 + side, i + 1), diagonal and side == 1, q, local_column, n, r
                )
            y0, y1 = solve(L0, d0, Z, L1, d1, v0, v1)
            t0, t1 = product(matrix, i - 1 + side, side == 1, y0, y1, n, r)
            o0 = o0 - t0
            o1 = o1 - t1
            if side == 1 and away < blocks:
                if c == 0 and lost > 0:
                    wp.atomic_add(lost_pivots, r, lost)
                row = wp.static(8 * nb2)
                stride = int(1)
                if not outer:
                    row = q * wp.static(nb) + local_column
                    stride = wp.static(2 * nb)
                    if not diagonal:
                        row += wp.static(4 * nb2)
                keep(kept_out, row, stride, j, kept_offset, r, y0, y1)
                if wp.static(packs):
                    if diagonal:
                        for d in range(wp.static(nb)):
                            v0[d] = wp.where(q == 0 and d == local_column, linear(1.0), linear(0.0))
                            v1[d] = wp.where(q == 1 and d == local_column, linear(1.0), linear(0.0))
                        y0, y1 = solve(L0, d0, Z, L1, d1, v0, v1)
                        keep(kept_out, wp.static(8 * nb2) + row, stride, j, kept_offset, r, y0, y1)
        if diagonal:
            put(matrix_out, q * wp.static(nb2) + local_column, wp.static(nb), j, r, o0)
            if q == 1:
                put(matrix_out, wp.static(2 * nb2) + local_column, wp.static(nb), j, r, o1)
        elif outer:
            put(right_out, 0, 1, j, r, o0)
            put(right_out, wp.static(nb), 1, j, r, o1)
        else:
            put(matrix_out, (3 + q) * wp.static(nb2) + local_column, wp.static(nb), j, r, o0)
            put(matrix_out, (5 + q) * wp.static(nb2) + local_column, wp.static(nb), j, r, o1)

    return reduce


@cache
def last_kernel(nb: int, linear, first: bool, tensions: int = 0):
    """Build the kernel of the last level.

    `last`: solve the block that remains, the first two nodes of a rod.
    """
    factor, solve, _, right_side, *_ = block_functions(nb, linear, first, tensions)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def last(
        matrix: wp.array3d(dtype=linear),
        rhs: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        solution_out: wp.array3d(dtype=linear),
        lost_pivots: wp.array(dtype=int),
    ):
        r = wp.tid()
        if wanted[r] == 0:
            return
        n = int(1)
        if wp.static(first):
            n = count[r]
        L, d, Z, M, e, lost = factor(matrix, 0, n, r)
        b0, b1 = right_side(rhs, 0, n, r)
        u0, u1 = solve(L, d, Z, M, e, b0, b1)
        for c in range(wp.static(nb)):
            solution_out[c, 0, r] = u0[c]
            if count[r] > 1:
                solution_out[c, 1, r] = u1[c]
        if lost > 0:
            wp.atomic_add(lost_pivots, r, lost)

    return last


@cache
def expand_kernel(nb: int, linear):
    """Build the kernel of back substitution.

    `expand`: compute the solution of a level's odd blocks from the even blocks, one thread a component.
    """
    nb2 = nb**2

    @wp.func
    def product(kept: wp.array3d(dtype=linear), row: int, j: int, x: wp.array3d(dtype=linear), k: int, n: int, r: int):
        """Return a row of a kept block times the solution at nodes k and k + 1."""
        total = linear(0.0)
        for p in range(2):
            if k + p < n:
                for d in range(wp.static(nb)):
                    total += kept[row + p * wp.static(nb) + d, j, r] * x[d, k + p, r]
        return total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def expand(
        kept: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        spacing: int,
        solution: wp.array3d(dtype=linear),
    ):
        """Write the solution of odd blocks; `spacing` is the distance of the level's blocks in nodes."""
        c, j, r = wp.tid()
        n = count[r]
        half = c // wp.static(nb)
        k = (2 * j + 1) * spacing
        if wanted[r] == 0 or k + half >= n:
            return
        row = c * wp.static(2 * nb)
        value = kept[wp.static(8 * nb2) + c, j, r] - product(kept, row, j, solution, k - spacing, n, r)
        value -= product(kept, wp.static(4 * nb2) + row, j, solution, k + spacing, n, r)
        solution[c - half * wp.static(nb), k + half, r] = value

    return expand

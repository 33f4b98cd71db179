"""Block cyclic reduction: a block-pentadiagonal symmetric system solved in log2(n) parallel levels.

Two neighbouring nodes are one block of 2 nb dofs, which makes the matrix of an open chain block-tridiagonal, with diagonal blocks
A_i and couplings B_i to block i + 1. A level eliminates every odd block and leaves a tridiagonal system of the even ones
(Heller 1976; Gander and Golub, Cyclic Reduction - History and Applications, 1997). With l = j - 1 and u = j + 1 for an even j

    A'_j = A_j - B_l^T A_l^-1 B_l - B_j A_u^-1 B_j^T ,    B'_j = -B_j A_u^-1 B_u ,    r'_j = r_j - B_l^T A_l^-1 r_l - B_j A_u^-1 r_u ,
    x_u = A_u^-1 r_u - (A_u^-1 B_j^T) x_j - (A_u^-1 B_u) x_j+2 .

It is an elimination in another order than the sweep's, so that the pivots of a definite matrix are positive here too, and lost
ones mean the same. Nodes past the end of a rod are rows of the identity. Nodes may also have tensions among their dofs, the last ones:
see `paired`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.solve import pivot
from ddg_warp.kernels.threads import CPU_OPTIONS


def level_rows(nb: int) -> tuple[int, int, int]:
    """Rows of a level's matrix (A00, A01, A11, B00, B01, B10, B11), of its right-hand side, and of what it keeps.

    `nb` are the dofs of a node, here and below.
    """
    return 7 * nb**2, 2 * nb, 8 * nb**2 + 2 * nb


@cache
def block_functions(nb: int, linear, first: bool, tensions: int):
    """factor, solve, own_column, right_side of diagonal blocks, and column, product of a coupling X, from nodes or a level.

    X is the coupling B_i, or its transpose where it is `turned`, so that one code serves both neighbours of a block.
    """
    nb2 = nb**2
    H, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    factor_block, lower, _, lower_vector, upper_vector, congruence = pivot.signed_functions(nb, tensions, linear)

    @wp.func
    def place(i: int, p: int):
        """Where half p of block i lies along its array."""
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
        """Row of B_pq; of nodes, that is F for p = q, E for p > q, and none for p < q."""
        if wp.static(first):
            if p == q:
                return wp.static(2 * nb2)
            return wp.where(p > q, wp.static(nb2), -1)
        return (3 + 2 * p + q) * wp.static(nb2)

    @wp.func
    def block(A: wp.array3d(dtype=linear), row: int, down: int, across: int, k: int, n: int, r: int):
        """Entries of a block by their strides."""
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
        """L D L^T of diagonal block i, itself in two by two blocks: (L0, D0^-1, Z, L1, D1^-1, lost pivots)."""
        k0 = place(i, 0)
        k1 = place(i, 1)
        L0, d0, bad0 = factor_block(or_identity(block(A, 0, wp.static(nb), 1, k0, n, r), k0, n))
        Z = lower(L0, block(A, wp.static(nb2), wp.static(nb), 1, k0, n, r))
        A11 = or_identity(block(A, diagonal_row(1), wp.static(nb), 1, k1, n, r), k1, n)
        L1, d1, bad1 = factor_block(A11 - congruence(Z, d0, Z))
        return L0, d0, Z, L1, d1, bad0 + bad1

    @wp.func
    def solve(L0: M, d0: H, Z: M, L1: M, d1: H, a: H, b: H):
        z0 = lower_vector(L0, a)
        u1 = upper_vector(L1, d1, lower_vector(L1, b - wp.cw_mul(z0, d0) * Z))
        u0 = upper_vector(L0, d0, z0 - Z * u1)
        return u0, u1

    @wp.func
    def own_column(A: wp.array3d(dtype=linear), i: int, q: int, c: int, n: int, r: int):
        """Column c of half q of A_i; the lower half of the first columns, which nobody reads, is left out."""
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
        """Column c of half q of X."""
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
        """X^T u."""
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
    """One level: the even blocks take what the odd ones leave, and keep what the odd ones' solution needs.

    The first one reads blocks of nodes; of the dofs of a node the last ones may be `tensions`, with negative pivots.
    Thread c of a block has column c of its matrix, then the right-hand side, then the columns of its coupling. Each factors both
    neighbours for itself, one after the other in a loop that is not unrolled: that keeps them in registers. All of them read the same
    blocks: so those of as many chains as fill what memory brings at once are neighbours, and find them in the cache.

    If it `packs` there is no right-hand side, and what is kept goes to its place for many, see `reduction_again`.
    """
    nb2, sides = nb**2, 1 - packs
    H = wp.types.vector(nb, linear)
    factor, solve, own_column, right_side, column, product = block_functions(nb, linear, first, tensions)

    @wp.func
    def put(A: wp.array3d(dtype=linear), row: int, stride: int, k: int, r: int, v: H):
        for d in range(wp.static(nb)):
            A[row + d * stride, k, r] = v[d]

    @wp.func
    def keep(A: wp.array3d(dtype=linear), row: int, stride: int, k: int, at: int, r: int, v: H, w: H):
        """Both halves of a column."""
        for d in range(wp.static(nb)):
            if wp.static(packs):
                A[r, at + k, row + d * stride] = v[d]
                A[r, at + k, row + (d + wp.static(nb)) * stride] = w[d]
            else:
                A[row + d * stride, k, r] = v[d]
                A[row + (d + wp.static(nb)) * stride, k, r] = w[d]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def reduce(
        matrix: wp.array3d(dtype=linear),
        right: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        neighbours: int,
        at_kept: int,
        together: int,
        matrix_out: wp.array3d(dtype=linear),
        right_out: wp.array3d(dtype=linear),
        kept_out: wp.array3d(dtype=linear),
        bad: wp.array(dtype=int),
    ):
        """`blocks` of the level; `neighbours` is 2, which the compiler must not know; `at_kept`: odd blocks that are packed before;
        `together`: chains of threads that are neighbours.
        """
        j, group, c, r = wp.tid()
        r += group * together
        if r >= count.shape[0] or wanted[r] == 0:
            return
        n = blocks
        if wp.static(first):
            n = count[r]
        i = 2 * j
        own = c < wp.static(2 * nb)
        outer = wp.static(sides) == 1 and c == wp.static(2 * nb)
        at = c
        if not (own or outer):
            at = c - wp.static(2 * nb + sides)
        q = at // wp.static(nb)
        at -= q * wp.static(nb)
        o0 = H()
        o1 = H()
        start = int(0)
        if own:
            o0, o1 = own_column(matrix, i, q, at, n, r)
        elif outer:
            o0, o1 = right_side(right, i, n, r)
        else:
            start = 1
        for side in range(start, neighbours):
            away = i - 1 + 2 * side
            L0, d0, Z, L1, d1, lost = factor(matrix, away, n, r)
            v0 = H()
            v1 = H()
            if outer:
                v0, v1 = right_side(right, away, n, r)
            else:
                v0, v1 = column(matrix, wp.where(own, i - 1 + side, i + 1), own and side == 1, q, at, n, r)
            y0, y1 = solve(L0, d0, Z, L1, d1, v0, v1)
            t0, t1 = product(matrix, i - 1 + side, side == 1, y0, y1, n, r)
            o0 = o0 - t0
            o1 = o1 - t1
            if side == 1 and away < blocks:
                if c == 0 and lost > 0:
                    wp.atomic_add(bad, r, lost)
                row = wp.static(8 * nb2)
                stride = int(1)
                if not outer:
                    row = q * wp.static(nb) + at
                    stride = wp.static(2 * nb)
                    if not own:
                        row += wp.static(4 * nb2)
                keep(kept_out, row, stride, j, at_kept, r, y0, y1)
                if wp.static(packs):
                    if own:
                        for d in range(wp.static(nb)):
                            v0[d] = wp.where(q == 0 and d == at, linear(1.0), linear(0.0))
                            v1[d] = wp.where(q == 1 and d == at, linear(1.0), linear(0.0))
                        y0, y1 = solve(L0, d0, Z, L1, d1, v0, v1)
                        keep(kept_out, wp.static(8 * nb2) + row, stride, j, at_kept, r, y0, y1)
        if own:
            put(matrix_out, q * wp.static(nb2) + at, wp.static(nb), j, r, o0)
            if q == 1:
                put(matrix_out, wp.static(2 * nb2) + at, wp.static(nb), j, r, o1)
        elif outer:
            put(right_out, 0, 1, j, r, o0)
            put(right_out, wp.static(nb), 1, j, r, o1)
        else:
            put(matrix_out, (3 + q) * wp.static(nb2) + at, wp.static(nb), j, r, o0)
            put(matrix_out, (5 + q) * wp.static(nb2) + at, wp.static(nb), j, r, o1)

    return reduce


@cache
def last_kernel(nb: int, linear, first: bool, tensions: int = 0):
    """Solution of the one block that is left: the first two nodes of a rod."""
    factor, solve, _, right_side, *_ = block_functions(nb, linear, first, tensions)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def last(
        matrix: wp.array3d(dtype=linear),
        right: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        solution_out: wp.array3d(dtype=linear),
        bad: wp.array(dtype=int),
    ):
        r = wp.tid()
        if wanted[r] == 0:
            return
        n = int(1)
        if wp.static(first):
            n = count[r]
        L, d, Z, M, e, lost = factor(matrix, 0, n, r)
        b0, b1 = right_side(right, 0, n, r)
        u0, u1 = solve(L, d, Z, M, e, b0, b1)
        for c in range(wp.static(nb)):
            solution_out[c, 0, r] = u0[c]
            if count[r] > 1:
                solution_out[c, 1, r] = u1[c]
        if lost > 0:
            wp.atomic_add(bad, r, lost)

    return last


@cache
def expand_kernel(nb: int, linear):
    """Solution of a level's odd blocks from that of its even ones; a thread for a component."""
    nb2 = nb**2

    @wp.func
    def product(kept: wp.array3d(dtype=linear), row: int, j: int, x: wp.array3d(dtype=linear), k: int, n: int, r: int):
        """Row of a kept block times the solution at the nodes k and k + 1."""
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
        apart: int,
        solution: wp.array3d(dtype=linear),
    ):
        """`apart` is the distance of the level's blocks in nodes."""
        c, j, r = wp.tid()
        n = count[r]
        half = c // wp.static(nb)
        k = (2 * j + 1) * apart
        if wanted[r] == 0 or k + half >= n:
            return
        row = c * wp.static(2 * nb)
        value = kept[wp.static(8 * nb2) + c, j, r] - product(kept, row, j, solution, k - apart, n, r)
        value -= product(kept, wp.static(4 * nb2) + row, j, solution, k + apart, n, r)
        solution[c - half * wp.static(nb), k + half, r] = value

    return expand

"""Block cyclic reduction: a block-pentadiagonal symmetric system solved in log2(n) parallel levels.

Two neighbouring nodes are one block of 2 nb dofs, which makes the matrix of an open chain block-tridiagonal, with diagonal blocks
A_i and couplings B_i to block i + 1. A level eliminates every odd block and leaves a tridiagonal system of the even ones
(Heller 1976; Gander and Golub, Cyclic Reduction - History and Applications, 1997). With l = j - 1 and u = j + 1 for an even j

    A'_j = A_j - B_l^T A_l^-1 B_l - B_j A_u^-1 B_j^T ,    B'_j = -B_j A_u^-1 B_u ,    r'_j = r_j - B_l^T A_l^-1 r_l - B_j A_u^-1 r_u ,
    x_u = A_u^-1 r_u - (A_u^-1 B_j^T) x_j - (A_u^-1 B_u) x_j+2 .

It is an elimination in another order than the sweep's, so that the pivots of a definite matrix are positive here too, and lost
ones mean the same. Nodes past the end of a rod are rows of the identity. Columns of the right-hand sides are dealt to `lanes`
threads, each of which factors for itself: on a GPU that is cheaper than to wait for one another.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import pivot
from ddg_warp.kernels.element import CPU_OPTIONS, ChainKind


def level_rows(kind: ChainKind) -> tuple[int, int, int]:
    """Rows of a level's matrix (A00, A01, A11, B00, B01, B10, B11), of its right-hand side, and of what it keeps."""
    return 7 * kind.block**2, 2 * kind.block, 8 * kind.block**2 + 2 * kind.block


@cache
def _block_functions(kind: ChainKind, linear, first: bool):
    """factor(...) and solve(...) of a diagonal block; columns, rows and products of blocks, from nodes (`first`) or a level."""
    nb, nb2 = kind.block, kind.block**2
    H, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    factor_block, lower, _, lower_vector, upper_vector, congruence = pivot.functions(nb, linear)

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
        """Row of B_pq; of nodes, that is F for p = q, E for p > q, and nothing for p < q."""
        if wp.static(first):
            return wp.where(p == q, wp.static(2 * nb2), wp.static(nb2))
        return (3 + 2 * p + q) * wp.static(nb2)

    @wp.func
    def block(A: wp.array3d(dtype=linear), row: int, k: int, n: int, r: int):
        m = M()
        if k >= 0 and k < n:
            for i in range(wp.static(nb)):
                for j in range(wp.static(nb)):
                    m[i, j] = A[row + i * wp.static(nb) + j, k, r]
        return m

    @wp.func
    def column(A: wp.array3d(dtype=linear), row: int, k: int, c: int, n: int, r: int):
        v = H()
        if k >= 0 and k < n:
            for i in range(wp.static(nb)):
                v[i] = A[row + i * wp.static(nb) + c, k, r]
        return v

    @wp.func
    def line(A: wp.array3d(dtype=linear), row: int, k: int, c: int, n: int, r: int):
        v = H()
        if k >= 0 and k < n:
            for i in range(wp.static(nb)):
                v[i] = A[row + c * wp.static(nb) + i, k, r]
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
        L0, d0, bad0 = factor_block(or_identity(block(A, 0, k0, n, r), k0, n))
        Z = lower(L0, block(A, wp.static(nb2), k0, n, r))
        A11 = or_identity(block(A, diagonal_row(1), k1, n, r), k1, n)
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
        top = column(A, q * wp.static(nb2), place(i, 0), c, n, r)
        bottom = H()
        if q == 1:
            bottom = column(A, diagonal_row(1), k, c, n, r)
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
    def coupling_column(A: wp.array3d(dtype=linear), i: int, q: int, c: int, n: int, r: int):
        """Column c of half q of B_i."""
        top = H()
        if not wp.static(first) or q == 0:
            top = column(A, coupling_row(0, q), place(i, 0), c, n, r)
        return top, column(A, coupling_row(1, q), place(i, 1), c, n, r)

    @wp.func
    def coupling_line(A: wp.array3d(dtype=linear), i: int, p: int, c: int, n: int, r: int):
        """Row c of half p of B_i."""
        k = place(i, p)
        right = H()
        if not wp.static(first) or p == 1:
            right = line(A, coupling_row(p, 1), k, c, n, r)
        return line(A, coupling_row(p, 0), k, c, n, r), right

    @wp.func
    def couple(A: wp.array3d(dtype=linear), i: int, u0: H, u1: H, n: int, r: int):
        """B_i u."""
        k = place(i, 1)
        top = block(A, coupling_row(0, 0), place(i, 0), n, r) * u0
        bottom = block(A, coupling_row(1, 0), k, n, r) * u0 + block(A, coupling_row(1, 1), k, n, r) * u1
        if not wp.static(first):
            top += block(A, coupling_row(0, 1), k, n, r) * u1
        return top, bottom

    @wp.func
    def couple_back(A: wp.array3d(dtype=linear), i: int, u0: H, u1: H, n: int, r: int):
        """B_i^T u."""
        k = place(i, 1)
        top = u0 * block(A, coupling_row(0, 0), place(i, 0), n, r) + u1 * block(A, coupling_row(1, 0), k, n, r)
        bottom = u1 * block(A, coupling_row(1, 1), k, n, r)
        if not wp.static(first):
            bottom += u0 * block(A, coupling_row(0, 1), k, n, r)
        return top, bottom

    @wp.func
    def right_side(b: wp.array3d(dtype=linear), i: int, p: int, n: int, r: int):
        v = H()
        k = place(i, p)
        row = p * wp.static(0 if first else nb)
        if k >= 0 and k < n:
            for d in range(wp.static(nb)):
                v[d] = b[row + d, k, r]
        return v

    return factor, solve, own_column, coupling_column, coupling_line, couple, couple_back, right_side


@cache
def reduce_kernel(kind: ChainKind, linear, first: bool):
    """One level: the even blocks take what the odd ones leave, and keep what the odd ones' solution needs."""
    nb, nb2 = kind.block, kind.block**2
    H = wp.types.vector(nb, linear)
    functions = _block_functions(kind, linear, first)
    factor, solve, own_column, coupling_column, coupling_line, couple, couple_back, right_side = functions

    @wp.func
    def put_column(A: wp.array3d(dtype=linear), row: int, stride: int, k: int, r: int, v: H):
        for d in range(wp.static(nb)):
            A[row + d * stride, k, r] = v[d]

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
    def reduce(
        matrix: wp.array3d(dtype=linear),
        right: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        lanes: int,
        matrix_out: wp.array3d(dtype=linear),
        right_out: wp.array3d(dtype=linear),
        kept_out: wp.array3d(dtype=linear),
        bad: wp.array(dtype=int),
    ):
        lane, j, r = wp.tid()
        if wanted[r] == 0:
            return
        n = blocks
        if wp.static(first):
            n = count[r]
        i = 2 * j
        odd = i + 1 < blocks
        Ll, dl, Zl, Ml, el, _bad = factor(matrix, i - 1, n, r)
        Lu, du, Zu, Mu, eu, lost = factor(matrix, i + 1, n, r)
        if odd and lane == 0 and lost > 0:
            wp.atomic_add(bad, r, lost)
        for c in range(lane, wp.static(2 * nb + 1), lanes):
            q = c // wp.static(nb)
            at = c - q * wp.static(nb)
            a0 = H()
            a1 = H()
            b0 = H()
            b1 = H()
            o0 = H()
            o1 = H()
            if q < 2:
                a0, a1 = coupling_column(matrix, i - 1, q, at, n, r)
                b0, b1 = coupling_line(matrix, i, q, at, n, r)
                o0, o1 = own_column(matrix, i, q, at, n, r)
            else:
                a0 = right_side(right, i - 1, 0, n, r)
                a1 = right_side(right, i - 1, 1, n, r)
                b0 = right_side(right, i + 1, 0, n, r)
                b1 = right_side(right, i + 1, 1, n, r)
                o0 = right_side(right, i, 0, n, r)
                o1 = right_side(right, i, 1, n, r)
            y0, y1 = solve(Ll, dl, Zl, Ml, el, a0, a1)
            s0, s1 = couple_back(matrix, i - 1, y0, y1, n, r)
            w0, w1 = solve(Lu, du, Zu, Mu, eu, b0, b1)
            t0, t1 = couple(matrix, i, w0, w1, n, r)
            o0 = o0 - s0 - t0
            o1 = o1 - s1 - t1
            if q == 2:
                put_column(right_out, 0, 1, j, r, o0)
                put_column(right_out, wp.static(nb), 1, j, r, o1)
                if odd:
                    put_column(kept_out, wp.static(8 * nb2), 1, j, r, w0)
                    put_column(kept_out, wp.static(8 * nb2 + nb), 1, j, r, w1)
            else:
                v0, v1 = coupling_column(matrix, i + 1, q, at, n, r)
                y0, y1 = solve(Lu, du, Zu, Mu, eu, v0, v1)
                t0, t1 = couple(matrix, i, y0, y1, n, r)
                put_column(matrix_out, q * wp.static(nb2) + at, wp.static(nb), j, r, o0)
                if q == 1:
                    put_column(matrix_out, wp.static(2 * nb2) + at, wp.static(nb), j, r, o1)
                put_column(matrix_out, (3 + q) * wp.static(nb2) + at, wp.static(nb), j, r, -t0)
                put_column(matrix_out, (5 + q) * wp.static(nb2) + at, wp.static(nb), j, r, -t1)
                if odd:
                    put_column(kept_out, c, wp.static(2 * nb), j, r, w0)
                    put_column(kept_out, wp.static(2 * nb2) + c, wp.static(2 * nb), j, r, w1)
                    put_column(kept_out, wp.static(4 * nb2) + c, wp.static(2 * nb), j, r, y0)
                    put_column(kept_out, wp.static(6 * nb2) + c, wp.static(2 * nb), j, r, y1)

    return reduce


@cache
def last_kernel(kind: ChainKind, linear, first: bool):
    """Solution of the one block that is left: the first two nodes of a rod."""
    nb = kind.block
    factor, solve, *_, right_side = _block_functions(kind, linear, first)

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
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
        u0, u1 = solve(L, d, Z, M, e, right_side(right, 0, 0, n, r), right_side(right, 0, 1, n, r))
        for c in range(wp.static(nb)):
            solution_out[c, 0, r] = u0[c]
            if count[r] > 1:
                solution_out[c, 1, r] = u1[c]
        if lost > 0:
            wp.atomic_add(bad, r, lost)

    return last


@cache
def expand_kernel(kind: ChainKind, linear):
    """Solution of a level's odd blocks from that of its even ones; a thread for a component."""
    nb, nb2 = kind.block, kind.block**2

    @wp.func
    def product(
        kept: wp.array3d(dtype=linear), row: int, j: int, x: wp.array3d(dtype=linear), k: int, n: int, r: int
    ):
        """Row of a kept block times the solution at the nodes k and k + 1."""
        total = linear(0.0)
        for p in range(2):
            if k + p < n:
                for d in range(wp.static(nb)):
                    total += kept[row + p * wp.static(nb) + d, j, r] * x[d, k + p, r]
        return total

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
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

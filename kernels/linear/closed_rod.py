"""Block LDL^T of a closed rod: the last nodes are a separator, and the open rod before them is eliminated first.

A rod whose elements span s edges couples nodes at most s apart. Without its last s nodes, the separator, its block-banded matrix has
no periodic blocks. Every node before the separator is eliminated with its coupling to the separator as s more columns of blocks. The
rest is the Schur complement of the separator, at most 8 x 8. Pivots have the signs of the eigenvalues of H, as in an open rod.

The spin of an isotropic ring without rotary inertia costs no energy: its last pivot is zero, up to rounding. So that rounding is not
taken for an indefinite matrix, the last diagonal entry is enlarged by `ROUNDING` rounding units.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.linear import block_ldlt
from ddg_warp.kernels.linear.rod_matrix import block_functions

ROUNDING = 64.0  # Measured: the last pivot of free rings of 24 to 1024 nodes is up to 34 units, in float64 and float32.


def kept_rows(nb: int, span: int) -> int:
    """Return the rows of factors of a node: D^-1 E, D^-1 F, L, inverse pivots, and D^-1 times the coupling to the separator."""
    return (3 + span) * nb**2 + nb


@cache
def factor_function(nb: int, span: int, linear):
    """Return the device function `factorise(blocks, out, n, r) -> lost pivots`: block LDL^T of a closed rod of n nodes.

    Writes `kept_rows` rows of every node. The rows of an open rod come first; see `rod_matrix.factor_function`.
    """
    nb2, size = nb**2, span * nb
    H, M, W = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear), wp.types.matrix((nb, size), linear)
    S = wp.types.matrix((size, size), linear)
    larger = wp.constant(linear(1.0 + ROUNDING * (2.3e-16 if linear == wp.float64 else 1.2e-7)))
    load, store, _, store_vector = block_functions(nb, linear)
    factor, lower, upper, _, _, congruence = block_ldlt.functions(nb, linear)
    _, lower_wide, upper_wide, _, _, _ = block_ldlt.functions(nb, linear, size)

    @wp.func
    def plus(w: W, m: M, separator_node: int):
        total = w
        for i in range(wp.static(nb)):
            for j in range(wp.static(nb)):
                total[i, separator_node * wp.static(nb) + j] += m[i, j]
        return total

    @wp.func
    def coupling(blocks: wp.array3d(dtype=linear), j: int, n: int, r: int):
        """Return the blocks between node j before the separator and the separator."""
        w = W()
        first = n - wp.static(span)
        for o in range(1, wp.static(span + 1)):
            for s in range(wp.static(span)):
                if j + o == first + s:
                    w = plus(w, load(blocks, o * wp.static(nb2), j, r), s)
                if j - o == s - wp.static(span):
                    w = plus(w, wp.transpose(load(blocks, o * wp.static(nb2), first + s, r)), s)
        return w

    @wp.func
    def weighted(inverse: H, w: W):
        m = W()
        for i in range(wp.static(nb)):
            m[i] = inverse[i] * w[i]
        return m

    @wp.func
    def block_of(s: S, i: int, j: int):
        m = M()
        for a in range(wp.static(nb)):
            for b in range(wp.static(nb)):
                m[a, b] = s[i * wp.static(nb) + a, j * wp.static(nb) + b]
        return m

    @wp.func
    def keep(out: wp.array3d(dtype=linear), j: int, r: int, L: M, inverse: H):
        store(out, wp.static(2 * nb2), j, r, L)
        store_vector(out, wp.static(3 * nb2), j, r, inverse)

    @wp.func
    def factorise(blocks: wp.array3d(dtype=linear), out: wp.array3d(dtype=linear), n: int, r: int):
        lost = int(0)
        first = n - wp.static(span)
        # updates by the nodes before, of this node: diagonal block, and couplings to the next node and to the separator
        minus = M()
        minus_couple = M()
        minus_wide = W()
        minus_next = M()  # of the next node: diagonal block, and coupling to the separator
        minus_wide_next = W()
        minus_separator = S()
        for j in range(first):
            L, inverse, lost_here = factor(load(blocks, 0, j, r) - minus)
            lost += lost_here
            keep(out, j, r, L, inverse)
            B = M()
            if j < first - 1:
                B = load(blocks, wp.static(nb2), j, r) - minus_couple
            Zb = lower(L, B)
            store(out, 0, j, r, upper(L, inverse, Zb))
            Zw = lower_wide(L, coupling(blocks, j, n, r) - minus_wide)
            wide = upper_wide(L, inverse, Zw)
            for a in range(wp.static(nb)):
                for b in range(wp.static(size)):
                    out[wp.static(3 * nb2 + nb) + a * wp.static(size) + b, j, r] = wide[a, b]
            DZw = weighted(inverse, Zw)
            minus_separator += wp.transpose(Zw) * DZw
            minus = minus_next + congruence(Zb, inverse, Zb)
            minus_wide = minus_wide_next + wp.transpose(Zb) * DZw
            if wp.static(span == 2):
                C = M()
                if j < first - 2:
                    C = load(blocks, wp.static(2 * nb2), j, r)
                Zc = lower(L, C)
                store(out, wp.static(nb2), j, r, upper(L, inverse, Zc))
                minus_couple = congruence(Zb, inverse, Zc)
                minus_next = congruence(Zc, inverse, Zc)
                minus_wide_next = wp.transpose(Zc) * DZw
        L, inverse, lost_here = factor(load(blocks, 0, first, r) - block_of(minus_separator, 0, 0))
        lost += lost_here
        keep(out, first, r, L, inverse)
        if wp.static(span == 2):
            E = load(blocks, wp.static(nb2), first, r)
            if n == 3:  # the last node is two edges before the second, too
                E += wp.transpose(load(blocks, wp.static(2 * nb2), 2, r))
            Zs = lower(L, E - block_of(minus_separator, 0, 1))
            store(out, 0, first, r, upper(L, inverse, Zs))
            D = load(blocks, 0, first + 1, r)
            D[wp.static(nb - 1), wp.static(nb - 1)] *= larger
            L, inverse, lost_here = factor(D - block_of(minus_separator, 1, 1) - congruence(Zs, inverse, Zs))
            lost += lost_here
            keep(out, first + 1, r, L, inverse)
        return lost

    return factorise


@cache
def substitute_function(nb: int, span: int, linear):
    """Return the device function `substitute(factor, v, out, n, r, s)`: out = H^-1 v along a closed rod.

    Factors are in column r, vectors in column s.
    """
    nb2, size = nb**2, span * nb
    H, W = wp.types.vector(nb, linear), wp.types.matrix((nb, size), linear)
    Separator = wp.types.vector(size, linear)
    load, _, vector, store_vector = block_functions(nb, linear)
    _, _, _, lower_vector, upper_vector, _ = block_ldlt.functions(nb, linear)

    @wp.func
    def wide_at(factor: wp.array3d(dtype=linear), j: int, r: int):
        w = W()
        for a in range(wp.static(nb)):
            for b in range(wp.static(size)):
                w[a, b] = factor[wp.static(3 * nb2 + nb) + a * wp.static(size) + b, j, r]
        return w

    @wp.func
    def solve(factor: wp.array3d(dtype=linear), w: H, j: int, r: int):
        L = load(factor, wp.static(2 * nb2), j, r)
        return upper_vector(L, vector(factor, wp.static(3 * nb2), j, r), lower_vector(L, w))

    @wp.func
    def part(v: Separator, i: int):
        h = H()
        for d in range(wp.static(nb)):
            h[d] = v[i * wp.static(nb) + d]
        return h

    @wp.func
    def substitute(
        factor: wp.array3d(dtype=linear),
        v: wp.array3d(dtype=linear),
        out: wp.array3d(dtype=linear),
        n: int,
        r: int,
        s: int,
    ):
        first = n - wp.static(span)
        before = H()
        before2 = H()
        minus = Separator()
        for j in range(first):
            w = vector(v, 0, j, s) - before
            store_vector(out, 0, j, s, w)
            before = before2 + w * load(factor, 0, j, r)
            if wp.static(span == 2):
                before2 = w * load(factor, wp.static(nb2), j, r)
            minus += w * wide_at(factor, j, r)
        at_separator = Separator()
        w = vector(v, 0, first, s) - part(minus, 0)
        u = solve(factor, w, first, r)
        if wp.static(span == 2):
            U = load(factor, 0, first, r)
            last = solve(factor, vector(v, 0, first + 1, s) - part(minus, 1) - w * U, first + 1, r)
            u -= U * last
            store_vector(out, 0, first + 1, s, last)
            for d in range(wp.static(nb)):
                at_separator[wp.static(size - nb) + d] = last[d]
        store_vector(out, 0, first, s, u)
        for d in range(wp.static(nb)):
            at_separator[d] = u[d]
        e1 = H()
        e2 = H()
        for i in range(first):
            j = first - 1 - i
            u = solve(factor, vector(out, 0, j, s), j, r) - load(factor, 0, j, r) * e1
            if wp.static(span == 2):
                u -= load(factor, wp.static(nb2), j, r) * e2
            u -= wide_at(factor, j, r) * at_separator
            store_vector(out, 0, j, s, u)
            e2 = e1
            e1 = u

    return substitute

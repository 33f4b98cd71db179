"""The block LDL^T of chains from both of their ends at once, which meet in the middle: twice the threads, each with half the way.

A thread that walks along a chain waits for memory most of the time, and where chains are many but short there are too few of them. The
factorisation is the twisted one (Babuska, SIAM J. Numer. Anal. 9, 1972, 53; van der Vorst, Parallel Computing 5, 1987, 45): places
0, 1, ... up to the middle are eliminated by one side, the last, the one before it, ... by the other, and the two places in the middle,
h - 1 and h of n with h = n // 2, after that, with what both sides take from them. The far side is the near one of the chain turned
round, whose blocks are D_k, E_(k-1)^T and F_(k-2)^T. A place keeps U, V, L and inverse pivots as in `block_band.factor_function`,
which are those of the side that it belongs to. Not of edges that are split (`kernels.solve.tension`): a tension lies with the place
that its edge ends at, and has to come after both of its nodes. From the other end it would come before one of them, with the slack
alone as its pivot where the other is held, and all digits that it is there for would be lost.

10,000 chains of 32 places, an H200, float32: 49 us, where load, solve and finish of `elimination` take 82; 64 us if a thread reads
which dofs a place has only when it needs them. The factors take 26 us at 4 TB/s.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.matrix.block_band import block_functions
from ddg_warp.kernels.matrix.chain_places import angle_function, gather_function, place_dofs, solve_functions
from ddg_warp.kernels.solve import pivot
from ddg_warp.kernels.threads import CPU_OPTIONS


@wp.func
def share(n: int, side: int):
    """How many of n places a side eliminates, beside the middle."""
    return wp.where(side == 0, n / 2 - 1, n - 1 - n / 2)


@wp.func
def place_of(j: int, n: int, side: int):
    """The j-th place that a side comes to."""
    return wp.where(side == 0, j, n - 1 - j)


@cache
def factor_kernels(twist: bool, span: int, linear):
    """sides(...): all places but the middle, a thread for each side of a chain; middle(...): the two that are left."""
    nb = place_dofs(twist)
    nb2 = nb**2
    M = wp.types.matrix((nb, nb), linear)
    load, store, _, put = block_functions(nb, linear)
    factor, lower, upper, _, _, congruence = pivot.functions(nb, linear)

    @wp.func
    def eliminate(D: M, E: M, F: M, factors: wp.array3d(dtype=linear), k: int, r: int):
        """Writes the factors of a place.

        Returns what that takes from the block of the next place, from what couples that one to the place after it and from the block of
        the latter, and how many pivots were lost.
        """
        L, inverse, bad = factor(D)
        Zb = lower(L, E)
        store(factors, 0, k, r, upper(L, inverse, Zb))
        taken = congruence(Zb, inverse, Zb)
        couple = M()
        beyond = M()
        if wp.static(span == 2):
            Zc = lower(L, F)
            store(factors, wp.static(nb2), k, r, upper(L, inverse, Zc))
            couple = congruence(Zb, inverse, Zc)
            beyond = congruence(Zc, inverse, Zc)
        store(factors, wp.static(2 * nb2), k, r, L)
        put(factors, wp.static(3 * nb2), k, r, inverse)
        return taken, couple, beyond, bad

    @wp.func
    def coupling(blocks: wp.array3d(dtype=linear), which: int, j: int, n: int, side: int, r: int):
        """What couples the j-th place of a side to the one `which` places on, or its own block."""
        k = place_of(j, n, side)
        if side == 0:
            return load(blocks, which * wp.static(nb2), k, r)
        return wp.transpose(load(blocks, which * wp.static(nb2), k - which, r))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def sides(
        blocks: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        factors: wp.array3d(dtype=linear),
        taken_out: wp.array3d(dtype=linear),
        lost: wp.array(dtype=int),
    ):
        """`taken_out`: what a side takes from the block of its place in the middle, from the coupling there and from the other place.

        Lost and negative pivots become positive ones, and are noted. Factors may lie where the blocks are.
        """
        columns = wanted.shape[0] * count.shape[0]
        side = wp.tid() / columns
        r = wp.tid() - side * columns
        w = r / count.shape[0]
        if wanted[w] == 0 or idle[r] != 0:
            return
        n = count[r - w * count.shape[0]]
        minus = M()
        minus_couple = M()
        minus_next = M()
        bad = int(0)
        steps = share(n, side)
        D, E, F = M(), M(), M()
        for j in range(-1, steps):
            # what the next place has is read before this one is dealt with, as in `block_band.factor_function`
            ahead = wp.min(j + 1, steps - 1)
            if ahead < 0:
                break
            D_ahead = coupling(blocks, 0, ahead, n, side, r)
            E_ahead = coupling(blocks, 1, ahead, n, side, r)
            F_ahead = M()
            if wp.static(span == 2):
                F_ahead = coupling(blocks, 2, ahead, n, side, r)
            if j >= 0:
                taken, couple, beyond, own = eliminate(D - minus, E - minus_couple, F, factors, place_of(j, n, side), r)
                bad += own
                minus = minus_next + taken
                minus_couple = couple
                minus_next = beyond
            D = D_ahead
            E = E_ahead
            F = F_ahead
        if bad > 0:
            lost[w] = 1
        store(taken_out, 0, side, r, minus)
        store(taken_out, wp.static(nb2), side, r, minus_couple)
        store(taken_out, wp.static(2 * nb2), side, r, minus_next)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def middle(
        blocks: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        taken: wp.array3d(dtype=linear),
        factors: wp.array3d(dtype=linear),
        lost: wp.array(dtype=int),
    ):
        r = wp.tid()
        w = r / count.shape[0]
        if wanted[w] == 0 or idle[r] != 0:
            return
        h = count[r - w * count.shape[0]] / 2
        bad = int(0)
        D = load(blocks, 0, h, r) - load(taken, 0, 1, r)
        if h > 0:
            A = load(blocks, 0, h - 1, r) - load(taken, 0, 0, r) - load(taken, wp.static(2 * nb2), 1, r)
            E = load(blocks, wp.static(nb2), h - 1, r) - load(taken, wp.static(nb2), 0, r)
            E = E - wp.transpose(load(taken, wp.static(nb2), 1, r))
            own, _couple, _beyond, number = eliminate(A, E, M(), factors, h - 1, r)
            bad += number
            D = D - load(taken, wp.static(2 * nb2), 0, r) - own
        _own, _couple, _beyond, number = eliminate(D, M(), M(), factors, h, r)
        bad += number
        if bad > 0:
            lost[w] = 1

    return sides, middle


@cache
def solve_kernels(twist: bool, span: int, linear):
    """inward(...): from a vector of blocks, along both sides up to the middle; outward(...): from there to both ends, and z.

    Both are launched over the sides of chains; without joints, these are what is to be solved for.
    """
    nb = place_dofs(twist)
    nb2 = nb**2
    H, B, M = wp.types.vector(3, linear), wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    load, _, vector, put = block_functions(nb, linear)
    _, _, _, lower_vector, upper_vector, _ = pivot.functions(nb, linear)
    gather, angle_of = gather_function(twist, linear), angle_function(twist)
    right, hand = solve_functions(twist, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def inward(
        factors: wp.array3d(dtype=linear),
        residual: wp.array(dtype=H),
        places: wp.array3d(dtype=int),
        held: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        values_out: wp.array3d(dtype=linear),
        taken_out: wp.array3d(dtype=linear),
    ):
        """`taken_out`: what a side takes from its place in the middle, and from the other one."""
        columns = wanted.shape[0] * count.shape[0]
        side = wp.tid() / columns
        r = wp.tid() - side * columns
        w = r / count.shape[0]
        if wanted[w] != 1 or idle[r] != 0:
            return
        c = r - w * count.shape[0]
        n, first = count[c], w * blocks
        before, before2 = B(), B()
        # What the next place takes is read before this one is dealt with, as in `block_band.substitute_function`, and where its dofs
        # are before that: else a thread waits twice.
        k = place_of(0, n, side)
        U, V = load(factors, 0, k, r), M()
        if wp.static(span == 2):
            V = load(factors, wp.static(nb2), k, r)
        here = right(residual, places[0, k, c], angle_of(places, k, c), held[k, c], first)
        k = place_of(wp.min(1, n - 1), n, side)
        node = places[0, k, c]
        angle = angle_of(places, k, c)
        fixed = held[k, c]
        for j in range(share(n, side)):
            k = place_of(j + 1, n, side)
            U_ahead, V_ahead = load(factors, 0, k, r), M()
            if wp.static(span == 2):
                V_ahead = load(factors, wp.static(nb2), k, r)
            here_ahead = right(residual, node, angle, fixed, first)
            k = place_of(wp.min(j + 2, n - 1), n, side)
            node = places[0, k, c]
            angle = angle_of(places, k, c)
            fixed = held[k, c]
            u = here - before
            put(values_out, 0, place_of(j, n, side), r, u)
            before = before2 + u * U
            if wp.static(span == 2):
                before2 = u * V
            U = U_ahead
            V = V_ahead
            here = here_ahead
        put(taken_out, 0, side, r, before)
        put(taken_out, wp.static(nb), side, r, before2)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def outward(
        factors: wp.array3d(dtype=linear),
        residual: wp.array(dtype=H),
        places: wp.array3d(dtype=int),
        held: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        taken: wp.array3d(dtype=linear),
        values: wp.array3d(dtype=linear),
        z: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Both sides find what is in the middle, and write a place of it each; and r . z block by block."""
        columns = wanted.shape[0] * count.shape[0]
        side = wp.tid() / columns
        r = wp.tid() - side * columns
        w = r / count.shape[0]
        if wanted[w] != 1 or idle[r] != 0:
            return
        c = r - w * count.shape[0]
        n, first, last = count[c], w * blocks, share(count[c], side)
        # where the dofs of the first place on the way are, and what it has, is read before the middle is dealt with
        k = place_of(wp.max(last - 1, 0), n, side)
        node = places[0, k, c]
        angle = angle_of(places, k, c)
        U, V = load(factors, 0, k, r), M()
        if wp.static(span == 2):
            V = load(factors, wp.static(nb2), k, r)
        L, inverse = load(factors, wp.static(2 * nb2), k, r), vector(factors, wp.static(3 * nb2), k, r)
        here = vector(values, 0, k, r)
        h = n / 2
        a, a_right, C = B(), B(), M()
        b_right = right(residual, places[0, h, c], angle_of(places, h, c), held[h, c], first)
        b = b_right - vector(taken, 0, 1, r) - vector(taken, wp.static(nb), 0, r)
        if h > 0:
            a_right = right(residual, places[0, h - 1, c], angle_of(places, h - 1, c), held[h - 1, c], first)
            a = a_right - vector(taken, 0, 0, r) - vector(taken, wp.static(nb), 1, r)
            C = load(factors, 0, h - 1, r)
            b -= a * C
        own = lower_vector(load(factors, wp.static(2 * nb2), h, r), b)
        own = upper_vector(load(factors, wp.static(2 * nb2), h, r), vector(factors, wp.static(3 * nb2), h, r), own)
        other = B()
        if h > 0:
            L_first = load(factors, wp.static(2 * nb2), h - 1, r)
            other = (
                upper_vector(L_first, vector(factors, wp.static(3 * nb2), h - 1, r), lower_vector(L_first, a)) - C * own
            )
        if side == 0:
            swapped = own
            own = other
            other = swapped
            b_right = a_right
        if last >= 0:
            k = place_of(last, n, side)
            hand(own, b_right, places[0, k, c], angle_of(places, k, c), w, first, z, dots_out)
        for i in range(last):
            k = place_of(wp.max(last - 2 - i, 0), n, side)
            node_ahead = places[0, k, c]
            angle_ahead = angle_of(places, k, c)
            U_ahead, V_ahead = load(factors, 0, k, r), M()
            if wp.static(span == 2):
                V_ahead = load(factors, wp.static(nb2), k, r)
            L_ahead, inverse_ahead = load(factors, wp.static(2 * nb2), k, r), vector(factors, wp.static(3 * nb2), k, r)
            here_ahead = vector(values, 0, k, r)
            b = gather(residual, node, angle, first)
            u = upper_vector(L, inverse, lower_vector(L, here)) - U * own
            if wp.static(span == 2):
                u -= V * other
            hand(u, b, node, angle, w, first, z, dots_out)
            other = own
            own = u
            U = U_ahead
            V = V_ahead
            L = L_ahead
            inverse = inverse_ahead
            here = here_ahead
            node = node_ahead
            angle = angle_ahead

    return inward, outward

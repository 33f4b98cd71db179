"""Twisted factorisation: block LDL^T of a rod path from both ends at once, two threads a path.

A thread that eliminates along a path mostly waits for memory, and many short paths give too few threads. The factorisation is by
Babuska (SIAM J. Numer. Anal. 9, 1972, 53) and van der Vorst (Parallel Computing 5, 1987, 45). One side eliminates path nodes 0, 1,
... up to the middle, the other n - 1, n - 2, .... The two middle nodes, h - 1 and h with h = n // 2, follow with the updates of both
sides. The far side is the near side of the reversed path, with blocks D_k, E_(k-1)^T and F_(k-2)^T. A path node keeps U, V, L and
inverse pivots of its side, as in `rod_matrix.factor_function`.

Not for the mixed axial-force formulation (`kernels.linear.mixed_axial_force`). A tension is stored with the node where its edge
ends, and has to be eliminated after both nodes. From the far end it would come before one of them. If the other is fixed, the slack
alone is the pivot, and the digits that tensions are to save are lost.

Measured: 10,000 paths of 32 nodes, an H200, float32: 49 us, against 82 us for load, solve and finish of `rod_substructuring`. Without
prefetched dof indices 64 us. The factors take 26 us at 4 TB/s.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.linear import block_ldlt
from ddg_warp.kernels.linear.rod_dof_map import angle_function, gather_function, path_node_dofs, solve_functions
from ddg_warp.kernels.linear.rod_matrix import block_functions


@wp.func
def share(n: int, side: int):
    """Return the number of path nodes that a side eliminates before the middle, of n."""
    return wp.where(side == 0, n / 2 - 1, n - 1 - n / 2)


@wp.func
def index_of(j: int, n: int, side: int):
    """Return the index of the j-th path node that a side eliminates."""
    return wp.where(side == 0, j, n - 1 - j)


@cache
def factor_kernels(twist: bool, span: int, linear):
    """Build the kernels of the factorisation.

    `sides`: eliminate all path nodes but the middle, one thread a side.
    `middle`: eliminate the two middle nodes.
    """
    nb = path_node_dofs(twist)
    nb2 = nb**2
    M = wp.types.matrix((nb, nb), linear)
    load, store, _, store_vector = block_functions(nb, linear)
    factor, lower, upper, _, _, congruence = block_ldlt.functions(nb, linear)

    @wp.func
    def eliminate(D: M, E: M, F: M, factors: wp.array3d(dtype=linear), k: int, r: int):
        """Write the factors of a path node and return the updates of later blocks.

        Updates are subtracted from the next diagonal block, from the coupling between the next node and the one after, and from the
        diagonal block of the latter. The last result is the number of lost pivots.
        """
        L, inverse, lost_pivots = factor(D)
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
        store_vector(factors, wp.static(3 * nb2), k, r, inverse)
        return taken, couple, beyond, lost_pivots

    @wp.func
    def coupling(blocks: wp.array3d(dtype=linear), offset: int, j: int, n: int, side: int, r: int):
        """Return the block between a side's j-th node and the node `offset` further; its diagonal block for 0."""
        k = index_of(j, n, side)
        if side == 0:
            return load(blocks, offset * wp.static(nb2), k, r)
        return wp.transpose(load(blocks, offset * wp.static(nb2), k - offset, r))

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
        """Write factors, and the updates of the middle to `taken_out`.

        Updates of a side: of its middle block, of the middle coupling, of the other middle block. Lost and negative pivots become
        positive, and raise `lost` of the world. Factors may overwrite blocks.
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
        lost_pivots = int(0)
        steps = share(n, side)
        D, E, F = M(), M(), M()
        for j in range(-1, steps):
            # Prefetch: data of the next path node is read first, as in `rod_matrix.factor_function`.
            next_j = wp.min(j + 1, steps - 1)
            if next_j < 0:
                break
            D_ahead = coupling(blocks, 0, next_j, n, side, r)
            E_ahead = coupling(blocks, 1, next_j, n, side, r)
            F_ahead = M()
            if wp.static(span == 2):
                F_ahead = coupling(blocks, 2, next_j, n, side, r)
            if j >= 0:
                taken, couple, beyond, lost_here = eliminate(
                    D - minus, E - minus_couple, F, factors, index_of(j, n, side), r
                )
                lost_pivots += lost_here
                minus = minus_next + taken
                minus_couple = couple
                minus_next = beyond
            D = D_ahead
            E = E_ahead
            F = F_ahead
        if lost_pivots > 0:
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
        lost_pivots = int(0)
        D = load(blocks, 0, h, r) - load(taken, 0, 1, r)
        if h > 0:
            A = load(blocks, 0, h - 1, r) - load(taken, 0, 0, r) - load(taken, wp.static(2 * nb2), 1, r)
            E = load(blocks, wp.static(nb2), h - 1, r) - load(taken, wp.static(nb2), 0, r)
            E = E - wp.transpose(load(taken, wp.static(nb2), 1, r))
            update, _couple, _beyond, lost_here = eliminate(A, E, M(), factors, h - 1, r)
            lost_pivots += lost_here
            D = D - load(taken, wp.static(2 * nb2), 0, r) - update
        _update, _couple, _beyond, lost_here = eliminate(D, M(), M(), factors, h, r)
        lost_pivots += lost_here
        if lost_pivots > 0:
            lost[w] = 1

    return sides, middle


@cache
def solve_kernels(twist: bool, span: int, linear):
    """Build the kernels that solve with the factors, for paths without joints; one thread a side.

    `inward`: substitute forward along both sides up to the middle.
    `outward`: solve the middle, substitute back to both ends, and write z and r . z.
    """
    nb = path_node_dofs(twist)
    nb2 = nb**2
    H, B, M = wp.types.vector(3, linear), wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    load, _, vector, store_vector = block_functions(nb, linear)
    _, _, _, lower_vector, upper_vector, _ = block_ldlt.functions(nb, linear)
    gather, angle_of = gather_function(twist, linear), angle_function(twist)
    rhs_of, hand = solve_functions(twist, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def inward(
        factors: wp.array3d(dtype=linear),
        residual: wp.array(dtype=H),
        places: wp.array3d(dtype=int),
        fixed_dofs: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        values_out: wp.array3d(dtype=linear),
        taken_out: wp.array3d(dtype=linear),
    ):
        """Write substituted values, and to `taken_out` a side's updates of its own and of the other middle node."""
        columns = wanted.shape[0] * count.shape[0]
        side = wp.tid() / columns
        r = wp.tid() - side * columns
        w = r / count.shape[0]
        if wanted[w] != 1 or idle[r] != 0:
            return
        c = r - w * count.shape[0]
        n, first = count[c], w * blocks
        before, before2 = B(), B()
        # Prefetch: data of the next path node is read first, as in `rod_matrix.substitute_function`, and dof indices one node
        # earlier; otherwise a thread waits twice.
        k = index_of(0, n, side)
        U, V = load(factors, 0, k, r), M()
        if wp.static(span == 2):
            V = load(factors, wp.static(nb2), k, r)
        rhs = rhs_of(residual, places[0, k, c], angle_of(places, k, c), fixed_dofs[k, c], first)
        k = index_of(wp.min(1, n - 1), n, side)
        node = places[0, k, c]
        angle = angle_of(places, k, c)
        fixed = fixed_dofs[k, c]
        for j in range(share(n, side)):
            k = index_of(j + 1, n, side)
            U_ahead, V_ahead = load(factors, 0, k, r), M()
            if wp.static(span == 2):
                V_ahead = load(factors, wp.static(nb2), k, r)
            rhs_ahead = rhs_of(residual, node, angle, fixed, first)
            k = index_of(wp.min(j + 2, n - 1), n, side)
            node = places[0, k, c]
            angle = angle_of(places, k, c)
            fixed = fixed_dofs[k, c]
            u = rhs - before
            store_vector(values_out, 0, index_of(j, n, side), r, u)
            before = before2 + u * U
            if wp.static(span == 2):
                before2 = u * V
            U = U_ahead
            V = V_ahead
            rhs = rhs_ahead
        store_vector(taken_out, 0, side, r, before)
        store_vector(taken_out, wp.static(nb), side, r, before2)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def outward(
        factors: wp.array3d(dtype=linear),
        residual: wp.array(dtype=H),
        places: wp.array3d(dtype=int),
        fixed_dofs: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        taken: wp.array3d(dtype=linear),
        values: wp.array3d(dtype=linear),
        z: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Solve the middle on both sides, each of which writes one middle node; write z and r . z per block."""
        columns = wanted.shape[0] * count.shape[0]
        side = wp.tid() / columns
        r = wp.tid() - side * columns
        w = r / count.shape[0]
        if wanted[w] != 1 or idle[r] != 0:
            return
        c = r - w * count.shape[0]
        n, first, last = count[c], w * blocks, share(count[c], side)
        # prefetch dof indices and factors of the first node outward before the middle is solved
        k = index_of(wp.max(last - 1, 0), n, side)
        node = places[0, k, c]
        angle = angle_of(places, k, c)
        U, V = load(factors, 0, k, r), M()
        if wp.static(span == 2):
            V = load(factors, wp.static(nb2), k, r)
        L, inverse = load(factors, wp.static(2 * nb2), k, r), vector(factors, wp.static(3 * nb2), k, r)
        value = vector(values, 0, k, r)
        h = n / 2
        a, a_right, C = B(), B(), M()
        b_right = rhs_of(residual, places[0, h, c], angle_of(places, h, c), fixed_dofs[h, c], first)
        b = b_right - vector(taken, 0, 1, r) - vector(taken, wp.static(nb), 0, r)
        if h > 0:
            a_right = rhs_of(residual, places[0, h - 1, c], angle_of(places, h - 1, c), fixed_dofs[h - 1, c], first)
            a = a_right - vector(taken, 0, 0, r) - vector(taken, wp.static(nb), 1, r)
            C = load(factors, 0, h - 1, r)
            b -= a * C
        e1 = lower_vector(load(factors, wp.static(2 * nb2), h, r), b)
        e1 = upper_vector(load(factors, wp.static(2 * nb2), h, r), vector(factors, wp.static(3 * nb2), h, r), e1)
        e2 = B()
        if h > 0:
            L_first = load(factors, wp.static(2 * nb2), h - 1, r)
            e2 = upper_vector(L_first, vector(factors, wp.static(3 * nb2), h - 1, r), lower_vector(L_first, a)) - C * e1
        if side == 0:
            swapped = e1
            e1 = e2
            e2 = swapped
            b_right = a_right
        if last >= 0:
            k = index_of(last, n, side)
            hand(e1, b_right, places[0, k, c], angle_of(places, k, c), w, first, z, dots_out)
        for i in range(last):
            k = index_of(wp.max(last - 2 - i, 0), n, side)
            node_ahead = places[0, k, c]
            angle_ahead = angle_of(places, k, c)
            U_ahead, V_ahead = load(factors, 0, k, r), M()
            if wp.static(span == 2):
                V_ahead = load(factors, wp.static(nb2), k, r)
            L_ahead, inverse_ahead = load(factors, wp.static(2 * nb2), k, r), vector(factors, wp.static(3 * nb2), k, r)
            value_ahead = vector(values, 0, k, r)
            b = gather(residual, node, angle, first)
            u = upper_vector(L, inverse, lower_vector(L, value)) - U * e1
            if wp.static(span == 2):
                u -= V * e2
            hand(u, b, node, angle, w, first, z, dots_out)
            e2 = e1
            e1 = u
            U = U_ahead
            V = V_ahead
            L = L_ahead
            inverse = inverse_ahead
            value = value_ahead
            node = node_ahead
            angle = angle_ahead

    return inward, outward

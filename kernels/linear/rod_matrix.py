"""Block-banded system of a rod, open or closed: assembly, and block LDL^T of open rods.

Node k has the blocks D_k, E_k (coupling to node k + 1) and F_k (to node k + 2; modulo the nodes of a closed rod), in one array of 3
nb^2 rows: [component][node][rod]. One thread gathers a block, so that sums have a fixed order, without atomics. Rows and columns of
fixed dofs are rows and columns of the identity.

Why not shared with `kernels.linear.rod_band_assembly`: blocks here have the dofs of a node of one kind of rod, from one window of all
terms. Blocks there sum element sets found by index and positions of H, with dofs and tensions of joined rods.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import DROP_COMPRESSION, INERTIA_COEFFICIENT, ITERATION, STATUS
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions, inertia_type
from ddg_warp.kernels.linear import block_ldlt, geometric_stiffness
from ddg_warp.kernels.newton.line_search import converged_function
from ddg_warp.kernels.residual.rod_residual import node_functions

TILE = wp.constant(32)


@cache
def block_functions(nb: int, linear):
    """Return the device functions `load`, `store`, `vector` and `store_vector`.

    `load(A, row, k, r)`, `store(A, row, k, r, M)`: read and write a block.
    `vector(v, row, k, r)`, `store_vector(v, row, k, r, u)`: read and write a block vector.
    """
    H, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)

    @wp.func
    def load(A: wp.array3d(dtype=linear), row: int, k: int, r: int):
        m = M()
        for i in range(wp.static(nb)):
            for j in range(wp.static(nb)):
                m[i, j] = A[row + i * wp.static(nb) + j, k, r]
        return m

    @wp.func
    def store(A: wp.array3d(dtype=linear), row: int, k: int, r: int, m: M):
        for i in range(wp.static(nb)):
            for j in range(wp.static(nb)):
                A[row + i * wp.static(nb) + j, k, r] = m[i, j]

    @wp.func
    def vector(v: wp.array3d(dtype=linear), row: int, k: int, r: int):
        u = H()
        for i in range(wp.static(nb)):
            u[i] = v[row + i, k, r]
        return u

    @wp.func
    def store_vector(v: wp.array3d(dtype=linear), row: int, k: int, r: int, u: H):
        for i in range(wp.static(nb)):
            v[row + i, k, r] = u[i]

    return load, store, vector, store_vector


@cache
def assemble_kernel(kind: RodKind, real, linear, exact_from: int | None = None):
    """Build the kernel of assembly.

    `assemble`: write the blocks of H of every rod that has not converged.

    From iteration `exact_from` on, H includes the geometric stiffness of rods that are not flagged `drop_compression`. Launched over
    (tiles of `TILE` rods, nodes, rods of a tile), so that data of three nodes is still cached.
    """
    dim, nb, nb2, twist, span, closed = kind.dim, kind.block, kind.block**2, kind.twist, kind.span, kind.closed
    window, vertex_rows, edge_rows, tensions = kind.window, kind.vertex_strains, kind.edge_strains, kind.tensions
    H, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    quadratic, Inertia = kind.quadratic, inertia_type(kind, real)
    edge_row, tension_row = vertex_rows * window, vertex_rows * window + edge_rows * dim
    previous, _ = node_functions(kind, real)
    along, *_ = gather_functions(kind, real)
    rests, until, (_, store, *_) = converged_function(real), until_function(kind.serial), block_functions(nb, linear)
    curved, begin = exact_from is not None, exact_from or 0
    first_first, first_mid, first_last, mid_mid, mid_last, last_last = geometric_stiffness.block_functions(kind, linear)

    @wp.func
    def part(F: wp.array3d(dtype=linear), row: int, k: int, r: int):
        v = H()
        for d in range(wp.static(dim)):
            v[d] = F[row + d, k, r]
        return v

    @wp.func
    def own(F: wp.array3d(dtype=linear), row: int, k: int, r: int, local_node: int):
        """Return the factor row at the first (0), second (1) or third (2) node of the vertex."""
        v = H()
        if local_node == 0:
            v = -part(F, row, k, r)
        if local_node == 1:
            v = part(F, row, k, r) - part(F, row + wp.static(dim), k, r)
        if local_node == 2:
            v = part(F, row + wp.static(dim), k, r)
        if wp.static(twist):
            if local_node < 2:
                v[wp.static(nb - 1)] = F[row + wp.static(2 * dim) + local_node, k, r]
        return v

    @wp.func
    def edge_block(F: wp.array3d(dtype=linear), k: int, r: int):
        m = M()
        for i in range(wp.static(edge_rows)):
            t = part(F, wp.static(edge_row) + i * wp.static(dim), k, r)
            m += wp.outer(t, t)
        for i in range(wp.static(tensions)):
            for d in range(wp.static(dim)):
                m[d, d] = m[d, d] + F[wp.static(tension_row) + i, k, r]
        return m

    @wp.func
    def free_of(fixed: wp.array2d(dtype=wp.uint8), k: int, r: int):
        free = H()
        for d in range(wp.static(nb)):
            free[d] = linear(1 - ((int(fixed[k, r]) >> d) & 1))
        return free

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def assemble(
        F: wp.array3d(dtype=linear),
        second: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        mass: wp.array2d(dtype=Inertia),
        rotary: wp.array2d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        reuse: int,
        blocks_out: wp.array3d(dtype=linear),
    ):
        tile, first, lane = wp.tid()
        r = tile * TILE + lane
        if r >= count.shape[0]:
            return
        n = count[r]
        if flags[STATUS, r] != 0 or first >= n:
            return
        if rests(flags, r):
            return
        if reuse != 0 and flags[ITERATION, r] > 0:
            return
        c = scalars[INERTIA_COEFFICIENT, r]
        for k in range(first, until(first, n)):
            b = previous(k, n)
            free = free_of(fixed, k, r)
            D = M()
            E = M()
            G = M()
            if wp.static(span == 2):
                bb = int(-1)
                if b >= 0:
                    bb = previous(b, n)
                for m in range(wp.static(vertex_rows)):
                    row = m * wp.static(window)
                    if wp.static(closed) or k < n - 2:
                        A = own(F, row, k, r, 0)
                        D += wp.outer(A, A)
                        E += wp.outer(A, own(F, row, k, r, 1))
                        G += wp.outer(A, own(F, row, k, r, 2))
                    if b >= 0 and (wp.static(closed) or k < n - 1):
                        B = own(F, row, b, r, 1)
                        D += wp.outer(B, B)
                        E += wp.outer(B, own(F, row, b, r, 2))
                    if bb >= 0:
                        C = own(F, row, bb, r, 2)
                        D += wp.outer(C, C)
                if wp.static(curved):
                    if flags[DROP_COMPRESSION, r] == 0 and flags[ITERATION, r] >= wp.static(begin):
                        if wp.static(closed) or k < n - 2:
                            D += first_first(second, k, r)
                            E += first_mid(second, k, r)
                            G += first_last(second, k, r)
                        if b >= 0 and (wp.static(closed) or k < n - 1):
                            D += mid_mid(second, b, r)
                            E += mid_last(second, b, r)
                        if bb >= 0:
                            D += last_last(second, bb, r)
            if wp.static(closed) or k < n - 1:
                S = edge_block(F, k, r)
                D += S
                E -= S
            if b >= 0:
                D += edge_block(F, b, r)
            if wp.static(quadratic):
                stiffness = mass[k, r].stiffness
                for d in range(wp.static(dim)):
                    D[d, d] = D[d, d] + linear(c * mass[k, r].mass)
                    for i in range(wp.static(dim)):
                        D[d, i] = D[d, i] + linear(stiffness[d, i])
            else:
                for d in range(wp.static(dim)):
                    D[d, d] = D[d, d] + linear(c * mass[k, r])
            if wp.static(twist):
                D[wp.static(nb - 1), wp.static(nb - 1)] = D[wp.static(nb - 1), wp.static(nb - 1)] + linear(
                    c * rotary[k, r]
                )
            D = wp.cw_mul(D, wp.outer(free, free)) + wp.diag(H(linear(1.0)) - free)
            store(blocks_out, 0, k, r, D)
            if wp.static(closed) or k < n - 1:
                E = wp.cw_mul(E, wp.outer(free, free_of(fixed, along(k + 1, n), r)))
            store(blocks_out, wp.static(nb2), k, r, E)
            if wp.static(span == 2):
                second_next = along(k + 2, n)
                if wp.static(closed) or k < n - 2:
                    G = wp.cw_mul(G, wp.outer(free, free_of(fixed, second_next, r)))
                store(blocks_out, wp.static(2 * nb2), k, r, G)

    return assemble


@cache
def factor_function(nb: int, span: int, linear, tensions: int = 0):
    """Return the device function `factorise(blocks, out, n, r) -> lost pivots`: block LDL^T of an open rod of n nodes.

    Writes U = D^-1 E, D^-1 F, L and inverse pivots of every node (3 nb^2 + nb rows); `out` may be the array of the blocks. The last
    dofs of a node may be `tensions`, with negative pivots.
    """
    nb2 = nb**2
    M = wp.types.matrix((nb, nb), linear)
    load, store, _, store_vector = block_functions(nb, linear)
    factor, lower, upper, _, _, congruence = block_ldlt.signed_functions(nb, tensions, linear)

    @wp.func
    def factorise(blocks: wp.array3d(dtype=linear), out: wp.array3d(dtype=linear), n: int, r: int):
        lost = int(0)
        minus = (
            M()
        )  # updates of the diagonal block of this node, of its coupling, and of the next block, by the nodes before
        minus_couple = M()
        minus_next = M()
        # prefetch; see `substitute_function`
        D = load(blocks, 0, 0, r)
        E = load(blocks, wp.static(nb2), 0, r)
        F = M()
        if wp.static(span == 2):
            F = load(blocks, wp.static(2 * nb2), 0, r)
        for j in range(n):
            next_j = wp.min(j + 1, n - 1)
            D_ahead = load(blocks, 0, next_j, r)
            E_ahead = load(blocks, wp.static(nb2), next_j, r)
            F_ahead = M()
            if wp.static(span == 2):
                F_ahead = load(blocks, wp.static(2 * nb2), next_j, r)
            L, inverse, lost_here = factor(D - minus)
            lost += lost_here
            B = M()
            if j < n - 1:
                B = E - minus_couple
            Zb = lower(L, B)
            store(out, 0, j, r, upper(L, inverse, Zb))
            minus = minus_next + congruence(Zb, inverse, Zb)
            if wp.static(span == 2):
                C = M()
                if j < n - 2:
                    C = F
                Zc = lower(L, C)
                store(out, wp.static(nb2), j, r, upper(L, inverse, Zc))
                minus_couple = congruence(Zb, inverse, Zc)
                minus_next = congruence(Zc, inverse, Zc)
            store(out, wp.static(2 * nb2), j, r, L)
            store_vector(out, wp.static(3 * nb2), j, r, inverse)
            D = D_ahead
            E = E_ahead
            F = F_ahead
        return lost

    return factorise


@cache
def solve_function(nb: int, span: int, linear):
    """Return the device function `solve(blocks, v, factor, out, n, r) -> lost pivots`: out = H^-1 v along an open rod of n nodes.

    For one right-hand side, of which each node is read before it is written. `factor` is scratch, 2 nb^2 rows of every node.
    """
    nb2 = nb**2
    H, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    load, store, vector, store_vector = block_functions(nb, linear)
    eliminate, lower, upper, lower_vector, upper_vector, congruence = block_ldlt.functions(nb, linear)

    @wp.func
    def solve(
        blocks: wp.array3d(dtype=linear),
        v: wp.array3d(dtype=linear),
        factor: wp.array3d(dtype=linear),
        out: wp.array3d(dtype=linear),
        n: int,
        r: int,
    ):
        lost = int(0)
        # updates by the nodes before: of this node, of its coupling, and of the next node
        minus = M()
        minus_couple = M()
        minus_next = M()
        before = H()
        before_next = H()
        for j in range(n):
            L, inverse, lost_here = eliminate(load(blocks, 0, j, r) - minus)
            lost += lost_here
            w = vector(v, 0, j, r) - before
            store_vector(out, 0, j, r, upper_vector(L, inverse, lower_vector(L, w)))
            B = M()
            if j < n - 1:
                B = load(blocks, wp.static(nb2), j, r) - minus_couple
            Zb = lower(L, B)
            U = upper(L, inverse, Zb)
            store(factor, 0, j, r, U)
            minus = minus_next + congruence(Zb, inverse, Zb)
            before = before_next + w * U
            if wp.static(span == 2):
                C = M()
                if j < n - 2:
                    C = load(blocks, wp.static(2 * nb2), j, r)
                Zc = lower(L, C)
                V = upper(L, inverse, Zc)
                store(factor, wp.static(nb2), j, r, V)
                minus_couple = congruence(Zb, inverse, Zc)
                minus_next = congruence(Zc, inverse, Zc)
                before_next = w * V
        e1 = H()
        e2 = H()
        for i in range(n):
            j = n - 1 - i
            u = vector(out, 0, j, r) - load(factor, 0, j, r) * e1
            if wp.static(span == 2):
                u -= load(factor, wp.static(nb2), j, r) * e2
            store_vector(out, 0, j, r, u)
            e2 = e1
            e1 = u
        return lost

    return solve


@cache
def substitute_function(nb: int, span: int, linear, tensions: int = 0):
    """Return the device function `substitute(factor, v, out, n, r, s)`: out = (L D L^T)^-1 v along an open rod.

    Factors are in column r, vectors in column s.
    """
    nb2 = nb**2
    H, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    load, _, vector, store_vector = block_functions(nb, linear)
    _, _, _, lower_vector, upper_vector, _ = block_ldlt.signed_functions(nb, tensions, linear)

    @wp.func
    def substitute(
        factor: wp.array3d(dtype=linear),
        v: wp.array3d(dtype=linear),
        out: wp.array3d(dtype=linear),
        n: int,
        r: int,
        s: int,
    ):
        # Prefetch: data of the next node is read before this node is processed, since a sweeping thread mostly waits for memory.
        before = H()
        before2 = H()
        U = load(factor, 0, 0, r)
        V = M()
        if wp.static(span == 2):
            V = load(factor, wp.static(nb2), 0, r)
        value = vector(v, 0, 0, s)
        for j in range(n):
            next_j = wp.min(j + 1, n - 1)
            U_ahead = load(factor, 0, next_j, r)
            V_ahead = M()
            if wp.static(span == 2):
                V_ahead = load(factor, wp.static(nb2), next_j, r)
            value_ahead = vector(v, 0, next_j, s)
            # z = D^-1 (v - E^T z_before - ...): with U = D^-1 E stored, E^T D^-1 w = U^T w
            w = value - before
            store_vector(out, 0, j, s, w)
            before = before2 + w * U
            if wp.static(span == 2):
                before2 = w * V
            U = U_ahead
            V = V_ahead
            value = value_ahead
        e1 = H()
        e2 = H()
        L = load(factor, wp.static(2 * nb2), n - 1, r)
        inverse = vector(factor, wp.static(3 * nb2), n - 1, r)
        value = vector(out, 0, n - 1, s)
        for i in range(n):
            j = n - 1 - i
            next_j = wp.max(j - 1, 0)
            U_ahead = load(factor, 0, next_j, r)
            V_ahead = M()
            if wp.static(span == 2):
                V_ahead = load(factor, wp.static(nb2), next_j, r)
            L_ahead = load(factor, wp.static(2 * nb2), next_j, r)
            inverse_ahead = vector(factor, wp.static(3 * nb2), next_j, r)
            value_ahead = vector(out, 0, next_j, s)
            u = upper_vector(L, inverse, lower_vector(L, value))
            u -= U * e1
            if wp.static(span == 2):
                u -= V * e2
            store_vector(out, 0, j, s, u)
            e2 = e1
            e1 = u
            U = U_ahead
            V = V_ahead
            L = L_ahead
            inverse = inverse_ahead
            value = value_ahead

    return substitute


@cache
def substitute_all_function(nb: int, span: int, linear, sides: int):
    """Return the device function `substitute(factor, v, n, r, s, columns)`, which overwrites `sides` vectors.

    Vectors are `columns` apart. A thread reads the factors once for all of them.
    """
    nb2 = nb**2
    W = wp.types.matrix((nb, sides), linear)
    load, _, vector, _ = block_functions(nb, linear)
    _, lower, upper, _, _, _ = block_ldlt.functions(nb, linear, sides)

    @wp.func
    def read(v: wp.array3d(dtype=linear), j: int, s: int, columns: int):
        w = W()
        for q in range(wp.static(sides)):
            for i in range(wp.static(nb)):
                w[i, q] = v[i, j, s + q * columns]
        return w

    @wp.func
    def write(v: wp.array3d(dtype=linear), j: int, s: int, columns: int, w: W):
        for q in range(wp.static(sides)):
            for i in range(wp.static(nb)):
                v[i, j, s + q * columns] = w[i, q]

    @wp.func
    def substitute(factor: wp.array3d(dtype=linear), v: wp.array3d(dtype=linear), n: int, r: int, s: int, columns: int):
        before = W()
        before2 = W()
        for j in range(n):
            w = read(v, j, s, columns) - before
            write(v, j, s, columns, w)
            before = before2 + wp.transpose(load(factor, 0, j, r)) * w
            if wp.static(span == 2):
                before2 = wp.transpose(load(factor, wp.static(nb2), j, r)) * w
        e1 = W()
        e2 = W()
        for i in range(n):
            j = n - 1 - i
            L = load(factor, wp.static(2 * nb2), j, r)
            u = upper(L, vector(factor, wp.static(3 * nb2), j, r), lower(L, read(v, j, s, columns)))
            u -= load(factor, 0, j, r) * e1
            if wp.static(span == 2):
                u -= load(factor, wp.static(nb2), j, r) * e2
            write(v, j, s, columns, u)
            e2 = e1
            e1 = u

    return substitute

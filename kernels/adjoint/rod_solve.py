"""Linear solve of the adjoint of open rods, from element matrices: block LDL^T and one right-hand side, one thread a rod.

Blocks of H are formed in registers, node by node, and are not stored; see `kernels.newton.rod_sweep` for the order. Each block is read
when it is used: all blocks of an element at once take more registers in float64 than a GPU has.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, inertia_type
from ddg_warp.kernels.linear import block_ldlt, geometric_stiffness
from ddg_warp.kernels.linear.rod_matrix import block_functions, element_functions


def scratch_rows(kind: RodKind) -> int:
    """Return the rows of scratch memory of a node."""
    return 2 * kind.block**2


@cache
def solve_kernel(kind: RodKind, real):
    """Build the kernel of solutions.

    `solve`: write w of H w = g, with H from the factors and geometric stiffnesses of `evaluate_kernel`; count lost pivots.
    """
    dim, nb, nb2, twist, bends, drag = kind.dim, kind.block, kind.block**2, kind.twist, kind.span == 2, kind.drag
    H, M, Inertia = wp.types.vector(nb, real), wp.types.matrix((nb, nb), real), inertia_type(kind, real)
    factor_row, edge_block = element_functions(kind, real)
    vertex_rows, window = kind.vertex_strains, kind.window
    first_first, first_mid, first_last, mid_mid, mid_last, last_last = geometric_stiffness.block_functions(kind, real)
    load, store, vector, store_vector = block_functions(nb, real)
    factor_block, lower, upper, lower_vector, upper_vector, congruence = block_ldlt.functions(nb, real)

    @wp.func
    def vertex_block(factor: wp.array3d(dtype=real), k: int, r: int, i: int, j: int):
        """Return the Gauss-Newton block between local nodes i and j of the vertex that starts at node k."""
        m = M()
        for strain in range(wp.static(vertex_rows)):
            row = strain * wp.static(window)
            m += wp.outer(factor_row(factor, row, k, r, i), factor_row(factor, row, k, r, j))
        return m

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solve(
        factor: wp.array3d(dtype=real),
        geometric: wp.array3d(dtype=real),
        mass: wp.array2d(dtype=Inertia),
        rotary: wp.array2d(dtype=real),
        coefficient: wp.array(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        rhs: wp.array3d(dtype=real),
        count: wp.array(dtype=int),
        eliminated: wp.array3d(dtype=real),
        solution: wp.array3d(dtype=real),
        lost: wp.array(dtype=int),
    ):
        """Take a right-hand side that is zero at fixed dofs; `coefficient` is the factor of inertia [1/s^2]."""
        r = wp.tid()
        n = count[r]
        c = coefficient[r]
        # contributions of the nodes and elements before: to this block, its coupling to the next node, and the next block
        diagonal = M()
        coupling = M()
        next_diagonal = M()
        forward = H()
        next_forward = H()
        lost_here = int(0)
        for j in range(n):
            whole = wp.static(bends) and j < n - 2
            edge = M()
            if j < n - 1:
                edge = edge_block(factor, j, r)
            D = diagonal + edge
            if wp.static(drag):
                resistance = mass[j, r].resistance
                for d in range(wp.static(dim)):
                    D[d, d] = D[d, d] + c * mass[j, r].mass
                    for i in range(wp.static(dim)):
                        D[d, i] = D[d, i] + resistance[d, i]
            else:
                for d in range(wp.static(dim)):
                    D[d, d] = D[d, d] + c * mass[j, r]
            if wp.static(twist):
                D[wp.static(nb - 1), wp.static(nb - 1)] = D[wp.static(nb - 1), wp.static(nb - 1)] + c * rotary[j, r]
            E = coupling - edge
            if whole:
                D += vertex_block(factor, j, r, 0, 0) + first_first(geometric, j, r)
                E += vertex_block(factor, j, r, 0, 1) + first_mid(geometric, j, r)
            free = H()
            for d in range(wp.static(nb)):
                free[d] = real(1 - ((int(fixed[j, r]) >> d) & 1))
            D = wp.cw_mul(D, wp.outer(free, free)) + wp.diag(H(real(1.0)) - free)
            L, inverse, lost_pivots = factor_block(D)
            lost_here += lost_pivots
            inverse = wp.cw_mul(inverse, free)  # a fixed dof affects no other, and its solution is zero
            w = vector(rhs, 0, j, r) - forward
            store_vector(solution, 0, j, r, upper_vector(L, inverse, lower_vector(L, w)))
            Zb = lower(L, E)
            U = upper(L, inverse, Zb)
            store(eliminated, 0, j, r, U)
            forward = next_forward + w * U
            diagonal = next_diagonal + edge - congruence(Zb, inverse, Zb)
            if wp.static(bends):
                F = M()
                coupling = M()
                next_diagonal = M()
                if whole:
                    diagonal += vertex_block(factor, j, r, 1, 1) + mid_mid(geometric, j, r)
                    F = vertex_block(factor, j, r, 0, 2) + first_last(geometric, j, r)
                    coupling = vertex_block(factor, j, r, 1, 2) + mid_last(geometric, j, r)
                    next_diagonal = vertex_block(factor, j, r, 2, 2) + last_last(geometric, j, r)
                Zc = lower(L, F)
                V = upper(L, inverse, Zc)
                store(eliminated, wp.static(nb2), j, r, V)
                next_forward = w * V
                coupling -= congruence(Zb, inverse, Zc)
                next_diagonal -= congruence(Zc, inverse, Zc)
        e1 = H()
        e2 = H()
        for i in range(n):
            j = n - 1 - i
            u = vector(solution, 0, j, r) - load(eliminated, 0, j, r) * e1
            if wp.static(bends):
                u -= load(eliminated, wp.static(nb2), j, r) * e2
            store_vector(solution, 0, j, r, u)
            e2 = e1
            e1 = u
        lost[r] = lost_here

    return solve

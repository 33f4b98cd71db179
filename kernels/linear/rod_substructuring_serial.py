"""Rod paths of the coupled system on the CPU: one thread takes a path from element contributions to the solution.

Blocks of path nodes are assembled, eliminated and substituted in one sweep, as in `kernels.newton.rod_sweep`, and H is never
stored. A GPU assembles with one thread a path node; see `rod_bands`, `rod_band_assembly` and `rod_substructuring`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import mass_type
from ddg_warp.kernels.core.islands import NEEDS_DIRECTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS, first_of
from ddg_warp.kernels.linear import block_ldlt
from ddg_warp.kernels.linear.rod_band_assembly import blocks_function, layout_type
from ddg_warp.kernels.linear.rod_dof_map import value_function
from ddg_warp.kernels.linear.rod_matrix import block_functions
from ddg_warp.kernels.residual.coupled_residual_along_rods import along_type
from ddg_warp.kernels.terms import Term


@cache
def walk_kernel(
    terms: tuple[Term, ...],
    twist: bool,
    span: int,
    real,
    linear,
    exact_from: tuple[int | None, ...],
    quadratic: bool,
    joined: bool,
):
    """Build the kernel that solves rod paths on the CPU.

    `walk`: compute H_II^-1 r_I of every path, and mark worlds with lost or negative pivots; see `rod_substructuring`.

    If paths are `joined`, factors and solution stay at path nodes, for the joints. Otherwise the solution goes to the blocks z.
    """
    nb = 4 if twist else 3
    H, B, M = wp.types.vector(3, linear), wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    Mass, Layout, Along = mass_type(real, quadratic), layout_type(), along_type(real, linear)
    blocks_at = blocks_function(terms, twist, span, real, linear, exact_from, quadratic)
    value = value_function(twist, linear)
    load, store, vector, store_vector = block_functions(nb, linear)
    factor, lower, upper, lower_vector, upper_vector, congruence = block_ldlt.functions(nb, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def walk(
        matrix: wp.array2d(dtype=linear),
        mass: Mass,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        layout: Layout,
        sets: wp.array(dtype=Along),
        rhs: wp.array(dtype=H),
        blocks: int,
        factors: wp.array3d(dtype=linear),
        values: wp.array3d(dtype=linear),
        lost: wp.array(dtype=int),
        z: wp.array(dtype=H),
    ):
        r = wp.tid()
        w = r / layout.count.shape[0]
        c = r - w * layout.count.shape[0]
        if flags[NEEDS_DIRECTION, w] == 0:
            return
        n = layout.count[c]
        shift = first_of(w, blocks)
        lost_pivots = int(0)
        minus = (
            M()
        )  # updates of the diagonal block of this node, of its coupling, and of the next block, by the nodes before
        minus_couple = M()
        minus_next = M()
        before = B()
        before2 = B()
        for k in range(n):
            D, E, F = blocks_at(matrix, mass, flags, scalars, layout, sets, k, c, w)
            L, inverse, lost_here = factor(D - minus)
            lost_pivots += lost_here
            Zb = lower(L, E - minus_couple)
            U = upper(L, inverse, Zb)
            minus = minus_next + congruence(Zb, inverse, Zb)
            u = value(rhs, layout.places, k, c, shift) - before
            before = before2 + u * U
            store(factors, 0, k, r, U)
            if wp.static(span == 2):
                Zc = lower(L, F)
                V = upper(L, inverse, Zc)
                minus_couple = congruence(Zb, inverse, Zc)
                minus_next = congruence(Zc, inverse, Zc)
                before2 = u * V
                store(factors, wp.static(nb**2), k, r, V)
            if wp.static(joined):
                store(factors, wp.static(2 * nb**2), k, r, L)
                store_vector(factors, wp.static(3 * nb**2), k, r, inverse)
            store_vector(values, 0, k, r, upper_vector(L, inverse, lower_vector(L, u)))
        if lost_pivots > 0:
            lost[w] = 1
        e1 = B()
        e2 = B()
        for i in range(n):
            k = n - 1 - i
            u = vector(values, 0, k, r) - load(factors, 0, k, r) * e1
            if wp.static(span == 2):
                u -= load(factors, wp.static(nb**2), k, r) * e2
            e2 = e1
            e1 = u
            if wp.static(joined):
                store_vector(values, 0, k, r, u)
            else:
                node = layout.places[0, k, c]
                if node >= 0:
                    z[node + shift] = H(u[0], u[1], u[2])
                if wp.static(twist):
                    angle = layout.places[1, k, c]
                    if angle >= 0:
                        z[angle + shift] = H(u[3], linear(0.0), linear(0.0))

    return walk

"""BPX multilevel preconditioner of the coupled system: block Jacobi on every level of aggregated nodes, summed.

Nodes are numbered along a space-filling curve of the rest shape. A group of level l has `GROUP`^l neighbours on the curve and three
dofs, a common translation. With P_l the prolongation from groups to nodes and D_l the diagonal blocks of P_l^T H P_l,

    z = D_0^-1 r + sum_l P_l D_l^-1 P_l^T r

(Bramble, Pasciak and Xu 1990; Wu, Wang, Wang and Guo, A GPU-based multilevel additive Schwarz preconditioner for cloth, 2022, with
dense blocks). D_0^-1 r may come from substructuring (`rod_substructuring`). D_l sums the blocks of D_l-1 of its members, and the
blocks of H whose row and column are first in one group at level l.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.linear.sliced_ell import product_functions

GROUP = 8  # members of a group
PIECE = 32  # blocks of H that one thread sums


@cache
def level_kernels(linear):
    """Build the kernels of the levels.

    `collect`: sum blocks of H in a piece of a group's list.
    `gather`: sum and invert the diagonal block of a group.
    `restrict`: sum a vector over the members of a group.
    `correct`: compute the correction of a group.
    `finish`: add the corrections to z, and write r . z.
    """
    H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
    _, free = product_functions(linear)
    nonzero = nonzero_function(linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def collect(
        matrix: wp.array2d(dtype=linear),
        rows: wp.array(dtype=int),
        columns: wp.array(dtype=int),
        fixed: wp.array(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        pieces: int,
        positions: int,
        wanted: wp.array(dtype=int),
        sum_out: wp.array(dtype=M),
    ):
        """Sum the blocks of H in a piece of a group's list, on free dofs."""
        i = wp.tid()
        w = i / pieces
        if wanted[w] == 0:
            return
        k = i - w * pieces
        m = M()
        for index in range(starts[k], starts[k + 1]):
            p = items[index]
            q = p + w * positions
            block = M()
            for a in range(3):
                for b in range(3):
                    block[a, b] = matrix[3 * a + b, q]
            m += wp.cw_mul(block, wp.outer(free(fixed[rows[p]]), free(fixed[columns[p]])))
        sum_out[i] = m

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        piece_sums: wp.array(dtype=M),
        pieces: int,
        starts: wp.array(dtype=int),
        members: wp.array(dtype=M),
        member_count: int,
        groups: int,
        wanted: wp.array(dtype=int),
        sum_out: wp.array(dtype=M),
        inverse_out: wp.array(dtype=M),
    ):
        """Write the diagonal block of a group and the inverse; `members` are the blocks of the level below (none at the first)."""
        i = wp.tid()
        w = i / groups
        if wanted[w] == 0:
            return
        g = i - w * groups
        m = M()
        for k in range(g * wp.static(GROUP), wp.min((g + 1) * wp.static(GROUP), member_count)):
            m += members[k + w * member_count]
        for index in range(starts[g], starts[g + 1]):
            m += piece_sums[index + w * pieces]
        sum_out[i] = m
        s = H()
        for d in range(3):
            s[d] = wp.where(m[d, d] > linear(0.0), linear(1.0) / wp.sqrt(nonzero(m[d, d])), linear(0.0))
        scale = wp.outer(s, s)
        scaled = wp.cw_mul(m, scale)
        for d in range(3):
            scaled[d, d] = linear(1.0)
        inverse = wp.cw_mul(wp.inverse(scaled), scale)
        # Rounding may leave a block of a high level indefinite: the diagonal serves as well.
        if not (wp.determinant(scaled) > linear(1.0e-4)):
            inverse = wp.diag(wp.cw_mul(s, s))
        inverse_out[i] = inverse

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def restrict(
        values: wp.array(dtype=H),
        order: wp.array(dtype=int),
        member_count: int,
        stride: int,
        groups: int,
        wanted: wp.array(dtype=int),
        sum_out: wp.array(dtype=H),
    ):
        """Sum over the members of a group; `order` maps members to blocks at the first level, and is empty above."""
        i = wp.tid()
        w = i / groups
        if wanted[w] != 1:
            return
        g = i - w * groups
        total = H()
        for k in range(g * wp.static(GROUP), wp.min((g + 1) * wp.static(GROUP), member_count)):
            member = k
            if order.shape[0] > 1:
                member = order[k]
            total += values[member + w * stride]
        sum_out[i] = total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def correct(
        inverse: wp.array(dtype=M),
        sums: wp.array(dtype=H),
        above: wp.array(dtype=H),
        above_groups: int,
        groups: int,
        wanted: wp.array(dtype=int),
        correction_out: wp.array(dtype=H),
    ):
        """Write the correction of a group: the sum of its own and the enclosing group's."""
        i = wp.tid()
        w = i / groups
        if wanted[w] != 1:
            return
        g = i - w * groups
        z = inverse[i] * sums[i]
        if above_groups > 0:
            z += above[g / wp.static(GROUP) + w * above_groups]
        correction_out[i] = z

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        residual: wp.array(dtype=H),
        correction: wp.array(dtype=H),
        group: wp.array(dtype=int),
        inactive_mask: wp.array(dtype=wp.uint8),
        groups: int,
        blocks: int,
        wanted: wp.array(dtype=int),
        z: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Add the corrections to z, which holds D_0^-1 r, and write r . z."""
        i = wp.tid()
        w = i / blocks
        if wanted[w] != 1:
            return
        k = i - w * blocks
        y = z[i]
        g = group[k]
        if g >= 0:
            y += wp.cw_mul(correction[g + w * groups], free(inactive_mask[i]))
        z[i] = y
        dots_out[w, k] = wp.dot(residual[i], y)

    return collect, gather, restrict, correct, finish

"""Pairs of nodes with edge tensions: the blocks of cyclic reduction in the mixed axial-force formulation.

The matrix [H r^T; r -s] of `mixed_axial_force` has a tension for each edge, to be eliminated after both of its nodes. A level
eliminates every
other pair of nodes. So tensions between pairs are stored in the pairs that stay: a staying pair has the tensions behind, within and
ahead, an eliminated pair only the tension within. From the next level on, every tension of a pair is between its nodes or ends at
eliminated nodes, and whole pairs can be eliminated.

Alternative: eliminating the tension ahead or behind with a pair. In float32 errors of directions are then as large as the directions
where the rod is fixed there, from EA L^2 / EI = 1e9 on. This order leaves 1e-3 for every EA.

A node has two rows more than dofs: the tension behind, unless stored in the pair before, and, last in a staying pair, the tension
ahead. Rows without a tension are rows of the negative identity.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import MAX_EDGE_STIFFNESS, NEEDS_DIRECTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.linear import mixed_axial_force

TENSIONS = 2  # rows of a node for tensions


@cache
def pair_kernel(kind: RodKind, linear):
    """Build the kernel that assembles pairs.

    `pair`: write the system of wanted rods as a level of `cyclic_reduction.level_rows`, one thread a row of a pair.
    """
    dim, nb = kind.dim, kind.block
    nb2, size = nb**2, nb + TENSIONS
    size2 = size**2
    edge_row, slack_row = kind.vertex_strains * kind.window, kind.factor_rows

    @wp.func
    def edge_of(k: int, row: int, n: int):
        """Return the edge of the tension in a row of node k, -1 for none."""
        if row == wp.static(nb):
            return wp.where(k % 4 == 2, -1, k - 1)
        return wp.where(k % 4 == 1 and k + 1 < n, k, -1)

    @wp.func
    def coupling(F: wp.array3d(dtype=linear), fixed: wp.array2d(dtype=wp.uint8), edge: int, k: int, d: int, r: int):
        """Return the entry between the tension of an edge and dof d of node k."""
        if edge < 0 or k < edge or k > edge + 1 or d >= wp.static(dim):
            return linear(0.0)
        if F[wp.static(slack_row), edge, r] == linear(0.0) or ((int(fixed[k, r]) >> d) & 1) == 1:
            return linear(0.0)
        t = F[wp.static(edge_row) + d, edge, r]
        return wp.where(k == edge, -t, t)

    @wp.func
    def entry(
        blocks: wp.array3d(dtype=linear),
        F: wp.array3d(dtype=linear),
        fixed: wp.array2d(dtype=wp.uint8),
        k: int,
        i: int,
        l: int,
        j: int,
        n: int,
        r: int,
    ):
        """Return the entry between row i of node k and row j of node l >= k."""
        if k == l and i == j and (k >= n or i >= wp.static(nb)):
            diagonal = linear(1.0)
            if i >= wp.static(nb):
                diagonal = linear(-1.0)
                edge = edge_of(k, i, n)
                if k < n and edge >= 0:
                    slack = F[wp.static(slack_row), edge, r]
                    if slack > linear(0.0):
                        diagonal = -slack
            return diagonal
        if l >= n or (i >= wp.static(nb) and j >= wp.static(nb)):
            return linear(0.0)
        if i >= wp.static(nb):
            return coupling(F, fixed, edge_of(k, i, n), l, j, r)
        if j >= wp.static(nb):
            return coupling(F, fixed, edge_of(l, j, n), k, i, r)
        if l > k + 2:
            return linear(0.0)
        return blocks[(l - k) * wp.static(nb2) + i * wp.static(nb) + j, k, r]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pair(
        blocks: wp.array3d(dtype=linear),
        F: wp.array3d(dtype=linear),
        fixed: wp.array2d(dtype=wp.uint8),
        rhs: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        matrix_out: wp.array3d(dtype=linear),
        right_out: wp.array3d(dtype=linear),
    ):
        c, b, r = wp.tid()
        if wanted[r] == 0:
            return
        n = count[r]
        p = c // wp.static(size)
        i = c - p * wp.static(size)
        k = 2 * b + p
        value = linear(0.0)
        if k < n and i < wp.static(nb):
            value = rhs[i, k, r]
        right_out[c, b, r] = value
        for j in range(wp.static(size)):
            offset = i * wp.static(size) + j
            for q in range(p, 2):
                matrix_out[(p + q) * wp.static(size2) + offset, b, r] = entry(
                    blocks, F, fixed, k, i, 2 * b + q, j, n, r
                )
            for q in range(2):
                value_ahead = entry(blocks, F, fixed, k, i, 2 * b + 2 + q, j, n, r)
                matrix_out[(3 + 2 * p + q) * wp.static(size2) + offset, b, r] = value_ahead

    return pair


@cache
def unpair_kernel(kind: RodKind, real, linear):
    """Build the kernel that extracts directions.

    `unpair`: write the directions of nodes and the lengthening of edges of wanted rods.
    """
    nb, dim = kind.block, kind.dim
    V, slack_row = wp.types.vector(dim, real), kind.factor_rows
    longer = mixed_axial_force.longer_function(dim, real, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def unpair(
        solution: wp.array3d(dtype=linear),
        F: wp.array3d(dtype=linear),
        x: wp.array2d(dtype=V),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        direction_out: wp.array3d(dtype=linear),
    ):
        k, r = wp.tid()
        n = count[r]
        if flags[NEEDS_DIRECTION, r] == 0 or k >= n:
            return
        for d in range(wp.static(nb)):
            direction_out[d, k, r] = solution[d, k, r]
        if k == n - 1:
            return
        axial_force = solution[wp.static(nb), k + 1, r]
        if k % 4 == 1:
            axial_force = solution[wp.static(nb + 1), k, r]
        step = V()
        for d in range(wp.static(dim)):
            step[d] = real(solution[d, k + 1, r] - solution[d, k, r])
        edge = x[k + 1, r] - x[k, r]
        per_root = linear(real(1.0) / wp.sqrt(scalars[MAX_EDGE_STIFFNESS, r]))
        direction_out[wp.static(nb), k, r] = longer(F[wp.static(slack_row), k, r], axial_force, per_root, edge, step)

    return unpair

"""Joint Schur complement: diagonal blocks of joints after elimination of rod interiors; see `rod_substructuring`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.linear.coupled_pcg import inverse_function
from ddg_warp.kernels.linear.sliced_ell import product_functions


@cache
def coupling_functions(linear):
    """Return the device functions `multiply(matrix, p, v)` and `block(matrix, p)`.

    `multiply`: block p of H times v.
    `block`: block p of H.
    """
    H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)

    @wp.func
    def multiply(matrix: wp.array2d(dtype=linear), p: int, v: H):
        return H(
            matrix[0, p] * v[0] + matrix[1, p] * v[1] + matrix[2, p] * v[2],
            matrix[3, p] * v[0] + matrix[4, p] * v[1] + matrix[5, p] * v[2],
            matrix[6, p] * v[0] + matrix[7, p] * v[1] + matrix[8, p] * v[2],
        )

    @wp.func
    def block(matrix: wp.array2d(dtype=linear), p: int):
        m = M()
        for i in range(3):
            for j in range(3):
                m[i, j] = matrix[3 * i + j, p]
        return m

    return multiply, block


@cache
def joint_kernels(linear):
    """Build the kernels of joints.

    `factorise_joints`: write P, Q and R of every joint, from responses `values` to unit probes; H_jj serves where S_jj is
    indefinite, which counts in `lost`.
    `solve_joints`: compute z_J.

    `more`, `cross`: blocks of contact on the diagonal and between both blocks of a joint, at b (W N,); empty without.

    A joint has one dof block or two (a node and the rotation of its rigid joint), a and b, rows 2 m and 2 m + 1 of all joints. With P
    = S_aa^-1, Q = P S_ab and R = (S_bb - S_ba Q)^-1 the solution is z_b = R (t_b - Q^T t_a), z_a = P t_a - Q z_b.
    """
    H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
    _, free = product_functions(linear)
    multiply, block = coupling_functions(linear)
    invert, nonzero = inverse_function(linear), nonzero_function(linear)

    @wp.func
    def inverse_or(m: M, instead: M, f: H):
        """Return the inverse of m on the free dofs f, and True if m is definite.

        If m is not definite, `instead` is inverted, or as a last resort its diagonal.
        """
        inverse, definite = invert(wp.cw_mul(m, wp.outer(f, f)), f)
        if not definite:
            inverse, good = invert(wp.cw_mul(instead, wp.outer(f, f)), f)
            if not good:
                for d in range(3):
                    inverse[d, d] = f[d] / nonzero(wp.abs(instead[d, d]))
        return inverse, definite

    @wp.func
    def matrix_row_product(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        values: wp.array3d(dtype=linear),
        where: wp.array(dtype=int),
        width: int,
        nodes: int,
        row: int,
        first: int,
        shift: int,
    ):
        """Return a row of H_JI times the values of paths, with columns from `shift` on."""
        y = H()
        for index in range(starts[row], starts[row + 1]):
            p = items[index]
            b = columns[p]
            k = where[b] / width
            s = shift + where[b] - k * width
            v = H()
            if b < nodes:
                v = H(values[0, k, s], values[1, k, s], values[2, k, s])
            else:
                v[0] = values[values.shape[0] - 1, k, s]
            y += multiply(matrix, p + first, v)
        return y

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def factorise_joints(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        values: wp.array3d(dtype=linear),
        where: wp.array(dtype=int),
        width: int,
        nodes: int,
        pairs: wp.array2d(dtype=int),
        block_positions: wp.array2d(dtype=int),
        colour: wp.array(dtype=int),
        size: int,
        fixed: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        positions: int,
        blocks: int,
        more: wp.array(dtype=M),
        cross: wp.array(dtype=M),
        parts_out: wp.array2d(dtype=M),
        lost: wp.array(dtype=int),
    ):
        i = wp.tid()
        joints = pairs.shape[0]
        w = i / joints
        if wanted[w] == 0:
            return
        m = i - w * joints
        first = w * positions
        all_columns = wanted.shape[0] * width
        a = pairs[m, 0]
        b = pairs[m, 1]
        P = M()
        Q = M()
        R = M()
        aa = M()
        ab = M()
        bb = M()
        if a >= 0:
            for d in range(3):
                shift = (colour[m] * size + d) * all_columns + w * width
                y = matrix_row_product(matrix, columns, starts, items, values, where, width, nodes, 2 * m, first, shift)
                for e in range(3):
                    aa[e, d] = y[e]
            f = free(fixed[a])
            H_aa = block(matrix, block_positions[m, 0] + first)
            if more.shape[0] > 0:
                H_aa += more[a + w * blocks]
            P, definite = inverse_or(H_aa + linear(0.5) * (aa + wp.transpose(aa)), H_aa, f)
            if not definite:
                lost[w] = 1
        if b >= 0:
            for d in range(3):
                shift = (colour[m] * size + 3 + d) * all_columns + w * width
                y = matrix_row_product(
                    matrix, columns, starts, items, values, where, width, nodes, 2 * m + 1, first, shift
                )
                for e in range(3):
                    bb[e, d] = y[e]
                if a >= 0:
                    y = matrix_row_product(
                        matrix, columns, starts, items, values, where, width, nodes, 2 * m, first, shift
                    )
                    for e in range(3):
                        ab[e, d] = y[e]
            f = free(fixed[b])
            if a >= 0:
                if block_positions[m, 2] >= 0:
                    ab += block(matrix, block_positions[m, 2] + first)
                if cross.shape[0] > 0:
                    ab += cross[b + w * blocks]
                ab = wp.cw_mul(ab, wp.outer(free(fixed[a]), f))
                Q = P * ab
            H_bb = block(matrix, block_positions[m, 1] + first)
            if more.shape[0] > 0:
                H_bb += more[b + w * blocks]
            R, definite = inverse_or(H_bb + linear(0.5) * (bb + wp.transpose(bb)) - wp.transpose(ab) * Q, H_bb, f)
            if not definite:
                lost[w] = 1
        parts_out[0, i] = P
        parts_out[1, i] = Q
        parts_out[2, i] = R

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solve_joints(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        values: wp.array3d(dtype=linear),
        where: wp.array(dtype=int),
        width: int,
        nodes: int,
        pairs: wp.array2d(dtype=int),
        parts: wp.array2d(dtype=M),
        residual: wp.array(dtype=H),
        wanted: wp.array(dtype=int),
        blocks: int,
        positions: int,
        moved_out: wp.array(dtype=H),
    ):
        i = wp.tid()
        joints = pairs.shape[0]
        w = i / joints
        if wanted[w] != 1:
            return
        m = i - w * joints
        first = w * positions
        shift = w * width
        a = pairs[m, 0]
        b = pairs[m, 1]
        t = H()
        if a >= 0:
            t = residual[a + w * blocks]
            t -= matrix_row_product(matrix, columns, starts, items, values, where, width, nodes, 2 * m, first, shift)
        u = H()
        if b >= 0:
            u = residual[b + w * blocks]
            u -= matrix_row_product(
                matrix, columns, starts, items, values, where, width, nodes, 2 * m + 1, first, shift
            )
        z = parts[2, i] * (u - t * parts[1, i])
        moved_out[2 * i] = parts[0, i] * t - parts[1, i] * z
        moved_out[2 * i + 1] = z

    return factorise_joints, solve_joints

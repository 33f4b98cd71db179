"""Substructuring preconditioner: rod interiors are eliminated exactly, joints by their diagonal Schur complement blocks.

Let I be the dofs of rods between joints, a block-banded matrix H_II for each rod path, and J the dofs of joints. Exact elimination
of I leaves the joint Schur complement S = H_JJ - H_JI H_II^-1 H_IJ, of which the preconditioner keeps the blocks of single joints:

    w = H_II^-1 r_I ,    z_J = S_jj^-1 (r_J - H_JI w)_j ,    z_I = H_II^-1 (r_I - H_IJ z_J)

(Smith, Bjorstad and Gropp, Domain Decomposition, 1996, ch. 4). The preconditioner is symmetric and positive definite. S knows rods
only by their ends, so that the number of iterations does not depend on the nodes of a rod.

Columns of S come from solves for unit displacements of joints, V = -H_II^-1 H_IJ. Graph colouring: joints on one rod have different
colours, and joints of one colour are probed together. Where a rod continues over hinged joints, a column also holds a little of the
response to the joints after the next. If no path meets two joints of one colour, z_I = w + V z_J takes no second solve. Blocks of S
that rounding leaves indefinite are replaced by blocks of H. All other dof blocks keep block Jacobi.

Measured: iterations to a residual of 1e-3 for the gridshell of `scenes.gridshell_dome` in equilibrium under its weight, at 2, 8 and
32 edges between crossings: block Jacobi 43, 250, 2378, additive overlapping rods 14, 35, 51, this 13, 16, 16.

Columns of paths are counted world by world; a solve for colour and dof d is in column d * columns + r.

Why not shared with `kernels.newton.rod_sweep` and `kernels.linear.cyclic_reduction`: paths are solved once an iteration of PCG, for
several right-hand sides from stored factors. The sweep eliminates once an iteration of Newton's method and forms its blocks itself.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS, first_of, until_function
from ddg_warp.kernels.linear.joint_schur import coupling_functions
from ddg_warp.kernels.linear.rod_dof_map import (
    angle_function,
    path_node_dofs,
    path_node_functions,
    solve_functions,
    value_function,
)
from ddg_warp.kernels.linear.rod_matrix import (
    block_functions,
    factor_function,
    substitute_all_function,
    substitute_function,
)
from ddg_warp.kernels.linear.sliced_ell import ALL_INACTIVE


@cache
def serial_path_nodes_kernel(twist: bool, span: int, linear, mixed_axial: bool = False):
    """Build the kernel that solves paths without joints on the CPU, one thread a path.

    `solve`: load, solve and finish of `path_kernels` in one.
    """
    nb = path_node_dofs(twist, mixed_axial)
    H = wp.types.vector(3, linear)
    _, _, vector, store_vector = block_functions(nb, linear)
    substitute = substitute_function(nb, span, linear, tensions=int(mixed_axial))
    rhs, hand = solve_functions(twist, linear, mixed_axial)
    value, angle_of = value_function(twist, linear, mixed_axial), angle_function(twist)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solve(
        factors: wp.array3d(dtype=linear),
        residual: wp.array(dtype=H),
        places: wp.array3d(dtype=int),
        fixed_dofs: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        values: wp.array3d(dtype=linear),
        z: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        r = wp.tid()
        w = r / count.shape[0]
        c = r - w * count.shape[0]
        if wanted[w] != 1 or idle[r] != 0:
            return
        n, first = count[c], first_of(w, blocks)
        for k in range(n):
            store_vector(
                values, 0, k, r, rhs(residual, places[0, k, c], angle_of(places, k, c), fixed_dofs[k, c], first)
            )
        substitute(factors, values, values, n, r, r)
        for k in range(n):
            b = value(residual, places, k, c, first)
            hand(vector(values, 0, k, r), b, places[0, k, c], angle_of(places, k, c), w, first, z, dots_out)

    return solve


@cache
def path_kernels(twist: bool, span: int, linear, sides: int, serial: bool, mixed_axial: bool = False):
    """Build the kernels of substructuring.

    `factorise`: factorise H_II.
    `load`: write right-hand sides of rod interiors.
    `solve`: solve with H_II.
    `solve_all`: solve for all `sides` unit displacements of a joint at once.
    `follow`: add V z_J.
    `finish`: write z of every block and r . z.
    `spread`: write the wanted columns of wanted worlds.
    `note`: mark worlds that lost pivots.
    """
    nb = path_node_dofs(twist, mixed_axial)
    parts, angle = 1 + twist, 2 + twist  # dof blocks of a path node (node, twist angle); index of the twist angle
    H, B = wp.types.vector(3, linear), wp.types.vector(nb, linear)
    _, _, _, store_vector = block_functions(nb, linear)
    factor = factor_function(nb, span, linear, int(mixed_axial))
    substitute = substitute_function(nb, span, linear, tensions=int(mixed_axial))
    substitute_all = substitute_all_function(nb, span, linear, sides)
    free_of, _ = path_node_functions(twist, linear, mixed_axial)
    until = until_function(serial)
    multiply, _ = coupling_functions(linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def factorise(
        blocks: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        factors: wp.array3d(dtype=linear),
        lost: wp.array(dtype=int),
    ):
        """Factorise H_II; lost and negative pivots become positive, for definite solves, and raise `lost`."""
        r = wp.tid()
        w = r / count.shape[0]
        if wanted[w] != 0 and idle[r] == 0:
            if factor(blocks, factors, count[r - w * count.shape[0]], r) > 0:
                lost[w] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def load(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        places: wp.array3d(dtype=int),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        fixed_dofs: wp.array2d(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        joint_row: wp.array(dtype=int),
        joint_rows: int,
        wanted: wp.array(dtype=int),
        blocks: int,
        positions: int,
        with_residual: int,
        with_joints: int,
        residual: wp.array(dtype=H),
        moved: wp.array(dtype=H),
        values_out: wp.array3d(dtype=linear),
    ):
        """Write r_I (if `with_residual`) - H_IJ z_J (if `with_joints`), with z_J in `moved`."""
        start, s = wp.tid()
        worlds = wanted.shape[0]
        q = s / (worlds * count.shape[0])
        r = s - q * worlds * count.shape[0]
        w = r / count.shape[0]
        c = r - w * count.shape[0]
        if wanted[w] != 1 or idle[r] != 0 or start >= count[c]:
            return
        for k in range(start, until(start, count[c])):
            u = B()
            for part in range(wp.static(parts)):
                block = places[part, k, c]
                if block >= 0:
                    v = H()
                    if with_residual != 0:
                        v = residual[block + w * blocks]
                    if with_joints != 0:
                        for index in range(starts[block], starts[block + 1]):
                            p = items[index]
                            j = joint_row[columns[p]]
                            v -= multiply(matrix, p + w * positions, moved[(q * worlds + w) * joint_rows + j])
                    if part == 0:
                        for d in range(3):
                            u[d] = v[d]
                    else:
                        u[wp.static(angle)] = v[0]
            if fixed_dofs[k, c] != wp.uint8(0):
                u = wp.cw_mul(u, free_of(fixed_dofs[k, c]))
            store_vector(values_out, 0, k, s, u)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solve(
        factors: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        values: wp.array3d(dtype=linear),
    ):
        """Replace values by H_II^-1 times values."""
        s = wp.tid()
        columns = wanted.shape[0] * count.shape[0]
        r = s - s / columns * columns
        w = r / count.shape[0]
        if wanted[w] == 1 and idle[r] == 0:
            substitute(factors, values, values, count[r - w * count.shape[0]], r, s)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def spread(wanted: wp.array(dtype=int), idle: wp.array(dtype=int), columns: int, wanted_out: wp.array(dtype=int)):
        """Write the wanted columns, for `kernels.linear.cyclic_reduction`."""
        r = wp.tid()
        wanted_out[r] = wp.where(wanted[r / columns] == 1 and idle[r] == 0, 1, 0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def note(columns: int, lost_pivots: wp.array(dtype=int), lost: wp.array(dtype=int)):
        """Mark worlds that lost pivots, and reset the counters."""
        r = wp.tid()
        if lost_pivots[r] > 0:
            lost[r / columns] = 1
        lost_pivots[r] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solve_all(
        factors: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        values: wp.array3d(dtype=linear),
    ):
        """Replace the values of all colours and unit displacements by H_II^-1 times values."""
        s = wp.tid()
        columns = wanted.shape[0] * count.shape[0]
        colour = s / columns
        r = s - colour * columns
        w = r / count.shape[0]
        if wanted[w] == 1 and idle[r] == 0:
            first = colour * wp.static(sides) * columns + r
            substitute_all(factors, values, count[r - w * count.shape[0]], r, first, columns)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def follow(
        joint_of_colour: wp.array3d(dtype=int),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        responses: wp.array3d(dtype=linear),
        moved: wp.array(dtype=H),
        joint_rows: int,
        values: wp.array3d(dtype=linear),
    ):
        """Add V z_J, with z_J in `moved`; `joint_of_colour` is the joint of each colour on a node's path, or -1."""
        k, r = wp.tid()
        columns = wanted.shape[0] * count.shape[0]
        w = r / count.shape[0]
        c = r - w * count.shape[0]
        if wanted[w] != 1 or k >= count[c]:
            return
        u = B()
        for colour in range(joint_of_colour.shape[0]):
            m = joint_of_colour[colour, k, c]
            if m >= 0:
                for d in range(wp.static(sides)):
                    z = moved[w * joint_rows + 2 * m + d // 3]
                    s = (colour * wp.static(sides) + d) * columns + r
                    for i in range(wp.static(nb)):
                        u[i] = u[i] + responses[i, k, s] * z[d % 3]
        for i in range(wp.static(nb)):
            values[i, k, r] = values[i, k, r] + u[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        residual: wp.array(dtype=H),
        values: wp.array3d(dtype=linear),
        where: wp.array(dtype=int),
        width: int,
        joint_row: wp.array(dtype=int),
        joint_rows: int,
        moved: wp.array(dtype=H),
        inactive_mask: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        blocks: int,
        nodes: int,
        z: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """Write z of blocks of rods and joints, over the result of block Jacobi, and r . z."""
        start = wp.tid()
        for i in range(start, until(start, z.shape[0])):
            w = i / blocks
            if wanted[w] != 1 or inactive_mask[i] == ALL_INACTIVE:
                continue
            b = i - w * blocks
            entry = where[b]
            if entry >= 0:
                k = entry / width
                r = w * width + entry - k * width
                if b < nodes:
                    z[i] = H(values[0, k, r], values[1, k, r], values[2, k, r])
                else:
                    z[i] = H(values[wp.static(angle), k, r], linear(0.0), linear(0.0))
            if joint_row[b] >= 0:
                z[i] = moved[w * joint_rows + joint_row[b]]
            dots_out[w, b] = wp.dot(residual[i], z[i])

    return factorise, load, solve, solve_all, follow, finish, spread, note

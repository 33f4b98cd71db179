"""The chain preconditioner of a net: rods are eliminated between their joints, the joints with what the rods do to them.

Let I be the dofs of rods that lie between joints, a block-banded matrix H_II for each rod, and J those of the joints. The exact
elimination of I leaves the joints with S = H_JJ - H_JI H_II^-1 H_IJ, of which the preconditioner keeps the blocks of single joints:

    w = H_II^-1 r_I ,    z_J = S_jj^-1 (r_J - H_JI w)_j ,    z_I = H_II^-1 (r_I - H_IJ z_J)

(a substructuring method; Smith, Bjorstad and Gropp, Domain Decomposition, 1996, ch. 4). It is symmetric and positive definite, and
S knows rods only by their ends: the number of iterations does not depend on the nodes of a rod. Columns of S come from solves for
unit movements of joints, V = -H_II^-1 H_IJ; joints that meet on a rod have different colours, those of one colour move at once. (A rod
bends on over hinged joints, so that there a column also holds a little of what the joints after the next do.) Where no chain meets two
joints of one colour, z_I = w + V z_J takes no second solve. Blocks of S that rounding leaves indefinite give way to those of H. All
other blocks keep block Jacobi.

For the gridshell of `scenes.gridshell_dome` at rest under its weight, iterations to a residual of 1e-3 at 2, 8 and 32 edges between
crossings: block Jacobi 43, 250, 2378; rods that overlap in their joints, added up, 14, 35, 51; this 13, 16, 16.

Columns of chains are counted world by world, a solve for colour and dof d lies in column d * columns + r.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.matrix.block_band import (
    block_functions,
    factor_function,
    substitute_all_function,
    substitute_function,
)
from ddg_warp.kernels.matrix.chain_places import (
    angle_function,
    place_dofs,
    place_functions,
    solve_functions,
    value_function,
)
from ddg_warp.kernels.matrix.sliced import BARRED
from ddg_warp.kernels.solve.joints import coupling_functions
from ddg_warp.kernels.threads import CPU_OPTIONS, first_of, until_function


@cache
def walk_places_kernel(twist: bool, span: int, linear, split: bool = False):
    """solve(...) of chains without joints by a thread each, for the CPU, which has one: load, solve and finish of `chain_kernels`."""
    nb = place_dofs(twist, split)
    H = wp.types.vector(3, linear)
    _, _, vector, put = block_functions(nb, linear)
    substitute = substitute_function(nb, span, linear, tensions=int(split))
    right, hand = solve_functions(twist, linear, split)
    value, angle_of = value_function(twist, linear, split), angle_function(twist)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solve(
        factors: wp.array3d(dtype=linear),
        residual: wp.array(dtype=H),
        places: wp.array3d(dtype=int),
        held: wp.array2d(dtype=wp.uint8),
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
            put(values, 0, k, r, right(residual, places[0, k, c], angle_of(places, k, c), held[k, c], first))
        _product = substitute(factors, values, values, n, r, r)
        for k in range(n):
            b = value(residual, places, k, c, first)
            hand(vector(values, 0, k, r), b, places[0, k, c], angle_of(places, k, c), w, first, z, dots_out)

    return solve


@cache
def chain_kernels(twist: bool, span: int, linear, sides: int, serial: bool, split: bool = False):
    """factorise(...): H_II; load(...), solve(...): its solutions; finish(...): z of every block and r . z.

    solve_all(...) takes all movements of a joint, `sides`, at once; follow(...) adds V z_J. Between worlds and their columns are
    spread(...) and note(...).
    """
    nb = place_dofs(twist, split)
    parts, angle = 1 + twist, 2 + twist  # blocks of a place, node and angle of the edge ahead; where that is
    H, B = wp.types.vector(3, linear), wp.types.vector(nb, linear)
    _, _, _, put = block_functions(nb, linear)
    factor = factor_function(nb, span, linear, int(split))
    substitute = substitute_function(nb, span, linear, tensions=int(split))
    substitute_all = substitute_all_function(nb, span, linear, sides)
    free_of, _ = place_functions(twist, linear, split)
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
        """Lost and negative pivots become positive ones, so that the solves stay definite, and are noted."""
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
        held: wp.array2d(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        joint_row: wp.array(dtype=int),
        joint_rows: int,
        wanted: wp.array(dtype=int),
        blocks: int,
        positions: int,
        own: int,
        joined: int,
        residual: wp.array(dtype=H),
        moved: wp.array(dtype=H),
        values_out: wp.array3d(dtype=linear),
    ):
        """r_I (if `own`) - H_IJ z_J (if `joined`), with z_J in `moved`."""
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
                at = places[part, k, c]
                if at >= 0:
                    v = H()
                    if own != 0:
                        v = residual[at + w * blocks]
                    if joined != 0:
                        for index in range(starts[at], starts[at + 1]):
                            p = items[index]
                            j = joint_row[columns[p]]
                            v -= multiply(matrix, p + w * positions, moved[(q * worlds + w) * joint_rows + j])
                    if part == 0:
                        for d in range(3):
                            u[d] = v[d]
                    else:
                        u[wp.static(angle)] = v[0]
            if held[k, c] != wp.uint8(0):
                u = wp.cw_mul(u, free_of(held[k, c]))
            put(values_out, 0, k, s, u)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solve(
        factors: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        values: wp.array3d(dtype=linear),
    ):
        """H_II^-1 of the values, in their place."""
        s = wp.tid()
        columns = wanted.shape[0] * count.shape[0]
        r = s - s / columns * columns
        w = r / count.shape[0]
        if wanted[w] == 1 and idle[r] == 0:
            _product = substitute(factors, values, values, count[r - w * count.shape[0]], r, s)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def spread(wanted: wp.array(dtype=int), idle: wp.array(dtype=int), columns: int, wanted_out: wp.array(dtype=int)):
        """For `kernels.solve.cyclic_reduction`: which columns are wanted."""
        r = wp.tid()
        wanted_out[r] = wp.where(wanted[r / columns] == 1 and idle[r] == 0, 1, 0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def note(columns: int, bad: wp.array(dtype=int), lost: wp.array(dtype=int)):
        """Which worlds lost pivots; starts counting them anew."""
        r = wp.tid()
        if bad[r] > 0:
            lost[r / columns] = 1
        bad[r] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solve_all(
        factors: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        idle: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        values: wp.array3d(dtype=linear),
    ):
        """The same for every colour of joints and all of its movements."""
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
        met: wp.array3d(dtype=int),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        responses: wp.array3d(dtype=linear),
        moved: wp.array(dtype=H),
        joint_rows: int,
        values: wp.array3d(dtype=linear),
    ):
        """Adds V z_J, with z_J in `moved`; `met` is the joint of each colour that the chain of a place meets, -1 for none."""
        k, r = wp.tid()
        columns = wanted.shape[0] * count.shape[0]
        w = r / count.shape[0]
        c = r - w * count.shape[0]
        if wanted[w] != 1 or k >= count[c]:
            return
        u = B()
        for colour in range(met.shape[0]):
            m = met[colour, k, c]
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
        barred: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        blocks: int,
        nodes: int,
        z: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        """z of blocks of rods and joints beside what block Jacobi left there, and r . z."""
        start = wp.tid()
        for i in range(start, until(start, z.shape[0])):
            w = i / blocks
            if wanted[w] != 1 or barred[i] == BARRED:
                continue
            b = i - w * blocks
            at = where[b]
            if at >= 0:
                k = at / width
                r = w * width + at - k * width
                if b < nodes:
                    z[i] = H(values[0, k, r], values[1, k, r], values[2, k, r])
                else:
                    z[i] = H(values[wp.static(angle), k, r], linear(0.0), linear(0.0))
            if joint_row[b] >= 0:
                z[i] = moved[w * joint_rows + joint_row[b]]
            dots_out[w, b] = wp.dot(residual[i], z[i])

    return factorise, load, solve, solve_all, follow, finish, spread, note

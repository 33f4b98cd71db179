"""Line search of few, long rods, one thread a node; `judge` and `rod_pcg.take_kernel` use one thread a rod.

Sums over a rod run over fixed ranges of about the square root of its nodes, one thread a range, then over the ranges, one thread a
rod. The order of summation is fixed.

Why not shared with `kernels.newton.coupled_newton`: two launches sum and decide for each rod, and repeat indefinite iterates. There
tiles of dof blocks are summed, and decisions set forcing terms of PCG, allow contact to cut steps, and excuse bodies.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import (
    ANGLE_STEP_LEFT,
    ANY_ACTIVE,
    DROP_COMPRESSION,
    ITERATE_ACTION,
    ITERATION,
    LOST_PIVOTS,
    LOST_PIVOTS_TOTAL,
    NEEDS_DIRECTION,
    PREDICTED_DECREASE,
    STATUS,
    STEP_LENGTH,
    STRAIGHT_ROTATION_LIMIT,
    projected_limit_function,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.newton.line_search import NEED_DIRECTION, STOP, line_search_functions
from ddg_warp.kernels.newton.rod_iterate import MOVE_STRAIGHT, ROTATE_EDGES


@cache
def sum_kernels(kind: RodKind, real, linear):
    """Build the kernels of partial sums over ranges of nodes.

    `weigh`: sum energy changes, rounding and residuals.
    `gauge`: sum r . d and find the largest rotation of a direction.

    Range i of a rod has its nodes i, i + ranges, ..., so that neighbouring threads read neighbouring nodes.
    """
    dim, nb = kind.dim, kind.block
    V = wp.types.vector(dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def weigh(
        residual: wp.array3d(dtype=linear),
        change: wp.array2d(dtype=real),
        noise: wp.array2d(dtype=linear),
        count: wp.array(dtype=int),
        status: wp.array(dtype=int),
        ranges: int,
        partial_out: wp.array3d(dtype=real),
    ):
        """Sum energy changes, their rounding and squared residuals; find the largest residual component."""
        i, r = wp.tid()
        if status[r] != 0:
            return
        total = real(0.0)
        rounding = real(0.0)
        square = real(0.0)
        worst = real(0.0)
        for k in range(i, count[r], ranges):
            total += change[k, r]
            rounding += real(noise[k, r])
            for d in range(wp.static(nb)):
                size = wp.abs(real(residual[d, k, r]))
                worst = wp.max(worst, size)
                square += size * size
        partial_out[0, i, r] = total
        partial_out[1, i, r] = rounding
        partial_out[2, i, r] = square
        partial_out[3, i, r] = worst

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gauge(
        residual: wp.array3d(dtype=linear),
        direction: wp.array3d(dtype=linear),
        x: wp.array2d(dtype=V),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        ranges: int,
        base_out: wp.array2d(dtype=V),
        partial_out: wp.array3d(dtype=real),
    ):
        """Write partial sums of r . d and the largest squared edge rotation; store the iterate as base of the step."""
        i, r = wp.tid()
        if wanted[r] == 0:
            return
        total = real(0.0)
        rotation = real(0.0)
        for k in range(i, count[r], ranges):
            x_k = x[k, r]
            base_out[k, r] = x_k
            for d in range(wp.static(nb)):
                total += real(residual[d, k, r]) * real(direction[d, k, r])
            if k > 0:
                bent = V()
                for d in range(wp.static(dim)):
                    bent[d] = real(direction[d, k, r] - direction[d, k - 1, r])
                rotation = wp.max(rotation, wp.length_sq(bent) / wp.length_sq(x_k - x[k - 1, r]))
        partial_out[0, i, r] = total
        partial_out[1, i, r] = rotation

    return weigh, gauge


@cache
def decide_kernels(kind: RodKind, real, linear, exact: bool):
    """Build the kernels of decisions from partial sums.

    `judge`: test the iterate of a rod.
    `take`: set the step length along a direction.

    `exact` as in `rod_pcg.repeat_kernel`.
    """
    balanced, decide = line_search_functions(kind.twist, real)
    out_of_patience = projected_limit_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def judge(
        partial: wp.array3d(dtype=real),
        ranges: int,
        floor: real,
        max_iterations: int,
        max_halvings: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
    ):
        r = wp.tid()
        flags[NEEDS_DIRECTION, r] = 0
        flags[ITERATE_ACTION, r] = 0
        flags[LOST_PIVOTS, r] = 0
        if balanced(flags, scalars, r):
            return
        total = real(0.0)
        rounding = real(0.0)
        square = real(0.0)
        worst = real(0.0)
        for i in range(ranges):
            total += partial[0, i, r]
            rounding += partial[1, i, r]
            square += partial[2, i, r]
            worst = wp.max(worst, partial[3, i, r])
        if flags[ITERATION, r] == 0:
            flags[LOST_PIVOTS_TOTAL, r] = 0
        taken = scalars[STEP_LENGTH, r]
        action = decide(total, rounding * floor, square, worst, max_iterations, max_halvings, flags, scalars, r)
        if action == wp.static(STOP):
            return
        flags[ANY_ACTIVE, 0] = 1
        if action == wp.static(NEED_DIRECTION):
            flags[NEEDS_DIRECTION, r] = 1
        else:
            flags[ITERATE_ACTION, r] = action
            scalars[ANGLE_STEP_LEFT, r] = scalars[STEP_LENGTH, r] - taken

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def take(
        partial: wp.array3d(dtype=real),
        ranges: int,
        rotation_cap: real,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
    ):
        r = wp.tid()
        if flags[NEEDS_DIRECTION, r] == 0:
            return
        if flags[LOST_PIVOTS, r] > 0 and flags[DROP_COMPRESSION, r] == 0:
            # The matrix is indefinite: repeat the iterate with compression dropped.
            flags[DROP_COMPRESSION, r] = 1
            flags[ITERATION, r] = flags[ITERATION, r] - 1
            scalars[STEP_LENGTH, r] = real(0.0)
            return
        if wp.static(exact):
            if out_of_patience(flags, scalars, r):
                return
        flags[LOST_PIVOTS_TOTAL, r] = flags[LOST_PIVOTS_TOTAL, r] + flags[LOST_PIVOTS, r]
        total = real(0.0)
        rotation = real(0.0)
        for i in range(ranges):
            total += partial[0, i, r]
            rotation = wp.max(rotation, partial[1, i, r])
        if not wp.isfinite(total):
            flags[STATUS, r] = wp.static(outcome.NON_FINITE)
            return
        whole = real(1.0)
        if rotation > rotation_cap * rotation_cap:
            whole = rotation_cap / wp.sqrt(rotation)
        scalars[STEP_LENGTH, r] = whole
        scalars[ANGLE_STEP_LEFT, r] = whole
        scalars[PREDICTED_DECREASE, r] = total
        flags[ITERATE_ACTION, r] = wp.where(
            rotation > scalars[STRAIGHT_ROTATION_LIMIT, r] * scalars[STRAIGHT_ROTATION_LIMIT, r],
            wp.static(ROTATE_EDGES),
            wp.static(MOVE_STRAIGHT),
        )

    return judge, take

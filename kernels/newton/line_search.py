"""Armijo line search and convergence test of a rod, from sums over its nodes; of assembled rods also the sums, in a fixed order.

A rod stops where it has converged. Otherwise its iterate is accepted, or the step is shortened, by Armijo's rule (c = 1e-4) on the
energy. If the predicted decrease is below the rounding floor, a residual that has not grown much is accepted.

In float32 the rounding floor of a residual may be much of the load itself, and far above actual rounding errors. A residual above
`ROUNDED` of the load scale but within the floor ends a solve if the last Newton step was small. It has moved the node by less than
`SETTLED` of the length of the rod, or rotated the edge by less than `SETTLED`. Otherwise `POLISHES` more iterations follow, and
such solves are reported, see `Integrator`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import (
    ANGLE_STEP_LEFT,
    ANY_ACTIVE,
    BACKTRACKS,
    BELOW_ROUNDING_FLOOR,
    DOUBTED,
    DOUBTFUL,
    DROP_COMPRESSION,
    ENERGY_BUFFER,
    FRAMES_OUTDATED,
    ITERATE_ACTION,
    ITERATION,
    LOAD_SCALE,
    LOST_PIVOTS,
    LOST_PIVOTS_TOTAL,
    MAX_RESIDUAL,
    NEEDS_DIRECTION,
    NOT_CONVERGED,
    POLISHED,
    PREDICTED_DECREASE,
    RESIDUAL_NORM_SQ,
    STATUS,
    STEP_LENGTH,
    STRAIGHT_ROTATION_LIMIT,
    SUPPORT_MOTION_PENDING,
    projected_limit_function,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.newton.rod_iterate import MOVE_STRAIGHT, ROTATE_EDGES, UPDATE_FRAMES, shorter_function

STOP, NEED_DIRECTION = 0, 3  # actions in addition to `ROTATE_EDGES` and `UPDATE_FRAMES`: none, and compute a direction
ROUNDED, SETTLED, POLISHES = 1e-4, 1e-5, 10


@cache
def converged_function(real):
    """Return the device function `rests(flags, i)`: True if island i has converged, by the flags of its iterate."""

    @wp.func
    def rests(flags: wp.array2d(dtype=int), i: int):
        if flags[NOT_CONVERGED, i] != 0:
            return False
        if flags[BELOW_ROUNDING_FLOOR, i] == 0:
            return True
        # The rounding floor counts only after an iteration: in a coarse precision the predictor's residual may be all of the load.
        if flags[ITERATION, i] == 0:
            return False
        if wp.static(real is wp.float32):
            return flags[DOUBTFUL, i] == 0 or (
                flags[POLISHED, i] != 0 and flags[ITERATION, i] >= flags[POLISHED, i] + wp.static(POLISHES)
            )
        else:
            return True

    return rests


@cache
def line_search_functions(twist: bool, real, driven: bool = False):
    """Return the device functions `balanced` and `decide` of a rod.

    `balanced(...)`: True if the rod has stopped.
    `decide(...)`: next action of an active rod (`STOP`, `ROTATE_EDGES`, `UPDATE_FRAMES` or `NEED_DIRECTION`).

    `driven`: supports may have moved in the last step, which does work unknown to the line search.
    """
    shorter, rests = shorter_function(real), converged_function(real)

    @wp.func
    def balanced(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), r: int):
        """Return True if the rod has stopped, now or before; otherwise reset its flags."""
        if flags[STATUS, r] != 0:
            return True
        if rests(flags, r):
            flags[STATUS, r] = wp.where(
                flags[BELOW_ROUNDING_FLOOR, r] == 0,
                int(wp.static(outcome.CONVERGED)),
                int(wp.static(outcome.CONVERGED_TO_ROUNDING)),
            )
            if wp.static(real is wp.float32):
                if flags[BELOW_ROUNDING_FLOOR, r] != 0 and flags[DOUBTFUL, r] != 0 and flags[POLISHED, r] > 0:
                    flags[DOUBTED, r] = 1
            return True
        if wp.static(real is wp.float32):
            if flags[NOT_CONVERGED, r] == 0 and flags[POLISHED, r] == 0:
                flags[POLISHED, r] = flags[ITERATION, r]
                if flags[ITERATION, r] == 0 and scalars[LOAD_SCALE, r] == real(0.0):  # only rounding moves it
                    flags[POLISHED, r] = -wp.static(POLISHES)
            flags[DOUBTFUL, r] = 0
        flags[NOT_CONVERGED, r] = 0
        flags[BELOW_ROUNDING_FLOOR, r] = 0
        return False

    @wp.func
    def decide(
        change: real,
        rounding: real,
        square: real,
        worst: real,
        max_iterations: int,
        max_halvings: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        r: int,
    ):
        """Return the action, from change and rounding of the energy, square and largest component of the residual.

        `ROTATE_EDGES` leaves the shorter step in `step_length`. `UPDATE_FRAMES` requests a frame update and a step of zero length.
        """
        first = flags[ITERATION, r] == 0
        scalars[MAX_RESIDUAL, r] = worst
        total = change
        if first:
            total = real(0.0)
            if scalars[LOAD_SCALE, r] == real(0.0):
                scalars[LOAD_SCALE, r] = worst
        finite = wp.isfinite(square) and wp.isfinite(total)
        if first and not finite:
            flags[STATUS, r] = wp.static(outcome.NON_FINITE)
            return wp.static(STOP)
        taken = scalars[STEP_LENGTH, r]
        expected = taken * scalars[PREDICTED_DECREASE, r]
        accept = first
        if not first and finite:
            if expected > real(10.0) * rounding:
                accept = total <= real(-1.0e-4) * expected + rounding
            else:
                accept = square <= real(4.0) * scalars[RESIDUAL_NORM_SQ, r] or taken == real(0.0)
            if wp.static(driven):
                accept = accept or flags[SUPPORT_MOTION_PENDING, r] != 0
        if not accept:
            flags[BACKTRACKS, r] = flags[BACKTRACKS, r] + 1
            if flags[BACKTRACKS, r] > max_halvings:
                flags[STATUS, r] = wp.static(outcome.LINE_SEARCH_FAILED)
                return wp.static(STOP)
            scalars[STEP_LENGTH, r] = shorter(taken, expected, total, finite)
            return wp.static(ROTATE_EDGES)
        flags[ITERATION, r] = flags[ITERATION, r] + 1
        if flags[ITERATION, r] > max_iterations:
            flags[STATUS, r] = wp.static(outcome.MAX_ITERATIONS)
            return wp.static(STOP)
        scalars[RESIDUAL_NORM_SQ, r] = square
        flags[ENERGY_BUFFER, r] = 1 - flags[ENERGY_BUFFER, r]
        flags[BACKTRACKS, r] = 0
        if wp.static(twist):
            if flags[FRAMES_OUTDATED, r] != 0:
                # Twist angles change meaning: take no step, and compute a direction in the updated frames.
                flags[FRAMES_OUTDATED, r] = 0
                scalars[PREDICTED_DECREASE, r] = real(1.0e30)
                scalars[STEP_LENGTH, r] = real(0.0)
                return wp.static(UPDATE_FRAMES)
        return wp.static(NEED_DIRECTION)

    return balanced, decide


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
        rounding_error: wp.array2d(dtype=linear),
        run: int,
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
        for k in range(i, (count[r] + run - 1) / run, ranges):
            total += change[k, r]
            rounding += real(rounding_error[k, r])
        for k in range(i, count[r], ranges):
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
def decide_kernels(kind: RodKind, real, exact: bool, fails: bool = False):
    """Build the kernels of decisions from partial sums.

    `decide_action`: test the iterate of a rod.
    `take`: set the step length along a direction.

    A lost pivot ends the solve if it `fails`. Otherwise the iterate is repeated without geometric stiffness and compression.
    `exact`: the matrix is the exact Hessian unless that is indefinite.
    """
    balanced, decide = line_search_functions(kind.twist, real)
    out_of_patience = projected_limit_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def decide_action(
        partial: wp.array3d(dtype=real),
        ranges: int,
        rounding_factor: real,
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
        action = decide(
            total, rounding * rounding_factor, square, worst, max_iterations, max_halvings, flags, scalars, r
        )
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
            if wp.static(fails):
                flags[STATUS, r] = wp.static(outcome.INDEFINITE)
                return
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

    return decide_action, take

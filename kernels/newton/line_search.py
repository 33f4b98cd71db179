"""Armijo line search and convergence test of a rod, from sums over its nodes.

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
    ANY_ACTIVE,
    BACKTRACKS,
    BELOW_ROUNDING_FLOOR,
    DOUBTED,
    DOUBTFUL,
    ENERGY_BUFFER,
    FRAMES_OUTDATED,
    ITERATION,
    LOAD_SCALE,
    MAX_RESIDUAL,
    NEEDS_DIRECTION,
    NOT_CONVERGED,
    POLISHED,
    PREDICTED_DECREASE,
    RESIDUAL_NORM_SQ,
    STATUS,
    STEP_LENGTH,
    SUPPORT_MOTION_PENDING,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.newton.rod_iterate import ROTATE_EDGES, UPDATE_FRAMES, search_functions, shorter_function

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
def line_search_kernel(kind: RodKind, real, linear):
    """Build the kernel of the line search.

    `judge`: sum over a rod's nodes, decide, and write a shortened step or updated frames, one thread a rod.
    """
    V = wp.types.vector(kind.dim, real)
    place, turn_angles, relag, _ = search_functions(kind, real, linear)
    balanced, decide = line_search_functions(kind.twist, real)
    twist, nb = kind.twist, kind.block

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def judge(
        residual: wp.array3d(dtype=linear),
        change: wp.array2d(dtype=real),
        noise: wp.array2d(dtype=linear),
        count: wp.array(dtype=int),
        floor: real,
        max_iterations: int,
        max_halvings: int,
        direction: wp.array3d(dtype=linear),
        fixed: wp.array2d(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        base: wp.array2d(dtype=V),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
    ):
        r = wp.tid()
        flags[NEEDS_DIRECTION, r] = 0
        if balanced(flags, scalars, r):
            return
        n = count[r]
        total = real(0.0)
        rounding = real(0.0)
        square = real(0.0)
        worst = real(0.0)
        for k in range(n):
            total += change[k, r]
            rounding += real(noise[k, r])
            for d in range(wp.static(nb)):
                size = wp.abs(real(residual[d, k, r]))
                worst = wp.max(worst, size)
                square += size * size
        taken = scalars[STEP_LENGTH, r]
        action = decide(total, rounding * floor, square, worst, max_iterations, max_halvings, flags, scalars, r)
        if action == wp.static(STOP):
            return
        flags[ANY_ACTIVE, 0] = 1
        if action == wp.static(ROTATE_EDGES):
            shortened = scalars[STEP_LENGTH, r]
            place(x, base, base, direction, fixed, anchor, shortened, 0, n, r)
            turn_angles(theta, direction, shortened - taken, n, r)
        if wp.static(twist):
            if action == wp.static(UPDATE_FRAMES):
                relag(x, frame, n, r)
                for k in range(n):
                    base[k, r] = x[k, r]
        if action == wp.static(NEED_DIRECTION):
            flags[NEEDS_DIRECTION, r] = 1

    return judge

"""Line search on an assembled system: what becomes of a rod at its iterate, from sums over its nodes.

A rod stops where it balances; else its iterate is accepted, or the step to it is shortened: Armijo's rule (c = 1e-4) on the
energy, or, where the expected decrease drowns in rounding, a residual that has not grown much.

In float32 the bound of what rounding leaves of a residual may be much of the load itself, and far more than rounding does leave. A
residual above `ROUNDED` of the load scale that is within that bound ends a solve where the last Newton step has moved its node by less
than `SETTLED` of the length of the rod, or turned its edge by less than `SETTLED`; else after `POLISHES` more iterations, and such
solves are told, see `Integrator`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import outcome
from ddg_warp.kernels.chain import ChainKind
from ddg_warp.kernels.islands import (
    ACTIVE,
    DECREMENT,
    DOUBTED,
    DOUBTFUL,
    DRIVEN,
    DROWNED,
    HALVINGS,
    ITERATION,
    LOAD_SCALE,
    MERIT,
    POLISHED,
    RESIDUAL,
    SLOT,
    STALE,
    STATUS,
    STEP_LENGTH,
    UNBALANCED,
    WANTED,
)
from ddg_warp.kernels.search import PLACE, RELAG, search_functions, shorter_function
from ddg_warp.kernels.threads import CPU_OPTIONS

STOP, DIRECT = 0, 3  # beside PLACE and RELAG: nothing more to do, and a direction is wanted
ROUNDED, SETTLED, POLISHES = 1e-4, 1e-5, 10


@cache
def rests_function(real):
    """rests(flags, i): whether residuals of island i are small, or rounding excuses them, by the flags of its iterate."""

    @wp.func
    def rests(flags: wp.array2d(dtype=int), i: int):
        if flags[UNBALANCED, i] != 0:
            return False
        if flags[DROWNED, i] == 0:
            return True
        # rounding excuses a residual only after an iteration: the predictor's may be all of a coarse precision's load
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
def judge_functions(twist: bool, real, driven: bool = False):
    """balanced(...): whether a rod has stopped; decide(...): what an active rod does next (STOP, PLACE, RELAG or DIRECT).

    `driven`: whether supports may have moved in the last step, whose work the search does not know.
    """
    shorter, rests = shorter_function(real), rests_function(real)

    @wp.func
    def balanced(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), r: int):
        """Whether the rod has stopped, by its last iterate or before; lowers its flags where it has not."""
        if flags[STATUS, r] != 0:
            return True
        if rests(flags, r):
            flags[STATUS, r] = wp.where(
                flags[DROWNED, r] == 0,
                int(wp.static(outcome.CONVERGED)),
                int(wp.static(outcome.CONVERGED_TO_ROUNDING)),
            )
            if wp.static(real is wp.float32):
                if flags[DROWNED, r] != 0 and flags[DOUBTFUL, r] != 0 and flags[POLISHED, r] > 0:
                    flags[DOUBTED, r] = 1
            return True
        if wp.static(real is wp.float32):
            if flags[UNBALANCED, r] == 0 and flags[POLISHED, r] == 0:
                flags[POLISHED, r] = flags[ITERATION, r]
                if flags[ITERATION, r] == 0 and scalars[LOAD_SCALE, r] == real(0.0):  # all that moves it is rounding
                    flags[POLISHED, r] = -wp.static(POLISHES)
            flags[DOUBTFUL, r] = 0
        flags[UNBALANCED, r] = 0
        flags[DROWNED, r] = 0
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
        """From the energy's change and its rounding, the square and the largest component of the residual.

        PLACE leaves the shorter step in `step_length`; RELAG asks for frames of the iterate and a step of no length.
        """
        first = flags[ITERATION, r] == 0
        scalars[RESIDUAL, r] = worst
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
        expected = taken * scalars[DECREMENT, r]
        accept = first
        if not first and finite:
            if expected > real(10.0) * rounding:
                accept = total <= real(-1.0e-4) * expected + rounding
            else:
                accept = square <= real(4.0) * scalars[MERIT, r] or taken == real(0.0)
            if wp.static(driven):
                accept = accept or flags[DRIVEN, r] != 0
        if not accept:
            flags[HALVINGS, r] = flags[HALVINGS, r] + 1
            if flags[HALVINGS, r] > max_halvings:
                flags[STATUS, r] = wp.static(outcome.LINE_SEARCH_FAILED)
                return wp.static(STOP)
            scalars[STEP_LENGTH, r] = shorter(taken, expected, total, finite)
            return wp.static(PLACE)
        flags[ITERATION, r] = flags[ITERATION, r] + 1
        if flags[ITERATION, r] > max_iterations:
            flags[STATUS, r] = wp.static(outcome.MAX_ITERATIONS)
            return wp.static(STOP)
        scalars[MERIT, r] = square
        flags[SLOT, r] = 1 - flags[SLOT, r]
        flags[HALVINGS, r] = 0
        if wp.static(twist):
            if flags[STALE, r] != 0:
                # angles mean something else now: take no step, and ask for a direction in the new frames
                flags[STALE, r] = 0
                scalars[DECREMENT, r] = real(1.0e30)
                scalars[STEP_LENGTH, r] = real(0.0)
                return wp.static(RELAG)
        return wp.static(DIRECT)

    return balanced, decide


@cache
def judge_kernel(kind: ChainKind, real, linear):
    """The line search of a rod by one thread: sums over its nodes, decides, and puts a shortened step or new frames."""
    V = wp.types.vector(kind.dim, real)
    place, turn_angles, relag, _ = search_functions(kind, real, linear)
    balanced, decide = judge_functions(kind.twist, real)
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
        flags[WANTED, r] = 0
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
        what = decide(total, rounding * floor, square, worst, max_iterations, max_halvings, flags, scalars, r)
        if what == wp.static(STOP):
            return
        flags[ACTIVE, 0] = 1
        if what == wp.static(PLACE):
            less = scalars[STEP_LENGTH, r]
            place(x, base, base, direction, fixed, anchor, less, 0, n, r)
            turn_angles(theta, direction, less - taken, n, r)
        if wp.static(twist):
            if what == wp.static(RELAG):
                relag(x, frame, n, r)
                for k in range(n):
                    base[k, r] = x[k, r]
        if what == wp.static(DIRECT):
            flags[WANTED, r] = 1

    return judge

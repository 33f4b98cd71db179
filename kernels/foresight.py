"""From where the solve of a step starts: its predictor, and what the last solve added to its own; see `kernels.step`.

By implicit Euler the search starts from s^2 a beyond the predictor, where a is what the last solve added to its own, over the square of
its step: constant accelerations of what is loaded are foreseen. (By the midpoint rule what stiff modes add changes sign from step to
step.) No solution depends on that: what is lagged is that of the predictor.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.chain import ChainKind
from ddg_warp.kernels.islands import BENT, CAUTIOUS, ITERATION, LOAD_SCALE, PROGRESS, RATE
from ddg_warp.kernels.search import search_functions
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function
from ddg_warp.kernels.turns import FURTHER, loose_function

FORESEEN = 6  # iterations of a solve, at most, after which the next one starts from what it added


@cache
def ahead_function(real):
    """ahead(flags, scalars, i): the square of the step by which accelerations lead on from the predictor of an island.

    Zero where they do not: from x_n, and without loads, as the tolerance is of the residual that a solve starts with then.
    """

    @wp.func
    def ahead(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), i: int):
        s = real(1.0) / scalars[RATE, i]
        foreseen = flags[CAUTIOUS, i] == 0 and scalars[LOAD_SCALE, i] > real(0.0)
        return wp.where(foreseen, s * s, real(0.0))

    return ahead


@cache
def told_function(real, midpoint: bool, crowd: bool = False):
    """told(flags, scalars, i): square of the rate by which what a solve added is an acceleration that the next one starts with.

    Zero where that is not foreseen: by the midpoint rule, after a solve from x_n, or one of so many iterations that the motion was none
    that goes on. In a `crowd` these tell of contacts, and `kernels.net.foresight` of the motion.
    """

    @wp.func
    def told(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), i: int):
        known = (
            wp.static(not midpoint)
            and flags[CAUTIOUS, i] == 0
            and (wp.static(crowd) or flags[ITERATION, i] <= wp.static(FORESEEN))
        )
        return wp.where(known, scalars[RATE, i] * scalars[RATE, i], real(0.0))

    return told


@cache
def foresee_kernel(kind: ChainKind, real, linear):
    """Keep the predictor of every rod that still has to move, and start from where its accelerations lead from there.

    They are a `direction`, along which `further_kernel` moves rods whose edges turn.
    """
    dim, twist = kind.dim, kind.twist
    V = wp.types.vector(dim, real)
    until, ahead, loose = until_function(kind.serial), ahead_function(real), loose_function(dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def foresee(
        a0: wp.array2d(dtype=V),
        alpha0: wp.array2d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        predicted: wp.array2d(dtype=V),
        predicted_angle: wp.array2d(dtype=real),
        direction: wp.array3d(dtype=linear),
    ):
        start, r = wp.tid()
        n = count[r]
        if scalars[PROGRESS, r] >= real(1.0) or start >= n:
            return
        weight = ahead(flags, scalars, r)
        for k in range(start, until(start, n)):
            mask = int(fixed[k, r])
            here = x[k, r]
            predicted[k, r] = here
            more = loose(mask, weight * a0[k, r])
            x[k, r] = here + more
            if flags[BENT, r] != 0:
                for d in range(wp.static(dim)):
                    direction[d, k, r] = linear(more[d])
            if wp.static(twist):
                angle = theta[k, r]
                predicted_angle[k, r] = angle
                if ((mask >> wp.static(dim)) & 1) == 0:
                    theta[k, r] = angle + weight * alpha0[k, r]

    return foresee


@cache
def further_kernel(kind: ChainKind, real, linear):
    """Redo that of a rod whose edges its predictor turned: they turn and lengthen as the last solve has turned and lengthened them."""
    V = wp.types.vector(kind.dim, real)
    place, *_ = search_functions(kind, real, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def further(
        x0: wp.array2d(dtype=V),
        fixed: wp.array2d(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        predicted: wp.array2d(dtype=V),
        direction: wp.array3d(dtype=linear),
        x: wp.array2d(dtype=V),
    ):
        r = wp.tid()
        if scalars[PROGRESS, r] < real(1.0) and flags[BENT, r] != 0:
            place(x, predicted, x0, direction, fixed, anchor, real(1.0), wp.static(FURTHER), count[r], r)

    return further

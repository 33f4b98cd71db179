"""Warm start: extrapolate the correction of the last step, an acceleration, from the inertial predictor; see
`kernels.stepping.time_step`.

With implicit Euler the iteration starts at s^2 a from the predictor. The acceleration a is the last solve's correction of its
predictor over the square of its step, so that constant accelerations are anticipated. With the midpoint rule corrections of stiff
modes change sign every step. Solutions do not depend on the warm start: time-lagged quantities stay at the predictor.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import (
    COLD_START,
    INVERSE_STEP,
    ITERATE_ACTION,
    ITERATION,
    LOAD_SCALE,
    ROTATE_PREDICTOR,
    STEP_PROGRESS,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.nodes import NodeStorage, dof_functions
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.newton.edge_rotation import EXTRAPOLATE_ROTATED, loose_function
from ddg_warp.kernels.newton.rod_iterate import ROTATE_EDGES, search_functions

MAX_WARM_START_ITERATIONS = 6  # maximum iterations of a solve whose correction is extrapolated


@cache
def extrapolation_step_function(real):
    """Return the device function `ahead(flags, scalars, i)`: squared step by which accelerations extrapolate the predictor.

    Zero after a cold start, and without loads, as the tolerance then is relative to the first residual of a solve.
    """

    @wp.func
    def ahead(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), i: int):
        s = real(1.0) / scalars[INVERSE_STEP, i]
        foreseen = flags[COLD_START, i] == 0 and scalars[LOAD_SCALE, i] > real(0.0)
        return wp.where(foreseen, s * s, real(0.0))

    return ahead


@cache
def extrapolation_rate_function(real, midpoint: bool, contact: bool = False):
    """Return the device function `told(flags, scalars, i)`: squared rate that makes a correction an acceleration.

    Zero where corrections are not extrapolated: with the midpoint rule, after a cold start, or after so many iterations that the
    motion does not continue. In `contact` many iterations indicate contacts, and `kernels.stepping.coupled_warm_start` decides instead.
    """

    @wp.func
    def told(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), i: int):
        valid = (
            wp.static(not midpoint)
            and flags[COLD_START, i] == 0
            and (wp.static(contact) or flags[ITERATION, i] <= wp.static(MAX_WARM_START_ITERATIONS))
        )
        return wp.where(valid, scalars[INVERSE_STEP, i] * scalars[INVERSE_STEP, i], real(0.0))

    return told


@cache
def warm_start_kernel(nodes: NodeStorage, real, linear):
    """Build the kernel of the warm start.

    `foresee`: store the predictor of every island that still has to move, and add extrapolated accelerations.

    Islands with rotated edges take them as a `direction`; see `further_kernel` and `ddg_warp.solve.newton.edge_rotation`.
    """
    dim, coupled, (items, until) = nodes.dim, nodes.coupled, nodes.thread_functions
    V, (dofs, store) = wp.types.vector(dim, real), dof_functions(nodes, real)
    squared_step, loose = extrapolation_step_function(real), loose_function(nodes.block, real)

    @wp.func
    def rotates(flags: wp.array2d(dtype=int), island: int):
        if wp.static(coupled):
            return flags[ITERATE_ACTION, island] == wp.static(ROTATE_EDGES)
        return flags[ROTATE_PREDICTOR, island] != 0

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
        i, j = wp.tid()
        island, first = items(i, j)
        n = count[island]
        if scalars[STEP_PROGRESS, island] >= real(1.0) or first >= n:
            return
        weight = squared_step(flags, scalars, island)
        for k in range(first, until(first, n)):
            start = dofs(x, theta, k, island)
            store(predicted, predicted_angle, k, island, start)
            correction = loose(int(fixed[k, island]), weight * dofs(a0, alpha0, k, island))
            store(x, theta, k, island, start + correction)
            if rotates(flags, island):
                for d in range(wp.static(dim)):
                    direction[d, k, island] = linear(correction[d])

    return foresee


@cache
def further_kernel(kind: RodKind, real, linear):
    """Build the kernel of the warm start after predictors with rotated edges.

    `further`: extrapolate the last edge rotations and stretches.
    """
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
        if scalars[STEP_PROGRESS, r] < real(1.0) and flags[ROTATE_PREDICTOR, r] != 0:
            place(x, predicted, x0, direction, fixed, anchor, real(1.0), wp.static(EXTRAPOLATE_ROTATED), count[r], r)

    return further

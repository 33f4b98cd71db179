"""Rotated predictors, and frames at the end of a step, of uncoupled rods; see `kernels.stepping.time_step`.

Why not shared with `kernels.newton.coupled_edge_rotation` and `kernels.elements.coupled_frames`: one thread a rod, or an edge and its
vertex, does all in one launch and reads a frame once. The coupled system needs launches by level, edge and vertex.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import (
    COLD_START,
    INVERSE_STEP,
    ROTATE_PREDICTOR,
    STEP_PROGRESS,
    STRAIGHT_ROTATION_LIMIT,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions
from ddg_warp.kernels.newton.edge_rotation import REPEAT_ROTATION, repeat_rotation_function
from ddg_warp.kernels.newton.rod_iterate import search_functions


@cache
def predicted_function(dim: int, real):
    """Return the device function `predicted(x, x0, v, mask, cautious, rate)`: step of a node from x0 along its velocity.

    Components that a support fixes step to x, unless all are fixed. After a cold start the velocity does not count.
    """
    V, every = wp.types.vector(dim, real), (1 << dim) - 1

    @wp.func
    def predicted(x: V, x0: V, v: V, mask: int, cautious: int, rate: real):
        step = v / rate
        if cautious != 0:
            step = V()
        if (mask & wp.static(every)) != wp.static(every):
            for d in range(wp.static(dim)):
                if ((mask >> d) & 1) == 1:
                    step[d] = x[d] - x0[d]
        return step

    return predicted


@cache
def predict_kernel(kind: RodKind, real, linear, midpoint: bool):
    """Build the kernel of predictors with edge rotations.

    `predict`: write the predictor of rods whose edges rotate far, by edge rotations along the velocity instead of stretch.

    Supports have prescribed positions by then, and the rod follows them. So no edge is stretched by the deviation of a support from its
    velocity. With implicit Euler velocities are the displacements of the last step, and edges continue its rotations.

    With the midpoint rule lagged frames are transported to the predicted midpoint. Frames lagged at the start of the step rotate about
    their edges by O(h) until the midpoint, which rotary inertia does not see: its error would be of first order.
    """
    dim, carried = kind.dim, kind.twist and midpoint
    V = wp.types.vector(dim, real)
    place, _, relag = search_functions(kind, real, linear)
    predicted, extrapolation_of = predicted_function(dim, real), repeat_rotation_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def predict(
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        fixed: wp.array2d(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        base: wp.array2d(dtype=V),
        direction: wp.array3d(dtype=linear),
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
    ):
        r = wp.tid()
        if scalars[STEP_PROGRESS, r] >= real(1.0):
            return
        n = count[r]
        if flags[ROTATE_PREDICTOR, r] != 0:
            for k in range(n):
                step = predicted(
                    x[k, r], x0[k, r], v0[k, r], int(fixed[k, r]), flags[COLD_START, r], scalars[INVERSE_STEP, r]
                )
                base[k, r] = x0[k, r]
                for d in range(wp.static(dim)):
                    direction[d, k, r] = linear(step[d])
            extrapolation = extrapolation_of(
                scalars[STRAIGHT_ROTATION_LIMIT, r], wp.static(0 if midpoint else REPEAT_ROTATION)
            )
            place(x, base, base, direction, fixed, anchor, real(1.0), extrapolation, n, r)
        if wp.static(carried):
            relag(x, frame, n, r)

    return predict


@cache
def finish_frames_kernel(kind: RodKind, real):
    """Build the kernel of frames at the end of a step.

    `finish`: transport reference frames to the tangents of the new state, orthonormalise, and write reference twists.

    Rods that did not move keep the frames of the start: frames transported along iterates of a failed solve have rotated.
    """
    V, X = wp.types.vector(kind.dim, real), wp.types.vector(3, real)
    along, *_ = gather_functions(kind, real)
    until = until_function(kind.serial)
    transport, reference_twist, _ = parallel_transport.functions(real)
    closed = kind.closed

    @wp.func
    def carried(x: wp.array2d(dtype=V), frame: wp.array3d(dtype=real), k: int, n: int, r: int):
        t = wp.normalize(x[along(k + 1, n), r] - x[along(k, n), r])
        j = along(k, n)
        u = transport(
            X(frame[0, j, r], frame[1, j, r], frame[2, j, r]), X(frame[3, j, r], frame[4, j, r], frame[5, j, r]), t
        )
        return wp.normalize(u - t * wp.dot(u, t)), t

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
        frame0: wp.array3d(dtype=real),
        count: wp.array(dtype=int),
        moved: wp.array(dtype=int),
        frame_out: wp.array3d(dtype=real),
    ):
        start, r = wp.tid()
        n = count[r]
        if start >= n - wp.static(0 if closed else 1):
            return
        if moved[r] == 0:
            for k in range(start, until(start, n - wp.static(0 if closed else 1))):
                for c in range(7):
                    frame_out[c, k, r] = frame0[c, k, r]
            return
        for k in range(start, until(start, n - wp.static(0 if closed else 1))):
            u, t = carried(x, frame, k, n, r)
            for c in range(3):
                frame_out[c, k, r] = u[c]
                frame_out[3 + c, k, r] = t[c]
            if wp.static(closed) or k < n - 2:
                u1, t1 = carried(x, frame, k + 1, n, r)
                frame_out[6, k, r] = reference_twist(u, u1, t, t1, frame[6, k, r])

    return finish

"""Time step of uncoupled rods around Newton's method: predictor, end update, retry with smaller substeps.

Both schemes solve one implicit Euler step of length s (s = h, or h/2 for the implicit midpoint rule):

    m (x - x_n - s v_n) / s^2 + alpha m (x - x_n) / s + dE/dx = 0,

so that inertia and mass-proportional damping alpha are one quadratic, coefficient * m |x - target|^2 / 2. The midpoint rule then
extrapolates, x_n+1 = 2 x - x_n and v_n+1 = 2 (x - x_n) / s - v_n.

Newton's method starts from the predictor, x_n + s v_n with rotated edges, plus a warm start: see `kernels.stepping.rod_warm_start`.

A rod whose solve fails first repeats it with a cold start from x_n, then halves the substep (`substep_fraction`), each rod on its own.
`step_progress` is the completed fraction of the step; both are multiples of powers of two, and exact. With large rotations of
prescribed motions, substeps are at most `substep`, and each is retried as a step is (`solve.collision.support_arcs`).
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import (
    COLD_START,
    FAILURE_STATUS,
    INVERSE_STEP,
    ITERATION,
    LOST_PIVOTS_TOTAL,
    PROJECTED_ITERATIONS,
    PROJECTED_LIMIT,
    RETRIES,
    ROTATE_PREDICTOR,
    STATUS,
    STEP_PROGRESS,
    STRAIGHT_ROTATION_LIMIT,
    SUBSTEP,
    SUBSTEP_ACCEPTED,
    SUBSTEP_FRACTION,
    attempt_functions,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions
from ddg_warp.kernels.newton.edge_rotation import REPEAT_ROTATION, repeat_rotation_function
from ddg_warp.kernels.newton.rod_iterate import search_functions
from ddg_warp.kernels.stepping.rod_warm_start import extrapolation_rate_function


@cache
def begin_kernel(kind: RodKind, real, midpoint: bool):
    """Build the kernel of predictors.

    `begin`: write predictor, target of inertia and lagged frames, and restart the solve of every rod that still has to move.
    """
    length, restart = attempt_functions(real, midpoint)
    dim, twist = kind.dim, kind.twist
    V = wp.types.vector(dim, real)
    until = until_function(kind.serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        theta0: wp.array2d(dtype=real),
        omega0: wp.array2d(dtype=real),
        frame0: wp.array3d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        world: wp.array(dtype=int),
        dt: wp.array(dtype=real),
        damping: wp.array(dtype=real),
        outer: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        x_out: wp.array2d(dtype=V),
        theta_out: wp.array2d(dtype=real),
        frame_out: wp.array3d(dtype=real),
        target_out: wp.array2d(dtype=V),
        target_angle_out: wp.array2d(dtype=real),
    ):
        start, r = wp.tid()
        n = count[r]
        if scalars[STEP_PROGRESS, r] >= real(1.0) or start >= n:
            return
        s = length(scalars, r, dt[world[r]])
        rate = real(1.0) / s
        coefficient = rate * (rate + damping[0])
        if start == 0:
            if scalars[STRAIGHT_ROTATION_LIMIT, r] == real(0.0):
                flags[ROTATE_PREDICTOR, r] = 1
            restart(flags, scalars, r, rate, coefficient, outer[r])
        predict_length = wp.where(flags[COLD_START, r] == 0, s, real(0.0))
        for k in range(start, until(start, n)):
            mask = int(fixed[k, r])
            position = x0[k, r]
            v = v0[k, r]
            target_out[k, r] = position + v * (rate / coefficient)
            for d in range(wp.static(dim)):
                if ((mask >> d) & 1) == 0:
                    position[d] = position[d] + predict_length * v[d]
            x_out[k, r] = position
            if flags[COLD_START, r] == 0 and k + 1 < n:
                edge_change = (v0[k + 1, r] - v) * s
                edge = x0[k + 1, r] - x0[k, r]
                straight = scalars[STRAIGHT_ROTATION_LIMIT, r]
                if wp.length_sq(edge_change) > straight * straight * wp.length_sq(edge):
                    flags[ROTATE_PREDICTOR, r] = 1
            if wp.static(twist):
                angle = theta0[k, r]
                spin = omega0[k, r]
                target_angle_out[k, r] = angle + spin * (rate / coefficient)
                if ((mask >> wp.static(dim)) & 1) == 0:
                    angle += predict_length * spin
                theta_out[k, r] = angle
                for c in range(7):
                    frame_out[c, k, r] = frame0[c, k, r]

    return begin


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
    place, _, relag, _ = search_functions(kind, real, linear)
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
def start_function(real):
    """Return the device function `start(flags, scalars, i)`: start a step of an island.

    The step is complete at once if the island has failed for good.
    """

    @wp.func
    def start(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), i: int):
        scalars[SUBSTEP_FRACTION, i] = scalars[SUBSTEP, i]
        flags[COLD_START, i] = 0
        flags[RETRIES, i] = 0
        scalars[STEP_PROGRESS, i] = wp.where(flags[STATUS, i] == wp.static(outcome.STEP_FAILED), real(1.0), real(0.0))

    return start


@cache
def start_kernel(real):
    """Build the kernel `start`: start a step of all islands."""
    start_one = start_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real)):
        start_one(flags, scalars, wp.tid())

    return start


@cache
def finish_nodes_kernel(kind: RodKind, real, midpoint: bool):
    """Build the kernel of the end update.

    `finish`: write positions, twist angles, velocities and accelerations at the end of the substep of rods that converged.
    """
    V, twist = wp.types.vector(kind.dim, real), kind.twist
    until, extrapolation_of = until_function(kind.serial), extrapolation_rate_function(real, midpoint)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        theta0: wp.array2d(dtype=real),
        omega0: wp.array2d(dtype=real),
        a0: wp.array2d(dtype=V),
        alpha0: wp.array2d(dtype=real),
        predicted: wp.array2d(dtype=V),
        predicted_angle: wp.array2d(dtype=real),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        x_out: wp.array2d(dtype=V),
        v_out: wp.array2d(dtype=V),
        theta_out: wp.array2d(dtype=real),
        omega_out: wp.array2d(dtype=real),
        a_out: wp.array2d(dtype=V),
        alpha_out: wp.array2d(dtype=real),
    ):
        start, r = wp.tid()
        n = count[r]
        if start >= n:
            return
        moves = scalars[STEP_PROGRESS, r] < real(1.0) and flags[STATUS, r] <= wp.static(outcome.CONVERGED_TO_ROUNDING)
        if start == 0:
            flags[SUBSTEP_ACCEPTED, r] = wp.where(moves, 1, 0)
        extrapolation = extrapolation_of(flags, scalars, r)
        for k in range(start, until(start, n)):
            before = x0[k, r]
            v = v0[k, r]
            a = a0[k, r]
            angle0 = real(0.0)
            spin = real(0.0)
            alpha = real(0.0)
            if wp.static(twist):
                angle0 = theta0[k, r]
                spin = omega0[k, r]
                alpha = alpha0[k, r]
            end = before
            angle = angle0
            if moves:
                end = x[k, r]
                a = (end - predicted[k, r]) * extrapolation
                change = (end - before) * scalars[INVERSE_STEP, r]
                if wp.static(midpoint):
                    end = real(2.0) * end - before
                    v = real(2.0) * change - v
                else:
                    v = change
                if wp.static(twist):
                    angle = theta[k, r]
                    alpha = (angle - predicted_angle[k, r]) * extrapolation
                    spin_mean = (angle - angle0) * scalars[INVERSE_STEP, r]
                    if wp.static(midpoint):
                        angle = real(2.0) * angle - angle0
                        spin = real(2.0) * spin_mean - spin
                    else:
                        spin = spin_mean
            x_out[k, r] = end
            v_out[k, r] = v
            a_out[k, r] = a
            if wp.static(twist):
                theta_out[k, r] = angle
                omega_out[k, r] = spin
                alpha_out[k, r] = alpha

    return finish


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


@cache
def advance_kernel(real):
    """Build the kernel of step control.

    `advance`: count the outcome of a substep, and continue (with longer substeps again), retry, or end as failed.

    `tally`: counts of outcomes by code, with `rounded` for solves that converged to rounding. `work`: Newton iterations (sum, largest),
    solves, retries, lost pivots.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def advance(
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        retry_limit: int,
        smallest: real,
        rounded: int,
        tally: wp.array(dtype=wp.int64),
        work: wp.array(dtype=wp.int64),
        remaining: wp.array(dtype=int),
    ):
        r = wp.tid()
        if scalars[STEP_PROGRESS, r] >= real(1.0):
            return
        result = flags[STATUS, r]
        counted = result
        if result == wp.static(outcome.CONVERGED_TO_ROUNDING):
            counted = rounded
        wp.atomic_add(tally, counted, wp.int64(1))
        wp.atomic_add(work, 0, wp.int64(flags[ITERATION, r]))
        wp.atomic_max(work, 1, wp.int64(flags[ITERATION, r]))
        wp.atomic_add(work, 2, wp.int64(1))
        if flags[LOST_PIVOTS_TOTAL, r] > 0:
            wp.atomic_add(work, 4, wp.int64(flags[LOST_PIVOTS_TOTAL, r]))
        if result <= wp.static(outcome.CONVERGED_TO_ROUNDING):
            scalars[STEP_PROGRESS, r] = scalars[STEP_PROGRESS, r] + scalars[SUBSTEP_FRACTION, r]
            flags[COLD_START, r] = 0
            if scalars[STEP_PROGRESS, r] < real(1.0):
                flags[RETRIES, r] = 0
            # double the substep if it starts at a multiple of its length, so that all islands end together
            longer = real(2.0) * scalars[SUBSTEP_FRACTION, r]
            if (
                scalars[STEP_PROGRESS, r] < real(1.0)
                and longer <= scalars[SUBSTEP, r]
                and wp.floor(scalars[STEP_PROGRESS, r] / longer) * longer == scalars[STEP_PROGRESS, r]
            ):
                scalars[SUBSTEP_FRACTION, r] = longer
        else:
            wp.atomic_add(work, 3, wp.int64(1))
            flags[RETRIES, r] = flags[RETRIES, r] + 1
            # a cold start would lead to the same step with its energy drift, or to the same minimum
            again = (
                result != wp.static(outcome.ENERGY_DRIFT)
                and flags[PROJECTED_ITERATIONS, r] <= flags[PROJECTED_LIMIT, r]
            )
            if again and flags[COLD_START, r] == 0:
                flags[COLD_START, r] = 1
            else:
                flags[COLD_START, r] = 0
                scalars[SUBSTEP_FRACTION, r] = real(0.5) * scalars[SUBSTEP_FRACTION, r]
            if flags[RETRIES, r] > retry_limit or scalars[SUBSTEP_FRACTION, r] < smallest * scalars[SUBSTEP, r]:
                flags[FAILURE_STATUS, r] = result
                flags[STATUS, r] = wp.static(outcome.STEP_FAILED)
                scalars[STEP_PROGRESS, r] = real(1.0)
        if scalars[STEP_PROGRESS, r] < real(1.0):
            remaining[0] = 1

    return advance

"""Time step around Newton's method: begin, end update, retry with smaller substeps; of uncoupled rods and of the coupled system.

Both schemes solve one implicit Euler step of length s (s = h, or h/2 for the implicit midpoint rule):

    m (x - x_n - s v_n) / s^2 + alpha m (x - x_n) / s + dE/dx = 0,

so that inertia and mass-proportional damping alpha are one quadratic, coefficient * m |x - target|^2 / 2. The midpoint rule then
extrapolates, x_n+1 = 2 x - x_n and v_n+1 = 2 (x - x_n) / s - v_n.

Newton's method starts from the predictor, x_n + s v_n with rotated edges, plus a warm start: see `kernels.stepping.warm_start`.

An island whose solve fails first repeats it with a cold start from x_n, then halves the substep (`substep_fraction`), each on its own.
`step_progress` is the completed fraction of the step; both are multiples of powers of two, and exact. With large rotations of
prescribed motions, substeps are at most `substep`, and each is retried as a step is (`solve.collision.support_arcs`).
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.inertia import block_inertia, node_inertia
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
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.nodes import NodeStorage, dof_functions, mass_functions, state_type
from ddg_warp.kernels.stepping.warm_start import extrapolation_rate_function


@cache
def begin_kernel(nodes: NodeStorage, real, midpoint: bool):
    """Build the kernel of predictors.

    `begin`: write predictor, target of inertia and lagged frames, and restart the solve of every island that still has to move.

    Dofs in the mask `kept` start from the last state. These are fixed dofs and, in the coupled system, massless dofs, whose velocities
    have no meaning. The flag `rotate_predictor` is set for rods; in the coupled system `kernels.newton.coupled_edge_rotation` tests
    edges, from `base`, the last state.
    """
    length, restart = attempt_functions(real, midpoint)
    block, twist, coupled = nodes.block, nodes.twist, nodes.coupled
    V, State, (dofs, store) = wp.types.vector(nodes.dim, real), state_type(nodes, real), dof_functions(nodes, real)
    items, until = nodes.thread_functions

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(
        before: State,
        frame0: wp.array3d(dtype=real),
        kept: wp.array2d(dtype=wp.uint8),
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
        base_out: wp.array2d(dtype=V),
        target_out: wp.array2d(dtype=V),
        target_angle_out: wp.array2d(dtype=real),
    ):
        i, j = wp.tid()
        island, first = items(i, j)
        n = count[island]
        moves = scalars[STEP_PROGRESS, island] < real(1.0)
        if first == 0:
            flags[SUBSTEP_ACCEPTED, island] = wp.where(moves, 1, 0)
        if not moves or first >= n:
            return
        s = length(scalars, island, dt[world[island]])
        rate = real(1.0) / s
        coefficient = rate * (rate + damping[0])
        straight = scalars[STRAIGHT_ROTATION_LIMIT, island]
        if first == 0:
            if wp.static(not coupled):
                if straight == real(0.0):
                    flags[ROTATE_PREDICTOR, island] = 1
            restart(flags, scalars, island, rate, coefficient, outer[island])
        predict_length = wp.where(flags[COLD_START, island] == 0, s, real(0.0))
        for k in range(first, until(first, n)):
            mask = int(kept[k, island])
            start = dofs(before.x, before.theta, k, island)
            v = dofs(before.v, before.omega, k, island)
            store(target_out, target_angle_out, k, island, start + v * (rate / coefficient))
            predicted = start
            for d in range(wp.static(block)):
                if ((mask >> d) & 1) == 0:
                    predicted[d] = predicted[d] + predict_length * v[d]
            store(x_out, theta_out, k, island, predicted)
            if wp.static(coupled):
                base_out[k, island] = start
            else:
                if flags[COLD_START, island] == 0 and k + 1 < n:
                    edge_change = (before.v[k + 1, island] - before.v[k, island]) * s
                    edge = before.x[k + 1, island] - before.x[k, island]
                    if wp.length_sq(edge_change) > straight * straight * wp.length_sq(edge):
                        flags[ROTATE_PREDICTOR, island] = 1
            if wp.static(twist):
                for c in range(7):
                    frame_out[c, k, island] = frame0[c, k, island]

    return begin


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
def finish_kernel(nodes: NodeStorage, real, midpoint: bool, quadratic: bool, contact: bool = False):
    """Build the kernel of the end update.

    `finish`: write positions, twist angles, velocities and accelerations at the end of the substep of islands that converged.

    The midpoint rule would keep rates of massless dofs oscillating. With a quadratic potential these dofs have mean rates over the
    step. Their accelerations are changes of means, zero without motion before.

    In the coupled system `trust` scales accelerations, and the rate of inertia in contact is stored if `rate_out` has entries.
    `contact`: see `extrapolation_rate_function`.
    """
    coupled, extrapolation_of = nodes.coupled, extrapolation_rate_function(real, midpoint, contact)
    V, B, State = wp.types.vector(nodes.dim, real), wp.types.vector(nodes.block, real), state_type(nodes, real)
    (dofs, store), (items, until) = dof_functions(nodes, real), nodes.thread_functions
    (masses, _), Mass, dim, block = mass_functions(nodes, real), nodes.mass_type(real), nodes.dim, nodes.block
    Inertia = block_inertia(real) if coupled else node_inertia(dim, real)

    @wp.func
    def is_settled(m: B, inertia: wp.array2d(dtype=Inertia), k: int, island: int, d: int):
        """Return True if a dof has no mass; in the coupled system only if the potential holds it."""
        result = m[d] <= real(0.0)
        if wp.static(coupled):
            result = result and inertia[k, island].stiffness[d, d] > real(0.0)
        return result

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        before: State,
        a0: wp.array2d(dtype=V),
        alpha0: wp.array2d(dtype=real),
        predicted: wp.array2d(dtype=V),
        predicted_angle: wp.array2d(dtype=real),
        trust: wp.array(dtype=real),
        rate: wp.array(dtype=real),
        mass: wp.array2d(dtype=Mass),
        rotary: wp.array2d(dtype=real),
        inertia: wp.array2d(dtype=Inertia),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        out: State,
        a_out: wp.array2d(dtype=V),
        alpha_out: wp.array2d(dtype=real),
        rate_out: wp.array(dtype=real),
    ):
        i, j = wp.tid()
        island, first = items(i, j)
        n = count[island]
        if first >= n:
            return
        moves = scalars[STEP_PROGRESS, island] < real(1.0) and flags[STATUS, island] <= wp.static(
            outcome.CONVERGED_TO_ROUNDING
        )
        if first == 0:
            flags[SUBSTEP_ACCEPTED, island] = wp.where(moves, 1, 0)
            if wp.static(coupled):
                if moves and rate_out.shape[0] > 0:
                    rate_out[island] = rate[island]
        extrapolation = extrapolation_of(flags, scalars, island)
        if wp.static(coupled):
            extrapolation *= trust[island]
        for k in range(first, until(first, n)):
            start = dofs(before.x, before.theta, k, island)
            end = start
            v = B()
            a = B()
            if moves:
                end = dofs(x, theta, k, island)
                a = (end - dofs(predicted, predicted_angle, k, island)) * extrapolation
                v = (end - start) * scalars[INVERSE_STEP, island]
                if wp.static(midpoint):
                    solution = end
                    v0 = dofs(before.v, before.omega, k, island)
                    end = real(2.0) * end - start
                    v = real(2.0) * v - v0
                    if wp.static(quadratic):
                        mean = (end - solution) * scalars[INVERSE_STEP, island]
                        change = (v - mean) * (real(0.5) * scalars[INVERSE_STEP, island])
                        m = masses(mass, rotary, k, island)
                        moved = wp.length_sq(before.v[k, island]) > real(0.0)
                        for d in range(wp.static(block)):
                            if is_settled(m, inertia, k, island, d):
                                if d >= wp.static(dim):
                                    moved = v0[d] != real(0.0)
                                v[d] = mean[d]
                                a[d] = wp.where(moved, change[d], real(0.0))
            else:
                v = dofs(before.v, before.omega, k, island)
                a = dofs(a0, alpha0, k, island)
            store(out.x, out.theta, k, island, end)
            store(out.v, out.omega, k, island, v)
            store(a_out, alpha_out, k, island, a)

    return finish


@cache
def advance_kernel(real):
    """Build the kernel of step control.

    `advance`: count the outcome of a substep, and continue (with longer substeps again), retry, or end as failed.

    `tally`: counts of outcomes by code, with `rounded` for solves that converged to rounding. `work`: Newton iterations (sum, largest),
    solves, retries, lost pivots. A thread takes islands `threads` apart, so that few threads add to these.

    Measured: 100,000 rods, an H100: one thread a rod takes 190 us.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def advance(
        threads: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        retry_limit: int,
        smallest: real,
        rounded: int,
        tally: wp.array(dtype=wp.int64),
        work: wp.array(dtype=wp.int64),
        remaining: wp.array(dtype=int),
    ):
        iterations = int(0)
        most = int(0)
        solves = int(0)
        retries = int(0)
        lost = int(0)
        counted = int(-1)  # the outcome of the last `alike` solves
        alike = int(0)
        for r in range(wp.tid(), flags.shape[1], threads):
            if scalars[STEP_PROGRESS, r] >= real(1.0):
                continue
            result = flags[STATUS, r]
            code = result
            if result == wp.static(outcome.CONVERGED_TO_ROUNDING):
                code = rounded
            if code != counted:
                if alike > 0:
                    wp.atomic_add(tally, counted, wp.int64(alike))
                counted = code
                alike = 0
            alike += 1
            iterations += flags[ITERATION, r]
            most = wp.max(most, flags[ITERATION, r])
            solves += 1
            lost += flags[LOST_PIVOTS_TOTAL, r]
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
                retries += 1
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
        if alike > 0:
            wp.atomic_add(tally, counted, wp.int64(alike))
            wp.atomic_add(work, 0, wp.int64(iterations))
            wp.atomic_max(work, 1, wp.int64(most))
            wp.atomic_add(work, 2, wp.int64(solves))
            if retries > 0:
                wp.atomic_add(work, 3, wp.int64(retries))
            if lost > 0:
                wp.atomic_add(work, 4, wp.int64(lost))

    return advance

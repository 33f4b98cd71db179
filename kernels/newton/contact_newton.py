"""Contact in Newton's method of the coupled system: energy in the line search, step fractions, and obstructed supports."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import (
    ANY_ACTIVE,
    BACKTRACKS,
    CCD_LIMITED,
    DROP_COMPRESSION,
    ENERGY_BUFFER,
    ITERATE_ACTION,
    ITERATION,
    NEEDS_DIRECTION,
    PREDICTED_DECREASE,
    PROJECTED_ITERATIONS,
    RETRIES,
    STATUS,
    STEP_LENGTH,
    STEP_PROGRESS,
    SUBSTEP_ACCEPTED,
    SUBSTEP_FRACTION,
    SUPPORT_MOTION_PENDING,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS, items_function, until_function
from ddg_warp.kernels.linear.sliced_ell import product_functions
from ddg_warp.kernels.newton.coupled_newton import SUPPORTS_ARRIVED, SUPPORTS_MOVING
from ddg_warp.kernels.newton.rod_iterate import MOVE_STRAIGHT, ROTATE_EDGES, UPDATE_FRAMES

SINGLE_FRACTION, PER_BODY_FRACTION, NONE = (
    1,
    0,
    -1,
)  # modes of a world's motion: one fraction, one per CCD body, no motion
UNBRACED = 2  # retries, until the step is halved, after which inertia stiffens contact at its minimum gap
UNTRIED = 2  # iterates without the exact matrix after one in which it was indefinite


@cache
def contact_kernels(real, linear, serial: bool):
    """Build the kernels of contact in the line search and in the matrix.

    `account`: add the contact energy to the change since the accepted iterate.
    `gain`: write the predicted decrease of a motion.
    `expect`: correct the predicted decrease of a limited update.
    `refuse`: reject substeps with crossings.
    `curve`: choose the exact or the projected matrix.
    `again`: continue converged worlds with updated friction.
    `keep`: store the solution.
    `brace`: set the rate of inertia in contact stiffness.
    """
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    first_item, until = items_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def account(
        energy: wp.array(dtype=real),
        gap: wp.array(dtype=real),
        least: real,
        overflow: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        kept: wp.array2d(dtype=real),
        change: wp.array(dtype=real),
        rounding_error: wp.array(dtype=real),
    ):
        """Add contact energy to the change since the accepted iterate, and to the rounding.

        A world with a gap below `least` [m] stops, and shorter steps are tried. All stop if pairs overflowed, as the step is repeated.
        """
        w = wp.tid()
        if flags[STATUS, w] == 0 and (gap[w] < least or overflow[0] != 0):
            flags[STATUS, w] = wp.static(outcome.MINIMUM_GAP)
        if flags[STATUS, w] == 0:
            accepted = flags[ENERGY_BUFFER, w]
            kept[1 - accepted, w] = energy[w]
            change[w] = change[w] + energy[w] - kept[accepted, w]
            rounding_error[w] = rounding_error[w] + wp.abs(energy[w])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gain(
        rhs: wp.array(dtype=H),
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        modes: wp.array(dtype=int),
        blocks: int,
        dots_out: wp.array2d(dtype=real),
    ):
        """Write r . (q - base), summed over the blocks of a thread."""
        w, start = first_item(wp.tid(), blocks)
        if modes[w] == wp.static(NONE):
            return
        total = real(0.0)
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            r = rhs[i]
            total += wp.dot(V(real(r[0]), real(r[1]), real(r[2])), q[i] - base[i])
        dots_out[w, start] = total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def expect(
        modes: wp.array(dtype=int),
        time: wp.array(dtype=real),
        decrease: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        stalled: wp.array(dtype=int),
        projected: wp.array(dtype=int),
    ):
        """Set the predicted decrease of a limited update, over its length, and keep the world from counting as stalled.

        If the matrix was indefinite and the step is shortened, the exact matrix is of no use yet. The next iterate is projected at
        once, and does not count as a projected iteration (`kernels.core.islands.projected_limit_function`). Nor is the exact matrix
        tried in
        the next few iterates: some of many bodies are always where it is indefinite, and each trial is a full solve.
        """
        w = wp.tid()
        length = scalars[STEP_LENGTH, w]
        moves = modes[w] != wp.static(NONE)
        cut = moves and time[w] < real(1.0)
        if moves:
            flags[CCD_LIMITED, w] = int(cut)
        short = cut or (moves and flags[BACKTRACKS, w] > 0)
        if (
            projected[w] > 0
            and flags[DROP_COMPRESSION, w] == 0
            and (short or (moves and projected[w] <= wp.static(UNTRIED)))
        ):
            flags[DROP_COMPRESSION, w] = 1
            if short:
                flags[PROJECTED_ITERATIONS, w] = flags[PROJECTED_ITERATIONS, w] - 1
        cut = cut and length > real(0.0)
        if cut:
            scalars[PREDICTED_DECREASE, w] = wp.max(decrease[w], real(0.0)) / length
        if cut or flags[SUPPORT_MOTION_PENDING, w] != 0:
            stalled[w] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def refuse(
        crossed: wp.array(dtype=int),
        gap: wp.array(dtype=real),
        overflow: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        total: wp.array(dtype=wp.int64),
        least: wp.array(dtype=real),
    ):
        """Reject substeps with crossing pairs; note the smallest gap of others.

        If pairs overflowed, the step ends, as it will be repeated from its start.
        """
        w = wp.tid()
        if overflow[0] != 0:
            scalars[STEP_PROGRESS, w] = real(1.0)
            return
        if flags[SUBSTEP_ACCEPTED, w] != 0 and flags[STATUS, w] <= wp.static(outcome.CONVERGED_TO_ROUNDING):
            if crossed[w] > 0:
                flags[STATUS, w] = wp.static(outcome.INTERPENETRATION)
                wp.atomic_add(total, 0, wp.int64(crossed[w]))
            else:
                wp.atomic_min(least, 0, gap[w])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def curve(
        flags: wp.array2d(dtype=int), first_exact: int, curved: wp.array(dtype=int), projected: wp.array(dtype=int)
    ):
        """Mark worlds with geometric stiffness of pairs in the matrix; count consecutive projected iterates."""
        w = wp.tid()
        if flags[NEEDS_DIRECTION, w] != 0:
            projected[w] = wp.where(flags[DROP_COMPRESSION, w] != 0, projected[w] + 1, int(0))
        curved[w] = wp.where(
            flags[NEEDS_DIRECTION, w] != 0 and flags[ITERATION, w] > first_exact and flags[DROP_COMPRESSION, w] == 0,
            1,
            0,
        )

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def again(flags: wp.array2d(dtype=int)):
        """Continue worlds that have converged, with updated friction; the next iterate is accepted."""
        w = wp.tid()
        if flags[SUBSTEP_ACCEPTED, w] != 0 and flags[STATUS, w] <= wp.static(outcome.CONVERGED_TO_ROUNDING):
            flags[STATUS, w] = 0
            flags[BACKTRACKS, w] = 0
            flags[SUPPORT_MOTION_PENDING, w] = wp.static(SUPPORTS_ARRIVED)
            flags[ANY_ACTIVE, 0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def keep(q: wp.array(dtype=V), moved: wp.array(dtype=int), blocks: int, out: wp.array(dtype=V)):
        """Store positions of worlds that are solved; other entries keep their last solution."""
        w, start = first_item(wp.tid(), blocks)
        if moved[w] != 0:
            for k in range(start, until(start, blocks)):
                out[k + w * blocks] = q[k + w * blocks]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def brace(
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        dt: wp.array(dtype=real),
        braced: wp.array(dtype=int),
        rate: wp.array(dtype=real),
    ):
        """Write the rate of inertia in contact stiffness of the next substep, 0 until the minimum gap was reached."""
        w = wp.tid()
        if scalars[STEP_PROGRESS, w] >= real(1.0):
            return
        if scalars[STEP_PROGRESS, w] == real(0.0) and flags[RETRIES, w] == 0:
            braced[w] = 0
        elif flags[RETRIES, w] >= wp.static(UNBRACED) and flags[STATUS, w] == wp.static(outcome.MINIMUM_GAP):
            braced[w] = 1
        rate[w] = wp.where(braced[w] != 0, real(1.0) / (dt[w] * scalars[SUBSTEP_FRACTION, w]), real(0.0))

    return account, gain, expect, refuse, curve, again, keep, brace


@cache
def limit_kernels(real, serial: bool):
    """Build the kernels of step fractions.

    `modes`, `predicted`: choose the motion mode of an update or a predictor, and reset or advance the state of moving supports.
    `stay`: write starts and proposed ends of motions; choose one fraction for long ones.
    `near`: shorten long motions.
    `less`: correct the fraction of a motion that was shortened before CCD.
    `short`: mark worlds with a limited predictor.
    `combine`: multiply fractions of a motion that was limited twice.
    """
    V = wp.types.vector(3, real)
    first_item, until = items_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def modes(
        flags: wp.array2d(dtype=int),
        modes_out: wp.array(dtype=int),
        longest_out: wp.array(dtype=real),
        going: wp.array(dtype=int),
    ):
        """Choose modes: one fraction for updates that the line search has shortened, so that short ones descend.

        Reset `longest` and `going`, and advance the state of moving supports.
        """
        w = wp.tid()
        if w == 0:
            going[0] = 0
        longest_out[w] = real(0.0)
        modes_out[w] = wp.static(NONE)
        if flags[ITERATE_ACTION, w] == wp.static(ROTATE_EDGES) or flags[ITERATE_ACTION, w] == wp.static(MOVE_STRAIGHT):
            modes_out[w] = wp.where(
                flags[BACKTRACKS, w] > 0, int(wp.static(SINGLE_FRACTION)), int(wp.static(PER_BODY_FRACTION))
            )
            flags[SUPPORT_MOTION_PENDING, w] = wp.where(
                flags[SUPPORT_MOTION_PENDING, w] == wp.static(SUPPORTS_MOVING), int(wp.static(SUPPORTS_ARRIVED)), int(0)
            )

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def predicted(
        flags: wp.array2d(dtype=int),
        modes_out: wp.array(dtype=int),
        longest_out: wp.array(dtype=real),
        going: wp.array(dtype=int),
    ):
        """Choose modes of predictors, in worlds that take the step."""
        w = wp.tid()
        if w == 0:
            going[0] = 0
        longest_out[w] = real(0.0)
        modes_out[w] = wp.where(
            flags[SUBSTEP_ACCEPTED, w] != 0, int(wp.static(PER_BODY_FRACTION)), int(wp.static(NONE))
        )
        flags[SUPPORT_MOTION_PENDING, w] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def stay(
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        unit: wp.array(dtype=int),
        nodes: int,
        far: real,
        blocks: int,
        start_out: wp.array(dtype=V),
        modes: wp.array(dtype=int),
        proposed: wp.array(dtype=V),
        longest: wp.array(dtype=real),
    ):
        """Write the start of motions and proposed ends; motionless worlds start from `q`.

        Worlds in which a node moves by more than `far` [m] take one fraction; `longest` [m] is the longest displacement of a node.
        """
        w, start = first_item(wp.tid(), blocks)
        still = modes[w] == wp.static(NONE)
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            start_out[i] = base[i]
            if still:
                start_out[i] = q[i]
            else:
                proposed[i] = q[i]
                if k < nodes and unit[k] >= 0:
                    square = wp.length_sq(q[i] - base[i])
                    if square > far * far:
                        modes[w] = wp.static(SINGLE_FRACTION)
                        wp.atomic_max(longest, w, wp.sqrt(square))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def near(
        base: wp.array(dtype=V),
        unit: wp.array(dtype=int),
        modes: wp.array(dtype=int),
        longest: wp.array(dtype=real),
        most: real,
        blocks: int,
        q: wp.array(dtype=V),
    ):
        """Shorten motions by one fraction so that no node moves by more than `most` [m]."""
        w, start = first_item(wp.tid(), blocks)
        if modes[w] == wp.static(SINGLE_FRACTION) and longest[w] > most:
            for k in range(start, until(start, blocks)):
                if unit[k] >= 0:
                    i = k + w * blocks
                    q[i] = base[i] + (most / longest[w]) * (q[i] - base[i])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def less(modes: wp.array(dtype=int), longest: wp.array(dtype=real), most: real, time: wp.array(dtype=real)):
        """Correct the fraction of a motion that was shortened to `most` [m] before CCD."""
        w = wp.tid()
        if modes[w] == wp.static(SINGLE_FRACTION) and longest[w] > most:
            time[w] = time[w] * (most / longest[w])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def short(modes: wp.array(dtype=int), time: wp.array(dtype=real), flags: wp.array2d(dtype=int)):
        """Mark worlds with a predictor limited by CCD as moving."""
        w = wp.tid()
        if modes[w] != wp.static(NONE):
            flags[CCD_LIMITED, w] = int(time[w] < real(1.0))
            if flags[CCD_LIMITED, w] != 0:
                flags[SUPPORT_MOTION_PENDING, w] = wp.static(SUPPORTS_MOVING)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def combine(before: wp.array(dtype=real), time: wp.array(dtype=real)):
        """Multiply fractions of a motion that was limited twice."""
        w = wp.tid()
        time[w] = time[w] * before[w]

    return modes, predicted, stay, near, less, short, combine


@cache
def pending_kernels(real, linear, serial: bool):
    """Build the kernels of pending motion.

    `aim`: store the prescribed positions of supports.
    `land`: put supports at the end of a full step.
    `arrive`: put supports at prescribed positions, or mark the world as moving.
    `part`: discard proposed motions that have ended.
    `remainder`: write the remainder of a proposed motion.
    `push`: write the remaining motion of supports into the direction.
    `lessen`: subtract a product from the residual.
    `add`: add that remainder to the direction.
    """
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    _, free = product_functions(linear)
    first_item, until = items_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def aim(nodes: wp.array(dtype=int), blocks: int, q: wp.array(dtype=V), aims_out: wp.array2d(dtype=V)):
        i, w = wp.tid()
        aims_out[i, w] = q[nodes[i] + w * blocks]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def land(
        nodes: wp.array(dtype=int),
        aims: wp.array2d(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        modes: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        q: wp.array(dtype=V),
    ):
        """Set supports to prescribed positions after a full step, without the rounding of directions."""
        i, w = wp.tid()
        if modes[w] == wp.static(NONE) or flags[SUPPORT_MOTION_PENDING, w] == 0 or scalars[STEP_LENGTH, w] != real(1.0):
            return
        k = nodes[i]
        x = q[k + w * blocks]
        for c in range(3):
            if ((int(fixed[k]) >> c) & 1) != 0:
                x[c] = aims[i, w][c]
        q[k + w * blocks] = x

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def arrive(
        nodes: wp.array(dtype=int),
        aims: wp.array2d(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        modes: wp.array(dtype=int),
        eps: real,
        blocks: int,
        q: wp.array(dtype=V),
        flags: wp.array2d(dtype=int),
    ):
        """Set supports to prescribed positions if only rounding is missing; else mark the world as moving."""
        i, w = wp.tid()
        if modes[w] == wp.static(NONE):
            return
        k = nodes[i]
        x = q[k + w * blocks]
        for c in range(3):
            if ((int(fixed[k]) >> c) & 1) != 0:
                goal = aims[i, w][c]
                if wp.abs(goal - x[c]) <= eps * (wp.abs(goal) + wp.abs(x[c])):
                    x[c] = goal
                else:
                    flags[SUPPORT_MOTION_PENDING, w] = wp.static(SUPPORTS_MOVING)
        q[k + w * blocks] = x

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def part(
        q: wp.array(dtype=V),
        flags: wp.array2d(dtype=int),
        blocks: int,
        proposed: wp.array(dtype=V),
        going: wp.array(dtype=int),
    ):
        """Discard proposed motions of worlds with arrived supports or updated frames."""
        w, start = first_item(wp.tid(), blocks)
        along = flags[SUPPORT_MOTION_PENDING, w] == wp.static(SUPPORTS_MOVING)
        if along and flags[STATUS, w] == 0:
            going[0] = 1
        if not along or flags[ITERATE_ACTION, w] == wp.static(UPDATE_FRAMES):
            for k in range(start, until(start, blocks)):
                proposed[k + w * blocks] = q[k + w * blocks]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def remainder(
        q: wp.array(dtype=V),
        proposed: wp.array(dtype=V),
        wanted: wp.array(dtype=int),
        blocks: int,
        remainder_out: wp.array(dtype=H),
    ):
        w, start = first_item(wp.tid(), blocks)
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            d = proposed[i] - q[i]
            remainder_out[i] = wp.where(wanted[w] != 0, H(linear(d[0]), linear(d[1]), linear(d[2])), H())

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def push(
        nodes: wp.array(dtype=int),
        aims: wp.array2d(dtype=V),
        q: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        blocks: int,
        direction: wp.array(dtype=H),
    ):
        """Write the remaining motion of supports, to prescribed positions, into the direction."""
        i, w = wp.tid()
        if wanted[w] == 0:
            return
        k = nodes[i]
        d = aims[i, w] - q[k + w * blocks]
        for c in range(3):
            if ((int(fixed[k]) >> c) & 1) != 0:
                direction[k + w * blocks][c] = linear(d[c])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def lessen(
        product: wp.array(dtype=H),
        fixed: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        blocks: int,
        rhs: wp.array(dtype=H),
    ):
        """Subtract a product from the residual on free dofs of worlds that need a direction."""
        w, start = first_item(wp.tid(), blocks)
        if wanted[w] != 0:
            for k in range(start, until(start, blocks)):
                i = k + w * blocks
                rhs[i] = rhs[i] - wp.cw_mul(product[i], free(fixed[k]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(remainder: wp.array(dtype=H), wanted: wp.array(dtype=int), blocks: int, direction: wp.array(dtype=H)):
        w, start = first_item(wp.tid(), blocks)
        if wanted[w] != 0:
            for k in range(start, until(start, blocks)):
                direction[k + w * blocks] += remainder[k + w * blocks]

    return aim, land, arrive, part, remainder, push, lessen, add

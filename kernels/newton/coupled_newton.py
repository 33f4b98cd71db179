"""Newton's method on the coupled system: decisions, one thread a world, and updates, one thread a block."""

import math
from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import (
    ANY_ACTIVE,
    ANY_EDGE_ROTATION,
    ANY_NEEDS_DIRECTION,
    BELOW_ROUNDING_FLOOR,
    CCD_LIMITED,
    DOUBTFUL,
    DROP_COMPRESSION,
    ENERGY_BUFFER,
    ITERATE_ACTION,
    ITERATION,
    LOAD_SCALE,
    LOST_PIVOTS_TOTAL,
    NEEDS_DIRECTION,
    NOT_CONVERGED,
    PREDICTED_DECREASE,
    RESIDUAL_NORM_SQ,
    STATUS,
    STEP_LENGTH,
    STRAIGHT_ROTATION_LIMIT,
    SUPPORT_MOTION_PENDING,
    projected_limit_function,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS, items_function, until_function
from ddg_warp.kernels.newton.line_search import NEED_DIRECTION, STOP, line_search_functions
from ddg_warp.kernels.newton.rod_iterate import MOVE_STRAIGHT, ROTATE_EDGES

SUPPORTS_MOVING, SUPPORTS_ARRIVED = 2, 1  # supports or predictor obstructed: still moving, arrived in the last update
POLISH = 1e-3  # largest forcing term of a direction after which a residual may count as rounding
FIRST = 1e-2  # forcing term of the first direction of many bodies in contact
STALLED = 8  # allowed iterations without progress if energy changes are below the rounding floor


@cache
def search_kernels(real, linear, serial: bool, turns: bool, renews: bool, contact: bool = False, relaxed: bool = False):
    """Build the kernels of the line search and of updates.

    `decide_action`: test convergence, accept or shorten an update, and set the forcing term.
    `measure`: write the predicted decrease of a direction.
    `rotate`: write the largest rotation of a full update.
    `take`: set the step length of a direction.
    `move`: apply a straight update.

    `turns`: True if there are rods, so that edges may rotate. `renews`: True if there are frames to update.
    `contact`: True if supports may be moving; see `kernels.newton.contact_newton`.
    `relaxed`: True for relaxed convergence; see `ddg_warp.solve.newton.relaxed_convergence`.
    """
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    balanced, decide = line_search_functions(renews, real, contact)
    first_item, until = items_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def decide_action(
        change: wp.array(dtype=real),
        rounding_error: wp.array(dtype=real),
        square: wp.array(dtype=real),
        worst: wp.array(dtype=real),
        rtol: real,
        rounding_factor: real,
        max_iterations: int,
        max_halvings: int,
        loosest: real,
        tightest: real,
        spare: real,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        best: wp.array(dtype=real),
        stalled: wp.array(dtype=int),
        forcing: wp.array(dtype=linear),
        goal: wp.array(dtype=real),
        limit: wp.array(dtype=real),
    ):
        """Decide from sums over all blocks; `worst` is the largest residual over its tolerance at rtol = 1.

        The forcing term of the next direction follows Eisenstat and Walker (1996). If that aims below a fraction `spare` of the
        tolerance, this fraction is the `goal`. With relaxed convergence, unless CCD has limited the update, the forcing term is a
        `limit` instead: residuals of most bodies are far smaller than the largest, which dominate the norm.

        A world has converged to rounding if its predicted decrease is below the rounding floor and its residual has not halved in
        `STALLED` iterations with solved directions (see `take`). On bad meshes rounding exceeds the estimate per block.
        """
        w = wp.tid()
        flags[NEEDS_DIRECTION, w] = 0
        flags[ITERATE_ACTION, w] = 0
        # residuals left by an inexact direction are not rounding yet
        polish = (
            flags[STATUS, w] == 0
            and flags[NOT_CONVERGED, w] == 0
            and flags[BELOW_ROUNDING_FLOOR, w] != 0
            and forcing[w] > linear(wp.static(POLISH))  # in the same precision
        )
        if polish and flags[ITERATION, w] > 0:
            flags[NOT_CONVERGED, w] = 1
        if wp.static(real is wp.float32):
            if scalars[STEP_LENGTH, w] < real(1.0):  # a short step does not show how far nodes will move
                flags[DOUBTFUL, w] = 1
        if wp.static(contact):
            if flags[SUPPORT_MOTION_PENDING, w] == wp.static(SUPPORTS_MOVING):
                flags[NOT_CONVERGED, w] = 1
        if balanced(flags, scalars, w):
            return
        before = scalars[RESIDUAL_NORM_SQ, w]
        first = flags[ITERATION, w] == 0
        # zero length: a frame update, which predicts no decrease
        moved = not first and scalars[STEP_LENGTH, w] > real(0.0)
        below_floor = moved and scalars[PREDICTED_DECREASE, w] <= real(10.0) * rounding_error[w] * rounding_factor
        action = decide(
            change[w],
            rounding_error[w] * rounding_factor,
            square[w],
            worst[w],
            max_iterations,
            max_halvings,
            flags,
            scalars,
            w,
        )
        if action == wp.static(STOP):
            return
        if action == wp.static(NEED_DIRECTION):
            stalled[w] = stalled[w] + 1
            if not below_floor or square[w] < real(0.25) * best[w]:
                best[w] = square[w]
                stalled[w] = 0
            if stalled[w] > wp.static(STALLED):
                flags[STATUS, w] = wp.static(outcome.CONVERGED_TO_ROUNDING)
                return
        flags[ANY_ACTIVE, 0] = 1
        if action == wp.static(NEED_DIRECTION):
            eta = loosest
            if not first and before > real(0.0):
                eta = wp.clamp(real(0.9) * square[w] / before, tightest, loosest)
            enough = rtol * scalars[LOAD_SCALE, w] / worst[w]
            till = spare * enough >= eta
            limit[w] = tightest
            if wp.static(relaxed):
                if flags[CCD_LIMITED, w] == 0:
                    till = True
                    limit[w] = wp.where(first, real(wp.static(FIRST)), eta)
                    eta = loosest
            goal[w] = wp.where(till, spare * rtol * scalars[LOAD_SCALE, w], real(wp.static(math.inf)))
            eta = wp.max(eta, wp.min(enough, real(0.5)))
            if polish:
                eta = wp.min(eta, real(wp.static(POLISH)))
            forcing[w] = linear(eta)
            flags[NEEDS_DIRECTION, w] = 1
            flags[ANY_NEEDS_DIRECTION, 0] = 1
            return
        flags[ITERATE_ACTION, w] = action
        if wp.static(turns):
            flags[ANY_EDGE_ROTATION, 0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        rhs: wp.array(dtype=H),
        direction: wp.array(dtype=H),
        wanted: wp.array(dtype=int),
        blocks: int,
        dots_out: wp.array2d(dtype=real),
    ):
        """Write r . d, summed over the blocks of a thread."""
        w, start = first_item(wp.tid(), blocks)
        if wanted[w] == 0:
            return
        total = real(0.0)
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            total += real(wp.dot(rhs[i], direction[i]))
        dots_out[w, start] = total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def rotate(
        q: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        ends: wp.array2d(dtype=int),
        spins: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        rotation_out: wp.array2d(dtype=real),
    ):
        """Write the largest squared rotation by a full update: of edges, then of the twist angles and joints `spins`."""
        count = ends.shape[0] + spins.shape[0]
        w, start = first_item(wp.tid(), count)
        if wanted[w] == 0:
            return
        shift = w * blocks
        largest = real(0.0)
        for k in range(start, until(start, count)):
            rotation = real(0.0)
            if k >= ends.shape[0]:
                angle = direction[spins[k - ends.shape[0]] + shift]
                rotation = real(wp.dot(angle, angle))
            else:
                a = ends[k, 0] + shift
                b = ends[k, 1] + shift
                e = q[b] - q[a]
                d = direction[b] - direction[a]
                rotation = real(wp.dot(d, d)) / wp.length_sq(e)
            largest = wp.where(rotation > largest, rotation, largest)
        rotation_out[w, start] = largest

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def take(
        decrease: wp.array(dtype=real),
        rotation: wp.array(dtype=real),
        rotation_cap: real,
        iterations: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        stalled: wp.array(dtype=int),
        work: wp.array(dtype=wp.int64),
    ):
        """Set the step length: 1, or less so that no rotation exceeds the cap.

        A direction that PCG has not solved predicts no reliable decrease, so that no world stalls by it. Without any direction the
        iterate is repeated with dropped compression; if there is none again, the solve ends as indefinite.
        """
        w = wp.tid()
        if flags[NEEDS_DIRECTION, w] == 0:
            return
        if not wp.isfinite(decrease[w]):
            flags[STATUS, w] = wp.static(outcome.NON_FINITE)
            return
        if flags[NEEDS_DIRECTION, w] == 3:
            stalled[w] = 0
            if decrease[w] == real(0.0) and scalars[PREDICTED_DECREASE, w] == real(0.0) and flags[ITERATION, w] > 1:
                flags[STATUS, w] = wp.static(outcome.INDEFINITE)
                return
        step_length = real(1.0)
        if rotation[w] > rotation_cap * rotation_cap:
            step_length = rotation_cap / wp.sqrt(rotation[w])
        scalars[STEP_LENGTH, w] = step_length
        scalars[PREDICTED_DECREASE, w] = decrease[w]
        flags[ITERATE_ACTION, w] = wp.static(MOVE_STRAIGHT)
        if wp.static(turns):
            if rotation[w] > scalars[STRAIGHT_ROTATION_LIMIT, w] * scalars[STRAIGHT_ROTATION_LIMIT, w]:
                flags[ITERATE_ACTION, w] = wp.static(ROTATE_EDGES)
                flags[ANY_EDGE_ROTATION, 0] = 1
        wp.atomic_add(work, 0, wp.int64(iterations[w]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def move(
        direction: wp.array(dtype=H),
        step_length: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        halvings: wp.array(dtype=int),
        blocks: int,
        base: wp.array(dtype=V),
        q: wp.array(dtype=V),
    ):
        """Apply a straight update.

        A first one starts from the iterate, which becomes the base; a shortened one from the base.
        """
        w, start = first_item(wp.tid(), blocks)
        if todo[w] != wp.static(ROTATE_EDGES) and todo[w] != wp.static(MOVE_STRAIGHT):
            return
        length = step_length[w]
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            if halvings[w] == 0:
                base[i] = q[i]
            d = direction[i]
            q[i] = base[i] + V(real(d[0]), real(d[1]), real(d[2])) * length

    return decide_action, measure, rotate, take, move


@cache
def freeze_kernel():
    """Build the kernel of frozen Hessians.

    `freeze`: clear the request of a matrix in worlds that have one (`done`), and mark others that request one as done.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def freeze(flags: wp.array2d(dtype=int), done: wp.array(dtype=int)):
        w = wp.tid()
        if done[w] != 0:
            flags[NEEDS_DIRECTION, w] = 0
        elif flags[NEEDS_DIRECTION, w] != 0:
            done[w] = 1

    return freeze


@cache
def static_kernels(real, linear):
    """Build the kernels of an equilibrium; see `ddg_warp.solve.equilibrium.newton_pcg`.

    `follow`: take the work of follower loads from the mean load of the update.
    `less`: subtract a product from the residual.
    `far`: end solves of directions that exceed the rotation cap.
    """
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def follow(
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        load: wp.array(dtype=V),
        load_base: wp.array(dtype=V),
        status: wp.array(dtype=int),
        blocks: int,
        change: wp.array2d(dtype=real),
    ):
        """Replace the work of loads at q by the work of mean loads of q and the base."""
        i = wp.tid()
        w = i / blocks
        if status[w] == 0:
            k = i - w * blocks
            change[w, k] = change[w, k] + real(0.5) * wp.dot(q[i] - base[i], load[i] - load_base[i])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def less(product: wp.array(dtype=H), rhs: wp.array(dtype=H)):
        """Subtract the product."""
        i = wp.tid()
        rhs[i] = rhs[i] - product[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def far(rotation: wp.array(dtype=real), rotation_cap: real, wanted: wp.array(dtype=int)):
        """End linear solves of worlds with a direction beyond the rotation cap."""
        w = wp.tid()
        if wanted[w] == 1 and rotation[w] > rotation_cap * rotation_cap:
            wanted[w] = 3

    return follow, less, far


@cache
def repeat_kernel(real, fails: bool, exact: bool = True):
    """Build the kernel that handles an indefinite exact Hessian.

    `repeat`: end the solve (if it `fails`), or undo the acceptance and repeat the iterate.

    `negative` counts lost pivots and negative curvatures of this iteration. `drop_compression` then drops the geometric stiffness and
    compression from the next matrix, and the line search accepts again on the same numbers. `done`: the direction has been computed.
    `exact`: the matrix is the exact Hessian unless that is indefinite.
    """

    out_of_patience = projected_limit_function(real)

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
    def repeat(done: int, flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), negative: wp.array(dtype=int)):
        r = wp.tid()
        if flags[NEEDS_DIRECTION, r] == 0:
            return
        if negative[r] > 0 and flags[DROP_COMPRESSION, r] == 0:
            flags[NEEDS_DIRECTION, r] = 0
            negative[r] = 0
            if wp.static(fails):
                flags[STATUS, r] = wp.static(outcome.INDEFINITE)
                return
            flags[DROP_COMPRESSION, r] = 1
            flags[ITERATION, r] = flags[ITERATION, r] - 1
            flags[ENERGY_BUFFER, r] = 1 - flags[ENERGY_BUFFER, r]
        elif done != 0:
            flags[LOST_PIVOTS_TOTAL, r] = flags[LOST_PIVOTS_TOTAL, r] + negative[r]
            negative[r] = 0
            if wp.static(exact):
                if out_of_patience(flags, scalars, r):
                    flags[NEEDS_DIRECTION, r] = 0
            else:
                flags[DROP_COMPRESSION, r] = 0

    return repeat

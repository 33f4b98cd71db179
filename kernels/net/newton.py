"""Newton's method on a net: what becomes of an iterate and of a direction, a thread a world, and the moves, a thread a block."""

import math
from functools import cache

import warp as wp

from ddg_warp.kernels import outcome
from ddg_warp.kernels.foresight import told_function
from ddg_warp.kernels.islands import (
    ACTIVE,
    CAUTIOUS,
    CUT,
    DECREMENT,
    DOUBTFUL,
    DRIVEN,
    DROWNED,
    ITERATION,
    LOAD_SCALE,
    MERIT,
    MOVED,
    PROGRESS,
    RATE,
    STATUS,
    STEP_LENGTH,
    TODO,
    TURN,
    TURNING,
    UNBALANCED,
    WANTED,
    WANTING,
    attempt_functions,
)
from ddg_warp.kernels.judge import DIRECT, STOP, judge_functions
from ddg_warp.kernels.search import PLACE, STRAIGHT
from ddg_warp.kernels.threads import CPU_OPTIONS, share_function, until_function

ON_THE_WAY, THERE = 2, 1  # worlds whose supports or predictor were held up: not there yet, there since the last step
POLISH = 1e-3  # reduction to which a direction must have been solved before rounding excuses what it leaves
FIRST = 1e-2  # to which the first direction of a crowd may be solved
STALLED = 8  # iterations without progress, where energies drown in rounding, that a world is given


@cache
def search_kernels(real, linear, serial: bool, turns: bool, renews: bool, contact: bool = False, crowd: bool = False):
    """judge(...) of an iterate, measure(...) and take(...) of a direction, move(...) of the blocks.

    Args:
        turns: whether there are rods, whose edges turn; renews: whether there are frames, which may have to be renewed.
        contact: whether supports may be on their way; see `kernels.net.touch`.
        crowd: whether a few of what is in a world may be out of balance; see `ddg_warp.solve.net.outliers`.
    """
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    balanced, decide = judge_functions(renews, real, contact)
    share, until = share_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def judge(
        change: wp.array(dtype=real),
        noise: wp.array(dtype=real),
        square: wp.array(dtype=real),
        worst: wp.array(dtype=real),
        rtol: real,
        floor: real,
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
        """Decides by the sums over all blocks; `worst` is the largest residual over what it may be at rtol = 1.

        How exactly the next direction is solved follows Eisenstat and Walker (1996). Where that leaves less than a fraction `spare`
        of the tolerance, this fraction is its `goal`. In a crowd it is that wherever contact cuts nothing, and theirs the `limit` to
        which it is sought: residuals of bodies that count are far smaller than the largest ones, which make up the norm.

        A world whose expected decrease of energy drowns in rounding, and whose residual has not halved in `STALLED` iterations whose
        directions were solved (see `take`), has converged to rounding: on bad meshes rounding leaves more than the estimate block by
        block.
        """
        w = wp.tid()
        flags[WANTED, w] = 0
        flags[TODO, w] = 0
        # what an inexact direction leaves is not rounding yet
        polish = (
            flags[STATUS, w] == 0
            and flags[UNBALANCED, w] == 0
            and flags[DROWNED, w] != 0
            and forcing[w] > linear(wp.static(POLISH))  # as rounded as it is
        )
        if polish and flags[ITERATION, w] > 0:
            flags[UNBALANCED, w] = 1
        if wp.static(real is wp.float32):
            if scalars[STEP_LENGTH, w] < real(1.0):  # which tells little of how far nodes are to go
                flags[DOUBTFUL, w] = 1
        if wp.static(contact):
            if flags[DRIVEN, w] == wp.static(ON_THE_WAY):
                flags[UNBALANCED, w] = 1
        if balanced(flags, scalars, w):
            return
        before = scalars[MERIT, w]
        first = flags[ITERATION, w] == 0
        # by a whole step: a short one says nothing, one that renews frames expects none
        moved = not first and scalars[STEP_LENGTH, w] > real(0.0)
        drowns = moved and scalars[DECREMENT, w] <= real(10.0) * noise[w] * floor
        what = decide(change[w], noise[w] * floor, square[w], worst[w], max_iterations, max_halvings, flags, scalars, w)
        if what == wp.static(STOP):
            return
        if what == wp.static(DIRECT):
            stalled[w] = stalled[w] + 1
            if not drowns or square[w] < real(0.25) * best[w]:
                best[w] = square[w]
                stalled[w] = 0
            if stalled[w] > wp.static(STALLED):
                flags[STATUS, w] = wp.static(outcome.CONVERGED_TO_ROUNDING)
                return
        flags[ACTIVE, 0] = 1
        if what == wp.static(DIRECT):
            eta = loosest
            if not first and before > real(0.0):
                eta = wp.clamp(real(0.9) * square[w] / before, tightest, loosest)
            enough = rtol * scalars[LOAD_SCALE, w] / worst[w]
            till = spare * enough >= eta
            limit[w] = tightest
            if wp.static(crowd):
                if flags[CUT, w] == 0:
                    till = True
                    limit[w] = wp.where(first, real(wp.static(FIRST)), eta)
                    eta = loosest
            goal[w] = wp.where(till, spare * rtol * scalars[LOAD_SCALE, w], real(wp.static(math.inf)))
            eta = wp.max(eta, wp.min(enough, real(0.5)))
            if polish:
                eta = wp.min(eta, real(wp.static(POLISH)))
            forcing[w] = linear(eta)
            flags[WANTED, w] = 1
            flags[WANTING, 0] = 1
            return
        flags[TODO, w] = what
        if wp.static(turns):
            flags[TURNING, 0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        right: wp.array(dtype=H),
        direction: wp.array(dtype=H),
        wanted: wp.array(dtype=int),
        blocks: int,
        dots_out: wp.array2d(dtype=real),
    ):
        """r . d of the blocks that a thread takes."""
        w, start = share(wp.tid(), blocks)
        if wanted[w] == 0:
            return
        total = real(0.0)
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            total += real(wp.dot(right[i], direction[i]))
        dots_out[w, start] = total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def rotate(
        q: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        ends: wp.array2d(dtype=int),
        spins: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        blocks: int,
        turn_out: wp.array2d(dtype=real),
    ):
        """Largest squared turn, by a whole step, of what a thread takes: edges, then the angles and joints `spins`."""
        count = ends.shape[0] + spins.shape[0]
        w, start = share(wp.tid(), count)
        if wanted[w] == 0:
            return
        shift = w * blocks
        largest = real(0.0)
        for k in range(start, until(start, count)):
            turn = real(0.0)
            if k >= ends.shape[0]:
                angle = direction[spins[k - ends.shape[0]] + shift]
                turn = real(wp.dot(angle, angle))
            else:
                a = ends[k, 0] + shift
                b = ends[k, 1] + shift
                e = q[b] - q[a]
                d = direction[b] - direction[a]
                turn = real(wp.dot(d, d)) / wp.length_sq(e)
            largest = wp.where(turn > largest, turn, largest)
        turn_out[w, start] = largest

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def take(
        decrease: wp.array(dtype=real),
        turn: wp.array(dtype=real),
        rotation_cap: real,
        iterations: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        stalled: wp.array(dtype=int),
        work: wp.array(dtype=wp.int64),
    ):
        """Length of the step: whole, or so that nothing turns by more than the cap.

        A direction that conjugate gradients have not solved does not tell what a step would gain: no world stalls by it. Where there
        is none at all, the iterate comes again, without compression in its matrix; if there is none again, the solve ends as
        indefinite.
        """
        w = wp.tid()
        if flags[WANTED, w] == 0:
            return
        if not wp.isfinite(decrease[w]):
            flags[STATUS, w] = wp.static(outcome.NON_FINITE)
            return
        if flags[WANTED, w] == 3:
            stalled[w] = 0
            if decrease[w] == real(0.0) and scalars[DECREMENT, w] == real(0.0) and flags[ITERATION, w] > 1:
                flags[STATUS, w] = wp.static(outcome.INDEFINITE)
                return
        whole = real(1.0)
        if turn[w] > rotation_cap * rotation_cap:
            whole = rotation_cap / wp.sqrt(turn[w])
        scalars[STEP_LENGTH, w] = whole
        scalars[DECREMENT, w] = decrease[w]
        flags[TODO, w] = wp.static(STRAIGHT)
        if wp.static(turns):
            if turn[w] > scalars[TURN, w] * scalars[TURN, w]:
                flags[TODO, w] = wp.static(PLACE)
                flags[TURNING, 0] = 1
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
        """Straight along the direction: a first step from the iterate, which becomes the base, a shortened one from the base."""
        w, start = share(wp.tid(), blocks)
        if todo[w] != wp.static(PLACE) and todo[w] != wp.static(STRAIGHT):
            return
        length = step_length[w]
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            if halvings[w] == 0:
                base[i] = q[i]
            d = direction[i]
            q[i] = base[i] + V(real(d[0]), real(d[1]), real(d[2])) * length

    return judge, measure, rotate, take, move


@cache
def freeze_kernel():
    """freeze(...): where a direction is wanted of a matrix that is `done`, flags say that none is; others are done now."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def freeze(flags: wp.array2d(dtype=int), done: wp.array(dtype=int)):
        w = wp.tid()
        if done[w] != 0:
            flags[WANTED, w] = 0
        elif flags[WANTED, w] != 0:
            done[w] = 1

    return freeze


@cache
def step_kernels(real, midpoint: bool, serial: bool, contact: bool = False):
    """begin(...) and finish(...) of a time step; see `kernels.step` for the schemes."""
    (length, restart), told_of = attempt_functions(real, midpoint), told_function(real, midpoint, contact)
    share, until = share_function(serial), until_function(serial)
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        mass: wp.array(dtype=V),
        dt: wp.array(dtype=real),
        damping: wp.array(dtype=real),
        outer: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        q_out: wp.array(dtype=V),
        base_out: wp.array(dtype=V),
        target_out: wp.array(dtype=V),
    ):
        """Starts a solve from the predictor; dofs without mass, whose rates mean nothing, start from where they are."""
        w, start = share(wp.tid(), blocks)
        ahead = scalars[PROGRESS, w] < real(1.0)
        if start == 0:
            flags[MOVED, w] = wp.where(ahead, 1, 0)
        if not ahead:
            return
        s = length(scalars, w, dt[w])
        rate = real(1.0) / s
        coefficient = rate * (rate + damping[0])
        if start == 0:
            restart(flags, scalars, w, rate, coefficient, outer[w])
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            mask = int(fixed[k])
            here = q0[i]
            v = v0[i]
            target_out[i] = here + v * (rate / coefficient)
            if flags[CAUTIOUS, w] == 0:
                for d in range(3):
                    if ((mask >> d) & 1) == 0 and mass[k][d] > real(0.0):
                        here[d] = here[d] + s * v[d]
            q_out[i] = here
            base_out[i] = q0[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        q: wp.array(dtype=V),
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        a0: wp.array(dtype=V),
        predicted: wp.array(dtype=V),
        trust: wp.array(dtype=real),
        rate: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        q_out: wp.array(dtype=V),
        v_out: wp.array(dtype=V),
        a_out: wp.array(dtype=V),
        rate_out: wp.array(dtype=real),
    ):
        """Blocks, their velocities and accelerations at the end of the step, of the worlds that converged; and the rates of inertia in
        contact, where there is room for them."""
        w, first = share(wp.tid(), blocks)
        ahead = scalars[PROGRESS, w] < real(1.0) and flags[STATUS, w] <= wp.static(outcome.CONVERGED_TO_ROUNDING)
        if first == 0:
            flags[MOVED, w] = wp.where(ahead, 1, 0)
            if ahead and rate_out.shape[0] > 0:
                rate_out[w] = rate[w]
        told = told_of(flags, scalars, w) * trust[w]
        for k in range(first, until(first, blocks)):
            i = k + w * blocks
            start = q0[i]
            v = v0[i]
            a = a0[i]
            end = start
            if ahead:
                end = q[i]
                a = (end - predicted[i]) * told
                change = (end - start) * scalars[RATE, w]
                if wp.static(midpoint):
                    end = real(2.0) * end - start
                    v = real(2.0) * change - v
                else:
                    v = change
            q_out[i] = end
            v_out[i] = v
            a_out[i] = a

    return begin, finish


@cache
def static_kernels(real, linear):
    """follow(...), less(...) and far(...) of an equilibrium; see `ddg_warp.solve.net.statics`."""
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def follow(
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        here: wp.array(dtype=V),
        there: wp.array(dtype=V),
        status: wp.array(dtype=int),
        blocks: int,
        change: wp.array2d(dtype=real),
    ):
        """Makes the work of the loads `here`, at q, that of their mean with those `there`, at the base."""
        i = wp.tid()
        w = i / blocks
        if status[w] == 0:
            k = i - w * blocks
            change[w, k] = change[w, k] + real(0.5) * wp.dot(q[i] - base[i], here[i] - there[i])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def less(product: wp.array(dtype=H), right: wp.array(dtype=H)):
        """Takes one vector of blocks from another."""
        i = wp.tid()
        right[i] = right[i] - product[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def far(turn: wp.array(dtype=real), rotation_cap: real, wanted: wp.array(dtype=int)):
        """Ends the solves of worlds whose direction turns something by more than the cap already."""
        w = wp.tid()
        if wanted[w] == 1 and turn[w] > rotation_cap * rotation_cap:
            wanted[w] = 3

    return follow, less, far

"""Contact within Newton's method on a net: its energy in the search, how far worlds move, and what supports push."""

from functools import cache

import warp as wp

from ddg_warp.kernels import outcome
from ddg_warp.kernels.islands import (
    ACTIVE,
    CLAMPED,
    CUT,
    DECREMENT,
    DETOURS,
    DRIVEN,
    HALVINGS,
    ITERATION,
    MOVED,
    PORTION,
    PROGRESS,
    RETRIES,
    SLOT,
    STATUS,
    STEP_LENGTH,
    TODO,
    WANTED,
)
from ddg_warp.kernels.matrix.sliced import product_functions
from ddg_warp.kernels.net.newton import ON_THE_WAY, THERE
from ddg_warp.kernels.search import PLACE, RELAG, STRAIGHT
from ddg_warp.kernels.threads import CPU_OPTIONS, share_function, until_function

WHOLE, UNITS, NONE = 1, 0, -1  # how a world moves: with one share, unit by unit, not at all
UNBRACED = 2  # retries, until the step was halved, after which inertia counts in contact that still has no room
UNTRIED = 2  # iterates that are not tried with the exact matrix after one in which it was indefinite


@cache
def world_kernels(real):
    """A thread a world: account(...) for the energy; modes(...) of motions, and of what is predicted(...); depart(...) on them;
    expect(...) of steps that were cut; refuse(...) what crossed; curve(...) of matrices; again(...) with another friction;
    short(...) of predictors that were cut; less(...) of motions that were long; brace(...) what has no room."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def account(
        energy: wp.array(dtype=real),
        gap: wp.array(dtype=real),
        least: real,
        overflow: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        kept: wp.array2d(dtype=real),
        change: wp.array(dtype=real),
        noise: wp.array(dtype=real),
    ):
        """Adds what contact has to the change of the energy since the accepted iterate, and to its rounding.

        A world in which a gap is less than `least` does not go on: what goes on there is tried again in shorter steps. Nor does any
        while pairs do not fit: the step will be done again.
        """
        w = wp.tid()
        if flags[STATUS, w] == 0 and (gap[w] < least or overflow[0] != 0):
            flags[STATUS, w] = wp.static(outcome.NO_ROOM)
        if flags[STATUS, w] == 0:
            accepted = flags[SLOT, w]
            kept[1 - accepted, w] = energy[w]
            change[w] = change[w] + energy[w] - kept[accepted, w]
            noise[w] = noise[w] + wp.abs(energy[w])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def modes(flags: wp.array2d(dtype=int), modes_out: wp.array(dtype=int), longest_out: wp.array(dtype=real)):
        """A step that was shortened by the search moves all with one share: it descends, if short enough. None is long so far."""
        w = wp.tid()
        longest_out[w] = real(0.0)
        modes_out[w] = wp.static(NONE)
        if flags[TODO, w] == wp.static(PLACE) or flags[TODO, w] == wp.static(STRAIGHT):
            modes_out[w] = wp.where(flags[HALVINGS, w] > 0, int(wp.static(WHOLE)), int(wp.static(UNITS)))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def predicted(flags: wp.array2d(dtype=int), modes_out: wp.array(dtype=int), longest_out: wp.array(dtype=real)):
        """The same of predictors, which the worlds have that are on their way."""
        w = wp.tid()
        longest_out[w] = real(0.0)
        modes_out[w] = wp.where(flags[MOVED, w] != 0, int(wp.static(UNITS)), int(wp.static(NONE)))
        flags[DRIVEN, w] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def depart(modes: wp.array(dtype=int), flags: wp.array2d(dtype=int)):
        w = wp.tid()
        if modes[w] != wp.static(NONE):
            flags[DRIVEN, w] = wp.where(flags[DRIVEN, w] == wp.static(ON_THE_WAY), int(wp.static(THERE)), int(0))

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
        """What a step that was cut is expected to gain, over its length. If that drowns in rounding, it is not for being near.

        Where the matrix was indefinite and the step is not whole, things are not yet where the exact one is of use: the next iterate
        does without it at once, and it was no detour (`kernels.islands.patience_function`). Nor is it tried in the next few: of many
        things some are always where it is indefinite, and each trial is a whole solve.
        """
        w = wp.tid()
        length = scalars[STEP_LENGTH, w]
        moves = modes[w] != wp.static(NONE)
        cut = moves and time[w] < real(1.0)
        if moves:
            flags[CUT, w] = int(cut)
        short = cut or (moves and flags[HALVINGS, w] > 0)
        if projected[w] > 0 and flags[CLAMPED, w] == 0 and (short or (moves and projected[w] <= wp.static(UNTRIED))):
            flags[CLAMPED, w] = 1
            if short:
                flags[DETOURS, w] = flags[DETOURS, w] - 1
        cut = cut and length > real(0.0)
        if cut:
            scalars[DECREMENT, w] = wp.max(decrease[w], real(0.0)) / length
        if cut or flags[DRIVEN, w] != 0:
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
        """A part of a step in which things passed through each other is not taken; of others the smallest gap is kept.

        Where pairs did not fit, the step is over: it will be done again from its start.
        """
        w = wp.tid()
        if overflow[0] != 0:
            scalars[PROGRESS, w] = real(1.0)
            return
        if flags[MOVED, w] != 0 and flags[STATUS, w] <= wp.static(outcome.CONVERGED_TO_ROUNDING):
            if crossed[w] > 0:
                flags[STATUS, w] = wp.static(outcome.CROSSED)
                wp.atomic_add(total, 0, wp.int64(crossed[w]))
            else:
                wp.atomic_min(least, 0, gap[w])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def curve(flags: wp.array2d(dtype=int), late: int, curved: wp.array(dtype=int), projected: wp.array(dtype=int)):
        """Where the matrix has what comes of pairs that turn, and in how many iterates in a row it is the projected one."""
        w = wp.tid()
        if flags[WANTED, w] != 0:
            projected[w] = wp.where(flags[CLAMPED, w] != 0, projected[w] + 1, int(0))
        curved[w] = wp.where(flags[WANTED, w] != 0 and flags[ITERATION, w] > late and flags[CLAMPED, w] == 0, 1, 0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def again(flags: wp.array2d(dtype=int)):
        """Worlds that have converged go on, under another friction: their next iterate is accepted."""
        w = wp.tid()
        if flags[MOVED, w] != 0 and flags[STATUS, w] <= wp.static(outcome.CONVERGED_TO_ROUNDING):
            flags[STATUS, w] = 0
            flags[HALVINGS, w] = 0
            flags[DRIVEN, w] = wp.static(THERE)
            flags[ACTIVE, 0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def short(modes: wp.array(dtype=int), time: wp.array(dtype=real), flags: wp.array2d(dtype=int)):
        """Worlds whose predictor was cut are on their way."""
        w = wp.tid()
        if modes[w] != wp.static(NONE):
            flags[CUT, w] = int(time[w] < real(1.0))
            if flags[CUT, w] != 0:
                flags[DRIVEN, w] = wp.static(ON_THE_WAY)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def less(modes: wp.array(dtype=int), longest: wp.array(dtype=real), most: real, time: wp.array(dtype=real)):
        """The part of a motion that is made, where that was cut to `most` before it was made."""
        w = wp.tid()
        if modes[w] == wp.static(WHOLE) and longest[w] > most:
            time[w] = time[w] * (most / longest[w])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def brace(
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        dt: wp.array(dtype=real),
        braced: wp.array(dtype=int),
        rate: wp.array(dtype=real),
    ):
        """Before a part of a step is tried: the rate by which inertia counts in the stiffness of contact, zero until there was no
        room."""
        w = wp.tid()
        if scalars[PROGRESS, w] >= real(1.0):
            return
        if scalars[PROGRESS, w] == real(0.0) and flags[RETRIES, w] == 0:
            braced[w] = 0
        elif flags[RETRIES, w] >= wp.static(UNBRACED) and flags[STATUS, w] == wp.static(outcome.NO_ROOM):
            braced[w] = 1
        rate[w] = wp.where(braced[w] != 0, real(1.0) / (dt[w] * scalars[PORTION, w]), real(0.0))

    return account, modes, predicted, depart, expect, refuse, curve, again, short, less, brace


@cache
def block_kernels(real, linear, serial: bool):
    """gain(...) by a motion; lessen(...) the residual by a product; aim(...), push(...), land(...)
    and arrive(...) of supports; stay(...) of worlds that do not move; near(...) where they would go too
    far; part(...) with what was proposed; way(...) that is left, and add(...) it; keep(...) a solution."""
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    _, free = product_functions(linear)
    share, until = share_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gain(
        right: wp.array(dtype=H),
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        modes: wp.array(dtype=int),
        blocks: int,
        dots_out: wp.array2d(dtype=real),
    ):
        """r . (q - base) of the blocks that a thread takes."""
        w, start = share(wp.tid(), blocks)
        if modes[w] == wp.static(NONE):
            return
        total = real(0.0)
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            r = right[i]
            total += wp.dot(V(real(r[0]), real(r[1]), real(r[2])), q[i] - base[i])
        dots_out[w, start] = total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def lessen(
        product: wp.array(dtype=H),
        fixed: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        blocks: int,
        right: wp.array(dtype=H),
    ):
        """Takes a product from the residual on free dofs of worlds that want a direction."""
        w, start = share(wp.tid(), blocks)
        if wanted[w] != 0:
            for k in range(start, until(start, blocks)):
                i = k + w * blocks
                right[i] = right[i] - wp.cw_mul(product[i], free(fixed[k]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def aim(nodes: wp.array(dtype=int), blocks: int, q: wp.array(dtype=V), aims_out: wp.array2d(dtype=V)):
        i, w = wp.tid()
        aims_out[i, w] = q[nodes[i] + w * blocks]

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
        """What is left of the way of supports: they go to where they have to be."""
        i, w = wp.tid()
        if wanted[w] == 0:
            return
        k = nodes[i]
        d = aims[i, w] - q[k + w * blocks]
        for c in range(3):
            if ((int(fixed[k]) >> c) & 1) != 0:
                direction[k + w * blocks][c] = linear(d[c])

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
        """Supports that a whole step was to bring where they have to be are bound for there, though directions are rounded."""
        i, w = wp.tid()
        if modes[w] == wp.static(NONE) or flags[DRIVEN, w] == 0 or scalars[STEP_LENGTH, w] != real(1.0):
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
        """Supports that are where they have to be, up to rounding, are put there."""
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
                    flags[DRIVEN, w] = wp.static(ON_THE_WAY)
        q[k + w * blocks] = x

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
        """Where motions start: what does not move, from where it is. Worlds in which a node goes `far` have one share; how far the
        `longest` way is of these."""
        w, start = share(wp.tid(), blocks)
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
                        modes[w] = wp.static(WHOLE)
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
        """Cuts motions by one share in which a node goes farther than `most` to where the farthest goes so far."""
        w, start = share(wp.tid(), blocks)
        if modes[w] == wp.static(WHOLE) and longest[w] > most:
            for k in range(start, until(start, blocks)):
                if unit[k] >= 0:
                    i = k + w * blocks
                    q[i] = base[i] + (most / longest[w]) * (q[i] - base[i])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def part(
        q: wp.array(dtype=V),
        flags: wp.array2d(dtype=int),
        blocks: int,
        proposed: wp.array(dtype=V),
        going: wp.array(dtype=int),
    ):
        """Nothing but where it is remains of worlds that are not on their way, or whose frames are new."""
        w, start = share(wp.tid(), blocks)
        along = flags[DRIVEN, w] == wp.static(ON_THE_WAY)
        if along and flags[STATUS, w] == 0:
            going[0] = 1
        if not along or flags[TODO, w] == wp.static(RELAG):
            for k in range(start, until(start, blocks)):
                proposed[k + w * blocks] = q[k + w * blocks]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def way(
        q: wp.array(dtype=V),
        proposed: wp.array(dtype=V),
        wanted: wp.array(dtype=int),
        blocks: int,
        way_out: wp.array(dtype=H),
    ):
        w, start = share(wp.tid(), blocks)
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            d = proposed[i] - q[i]
            way_out[i] = wp.where(wanted[w] != 0, H(linear(d[0]), linear(d[1]), linear(d[2])), H())

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(way: wp.array(dtype=H), wanted: wp.array(dtype=int), blocks: int, direction: wp.array(dtype=H)):
        w, start = share(wp.tid(), blocks)
        if wanted[w] != 0:
            for k in range(start, until(start, blocks)):
                direction[k + w * blocks] += way[k + w * blocks]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def keep(q: wp.array(dtype=V), moved: wp.array(dtype=int), blocks: int, out: wp.array(dtype=V)):
        """Of worlds that are solved for: what others have was theirs when they were."""
        w, start = share(wp.tid(), blocks)
        if moved[w] != 0:
            for k in range(start, until(start, blocks)):
                out[k + w * blocks] = q[k + w * blocks]

    return gain, lessen, aim, push, land, arrive, stay, near, part, way, add, keep

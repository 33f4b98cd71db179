"""The line search of few, long rods: what `judge` and `search` do with one thread a rod, spread over its nodes.

Sums over a rod run over fixed ranges of about the root of its nodes, a thread a range, then a thread a rod over the ranges: always
in one order. Turned edges are summed to positions by a prefix sum in the same two stages.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames, outcome
from ddg_warp.kernels.element import ChainKind
from ddg_warp.kernels.judge import DIRECT, STOP, judge_functions
from ddg_warp.kernels.search import PLACE, RELAG, TURNED, move_functions

STRAIGHT = 4  # beside PLACE and RELAG, what is to be done with a rod: move its nodes along the direction


@cache
def sum_kernels(kind: ChainKind, real, linear):
    """Partial sums of a range: `weigh` of energy changes, rounding and residuals, `gauge` of a direction.

    Range i of a rod holds its nodes i, i + ranges, ..., so that neighbouring threads read neighbouring nodes.
    """
    dim, nb = kind.dim, kind.block
    V = wp.types.vector(dim, real)

    @wp.kernel(module="unique", enable_backward=False)
    def weigh(
        residual: wp.array3d(dtype=linear),
        change: wp.array2d(dtype=real),
        noise: wp.array2d(dtype=real),
        count: wp.array(dtype=int),
        status: wp.array(dtype=int),
        ranges: int,
        partial_out: wp.array3d(dtype=real),
    ):
        """Sums of energy changes, of their rounding and of squares of the residual, and its largest component."""
        i, r = wp.tid()
        if status[r] != 0:
            return
        total = real(0.0)
        rounding = real(0.0)
        square = real(0.0)
        worst = real(0.0)
        for k in range(i, count[r], ranges):
            total += change[k, r]
            rounding += noise[k, r]
            for d in range(wp.static(nb)):
                size = wp.abs(real(residual[d, k, r]))
                worst = wp.max(worst, size)
                square += size * size
        partial_out[0, i, r] = total
        partial_out[1, i, r] = rounding
        partial_out[2, i, r] = square
        partial_out[3, i, r] = worst

    @wp.kernel(module="unique", enable_backward=False)
    def gauge(
        residual: wp.array3d(dtype=linear),
        direction: wp.array3d(dtype=linear),
        x: wp.array2d(dtype=V),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        ranges: int,
        base_out: wp.array2d(dtype=V),
        partial_out: wp.array3d(dtype=real),
    ):
        """Share of r . d, and the largest squared turn of an edge; takes the iterate as the positions a step comes from."""
        i, r = wp.tid()
        if wanted[r] == 0:
            return
        total = real(0.0)
        rotation = real(0.0)
        for k in range(i, count[r], ranges):
            here = x[k, r]
            base_out[k, r] = here
            for d in range(wp.static(nb)):
                total += real(residual[d, k, r]) * real(direction[d, k, r])
            if k > 0:
                bent = V()
                for d in range(wp.static(dim)):
                    bent[d] = real(direction[d, k, r] - direction[d, k - 1, r])
                rotation = wp.max(rotation, wp.length_sq(bent) / wp.length_sq(here - x[k - 1, r]))
        partial_out[0, i, r] = total
        partial_out[1, i, r] = rotation

    return weigh, gauge


@cache
def decide_kernels(kind: ChainKind, real, linear):
    """Decisions of a rod from its partial sums: `judge` of an iterate, `take` of a direction."""
    balanced, decide = judge_functions(kind, real, linear)

    @wp.kernel(module="unique", enable_backward=False)
    def judge(
        partial: wp.array3d(dtype=real),
        ranges: int,
        floor: real,
        max_iterations: int,
        max_halvings: int,
        status: wp.array(dtype=int),
        unbalanced: wp.array(dtype=int),
        drowned: wp.array(dtype=int),
        slot: wp.array(dtype=int),
        iteration: wp.array(dtype=int),
        halvings: wp.array(dtype=int),
        step_length: wp.array(dtype=real),
        decrement: wp.array(dtype=real),
        merit: wp.array(dtype=real),
        load_scale: wp.array(dtype=real),
        largest: wp.array(dtype=real),
        turned: wp.array(dtype=int),
        lost: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        bad: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        angle_change: wp.array(dtype=real),
        active: wp.array(dtype=int),
    ):
        r = wp.tid()
        wanted[r] = 0
        todo[r] = 0
        bad[r] = 0
        if balanced(status, unbalanced, drowned, iteration, r):
            return
        total = real(0.0)
        rounding = real(0.0)
        square = real(0.0)
        worst = real(0.0)
        for i in range(ranges):
            total += partial[0, i, r]
            rounding += partial[1, i, r]
            square += partial[2, i, r]
            worst = wp.max(worst, partial[3, i, r])
        if iteration[r] == 0:
            lost[r] = 0
        taken = step_length[r]
        what = decide(
            total,
            rounding * floor,
            square,
            worst,
            max_iterations,
            max_halvings,
            status,
            slot,
            iteration,
            halvings,
            step_length,
            decrement,
            merit,
            load_scale,
            largest,
            turned,
            r,
        )
        if what == wp.static(STOP):
            return
        active[0] = 1
        if what == wp.static(DIRECT):
            wanted[r] = 1
        else:
            todo[r] = what
            angle_change[r] = step_length[r] - taken

    @wp.kernel(module="unique", enable_backward=False)
    def take(
        partial: wp.array3d(dtype=real),
        ranges: int,
        rotation_cap: real,
        wanted: wp.array(dtype=int),
        bad: wp.array(dtype=int),
        status: wp.array(dtype=int),
        iteration: wp.array(dtype=int),
        step_length: wp.array(dtype=real),
        decrement: wp.array(dtype=real),
        lost: wp.array(dtype=int),
        clamped: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        angle_change: wp.array(dtype=real),
    ):
        r = wp.tid()
        if wanted[r] == 0:
            return
        if bad[r] > 0 and clamped[r] == 0:
            # compression has made the matrix indefinite: the same iterate again, without what compression takes away
            clamped[r] = 1
            iteration[r] = iteration[r] - 1
            step_length[r] = real(0.0)
            return
        lost[r] = lost[r] + bad[r]
        total = real(0.0)
        rotation = real(0.0)
        for i in range(ranges):
            total += partial[0, i, r]
            rotation = wp.max(rotation, partial[1, i, r])
        if not wp.isfinite(total):
            status[r] = wp.static(outcome.NON_FINITE)
            return
        whole = real(1.0)
        if rotation > rotation_cap * rotation_cap:
            whole = rotation_cap / wp.sqrt(rotation)
        step_length[r] = whole
        angle_change[r] = whole
        decrement[r] = total
        todo[r] = wp.where(rotation > real(wp.static(TURNED**2)), wp.static(PLACE), wp.static(STRAIGHT))

    return judge, take


@cache
def move_kernels(kind: ChainKind, real, linear):
    """`turn`, `scan` and `offset`, the prefix sum of turned edges, then `move`, which puts nodes or frames; see `search.place`.

    `turn` also carries frames, into a second array, as neighbours still read those of before.
    """
    dim, twist = kind.dim, kind.twist
    V = wp.types.vector(dim, real)
    step_of, excess, put, carry = move_functions(kind, real, linear)
    _, reference_twist, _ = frames.functions(real)

    @wp.kernel(module="unique", enable_backward=False)
    def turn(
        count: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        direction: wp.array3d(dtype=linear),
        step_length: wp.array(dtype=real),
        base: wp.array2d(dtype=V),
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
        excess_out: wp.array2d(dtype=V),
        frame_out: wp.array3d(dtype=real),
    ):
        """Of every edge: excess of turning it over shearing it, or its frame in the iterate."""
        k, r = wp.tid()
        n = count[r]
        if k >= n - 1:
            return
        if todo[r] == wp.static(PLACE):
            excess_out[k, r] = excess(base, direction, step_length[r], k, n, r)
        if wp.static(twist):
            if todo[r] == wp.static(RELAG):
                u, t = carry(x, frame, k, n, r)
                for c in range(3):
                    frame_out[c, k, r] = u[c]
                    frame_out[3 + c, k, r] = t[c]
                twisted = frame[6, k, r]
                if k < n - 2:
                    u1, t1 = carry(x, frame, k + 1, n, r)
                    twisted = reference_twist(u, u1, t, t1, twisted)
                frame_out[6, k, r] = twisted

    @wp.kernel(module="unique", enable_backward=False)
    def scan(
        count: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        width: int,
        excess_to_sum: wp.array2d(dtype=V),
        sum_out: wp.array3d(dtype=V),
    ):
        """Sums of the edges before every node within its range of `width` nodes; of a range, its sum and that of these sums."""
        i, r = wp.tid()
        if todo[r] != wp.static(PLACE):
            return
        n = count[r]
        running = V()
        area = V()
        for k in range(i * width, wp.min(n, (i + 1) * width)):
            here = V()
            if k < n - 1:
                here = excess_to_sum[k, r]
            excess_to_sum[k, r] = running
            area += running
            running += here
        sum_out[0, i, r] = running
        sum_out[1, i, r] = area

    @wp.kernel(module="unique", enable_backward=False)
    def offset(
        count: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        width: int,
        ranges: int,
        sums: wp.array3d(dtype=V),
        mean_out: wp.array(dtype=V),
    ):
        """Replaces a range's sum by that of all ranges before it; mean over the nodes of what the edges before them sum to."""
        r = wp.tid()
        if todo[r] != wp.static(PLACE):
            return
        n = count[r]
        running = V()
        mean = V()
        for i in range(ranges):
            here = sums[0, i, r]
            sums[0, i, r] = running
            nodes = wp.min(n, (i + 1) * width) - i * width
            if nodes > 0:
                mean += sums[1, i, r] + running * real(nodes)
                running += here
        mean_out[r] = mean / real(n)

    @wp.func
    def before(prefix: wp.array2d(dtype=V), sums: wp.array3d(dtype=V), width: int, k: int, r: int):
        """Sum over all edges before node k."""
        return prefix[k, r] + sums[0, k // width, r]

    @wp.kernel(module="unique", enable_backward=False)
    def move(
        count: wp.array(dtype=int),
        fixed: wp.array2d(dtype=wp.uint8),
        held: wp.array3d(dtype=int),
        todo: wp.array(dtype=int),
        direction: wp.array3d(dtype=linear),
        step_length: wp.array(dtype=real),
        angle_change: wp.array(dtype=real),
        prefix: wp.array2d(dtype=V),
        sums: wp.array3d(dtype=V),
        mean: wp.array(dtype=V),
        width: int,
        new_frame: wp.array3d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        base: wp.array2d(dtype=V),
    ):
        """Puts a node where its step ends: of turned edges the sum from the held node before it, closing at the next."""
        k, r = wp.tid()
        what = todo[r]
        if what == 0 or k >= count[r]:
            return
        if what == wp.static(RELAG):
            base[k, r] = x[k, r]
            if wp.static(twist):
                if k < count[r] - 1:
                    for c in range(7):
                        frame[c, k, r] = new_frame[c, k, r]
            return
        shift = V()
        if what == wp.static(PLACE):
            shift = before(prefix, sums, width, k, r)
            p = held[0, k, r]
            q = held[1, k, r]
            if p < 0 and q < 0:
                shift -= mean[r]
            elif p < 0:
                shift -= before(prefix, sums, width, q, r)
            else:
                start = before(prefix, sums, width, p, r)
                shift -= start
                if q > p:
                    shift -= (before(prefix, sums, width, q, r) - start) * (real(k - p) / real(q - p))
        put(x, base, direction, fixed, step_length[r], shift, k, r)
        if wp.static(twist):
            theta[k, r] = theta[k, r] + angle_change[r] * real(direction[wp.static(dim), k, r])

    return turn, scan, offset, move


@cache
def predict_kernels(kind: ChainKind, real, linear):
    """`aim`: bent rods step along their velocity, with edges turned; `renew`: every rod that moves takes new frames."""
    dim, nb = kind.dim, kind.block
    V = wp.types.vector(dim, real)

    @wp.kernel(module="unique", enable_backward=False)
    def aim(
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        fixed: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        progress: wp.array(dtype=real),
        bent: wp.array(dtype=int),
        base_out: wp.array2d(dtype=V),
        direction_out: wp.array3d(dtype=linear),
        step_length_out: wp.array(dtype=real),
        angle_change_out: wp.array(dtype=real),
        todo_out: wp.array(dtype=int),
    ):
        k, r = wp.tid()
        if k >= count[r]:
            return
        moving = progress[r] < real(1.0) and bent[r] != 0
        if k == 0:
            step_length_out[r] = real(1.0)
            angle_change_out[r] = real(0.0)
            todo_out[r] = wp.where(moving, wp.static(PLACE), 0)
        if moving:
            base_out[k, r] = x0[k, r]
            v = v0[k, r] / rate[r]
            for d in range(wp.static(nb)):
                direction_out[d, k, r] = linear(0.0)
            for d in range(wp.static(dim)):
                if ((int(fixed[k, r]) >> d) & 1) == 0:
                    direction_out[d, k, r] = linear(v[d])

    @wp.kernel(module="unique", enable_backward=False)
    def renew(progress: wp.array(dtype=real), todo_out: wp.array(dtype=int)):
        r = wp.tid()
        todo_out[r] = wp.where(progress[r] < real(1.0), wp.static(RELAG), 0)

    return aim, renew

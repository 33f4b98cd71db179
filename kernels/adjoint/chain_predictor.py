"""Reverse of the predictors of rods on their own; see `kernels.adjoint.turns`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.adjoint.turns import excess_function, unplace_function
from ddg_warp.kernels.chain import ChainKind, gather_functions
from ddg_warp.kernels.gather import row_functions
from ddg_warp.kernels.islands import BENT, RATE, TURN
from ddg_warp.kernels.step import predicted_function
from ddg_warp.kernels.threads import CPU_OPTIONS
from ddg_warp.kernels.turns import loose_function


@cache
def predict_kernel(kind: ChainKind, real, midpoint: bool):
    """pull(...): the reverse of the predictors of `step.begin_kernel` and `step.predict_kernel`, a thread a rod.

    Adds to the derivatives by where held dofs are, by positions and velocities at the start, and by the rate. `excess_out` and
    `added_out` are scratch.
    """
    dim, closed, every = kind.dim, kind.closed, (1 << kind.dim) - 1
    V = wp.types.vector(dim, real)
    along, *_ = gather_functions(kind, real)
    turned, predicted = excess_function(dim, real, midpoint), predicted_function(dim, real)
    loose, (take, give) = loose_function(dim, real), row_functions(dim, real)

    @wp.struct
    class Rod:
        given: wp.array3d(dtype=real)
        excess: wp.array3d(dtype=real)
        added: wp.array3d(dtype=real)
        fixed: wp.array2d(dtype=wp.uint8)
        count: int
        closed: int
        anchor: int
        r: int

    @wp.func
    def mask_of(rod: Rod, j: int):
        return int(rod.fixed[along(j, rod.count), rod.r])

    @wp.func
    def anchored(rod: Rod, j: int):
        return (mask_of(rod, j) & wp.static(every)) == wp.static(every)

    @wp.func
    def by_shift(rod: Rod, j: int):
        return loose(mask_of(rod, j), take(rod.given, along(j, rod.count), rod.r))

    @wp.func
    def free_part(rod: Rod, j: int, v: V):
        return loose(mask_of(rod, j), v)

    @wp.func
    def give_excess(rod: Rod, j: int, v: V):
        give(rod.excess, along(j, rod.count), rod.r, v)

    @wp.func
    def give_added(rod: Rod, j: int, v: V):
        k = along(j, rod.count)
        give(rod.added, k, rod.r, take(rod.added, k, rod.r) + v)

    unplace = unplace_function(dim, real, Rod, anchored, by_shift, free_part, give_excess, give_added)

    @wp.func
    def turn(
        x: wp.array2d(dtype=V),
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        fixed: wp.array2d(dtype=wp.uint8),
        rate: real,
        straight: real,
        excess: wp.array3d(dtype=real),
        k: int,
        n: int,
        r: int,
    ):
        """What the excess of edge k brings to its base and to its step."""
        b = along(k + 1, n)
        e = x0[b, r] - x0[k, r]
        step = predicted(x[b, r], x0[b, r], v0[b, r], int(fixed[b, r]), 0, rate)
        step -= predicted(x[k, r], x0[k, r], v0[k, r], int(fixed[k, r]), 0, rate)
        by_e, by_step, _f, _straight = wp.grad(turned)(e, step, take(excess, k, r), straight)
        return by_e, by_step

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        x: wp.array2d(dtype=V),
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        fixed: wp.array2d(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        given: wp.array3d(dtype=real),
        excess_out: wp.array3d(dtype=real),
        added_out: wp.array3d(dtype=real),
        held_out: wp.array3d(dtype=real),
        x_out: wp.array2d(dtype=V),
        v_out: wp.array2d(dtype=V),
        rate_out: wp.array2d(dtype=real),
    ):
        r = wp.tid()
        n = count[r]
        rate = scalars[RATE, r]
        bent = flags[BENT, r] != 0
        edges = int(0)
        if bent:
            for k in range(n):
                give(added_out, k, r, V())
            rod = Rod()
            rod.given = given
            rod.excess = excess_out
            rod.added = added_out
            rod.fixed = fixed
            rod.count = n
            rod.closed = wp.static(int(closed))
            rod.anchor = anchor[r]
            rod.r = r
            unplace(rod)
            edges = n - wp.static(0 if closed else 1)
        behind = V()
        behind_step = V()
        if wp.static(closed):
            if bent:
                behind, behind_step = turn(x, x0, v0, fixed, rate, scalars[TURN, r], excess_out, n - 1, n, r)
        for k in range(n):
            mask = int(fixed[k, r])
            held = (mask & wp.static(every)) == wp.static(every)
            own = take(given, k, r)
            by_base = own
            if held:
                by_base = V()
                if bent:
                    by_base = -take(added_out, k, r)
                own -= by_base
            by_step = by_base
            if k < edges:
                ahead, ahead_step = turn(x, x0, v0, fixed, rate, scalars[TURN, r], excess_out, k, n, r)
                by_base -= ahead
                by_step -= ahead_step
                by_base += behind
                by_step += behind_step
                behind = ahead
                behind_step = ahead_step
            elif bent:
                by_base += behind
                by_step += behind_step
            by_rate = V()
            for d in range(wp.static(dim)):
                if held:
                    held_out[d, k, r] = held_out[d, k, r] + own[d]
                    by_rate[d] = by_step[d]
                elif ((mask >> d) & 1) == 1:
                    held_out[d, k, r] = held_out[d, k, r] + by_step[d]
                    by_base[d] = by_base[d] - by_step[d]
                else:
                    by_rate[d] = by_step[d]
            x_out[k, r] = x_out[k, r] + by_base
            v_out[k, r] = v_out[k, r] + by_rate / rate
            rate_out[k, r] = rate_out[k, r] - wp.dot(by_rate, v0[k, r]) / (rate * rate)

    return pull

"""Reverse of predictors, where a solve lags what they lead to: loads that follow, and by the midpoint rule frames and drag; see
`kernels.turns`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.chain import ChainKind, gather_functions
from ddg_warp.kernels.islands import BENT, RATE, TURN
from ddg_warp.kernels.search import PLACE
from ddg_warp.kernels.step import predicted_function
from ddg_warp.kernels.threads import CPU_OPTIONS
from ddg_warp.kernels.turns import edge_functions, onward_function


@cache
def unplace_function(dim: int, real, Rod, anchored, by_shift, free_part, give_excess, give_added):
    """unplace(rod): the reverse of `kernels.turns.place_function`, which is linear in excesses and in what anchors add.

    Args:
        Rod: struct of a rod; its fields `count`, `closed` and `anchor` as there.
        anchored: as there; by_shift: (rod, j) -> derivative by what node j is put beyond its step, zero of anchors.
        free_part: (rod, j, v) -> the part of v that the mean of a free rod takes of node j.
        give_excess: (rod, j, v) puts the derivative by that of edge j; give_added: (rod, j, v) adds to that by what anchor j adds.
    """
    V = wp.types.vector(dim, real)

    @wp.func
    def unplace(rod: Rod):
        n = rod.count
        free = rod.anchor < 0
        first = int(0)
        mean = V()
        if free:
            for j in range(n):
                mean += by_shift(rod, j)
            mean /= real(n)
        else:
            while not anchored(rod, first):
                first += 1
        last = wp.where(rod.closed != 0, first + n, n - 1)
        i = int(first)
        while i < last:
            stop = int(last)
            slope = V()
            spread = rod.closed != 0 or i < rod.anchor
            if spread:
                stop = i + 1
                while stop < last and not anchored(rod, stop):
                    stop += 1
                for j in range(i + 1, stop):
                    slope += (by_shift(rod, j) - free_part(rod, j, mean)) * real(j - i)
                slope /= real(stop - i)
            total = V()
            for back in range(stop - i):
                j = stop - back
                if j < first + n and not anchored(rod, j):
                    total += by_shift(rod, j) - free_part(rod, j, mean)
                give_excess(rod, j - 1, total - slope)
            if not free:
                give_added(rod, i, total - slope)
                if spread:
                    give_added(rod, stop, slope)
            i = stop
        if not free and rod.closed == 0:
            total = V()
            for j in range(first):
                total += by_shift(rod, j)
                give_excess(rod, j, -total)
            give_added(rod, first, total)

    return unplace


@cache
def excess_function(dim: int, real, midpoint: bool):
    """turned(e, de, f, straight): the excess of an edge that a predictor turns, times f; see `turns.onward_function`."""
    V = wp.types.vector(dim, real)
    along_edge, excess_of = edge_functions(dim, real)
    onward_of = onward_function(real)

    @wp.func
    def turned(e: V, de: V, f: V, straight: real):
        onward = onward_of(straight, wp.static(0 if midpoint else 1))
        return wp.dot(excess_of(e, de, along_edge(e, de), onward), f)

    return turned


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

    @wp.func
    def take(a: wp.array3d(dtype=real), k: int, r: int):
        v = V()
        for d in range(wp.static(dim)):
            v[d] = a[d, k, r]
        return v

    @wp.func
    def give(a: wp.array3d(dtype=real), k: int, r: int, v: V):
        for d in range(wp.static(dim)):
            a[d, k, r] = v[d]

    @wp.func
    def loose(mask: int, v: V):
        """What no support holds of it."""
        result = V()
        for d in range(wp.static(dim)):
            result[d] = wp.where(((mask >> d) & 1) == 0, v[d], real(0.0))
        return result

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


@cache
def net_kernels(real, midpoint: bool):
    """The same of the blocks of a net: unplace(...) of the rods of a level, a thread a rod; pass_on(...) what anchors added, a thread a
    block; turn(...) of every edge; pull(...) of every block. Levels are taken from the last one on.
    """
    V = wp.types.vector(3, real)
    turned = excess_function(3, real, midpoint)

    @wp.func
    def loose(mask: int, v: V):
        """What no support holds of it."""
        return V(
            wp.where((mask & 1) == 0, v[0], real(0.0)),
            wp.where((mask & 2) == 0, v[1], real(0.0)),
            wp.where((mask & 4) == 0, v[2], real(0.0)),
        )

    @wp.struct
    class Rod:
        given: wp.array(dtype=V)
        excess: wp.array2d(dtype=V)
        added: wp.array2d(dtype=V)
        nodes: wp.array(dtype=int)
        anchored: wp.array(dtype=wp.uint8)
        fixed: wp.array(dtype=wp.uint8)
        first: int
        world: int
        blocks: int
        count: int
        closed: int
        anchor: int

    @wp.func
    def place_of(rod: Rod, j: int):
        return rod.first + wp.where(j < rod.count, j, j - rod.count)

    @wp.func
    def anchored(rod: Rod, j: int):
        return rod.anchored[place_of(rod, j)] != wp.uint8(0)

    @wp.func
    def by_shift(rod: Rod, j: int):
        node = rod.nodes[place_of(rod, j)]
        return loose(int(rod.fixed[node]), rod.given[node + rod.world * rod.blocks])

    @wp.func
    def free_part(rod: Rod, j: int, v: V):
        return v

    @wp.func
    def give_excess(rod: Rod, j: int, v: V):
        rod.excess[rod.world, place_of(rod, j)] = v

    @wp.func
    def give_added(rod: Rod, j: int, v: V):
        p = place_of(rod, j)
        rod.added[rod.world, p] = rod.added[rod.world, p] + v

    unplace_rod = unplace_function(3, real, Rod, anchored, by_shift, free_part, give_excess, give_added)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def unplace(
        rods: wp.array(dtype=int),
        start: wp.array(dtype=int),
        nodes: wp.array(dtype=int),
        anchored: wp.array(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        loops: wp.array(dtype=int),
        fixed: wp.array(dtype=wp.uint8),
        todo: wp.array(dtype=int),
        blocks: int,
        given: wp.array(dtype=V),
        excess_out: wp.array2d(dtype=V),
        added_out: wp.array2d(dtype=V),
    ):
        """Writes what excesses bring, adds what anchors did, at the places of rods, in worlds that turn their edges."""
        i, w = wp.tid()
        if todo[w] != wp.static(PLACE):
            return
        r = rods[i]
        rod = Rod()
        rod.given = given
        rod.excess = excess_out
        rod.added = added_out
        rod.nodes = nodes
        rod.anchored = anchored
        rod.fixed = fixed
        rod.first = start[r]
        rod.world = w
        rod.blocks = blocks
        rod.count = start[r + 1] - start[r]
        rod.closed = loops[r]
        rod.anchor = anchor[r]
        unplace_rod(rod)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pass_on(
        meets: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        blocks: int,
        added: wp.array2d(dtype=V),
        given: wp.array(dtype=V),
        along_out: wp.array(dtype=V),
    ):
        """Of the nodes `meets` where rods of a level are anchored: adds to the derivatives by where they are, and takes from those by
        base and step alike."""
        i, w = wp.tid()
        total = V()
        for at in range(starts[i], starts[i + 1]):
            total += added[w, items[at]]
        block = meets[i] + w * blocks
        given[block] = given[block] + total
        along_out[block] = along_out[block] - total

    @wp.func
    def step_of(
        q: wp.array(dtype=V),
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        mass: wp.array(dtype=V),
        rate: real,
        k: int,
        i: int,
    ):
        """See `kernels.net.turns.turn_kernels`, aim."""
        mask = int(fixed[k])
        ahead = v0[i] / rate
        step = q[i] - q0[i]
        for d in range(3):
            if (mask & 7) == 7:
                step[d] = ahead[d]
            elif ((mask >> d) & 1) == 0:
                step[d] = wp.where(mass[k][d] > real(0.0), ahead[d], real(0.0))
        return step

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        nodes: wp.array(dtype=int),
        ahead: wp.array(dtype=int),
        q: wp.array(dtype=V),
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        mass: wp.array(dtype=V),
        rates: wp.array(dtype=real),
        straight: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        blocks: int,
        excess: wp.array2d(dtype=V),
        base_out: wp.array2d(dtype=V),
        step_out: wp.array2d(dtype=V),
    ):
        """What the excess of the edge from every place brings to its base and to its step."""
        p, w = wp.tid()
        if todo[w] != wp.static(PLACE) or nodes[p] == ahead[p]:
            return
        a = nodes[p] + w * blocks
        b = ahead[p] + w * blocks
        step = step_of(q, q0, v0, fixed, mass, rates[w], ahead[p], b)
        step -= step_of(q, q0, v0, fixed, mass, rates[w], nodes[p], a)
        by_base, by_step, _f, _straight = wp.grad(turned)(q0[b] - q0[a], step, excess[w, p], straight[w])
        base_out[w, p] = by_base
        step_out[w, p] = by_step

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        given: wp.array(dtype=V),
        along: wp.array(dtype=V),
        placed: wp.array(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        places: int,
        base: wp.array2d(dtype=V),
        step: wp.array2d(dtype=V),
        v0: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        mass: wp.array(dtype=V),
        todo: wp.array(dtype=int),
        rates: wp.array(dtype=real),
        blocks: int,
        held_out: wp.array(dtype=V),
        q_out: wp.array(dtype=V),
        v_out: wp.array(dtype=V),
        rate_out: wp.array(dtype=real),
    ):
        """Adds to the derivatives by held dofs, by the start and by the rate. `along` are those by base and step alike; items of a
        block are the edges from places on, and behind these all edges to places.
        """
        i = wp.tid()
        w = i / blocks
        k = i - w * blocks
        mask = int(fixed[k])
        here = given[i]
        by_base = V()
        by_step = V()
        if todo[w] == wp.static(PLACE):
            by_base = along[i]
            if placed[k] != wp.uint8(0):
                by_base += here
                here = V()
            by_step = by_base
            for at in range(starts[k], starts[k + 1]):
                p = items[at]
                if p < places:
                    by_base -= base[w, p]
                    by_step -= step[w, p]
                else:
                    by_base += base[w, p - places]
                    by_step += step[w, p - places]
        by_start = by_base
        by_rate = V()
        if (mask & 7) == 7:
            held_out[i] = held_out[i] + here
            by_rate = by_step
        else:
            own = here + by_step
            free = loose(mask, own)
            held_out[i] = held_out[i] + own - free
            by_start += free - by_step
            for d in range(3):
                if mass[k][d] > real(0.0):
                    by_rate[d] = free[d]
        q_out[i] = q_out[i] + by_start
        v_out[i] = v_out[i] + by_rate / rates[w]
        rate_out[i] = rate_out[i] - wp.dot(by_rate, v0[i]) / (rates[w] * rates[w])

    return unplace, pass_on, turn, pull

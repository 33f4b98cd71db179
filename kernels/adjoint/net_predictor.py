"""Reverse of the predictors of a net's rods, level by level; see `kernels.adjoint.turns`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.adjoint.turns import excess_function, unplace_function
from ddg_warp.kernels.search import PLACE
from ddg_warp.kernels.threads import CPU_OPTIONS
from ddg_warp.kernels.turns import loose_function


@cache
def net_kernels(real, midpoint: bool):
    """Of the blocks of a net: unplace(...) of the rods of a level, a thread a rod; pass_on(...) what anchors added, a thread a
    block; turn(...) of every edge; pull(...) of every block. Levels are taken from the last one on.
    """
    V = wp.types.vector(3, real)
    turned, loose = excess_function(3, real, midpoint), loose_function(3, real)

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
        before = rod.added[rod.world, p]
        rod.added[rod.world, p] = before + v

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

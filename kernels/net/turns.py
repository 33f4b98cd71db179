"""Steps of a net that turn the edges of its rods: the storage of `kernels.turns`, and the predictors that need them."""

from functools import cache

import warp as wp

from ddg_warp.kernels.islands import CAUTIOUS, RATE, STEP_LENGTH, TODO, TURN, TURNING
from ddg_warp.kernels.search import PLACE
from ddg_warp.kernels.turns import place_function


@cache
def turn_kernels(real, linear):
    """bend(...) finds predictors whose edges turn, aim(...) makes steps of them; place(...) turns the edges of one level's rods."""
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)

    @wp.struct
    class Rod:
        q: wp.array(dtype=V)
        base: wp.array(dtype=V)
        direction: wp.array(dtype=H)
        fixed: wp.array(dtype=wp.uint8)
        nodes: wp.array(dtype=int)
        anchored: wp.array(dtype=wp.uint8)
        amount: real
        first: int
        shift: int  # of blocks of the world
        count: int
        closed: int
        anchor: int
        onward: int

    @wp.func
    def place_of(rod: Rod, j: int):
        return rod.first + wp.where(j < rod.count, j, j - rod.count)

    @wp.func
    def move_of(rod: Rod, block: int):
        d = rod.direction[block]
        return V(real(d[0]), real(d[1]), real(d[2])) * rod.amount

    @wp.func
    def edge(rod: Rod, j: int):
        return rod.base[rod.nodes[place_of(rod, j + 1)] + rod.shift] - rod.base[rod.nodes[place_of(rod, j)] + rod.shift]

    @wp.func
    def step(rod: Rod, j: int):
        ahead = move_of(rod, rod.nodes[place_of(rod, j + 1)] + rod.shift)
        return ahead - move_of(rod, rod.nodes[place_of(rod, j)] + rod.shift)

    @wp.func
    def anchored(rod: Rod, j: int):
        return rod.anchored[place_of(rod, j)] != wp.uint8(0)

    @wp.func
    def added(rod: Rod, j: int):
        block = rod.nodes[place_of(rod, j)] + rod.shift
        return rod.q[block] - rod.base[block] - move_of(rod, block)

    @wp.func
    def put(rod: Rod, j: int, shift: V):
        node = rod.nodes[place_of(rod, j)]
        mask = int(rod.fixed[node])
        free = shift
        for d in range(3):
            if ((mask >> d) & 1) == 1:
                free[d] = real(0.0)
        rod.q[node + rod.shift] = rod.base[node + rod.shift] + move_of(rod, node + rod.shift) + free

    place_rod = place_function(3, real, Rod, edge, step, anchored, added, put)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def bend(
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        ends: wp.array2d(dtype=int),
        blocks: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
    ):
        """Asks for the edges of worlds to be turned that a predictor q from `base` turns far."""
        i, w = wp.tid()
        a = ends[i, 0] + w * blocks
        b = ends[i, 1] + w * blocks
        e = base[b] - base[a]
        straight = scalars[TURN, w]
        if straight == real(0.0) or wp.length_sq(q[b] - q[a] - e) > straight * straight * wp.length_sq(e):
            flags[TODO, w] = wp.static(PLACE)
            flags[TURNING, 0] = 1
            scalars[STEP_LENGTH, w] = real(1.0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def aim(
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        v: wp.array(dtype=V),
        fixed: wp.array(dtype=wp.uint8),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        direction_out: wp.array(dtype=H),
    ):
        i = wp.tid()
        w = i / blocks
        if flags[TODO, w] == wp.static(PLACE):
            d = q[i] - base[i]
            if (int(fixed[i - w * blocks]) & 7) == 7 and flags[CAUTIOUS, w] == 0:
                d = v[i] / scalars[RATE, w]  # where its rod expects a support; it is where it has to be
            direction_out[i] = H(linear(d[0]), linear(d[1]), linear(d[2]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def place(
        rods: wp.array(dtype=int),
        start: wp.array(dtype=int),
        nodes: wp.array(dtype=int),
        held: wp.array(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        loops: wp.array(dtype=int),
        base: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        fixed: wp.array(dtype=wp.uint8),
        step_length: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        onward: int,
        blocks: int,
        q: wp.array(dtype=V),
    ):
        """Nodes of the `rods` of one level, which a straight step has moved already, in worlds that turn their edges."""
        i, w = wp.tid()
        if todo[w] != wp.static(PLACE):
            return
        r = rods[i]
        rod = Rod()
        rod.q = q
        rod.base = base
        rod.direction = direction
        rod.fixed = fixed
        rod.nodes = nodes
        rod.anchored = held
        rod.amount = step_length[w]
        rod.first = start[r]
        rod.shift = w * blocks
        rod.count = start[r + 1] - start[r]
        rod.closed = loops[r]
        rod.anchor = anchor[r]
        rod.onward = onward
        place_rod(rod)

    return bend, aim, place

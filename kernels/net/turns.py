"""Steps of a net that turn the edges of its rods: the storage of `kernels.turns`, and the predictors that need them."""

from functools import cache

import warp as wp

from ddg_warp.kernels.islands import CAUTIOUS, RATE, STEP_LENGTH, TODO, TURN, TURNING
from ddg_warp.kernels.search import PLACE
from ddg_warp.kernels.threads import CPU_OPTIONS
from ddg_warp.kernels.turns import edge_functions, onward_function, place_function


def walk_functions(Rod):
    """place_of(rod, j) and anchored(rod, j): where node j of a rod is among the places of all, and whether it is anchored there.

    Args:
        Rod: struct of a rod; its fields `first`, `count` and `anchored`, of all places. Nodes may be counted on past the last one.
    """

    @wp.func
    def place_of(rod: Rod, j: int):
        return rod.first + wp.where(j < rod.count, j, j - rod.count)

    @wp.func
    def anchored(rod: Rod, j: int):
        return rod.anchored[place_of(rod, j)] != wp.uint8(0)

    return place_of, anchored


@cache
def turn_kernels(real, linear):
    """What turns edges: bend(...) finds predictors that have to, aim(...) makes steps of them; turn(...) turns edges, a thread each,
    turn_longer(...) those whose tensions say how much they lengthen; place(...) sums them along the rods of one level, a thread
    each, and put(...) takes their nodes there.
    """
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    along_edge, excess_of = edge_functions(3, real)
    onward_of = onward_function(real)

    @wp.struct
    class Rod:
        q: wp.array(dtype=V)
        base: wp.array(dtype=V)
        direction: wp.array(dtype=H)
        nodes: wp.array(dtype=int)
        anchored: wp.array(dtype=wp.uint8)
        excess: wp.array2d(dtype=V)
        shift: wp.array2d(dtype=V)
        amount: real
        first: int
        world: int
        blocks: int
        count: int
        closed: int
        anchor: int

    place_of, anchored = walk_functions(Rod)

    @wp.func
    def move_of(direction: wp.array(dtype=H), block: int, amount: real):
        d = direction[block]
        return V(real(d[0]), real(d[1]), real(d[2])) * amount

    @wp.func
    def excess(rod: Rod, j: int):
        return rod.excess[rod.world, place_of(rod, j)]

    @wp.func
    def added(rod: Rod, j: int):
        p = place_of(rod, j)
        if rod.anchored[p] == wp.uint8(0):
            return rod.shift[rod.world, p]
        block = rod.nodes[p] + rod.world * rod.blocks
        return rod.q[block] - rod.base[block] - move_of(rod.direction, block, rod.amount)

    @wp.func
    def shift_by(rod: Rod, j: int, shift: V):
        rod.shift[rod.world, place_of(rod, j)] = shift

    place_rod = place_function(3, real, Rod, excess, anchored, added, shift_by)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
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

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
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
            if (int(fixed[i - w * blocks]) & 7) == 7:
                # where its rod expects a support, which is where it has to be
                d = v[i] * wp.where(flags[CAUTIOUS, w] == 0, real(1.0) / scalars[RATE, w], real(0.0))
            direction_out[i] = H(linear(d[0]), linear(d[1]), linear(d[2]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        nodes: wp.array(dtype=int),
        ahead: wp.array(dtype=int),
        base: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        step_length: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        straight: wp.array(dtype=real),
        onward: int,
        blocks: int,
        excess_out: wp.array2d(dtype=V),
    ):
        """Excess of the edge from every place to the one `ahead` of it, in worlds that turn their edges."""
        p, w = wp.tid()
        if todo[w] != wp.static(PLACE):
            return
        a = nodes[p] + w * blocks
        b = ahead[p] + w * blocks
        amount = step_length[w]
        step = move_of(direction, b, amount) - move_of(direction, a, amount)
        edge = base[b] - base[a]
        excess_out[w, p] = excess_of(edge, step, along_edge(edge, step), onward_of(straight[w], onward))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn_longer(
        nodes: wp.array(dtype=int),
        ahead: wp.array(dtype=int),
        base: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        step_length: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        blocks: int,
        places: wp.array2d(dtype=int),
        longer: wp.array3d(dtype=linear),
        columns: int,
        excess_out: wp.array2d(dtype=V),
    ):
        """The same, with slack and lengthening of edges at the places (k, column) of the nodes ahead; see `solve.net.chains`."""
        p, w = wp.tid()
        if todo[w] != wp.static(PLACE):
            return
        a = nodes[p] + w * blocks
        b = ahead[p] + w * blocks
        amount = step_length[w]
        step = move_of(direction, b, amount) - move_of(direction, a, amount)
        edge = base[b] - base[a]
        stretch = along_edge(edge, step)
        if places[0, p] >= 0:
            c = places[1, p] + w * columns
            if longer[0, places[0, p], c] > linear(0.0):
                stretch = real(longer[1, places[0, p], c]) * amount
        excess_out[w, p] = excess_of(edge, step, stretch, 0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def place(
        rods: wp.array(dtype=int),
        start: wp.array(dtype=int),
        nodes: wp.array(dtype=int),
        anchored: wp.array(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        loops: wp.array(dtype=int),
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        step_length: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        blocks: int,
        excess: wp.array2d(dtype=V),
        shift_out: wp.array2d(dtype=V),
    ):
        """What nodes of the `rods` of one level have to move, once a straight step has been taken, beyond it."""
        i, w = wp.tid()
        if todo[w] != wp.static(PLACE):
            return
        r = rods[i]
        rod = Rod()
        rod.q = q
        rod.base = base
        rod.direction = direction
        rod.nodes = nodes
        rod.anchored = anchored
        rod.excess = excess
        rod.shift = shift_out
        rod.amount = step_length[w]
        rod.first = start[r]
        rod.world = w
        rod.blocks = blocks
        rod.count = start[r + 1] - start[r]
        rod.closed = loops[r]
        rod.anchor = anchor[r]
        place_rod(rod)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def put(
        places: wp.array(dtype=int),
        nodes: wp.array(dtype=int),
        fixed: wp.array(dtype=wp.uint8),
        shift: wp.array2d(dtype=V),
        base: wp.array(dtype=V),
        direction: wp.array(dtype=H),
        step_length: wp.array(dtype=real),
        todo: wp.array(dtype=int),
        blocks: int,
        q: wp.array(dtype=V),
    ):
        """The nodes at `places`, of which none is an anchor."""
        i, w = wp.tid()
        if todo[w] != wp.static(PLACE):
            return
        p = places[i]
        mask = int(fixed[nodes[p]])
        free = shift[w, p]
        for d in range(3):
            if ((mask >> d) & 1) == 1:
                free[d] = real(0.0)
        block = nodes[p] + w * blocks
        q[block] = base[block] + move_of(direction, block, step_length[w]) + free

    return bend, aim, turn, turn_longer, place, put

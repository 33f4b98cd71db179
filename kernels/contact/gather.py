"""What pairs bring to nodes, gathered in one order: sums over the pairs that each node is in.

An item is 6 pair + slot. Slots are of the four nodes of a pair and, where friction turns rods, of two angles of their edges, the x of
blocks of their own. `node_items` lists those of each node.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.surfaces import surface_struct
from ddg_warp.kernels.reading import read_function, write_function
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function

SLOTS, ANGLES = 4, 2  # nodes of a pair, and angles
ITEMS = SLOTS + ANGLES
ROW, WEIGHT = 8, 4  # numbers of a row of a factor, and where its weights begin
PLACED = 4  # numbers of what is placed, the last of no use


@wp.func
def taken_apart(item: int):
    """The pair of an item, and the slot."""
    p = item / wp.static(ITEMS)
    return p, item - wp.static(ITEMS) * p


@cache
def row_functions(linear):
    """row_of(rows, k, p) of a factor, direction_of(row) and weight_of(row).

    It is as long as what a GPU takes from memory at once: gathering one of a pair takes 32 bytes in float32, of two arrays twice that.
    """
    R, V, W = (wp.types.vector(size, linear) for size in (ROW, 3, SLOTS))
    row_of = read_function(R, 2)

    @wp.func
    def direction_of(row: R):
        return V(row[0], row[1], row[2])

    @wp.func
    def weight_of(row: R):
        return W(
            row[wp.static(WEIGHT)],
            row[wp.static(WEIGHT + 1)],
            row[wp.static(WEIGHT + 2)],
            row[wp.static(WEIGHT + 3)],
        )

    return row_of, direction_of, weight_of


@cache
def lay_functions(real, linear):
    """aim(rows, k, p, direction) and weigh(rows, k, p, weight), which write a row of a factor.

    In two parts: of one of eight numbers the CPU's compiler makes kernels that take four times as long.
    """
    R, V, W = wp.types.vector(ROW, linear), wp.types.vector(3, real), wp.types.vector(SLOTS, real)

    @wp.func
    def aim(rows: wp.array2d(dtype=R), k: int, p: int, v: V):
        for i in range(3):
            rows[k, p][i] = linear(v[i])

    @wp.func
    def weigh(rows: wp.array2d(dtype=R), k: int, p: int, w: W):
        for i in range(wp.static(SLOTS)):
            rows[k, p][wp.static(WEIGHT) + i] = linear(w[i])

    return aim, weigh


@cache
def ahead_function(real, linear):
    """ahead(own, p) -> used and the first two rows of pair p of a `set_struct`, or one twice: read at once, used or not."""
    PairSet, used_of = set_struct(real, linear), read_function(wp.int32)
    row_of, *_ = row_functions(linear)

    @wp.func
    def ahead(own: PairSet, p: int):
        return used_of(own.used, p), row_of(own.row, 0, p), row_of(own.row, wp.min(1, own.rows - 1), p)

    return ahead


@cache
def place_functions(linear):
    """put(placed, rank, value): what a pair brings to a node, if any; placed_at(placed, rank)."""
    V, W = wp.types.vector(3, linear), wp.types.vector(PLACED, linear)
    read, write = read_function(W), write_function(W)

    @wp.func
    def put(placed: wp.array(dtype=W), rank: int, value: V):
        if rank >= 0:
            write(placed, rank, W(value[0], value[1], value[2], linear(0.0)))

    @wp.func
    def placed_at(placed: wp.array(dtype=W), rank: int):
        value = read(placed, rank)
        return V(value[0], value[1], value[2])

    return put, placed_at


@cache
def factor_struct(linear):
    """Rows of the factors of pairs: where bit k + 1 of used[p] is set, row[k, p] has a weight times its direction for each node, and
    lever[k, p][i] is for the x of its block angles[p][i]; see `row_functions`.

    nodes (capacity,): of each pair, in all worlds; used (capacity,): zero of pairs that add nothing, else bit 0 is set; bend
    (capacity,): see `pair_bend`, zero where a pair has none; angles (capacity,): below zero for none, empty where friction rolls
    nothing.
    """
    R, A = wp.types.vector(ROW, linear), wp.types.vector(ANGLES, linear)

    @wp.struct
    class Factor:
        nodes: wp.array(dtype=wp.vec4i)
        used: wp.array(dtype=int)
        row: wp.array2d(dtype=R)
        bend: wp.array(dtype=linear)
        angles: wp.array(dtype=wp.vec2i)
        lever: wp.array2d(dtype=A)

    return Factor


@cache
def set_struct(real, linear):
    """A list of pairs: its factor (see `factor_struct`) and gradients, the items of nodes, and what products write.

    ranks, angle_ranks: of each pair, the places of its items among all of the list, -1 where it has none; `placed` by these is what
    products bring to nodes, which read it one after the other.
    marks, starts, columns: of pairs whose Hessians are kept, see `pair_terms.mollified_kernels`; empty where there are none.
    idle: of each pair, not zero where products leave out what it brings to nodes, which nobody reads then.
    count (1,): how many pairs there are; kind: place in `pair_bend.KINDS`, -1 without `bend`; edges: how many of its things, the
    first ones, are edges; rows: of its factor; things: first things of pairs in one world.
    """
    X, V, R = wp.types.vector(3, real), wp.types.vector(3, linear), wp.types.vector(ROW, linear)
    A, W = wp.types.vector(ANGLES, linear), wp.types.vector(PLACED, linear)

    @wp.struct
    class PairSet:
        pairs: wp.array(dtype=wp.vec2i)
        nodes: wp.array(dtype=wp.vec4i)
        used: wp.array(dtype=int)
        row: wp.array2d(dtype=R)
        bend: wp.array(dtype=linear)
        angles: wp.array(dtype=wp.vec2i)
        lever: wp.array2d(dtype=A)
        gradient: wp.array2d(dtype=X)
        marks: wp.array(dtype=int)
        starts: wp.array(dtype=int)
        columns: wp.array3d(dtype=V)
        placed: wp.array(dtype=W)
        places: wp.array(dtype=int)
        numbers: wp.array(dtype=int)
        items: wp.array(dtype=int)
        ranks: wp.array(dtype=wp.vec4i)
        angle_ranks: wp.array(dtype=wp.vec2i)
        count: wp.array(dtype=int)
        idle: wp.array(dtype=wp.uint8)
        kind: int
        edges: int
        rows: int
        things: int

    return PairSet


@cache
def sum_kernel(real, serial: bool):
    """gather(...) to nodes what pairs have written by slot."""
    V, until = wp.types.vector(3, real), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        parts: wp.array2d(dtype=V),
        used: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        numbers: wp.array(dtype=int),
        items: wp.array(dtype=int),
        out: wp.array(dtype=V),
    ):
        tid = wp.tid()
        for node in range(tid, until(tid, numbers.shape[0])):
            if numbers[node] > 0:
                total = V()
                for k in range(starts[node], starts[node] + numbers[node]):
                    p, slot = taken_apart(items[k])
                    if used[p] != 0:
                        total += parts[slot, p]
                out[node] = out[node] + total

    return gather


@cache
def collect_kernels(real, linear, serial: bool, rolls: bool):
    """collect(...) forces of all lists on nodes, and the blocks of H on its diagonal; join(...) those between the nodes of edges.

    If friction `rolls` rods, blocks of angles are among those of nodes, and roll(...) finds what is between these and nodes.

    One thread alone adds pair by pair, in the order in which others gather node by node.
    """
    PairSet, Surface = set_struct(real, linear), surface_struct(real)
    V, M, B = wp.types.vector(3, real), wp.types.matrix((3, 3), linear), wp.types.vector(6, linear)
    L, R, until = wp.types.vector(3, linear), wp.types.vector(ROW, linear), until_function(serial)
    row_of, direction_of, weight_of = row_functions(linear)
    ahead, slope_of, pair_of = ahead_function(real, linear), read_function(V, 2), read_function(wp.vec2i)

    @wp.func
    def product(row: R, a: int, b: int):
        """What a row of a factor makes of its nodes in slots a and b [N/m], symmetric, by its six entries."""
        v, w = direction_of(row), weight_of(row)
        return B(v[0] * v[0], v[0] * v[1], v[0] * v[2], v[1] * v[1], v[1] * v[2], v[2] * v[2]) * (w[a] * w[b])

    @wp.func
    def block(own: PairSet, p: int, used: int, first: R, second: R, a: int, b: int):
        """What pair p adds to the matrix between its nodes in slots a and b, by what is used of it and its first rows."""
        m = B()
        if used & 2 != 0:
            m += product(first, a, b)
        if used & 4 != 0:
            m += product(second, a, b)
        if used >= 8:
            for k in range(2, own.rows):
                if (used >> (k + 1)) & 1 != 0:
                    m += product(row_of(own.row, k, p), a, b)
        return m

    @wp.func
    def block_of(own: PairSet, p: int, used: int, first: R, second: R, slot: int):
        """What it adds to the matrix of the block in a slot with itself."""
        if wp.static(rolls):
            if slot >= wp.static(SLOTS):
                m = B()
                for k in range(own.rows):
                    if (used >> (k + 1)) & 1 != 0:
                        a = own.lever[k, p][slot - wp.static(SLOTS)]
                        m[0] += a * a
                return m
        return block(own, p, used, first, second, slot, slot)

    @wp.func
    def whole(b: B):
        return M(b[0], b[1], b[2], b[1], b[3], b[4], b[2], b[4], b[5])

    @wp.func
    def items_of(sets: wp.array(dtype=PairSet), node: int):
        every = int(0)
        for s in range(sets.shape[0]):
            every += sets[s].numbers[node]
        return every

    @wp.func
    def add_all(
        sets: wp.array(dtype=PairSet),
        forces: wp.array(dtype=V),
        diagonal: wp.array(dtype=M),
        stiffness: wp.array(dtype=real),
    ):
        for node in range(forces.shape[0]):
            forces[node] = V()
            diagonal[node] = M()
        for s in range(sets.shape[0]):
            own = sets[s]
            for p in range(own.count[0]):
                used, first, second = ahead(own, p)
                if used != 0:
                    for slot in range(wp.static(SLOTS)):
                        if own.ranks[p][slot] >= 0:
                            node = own.nodes[p][slot]
                            forces[node] = forces[node] - own.gradient[slot, p]
                            diagonal[node] = diagonal[node] + whole(block(own, p, used, first, second, slot, slot))
                    if wp.static(rolls):
                        if own.angles.shape[0] > 0:
                            for side in range(wp.static(ANGLES)):
                                angle = own.angles[p][side]
                                if own.angle_ranks[p][side] >= 0:
                                    slot = wp.static(SLOTS) + side
                                    forces[angle] = forces[angle] - own.gradient[slot, p]
                                    diagonal[angle] = diagonal[angle] + whole(
                                        block_of(own, p, used, first, second, slot)
                                    )
        for node in range(forces.shape[0]):
            stiffness[node] = real(wp.trace(diagonal[node]))

    @wp.func
    def join_all(sets: wp.array(dtype=PairSet), between: wp.array(dtype=M)):
        for i in range(between.shape[0]):
            between[i] = M()
        for s in range(sets.shape[0]):
            own = sets[s]
            for p in range(own.count[0]):
                used, first, second = ahead(own, p)
                if used != 0:
                    for side in range(own.edges):
                        if own.ranks[p][2 * side] >= 0:
                            edge, a = own.pairs[p][side], 2 * side
                            between[edge] = between[edge] + whole(block(own, p, used, first, second, a, a + 1))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def collect(
        sets: wp.array(dtype=PairSet),
        forces: wp.array(dtype=V),
        diagonal: wp.array(dtype=M),
        stiffness: wp.array(dtype=real),
        told: wp.array(dtype=wp.uint8),
    ):
        """`stiffness` are the traces of the blocks; `told` are nodes that had items, of which most never have any, or else are zero."""
        node = wp.tid()
        if wp.static(serial):
            add_all(sets, forces, diagonal, stiffness)
            return
        every = items_of(sets, node)
        if every == 0 and told[node] == wp.uint8(0):
            return
        told[node] = wp.uint8(wp.min(every, 1))
        force, total = V(), B()
        for s in range(sets.shape[0]):
            number = sets[s].numbers[node]
            if number > 0:
                own = sets[s]
                for k in range(own.places[node], own.places[node] + number):
                    p, slot = taken_apart(own.items[k])
                    used, first, second = ahead(own, p)
                    slope = slope_of(own.gradient, slot, p)
                    if used != 0:
                        force -= slope
                        total += block_of(own, p, used, first, second, slot)
        forces[node] = force
        diagonal[node] = whole(total)
        stiffness[node] = real(total[0] + total[3] + total[5])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def join(
        sets: wp.array(dtype=PairSet),
        edges: Surface,
        count: int,
        between: wp.array(dtype=M),
        told: wp.array(dtype=wp.uint8),
    ):
        """Items of the first node that come from this edge, not from another one that begins there; `told`: as above, of edges."""
        i = wp.tid()
        if wp.static(serial):
            join_all(sets, between)
            return
        w = i / count
        node = edges.nodes[i - w * count, 0] + w * edges.nodes_a_world
        every = items_of(sets, node)
        if every == 0 and told[i] == wp.uint8(0):
            return
        told[i] = wp.uint8(wp.min(every, 1))
        total = B()
        for s in range(sets.shape[0]):
            number = sets[s].numbers[node]
            if number > 0:
                own = sets[s]
                for k in range(own.places[node], own.places[node] + number):
                    p, slot = taken_apart(own.items[k])
                    if slot % 2 == 0 and slot / 2 < own.edges:
                        used, first, second = ahead(own, p)
                        pair = pair_of(own.pairs, p)
                        if used != 0 and pair[slot / 2] == i:
                            total += block(own, p, used, first, second, slot, slot + 1)
        between[i] = whole(total)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def roll(
        sets: wp.array(dtype=PairSet),
        angles: wp.array(dtype=int),
        blocks: int,
        first: wp.array(dtype=L),
        second: wp.array(dtype=L),
        ahead: wp.array(dtype=linear),
    ):
        """What the angle of each edge, of those of a world, has with both of its nodes and with the angle of the next edge."""
        tid = wp.tid()
        for i in range(tid, until(tid, first.shape[0])):
            w = i / angles.shape[0]
            a, b, c = L(), L(), linear(0.0)
            if angles[i - w * angles.shape[0]] >= 0:
                block = angles[i - w * angles.shape[0]] + w * blocks
                for s in range(sets.shape[0]):
                    if sets[s].numbers[block] > 0:
                        own = sets[s]
                        for k in range(own.places[block], own.places[block] + own.numbers[block]):
                            p, slot = taken_apart(own.items[k])
                            side = slot - wp.static(SLOTS)
                            for m in range(own.rows):
                                if own.used[p] != 0 and (own.used[p] >> (m + 1)) & 1 != 0:
                                    row, lever = row_of(own.row, m, p), own.lever[m, p]
                                    weight = weight_of(row)
                                    v = direction_of(row) * lever[side]
                                    if own.edges > 0:
                                        a += v * weight[2 * side]
                                        b += v * weight[2 * side + 1]
                                    elif side == 0:  # the edge before a point
                                        b += v * weight[0]
                                        c += lever[0] * lever[1]
                                    else:
                                        a += v * weight[0]
            first[i] = a
            second[i] = b
            ahead[i] = c

    return collect, join, roll

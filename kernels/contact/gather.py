"""What pairs bring to nodes, gathered in one order: sums over the pairs that each node is in.

An item is 6 pair + slot. Slots are of the four nodes of a pair and, where friction turns rods, of two angles of their edges, the x of
blocks of their own. `node_items` lists those of each node.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.surfaces import surface_struct
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function

SLOTS, ANGLES = 4, 2  # nodes of a pair, and angles
ITEMS = SLOTS + ANGLES


@wp.func
def taken_apart(item: int):
    """The pair of an item, and the slot."""
    p = item / wp.static(ITEMS)
    return p, item - wp.static(ITEMS) * p


@cache
def factor_struct(linear):
    """Rows of the factors of pairs: where bit k + 1 of used[p] is set, row k of p has weight[k, p][i] direction[k, p] for its node i,
    and lever[k, p][i] for the x of its block angles[p][i].

    nodes (capacity,): of each pair, in all worlds; used (capacity,): zero of pairs that add nothing, else bit 0 is set; bend
    (capacity,): see `pair_bend`, zero where a pair has none; angles (capacity,): below zero for none, empty where friction rolls
    nothing.
    """
    V, W, A = wp.types.vector(3, linear), wp.types.vector(SLOTS, linear), wp.types.vector(ANGLES, linear)

    @wp.struct
    class Factor:
        nodes: wp.array(dtype=wp.vec4i)
        used: wp.array(dtype=int)
        direction: wp.array2d(dtype=V)
        weight: wp.array2d(dtype=W)
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
    X, V, W = wp.types.vector(3, real), wp.types.vector(3, linear), wp.types.vector(SLOTS, linear)
    A = wp.types.vector(ANGLES, linear)

    @wp.struct
    class PairSet:
        pairs: wp.array(dtype=wp.vec2i)
        nodes: wp.array(dtype=wp.vec4i)
        used: wp.array(dtype=int)
        direction: wp.array2d(dtype=V)
        weight: wp.array2d(dtype=W)
        bend: wp.array(dtype=linear)
        angles: wp.array(dtype=wp.vec2i)
        lever: wp.array2d(dtype=A)
        gradient: wp.array2d(dtype=X)
        marks: wp.array(dtype=int)
        starts: wp.array(dtype=int)
        columns: wp.array3d(dtype=V)
        placed: wp.array(dtype=V)
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
    L, until = wp.types.vector(3, linear), until_function(serial)

    @wp.func
    def block(own: PairSet, p: int, a: int, b: int):
        """What pair p adds to the matrix between its nodes in slots a and b [N/m], symmetric, by its six entries."""
        m, used = B(), own.used[p]
        for k in range(own.rows):
            if (used >> (k + 1)) & 1 != 0:
                v = own.direction[k, p]
                w = own.weight[k, p]
                m += B(v[0] * v[0], v[0] * v[1], v[0] * v[2], v[1] * v[1], v[1] * v[2], v[2] * v[2]) * (w[a] * w[b])
        return m

    @wp.func
    def block_of(own: PairSet, p: int, slot: int):
        """What it adds to the matrix of the block in a slot with itself."""
        if wp.static(rolls):
            if slot >= wp.static(SLOTS):
                m, used = B(), own.used[p]
                for k in range(own.rows):
                    if (used >> (k + 1)) & 1 != 0:
                        a = own.lever[k, p][slot - wp.static(SLOTS)]
                        m[0] += a * a
                return m
        return block(own, p, slot, slot)

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
                if own.used[p] != 0:
                    for slot in range(wp.static(SLOTS)):
                        if own.ranks[p][slot] >= 0:
                            node = own.nodes[p][slot]
                            forces[node] = forces[node] - own.gradient[slot, p]
                            diagonal[node] = diagonal[node] + whole(block(own, p, slot, slot))
                    if wp.static(rolls):
                        if own.angles.shape[0] > 0:
                            for side in range(wp.static(ANGLES)):
                                angle = own.angles[p][side]
                                if own.angle_ranks[p][side] >= 0:
                                    slot = wp.static(SLOTS) + side
                                    forces[angle] = forces[angle] - own.gradient[slot, p]
                                    diagonal[angle] = diagonal[angle] + whole(block_of(own, p, slot))
        for node in range(forces.shape[0]):
            stiffness[node] = real(wp.trace(diagonal[node]))

    @wp.func
    def join_all(sets: wp.array(dtype=PairSet), between: wp.array(dtype=M)):
        for i in range(between.shape[0]):
            between[i] = M()
        for s in range(sets.shape[0]):
            own = sets[s]
            for p in range(own.count[0]):
                if own.used[p] != 0:
                    for side in range(own.edges):
                        if own.ranks[p][2 * side] >= 0:
                            edge = own.pairs[p][side]
                            between[edge] = between[edge] + whole(block(own, p, 2 * side, 2 * side + 1))

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
                    if own.used[p] != 0:
                        force -= own.gradient[slot, p]
                        total += block_of(own, p, slot)
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
                    if slot % 2 == 0 and slot / 2 < own.edges and own.used[p] != 0:
                        if own.pairs[p][slot / 2] == i:
                            total += block(own, p, slot, slot + 1)
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
                            for row in range(own.rows):
                                if own.used[p] != 0 and (own.used[p] >> (row + 1)) & 1 != 0:
                                    lever, weight = own.lever[row, p], own.weight[row, p]
                                    v = own.direction[row, p] * lever[side]
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

"""Assembly of contact: sum the contributions of pairs to their nodes in a fixed order.

An item is 8 pair + local index. Local indices 0-3 are the nodes of a pair; if friction rolls rods, 4 and 5 are twist angles of its
edges, the x of dof blocks of their own. If friction acts on surfaces of rigid bodies, 6 and 7 are rotation blocks of the bodies on both
sides. `incidence` lists the items of each node.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.primitives import surface_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.core.vectorised_access import read_function, write_function

PAIR_NODES, ANGLES, BODIES = 4, 2, 2  # nodes of a pair, twist angles, and rotations of rigid bodies
FIRST_BODY = PAIR_NODES + ANGLES  # local index of the first rotation
ITEMS = FIRST_BODY + BODIES
ROW, WEIGHT = 8, 4  # numbers of a factor row, and index of its first weight
PLACED = 4  # numbers of a placed contribution, of which the last is unused


@wp.func
def unpacked(item: int):
    """Return the pair and the local index of an item."""
    p = item / wp.static(ITEMS)
    return p, item - wp.static(ITEMS) * p


@cache
def row_functions(linear):
    """Return the device functions `row_of(rows, k, p)`, `direction_of(row)` and `weight_of(row)` of a factor.

    A row has the size of a memory transaction of a GPU, 32 bytes in float32; two arrays would take twice that.
    """
    R, V, W = (wp.types.vector(size, linear) for size in (ROW, 3, PAIR_NODES))
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
    """Return the device functions `aim(rows, k, p, v)` and `weigh(rows, k, p, w)`: write direction and weights of a factor row.

    Measured: kernels that write all eight numbers at once take four times as long on the CPU.
    """
    R, V, W = wp.types.vector(ROW, linear), wp.types.vector(3, real), wp.types.vector(PAIR_NODES, real)

    @wp.func
    def aim(rows: wp.array2d(dtype=R), k: int, p: int, v: V):
        for i in range(3):
            rows[k, p][i] = linear(v[i])

    @wp.func
    def weigh(rows: wp.array2d(dtype=R), k: int, p: int, w: W):
        for i in range(wp.static(PAIR_NODES)):
            rows[k, p][wp.static(WEIGHT) + i] = linear(w[i])

    return aim, weigh


@cache
def prefetch_function(real, linear):
    """Return the device function `prefetch(pair_set, p) -> (used, first, second)`: flags and first rows of a pair.

    A single row is returned twice. Rows are read at once, whether used or not.
    """
    PairSet, used_of = set_struct(real, linear), read_function(wp.int32)
    row_of, *_ = row_functions(linear)

    @wp.func
    def prefetch(pair_set: PairSet, p: int):
        return (
            used_of(pair_set.used, p),
            row_of(pair_set.row, 0, p),
            row_of(pair_set.row, wp.min(1, pair_set.rows - 1), p),
        )

    return prefetch


@cache
def place_functions(linear):
    """Return the device functions `store(placed, rank, value)` and `placed_at(placed, rank)` of contributions of pairs to nodes.

    A negative rank stores nothing.
    """
    V, W = wp.types.vector(3, linear), wp.types.vector(PLACED, linear)
    read, write = read_function(W), write_function(W)

    @wp.func
    def store(placed: wp.array(dtype=W), rank: int, value: V):
        if rank >= 0:
            write(placed, rank, W(value[0], value[1], value[2], linear(0.0)))

    @wp.func
    def placed_at(placed: wp.array(dtype=W), rank: int):
        value = read(placed, rank)
        return V(value[0], value[1], value[2])

    return store, placed_at


@cache
def factor_struct(linear):
    """Gauss-Newton factors of pairs; see `row_functions`.

    `row` (rows, capacity): row k of pair p is a weight times the direction for each node, if bit k + 1 of used[p] is set.
    `lever` (rows, capacity): entries of the row for the twist angles of the pair.
    `nodes` (capacity,): indices in all worlds.
    `used` (capacity,): 0 for pairs that contribute nothing, else bit 0 is set.
    `bend` (capacity,): coefficient of the geometric stiffness, see `geometric_stiffness`, or 0.
    `angles` (capacity,): dof blocks of twist angles, negative for none; empty without rolling friction.
    `rotations`, `radii` (capacity,): rotation blocks of the rigid bodies of both sides, negative for none, and radii of their surfaces
        [m], else zero; empty without friction on rigid bodies.
    `spin` (rows, capacity): entries of the row for a rotation of a surface of radius 1.
    """
    R, A = wp.types.vector(ROW, linear), wp.types.vector(ANGLES, linear)
    V, B = wp.types.vector(3, linear), wp.types.vector(BODIES, linear)

    @wp.struct
    class Factor:
        nodes: wp.array(dtype=wp.vec4i)
        used: wp.array(dtype=int)
        row: wp.array2d(dtype=R)
        bend: wp.array(dtype=linear)
        angles: wp.array(dtype=wp.vec2i)
        lever: wp.array2d(dtype=A)
        rotations: wp.array(dtype=wp.vec2i)
        radii: wp.array(dtype=B)
        spin: wp.array2d(dtype=V)

    return Factor


@cache
def set_struct(real, linear):
    """List of pairs with factors (see `factor_struct`), gradients, items of nodes and products.

    `ranks`, `angle_ranks`, `rotation_ranks`: positions of the items of a pair in the list of all items, -1 for none.
    `placed`: contributions of products, by rank, so that nodes read consecutive entries.
    `places`, `numbers`, `items`: incidence list of the nodes.
    `marks`, `starts`, `columns`: stored Hessians, see `pair_evaluation`; empty if there are none.
    `idle`: not zero for inactive pairs, which products skip.
    `count` (1,): number of pairs.
    `kind`: index in `geometric_stiffness.KINDS`, -1 without `bend`.
    `edges`: number of leading primitives of a pair that are edges.
    `rows`: number of factor rows.
    `primitives`: number of first primitives in one world.
    """
    X, V, R = wp.types.vector(3, real), wp.types.vector(3, linear), wp.types.vector(ROW, linear)
    A, W, B = (wp.types.vector(size, linear) for size in (ANGLES, PLACED, BODIES))

    @wp.struct
    class PairSet:
        pairs: wp.array(dtype=wp.vec2i)
        nodes: wp.array(dtype=wp.vec4i)
        used: wp.array(dtype=int)
        row: wp.array2d(dtype=R)
        bend: wp.array(dtype=linear)
        angles: wp.array(dtype=wp.vec2i)
        lever: wp.array2d(dtype=A)
        rotations: wp.array(dtype=wp.vec2i)
        radii: wp.array(dtype=B)
        spin: wp.array2d(dtype=V)
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
        rotation_ranks: wp.array(dtype=wp.vec2i)
        count: wp.array(dtype=int)
        idle: wp.array(dtype=wp.uint8)
        kind: int
        edges: int
        rows: int
        primitives: int

    return PairSet


@cache
def sum_kernel(real, serial: bool):
    """Build the kernel of assembly.

    `gather`: add values of pairs by local index (local, pairs) to their nodes.
    """
    V, until = wp.types.vector(3, real), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        values: wp.array2d(dtype=V),
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
                    p, local = unpacked(items[k])
                    if used[p] != 0:
                        total += values[local, p]
                out[node] = out[node] + total

    return gather


@cache
def collect_kernels(real, linear, serial: bool, rolls: bool, rotates: bool):
    """Build the kernels of forces and of matrix blocks along rods.

    `collect`: write forces of all lists and the diagonal blocks of H.
    `join`: write the blocks of H between the nodes of edges.
    `roll`: write the couplings of twist angles, if friction `rolls` rods; their diagonal blocks are with the nodes.

    If friction `rotates` rigid bodies, diagonal blocks of rotations are with the nodes, too.

    A `serial` thread adds pair by pair, in the order in which parallel threads gather node by node.
    """
    PairSet, Surface = set_struct(real, linear), surface_struct(real)
    V, M, B = wp.types.vector(3, real), wp.types.matrix((3, 3), linear), wp.types.vector(6, linear)
    L, R, until = wp.types.vector(3, linear), wp.types.vector(ROW, linear), until_function(serial)
    row_of, direction_of, weight_of = row_functions(linear)
    prefetch, slope_of, pair_of = prefetch_function(real, linear), read_function(V, 2), read_function(wp.vec2i)

    @wp.func
    def square(v: L):
        """Return v v^T, as six entries."""
        return B(v[0] * v[0], v[0] * v[1], v[0] * v[2], v[1] * v[1], v[1] * v[2], v[2] * v[2])

    @wp.func
    def product(row: R, a: int, b: int):
        """Return the symmetric 3 x 3 block of one Gauss-Newton row between nodes a and b [N/m], as six entries."""
        w = weight_of(row)
        return square(direction_of(row)) * (w[a] * w[b])

    @wp.func
    def block(pair_set: PairSet, p: int, used: int, first: R, second: R, a: int, b: int):
        """Return the block of pair p between nodes a and b, given its flags and first two rows."""
        m = B()
        if used & 2 != 0:
            m += product(first, a, b)
        if used & 4 != 0:
            m += product(second, a, b)
        if used >= 8:
            for k in range(2, pair_set.rows):
                if (used >> (k + 1)) & 1 != 0:
                    m += product(row_of(pair_set.row, k, p), a, b)
        return m

    @wp.func
    def block_of(pair_set: PairSet, p: int, used: int, first: R, second: R, local: int):
        """Return the diagonal block of pair p at a node, at a rotation or, in xx alone, a twist angle."""
        if wp.static(rotates):
            if local >= wp.static(FIRST_BODY):
                m = B()
                radius = pair_set.radii[p][local - wp.static(FIRST_BODY)]
                for k in range(pair_set.rows):
                    if (used >> (k + 1)) & 1 != 0:
                        m += square(pair_set.spin[k, p] * radius)
                return m
        if wp.static(rolls):
            if local >= wp.static(PAIR_NODES):
                m = B()
                for k in range(pair_set.rows):
                    if (used >> (k + 1)) & 1 != 0:
                        a = pair_set.lever[k, p][local - wp.static(PAIR_NODES)]
                        m[0] += a * a
                return m
        return block(pair_set, p, used, first, second, local, local)

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
            pair_set = sets[s]
            for p in range(pair_set.count[0]):
                used, first, second = prefetch(pair_set, p)
                if used != 0:
                    for local in range(wp.static(PAIR_NODES)):
                        if pair_set.ranks[p][local] >= 0:
                            node = pair_set.nodes[p][local]
                            forces[node] = forces[node] - pair_set.gradient[local, p]
                            diagonal[node] = diagonal[node] + whole(
                                block(pair_set, p, used, first, second, local, local)
                            )
                    if wp.static(rolls):
                        if pair_set.angles.shape[0] > 0:
                            for side in range(wp.static(ANGLES)):
                                angle = pair_set.angles[p][side]
                                if pair_set.angle_ranks[p][side] >= 0:
                                    local = wp.static(PAIR_NODES) + side
                                    forces[angle] = forces[angle] - pair_set.gradient[local, p]
                                    diagonal[angle] = diagonal[angle] + whole(
                                        block_of(pair_set, p, used, first, second, local)
                                    )
                    if wp.static(rotates):
                        if pair_set.rotations.shape[0] > 0:
                            for side in range(wp.static(BODIES)):
                                node = pair_set.rotations[p][side]
                                if node >= 0:
                                    local = wp.static(FIRST_BODY) + side
                                    forces[node] = forces[node] - pair_set.gradient[local, p]
                                    diagonal[node] = diagonal[node] + whole(
                                        block_of(pair_set, p, used, first, second, local)
                                    )
        for node in range(forces.shape[0]):
            stiffness[node] = real(wp.trace(diagonal[node]))

    @wp.func
    def join_all(sets: wp.array(dtype=PairSet), between: wp.array(dtype=M)):
        for i in range(between.shape[0]):
            between[i] = M()
        for s in range(sets.shape[0]):
            pair_set = sets[s]
            for p in range(pair_set.count[0]):
                used, first, second = prefetch(pair_set, p)
                if used != 0:
                    for side in range(pair_set.edges):
                        if pair_set.ranks[p][2 * side] >= 0:
                            edge, a = pair_set.pairs[p][side], 2 * side
                            between[edge] = between[edge] + whole(block(pair_set, p, used, first, second, a, a + 1))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def collect(
        sets: wp.array(dtype=PairSet),
        forces: wp.array(dtype=V),
        diagonal: wp.array(dtype=M),
        stiffness: wp.array(dtype=real),
        had_items: wp.array(dtype=wp.uint8),
    ):
        """Write forces, diagonal blocks and their traces, `stiffness`.

        `had_items`: 0 for nodes whose outputs are zero; most nodes never have items.
        """
        node = wp.tid()
        if wp.static(serial):
            add_all(sets, forces, diagonal, stiffness)
            return
        every = items_of(sets, node)
        if every == 0 and had_items[node] == wp.uint8(0):
            return
        had_items[node] = wp.uint8(wp.min(every, 1))
        force, total = V(), B()
        for s in range(sets.shape[0]):
            number = sets[s].numbers[node]
            if number > 0:
                pair_set = sets[s]
                for k in range(pair_set.places[node], pair_set.places[node] + number):
                    p, local = unpacked(pair_set.items[k])
                    used, first, second = prefetch(pair_set, p)
                    slope = slope_of(pair_set.gradient, local, p)
                    if used != 0:
                        force -= slope
                        total += block_of(pair_set, p, used, first, second, local)
        forces[node] = force
        diagonal[node] = whole(total)
        stiffness[node] = real(total[0] + total[3] + total[5])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def join(
        sets: wp.array(dtype=PairSet),
        edges: Surface,
        count: int,
        between: wp.array(dtype=M),
        had_items: wp.array(dtype=wp.uint8),
    ):
        """Sum items of the first node that belong to this edge.

        `had_items`: 0 for edges whose block is zero.
        """
        i = wp.tid()
        if wp.static(serial):
            join_all(sets, between)
            return
        w = i / count
        node = edges.nodes[i - w * count, 0] + w * edges.nodes_a_world
        every = items_of(sets, node)
        if every == 0 and had_items[i] == wp.uint8(0):
            return
        had_items[i] = wp.uint8(wp.min(every, 1))
        total = B()
        for s in range(sets.shape[0]):
            number = sets[s].numbers[node]
            if number > 0:
                pair_set = sets[s]
                for k in range(pair_set.places[node], pair_set.places[node] + number):
                    p, local = unpacked(pair_set.items[k])
                    if local % 2 == 0 and local / 2 < pair_set.edges:
                        used, first, second = prefetch(pair_set, p)
                        pair = pair_of(pair_set.pairs, p)
                        if used != 0 and pair[local / 2] == i:
                            total += block(pair_set, p, used, first, second, local, local + 1)
        between[i] = whole(total)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def roll(
        sets: wp.array(dtype=PairSet),
        angles: wp.array(dtype=int),
        blocks: int,
        first: wp.array(dtype=L),
        second: wp.array(dtype=L),
        next_angle: wp.array(dtype=linear),
    ):
        """Write couplings of each twist angle with both nodes of the edge and with the next angle."""
        tid = wp.tid()
        for i in range(tid, until(tid, first.shape[0])):
            w = i / angles.shape[0]
            a, b, c = L(), L(), linear(0.0)
            if angles[i - w * angles.shape[0]] >= 0:
                block = angles[i - w * angles.shape[0]] + w * blocks
                for s in range(sets.shape[0]):
                    if sets[s].numbers[block] > 0:
                        pair_set = sets[s]
                        for k in range(pair_set.places[block], pair_set.places[block] + pair_set.numbers[block]):
                            p, local = unpacked(pair_set.items[k])
                            side = local - wp.static(PAIR_NODES)
                            for m in range(pair_set.rows):
                                if pair_set.used[p] != 0 and (pair_set.used[p] >> (m + 1)) & 1 != 0:
                                    row, lever = row_of(pair_set.row, m, p), pair_set.lever[m, p]
                                    weight = weight_of(row)
                                    v = direction_of(row) * lever[side]
                                    if pair_set.edges > 0:
                                        a += v * weight[2 * side]
                                        b += v * weight[2 * side + 1]
                                    elif side == 0:  # the edge before a point
                                        b += v * weight[0]
                                        c += lever[0] * lever[1]
                                    else:
                                        a += v * weight[0]
            first[i] = a
            second[i] = b
            next_angle[i] = c

    return collect, join, roll

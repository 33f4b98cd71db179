"""What pairs bring to nodes, gathered in one order: which pairs each node is in, and sums over them.

An item is 4 pair + slot. One thread alone lists items in order. Many threads list them in any order, and then put each one where as
many of its list as are smaller come before it, so that sums of two runs agree to the bit.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.surfaces import EDGES, Kind, pair_functions, sides_struct
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function

SLOTS = 4  # nodes of a pair


@cache
def factor_struct(linear):
    """Rows of the factors of pairs: where bit k + 1 of used[p] is set, row k of p has weight[k, p][i] direction[k, p] for its node i.

    nodes (capacity,): of each pair, in all worlds; used (capacity,): zero of pairs that add nothing, else bit 0 is set; bend
    (capacity,): see `pair_bend`, zero where a pair has none.
    """
    V, W = wp.types.vector(3, linear), wp.types.vector(SLOTS, linear)

    @wp.struct
    class Factor:
        nodes: wp.array(dtype=wp.vec4i)
        used: wp.array(dtype=int)
        direction: wp.array2d(dtype=V)
        weight: wp.array2d(dtype=W)
        bend: wp.array(dtype=linear)

    return Factor


@cache
def begin_kernel(real):
    """Whether there was a search since nodes were listed; and gaps of worlds before any is seen."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(
        searches: wp.array(dtype=int),
        reach: real,
        listed: wp.array(dtype=int),
        stale: wp.array(dtype=int),
        gap: wp.array(dtype=real),
    ):
        w = wp.tid()
        gap[w] = reach
        if w == 0:
            stale[0] = wp.where(searches[0] != listed[0], 1, 0)
            listed[0] = searches[0]

    return begin


@cache
def list_kernels(kind: Kind, real, serial: bool):
    """name(...) the nodes of pairs; number(...) and fill(...) the items of nodes, sort(...) each list into `ordered`.

    Items are of pairs that are used, and of none of the nodes of a world that are `silent`, not zero.
    """
    Sides, until, size = sides_struct(real), until_function(serial), kind.first + kind.second
    slots, *_ = pair_functions(kind, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def name(
        pairs: wp.array(dtype=wp.vec2i), count: wp.array(dtype=int), sides: Sides, nodes_out: wp.array(dtype=wp.vec4i)
    ):
        tid = wp.tid()
        if tid >= count[0]:
            return
        for p in range(tid, until(tid, count[0])):
            w = pairs[p][0] / sides.counts[0]
            nodes = slots(sides, pairs[p][0] - w * sides.counts[0], pairs[p][1] - w * sides.counts[1], w)
            nodes_out[p] = wp.vec4i(nodes[0], nodes[1], nodes[2], nodes[3])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def number(
        count: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        used: wp.array(dtype=int),
        silent: wp.array(dtype=wp.uint8),
        numbers: wp.array(dtype=int),
    ):
        tid = wp.tid()
        if tid >= count[0]:
            return
        for p in range(tid, until(tid, count[0])):
            if used[p] != 0:
                for slot in range(wp.static(size)):
                    node = nodes[p][slot]
                    if silent[node % silent.shape[0]] == wp.uint8(0):
                        wp.atomic_add(numbers, node, 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def fill(
        count: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        used: wp.array(dtype=int),
        silent: wp.array(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        filled: wp.array(dtype=int),
        items: wp.array(dtype=int),
    ):
        tid = wp.tid()
        if tid >= count[0]:
            return
        for p in range(tid, until(tid, count[0])):
            for slot in range(wp.static(size)):
                node = nodes[p][slot]
                if used[p] != 0 and silent[node % silent.shape[0]] == wp.uint8(0):
                    items[starts[node] + wp.atomic_add(filled, node, 1)] = wp.static(SLOTS) * p + slot

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def sort(
        count: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        used: wp.array(dtype=int),
        silent: wp.array(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        numbers: wp.array(dtype=int),
        items: wp.array(dtype=int),
        ordered: wp.array(dtype=int),
    ):
        """A thread a pair, as a thread a node would take thousands of steps where a node is in thousands of pairs."""
        tid = wp.tid()
        if tid >= count[0]:
            return
        for p in range(tid, until(tid, count[0])):
            for slot in range(wp.static(size)):
                node = nodes[p][slot]
                if used[p] != 0 and silent[node % silent.shape[0]] == wp.uint8(0):
                    start = starts[node]
                    item = wp.static(SLOTS) * p + slot
                    smaller = int(0)
                    for k in range(start, start + numbers[node]):
                        smaller += wp.where(items[k] < item, 1, 0)
                    ordered[start + smaller] = item

    return name, number, fill, sort


@cache
def sum_kernels(size: int, real, serial: bool):
    """gather(...) to nodes what pairs have written a slot, or scatter(...) it by atomic additions, in any order."""
    V, until = wp.types.vector(3, real), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        parts: wp.array2d(dtype=V),
        used: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        numbers: wp.array(dtype=int),
        items: wp.array(dtype=int),
        scale: real,
        out: wp.array(dtype=V),
    ):
        """out += scale times the sum."""
        tid = wp.tid()
        for node in range(tid, until(tid, numbers.shape[0])):
            if numbers[node] > 0:
                total = V()
                for k in range(starts[node], starts[node] + numbers[node]):
                    p = items[k] / wp.static(SLOTS)
                    if used[p] != 0:
                        total += parts[items[k] - wp.static(SLOTS) * p, p]
                out[node] = out[node] + total * scale

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def scatter(
        count: wp.array(dtype=int),
        parts: wp.array2d(dtype=V),
        used: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        scale: real,
        out: wp.array(dtype=V),
    ):
        tid = wp.tid()
        if tid >= count[0]:
            return
        for p in range(tid, until(tid, count[0])):
            if used[p] != 0:
                for slot in range(wp.static(size)):
                    wp.atomic_add(out, nodes[p][slot], parts[slot, p] * scale)

    return gather, scatter


@cache
def block_function(rows: int, linear):
    """block(factor, p, a, b): what pair p adds to the matrix between its nodes in slots a and b, 3 x 3 [N/m]."""
    M, Factor = wp.types.matrix((3, 3), linear), factor_struct(linear)

    @wp.func
    def block(factor: Factor, p: int, a: int, b: int):
        m = M()
        for k in range(wp.static(rows)):
            if (factor.used[p] >> (k + 1)) & 1 != 0:
                v = factor.direction[k, p]
                w = factor.weight[k, p]
                m += wp.outer(v, v) * (w[a] * w[b])
        return m

    return block


@cache
def block_kernels(kind: Kind, rows: int, real, linear, serial: bool):
    """nodes(...) adds the blocks of H on its diagonal, edges(...) those between the first and the second node of edges.

    The latter is for kinds whose first things are edges.
    """
    M, Factor, Sides = wp.types.matrix((3, 3), linear), factor_struct(linear), sides_struct(real)
    block, until = block_function(rows, linear), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def nodes(
        factor: Factor,
        starts: wp.array(dtype=int),
        numbers: wp.array(dtype=int),
        items: wp.array(dtype=int),
        out: wp.array(dtype=M),
    ):
        tid = wp.tid()
        for node in range(tid, until(tid, numbers.shape[0])):
            if numbers[node] > 0:
                total = M()
                for k in range(starts[node], starts[node] + numbers[node]):
                    p = items[k] / wp.static(SLOTS)
                    slot = items[k] - wp.static(SLOTS) * p
                    if factor.used[p] != 0:
                        total += block(factor, p, slot, slot)
                out[node] = out[node] + total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def edges(
        factor: Factor,
        pairs: wp.array(dtype=wp.vec2i),
        sides: Sides,
        starts: wp.array(dtype=int),
        numbers: wp.array(dtype=int),
        items: wp.array(dtype=int),
        out: wp.array(dtype=M),
    ):
        """Items of the first node that come from this edge, not from another one that begins there."""
        tid = wp.tid()
        for i in range(tid, until(tid, out.shape[0])):
            w = i / sides.counts[0]
            node = sides.first.nodes[i - w * sides.counts[0], 0] + w * sides.first.nodes_a_world
            if numbers[node] > 0:
                total = M()
                for k in range(starts[node], starts[node] + numbers[node]):
                    p = items[k] / wp.static(SLOTS)
                    slot = items[k] - wp.static(SLOTS) * p
                    if factor.used[p] != 0 and (slot == 0 or (wp.static(kind == EDGES) and slot == 2)):
                        if pairs[p][slot / 2] == i:
                            total += block(factor, p, slot, slot + 1)
                out[i] = out[i] + total

    return nodes, edges


@cache
def trace_kernel(real, linear):
    """Traces of blocks."""
    M = wp.types.matrix((3, 3), linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def trace(blocks: wp.array(dtype=M), out: wp.array(dtype=real)):
        i = wp.tid()
        out[i] = real(wp.trace(blocks[i]))

    return trace

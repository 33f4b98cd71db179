"""Which pairs each node is in, by items (see `gather`).

One thread alone lists items in order. Many threads list them in any order, and then put each one where as many of its list as are
smaller come before it, so that sums of two runs agree to the bit.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.gather import ITEMS, SLOTS
from ddg_warp.kernels.contact.surfaces import Kind
from ddg_warp.kernels.threads import CPU_OPTIONS


@cache
def list_kernels(kind: Kind, serial: bool, rolls: bool = False):
    """number(...) and fill(...) the items of nodes, sort(...) each list into `ordered`.

    Items are of as many pairs as `count` says, of their nodes and, if friction `rolls` rods, of `angles`; and of none of the nodes of a
    world that are `silent`, not zero.
    """
    size, R = kind.first + kind.second, wp.types.vector(ITEMS, int)
    slots = ITEMS if rolls else size

    @wp.func
    def node_of(
        nodes: wp.array(dtype=wp.vec4i),
        angles: wp.array(dtype=wp.vec2i),
        silent: wp.array(dtype=wp.uint8),
        p: int,
        slot: int,
    ):
        """Which block has the item of a slot, -1 for none."""
        node = int(-1)
        if slot < wp.static(size):
            node = nodes[p][slot]
        if wp.static(rolls):
            if slot >= wp.static(SLOTS):
                node = angles[p][slot - wp.static(SLOTS)]
        if node >= 0:
            if silent[node % silent.shape[0]] != wp.uint8(0):
                node = -1
        return node

    @wp.func
    def note(
        ranks: wp.array(dtype=wp.vec4i),
        angle_ranks: wp.array(dtype=wp.vec2i),
        p: int,
        rank: R,
    ):
        ranks[p] = wp.vec4i(rank[0], rank[1], rank[2], rank[3])
        if wp.static(rolls):
            angle_ranks[p] = wp.vec2i(rank[4], rank[5])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def number(
        threads: int,
        count: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        angles: wp.array(dtype=wp.vec2i),
        silent: wp.array(dtype=wp.uint8),
        numbers: wp.array(dtype=int),
    ):
        for p in range(wp.tid(), count[0], threads):
            for slot in range(wp.static(slots)):
                node = node_of(nodes, angles, silent, p, slot)
                if node >= 0:
                    wp.atomic_add(numbers, node, 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def fill(
        threads: int,
        count: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        angles: wp.array(dtype=wp.vec2i),
        silent: wp.array(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        filled: wp.array(dtype=int),
        items: wp.array(dtype=int),
        ranks: wp.array(dtype=wp.vec4i),
        angle_ranks: wp.array(dtype=wp.vec2i),
    ):
        """One thread alone fills them in order: these are the ranks then."""
        for p in range(wp.tid(), count[0], threads):
            rank = R(-1, -1, -1, -1, -1, -1)
            for slot in range(wp.static(slots)):
                node = node_of(nodes, angles, silent, p, slot)
                if node >= 0:
                    rank[slot] = starts[node] + wp.atomic_add(filled, node, 1)
                    items[rank[slot]] = wp.static(ITEMS) * p + slot
            if wp.static(serial):
                note(ranks, angle_ranks, p, rank)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def sort(
        threads: int,
        count: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        angles: wp.array(dtype=wp.vec2i),
        silent: wp.array(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        numbers: wp.array(dtype=int),
        items: wp.array(dtype=int),
        ordered: wp.array(dtype=int),
        ranks: wp.array(dtype=wp.vec4i),
        angle_ranks: wp.array(dtype=wp.vec2i),
    ):
        """A thread a pair, as a thread a node would take thousands of steps where a node is in thousands of pairs."""
        for p in range(wp.tid(), count[0], threads):
            rank = R(-1, -1, -1, -1, -1, -1)
            for slot in range(wp.static(slots)):
                node = node_of(nodes, angles, silent, p, slot)
                if node >= 0:
                    start = starts[node]
                    item = wp.static(ITEMS) * p + slot
                    smaller = int(0)
                    for k in range(start, start + numbers[node]):
                        smaller += wp.where(items[k] < item, 1, 0)
                    ordered[start + smaller] = item
                    rank[slot] = start + smaller
            note(ranks, angle_ranks, p, rank)

    return number, fill, sort

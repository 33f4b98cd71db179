"""Incidence list of contact: the pairs of each node, as items (see `assembly`).

A serial thread lists items in order. Parallel threads list them in any order and then sort each list by rank, so that sums of two runs
agree bitwise.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.assembly import FIRST_BODY, ITEMS, PAIR_NODES
from ddg_warp.kernels.collision.primitives import Kind
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.prefix_sum import add_to_tile


@cache
def list_kernels(kind: Kind, serial: bool, rolls: bool = False, rotates: bool = False):
    """Build the kernels of incidence lists.

    `number`: count the items of nodes.
    `fill`: list the items of nodes.
    `sort`: sort each list into `ordered`.

    Items are the nodes of the first `count` pairs, their `angles` if friction `rolls` rods, and their `rotations` if it `rotates` rigid
    bodies. Nodes of a world with non-zero `silent` have none.
    """
    size, R = kind.first + kind.second, wp.types.vector(ITEMS, int)
    locals_per_pair = ITEMS if rotates else FIRST_BODY if rolls else size

    @wp.func
    def node_of(
        nodes: wp.array(dtype=wp.vec4i),
        angles: wp.array(dtype=wp.vec2i),
        rotations: wp.array(dtype=wp.vec2i),
        silent: wp.array(dtype=wp.uint8),
        p: int,
        local: int,
    ):
        """Return the dof block of a local index of a pair, -1 for none."""
        node = int(-1)
        if local < wp.static(size):
            node = nodes[p][local]
        if wp.static(rolls):
            if local >= wp.static(PAIR_NODES) and local < wp.static(FIRST_BODY):
                node = angles[p][local - wp.static(PAIR_NODES)]
        if wp.static(rotates):
            if local >= wp.static(FIRST_BODY):
                node = rotations[p][local - wp.static(FIRST_BODY)]
        if node >= 0:
            if silent[node % silent.shape[0]] != wp.uint8(0):
                node = -1
        return node

    @wp.func
    def note(
        ranks: wp.array(dtype=wp.vec4i),
        angle_ranks: wp.array(dtype=wp.vec2i),
        rotation_ranks: wp.array(dtype=wp.vec2i),
        p: int,
        rank: R,
    ):
        ranks[p] = wp.vec4i(rank[0], rank[1], rank[2], rank[3])
        if wp.static(rolls):
            angle_ranks[p] = wp.vec2i(rank[4], rank[5])
        if wp.static(rotates):
            rotation_ranks[p] = wp.vec2i(rank[6], rank[7])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def number(
        threads: int,
        count: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        angles: wp.array(dtype=wp.vec2i),
        rotations: wp.array(dtype=wp.vec2i),
        silent: wp.array(dtype=wp.uint8),
        numbers: wp.array(dtype=int),
        tiles: wp.array(dtype=int),
    ):
        for p in range(wp.tid(), count[0], threads):
            for local in range(wp.static(locals_per_pair)):
                node = node_of(nodes, angles, rotations, silent, p, local)
                if node >= 0:
                    wp.atomic_add(numbers, node, 1)
                    add_to_tile(tiles, node, 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def fill(
        threads: int,
        count: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        angles: wp.array(dtype=wp.vec2i),
        rotations: wp.array(dtype=wp.vec2i),
        silent: wp.array(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        filled: wp.array(dtype=int),
        items: wp.array(dtype=int),
        ranks: wp.array(dtype=wp.vec4i),
        angle_ranks: wp.array(dtype=wp.vec2i),
        rotation_ranks: wp.array(dtype=wp.vec2i),
    ):
        """List items; a serial thread lists them in order, which gives the ranks."""
        for p in range(wp.tid(), count[0], threads):
            rank = R(-1)
            for local in range(wp.static(locals_per_pair)):
                node = node_of(nodes, angles, rotations, silent, p, local)
                if node >= 0:
                    rank[local] = starts[node] + wp.atomic_add(filled, node, 1)
                    items[rank[local]] = wp.static(ITEMS) * p + local
            if wp.static(serial):
                note(ranks, angle_ranks, rotation_ranks, p, rank)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def sort(
        threads: int,
        count: wp.array(dtype=int),
        nodes: wp.array(dtype=wp.vec4i),
        angles: wp.array(dtype=wp.vec2i),
        rotations: wp.array(dtype=wp.vec2i),
        silent: wp.array(dtype=wp.uint8),
        starts: wp.array(dtype=int),
        numbers: wp.array(dtype=int),
        items: wp.array(dtype=int),
        ordered: wp.array(dtype=int),
        ranks: wp.array(dtype=wp.vec4i),
        angle_ranks: wp.array(dtype=wp.vec2i),
        rotation_ranks: wp.array(dtype=wp.vec2i),
    ):
        """Sort items by rank, the number of smaller items.

        Alternative: one thread a node takes thousands of steps for a node in thousands of pairs.
        """
        for p in range(wp.tid(), count[0], threads):
            rank = R(-1)
            for local in range(wp.static(locals_per_pair)):
                node = node_of(nodes, angles, rotations, silent, p, local)
                if node >= 0:
                    start = starts[node]
                    item = wp.static(ITEMS) * p + local
                    smaller = int(0)
                    for k in range(start, start + numbers[node]):
                        smaller += wp.where(items[k] < item, 1, 0)
                    ordered[start + smaller] = item
                    rank[local] = start + smaller
            note(ranks, angle_ranks, rotation_ranks, p, rank)

    return number, fill, sort

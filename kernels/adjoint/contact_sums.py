"""Derivatives by the numbers of pairs in contact, summed to those of what has them, in one order: two groups, or a body."""

from functools import cache

import warp as wp

from ddg_warp.kernels.adjoint.contact import NUMBERS
from ddg_warp.kernels.contact.gather import taken_apart
from ddg_warp.kernels.contact.pair_terms import groups_function, law_struct
from ddg_warp.kernels.contact.surfaces import Kind, sides_struct
from ddg_warp.kernels.threads import CPU_OPTIONS


@cache
def group_kernels(real):
    """pieces(...) sums the pairs of some first things of a world by groups, total(...) adds the pieces of worlds."""
    Law, Sides, groups = law_struct(real), sides_struct(real), groups_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pieces(
        count: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        partners: wp.array(dtype=int),
        pairs: wp.array(dtype=wp.vec2i),
        sides: Sides,
        law: Law,
        numbers: wp.array2d(dtype=real),
        number: int,
        things: int,
        out: wp.array4d(dtype=real),
    ):
        """`number` pieces a world, of so many things."""
        piece = wp.tid()
        for r in range(out.shape[0]):
            for a in range(out.shape[2]):
                for b in range(out.shape[3]):
                    out[r, piece, a, b] = real(0.0)
        if count[0] == 0:
            return
        world = piece / number
        first = (piece - world * number) * things
        for k in range(first, wp.min(first + things, sides.counts[0])):
            i = k + world * sides.counts[0]
            for p in range(starts[i], starts[i] + partners[i]):
                _w, _i, _j, a, b = groups(law, sides, pairs[p])
                for r in range(wp.static(NUMBERS)):
                    out[r, piece, a, b] = out[r, piece, a, b] + numbers[r, p]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def total(found: wp.array4d(dtype=real), number: int, out: wp.array4d(dtype=real)):
        w, a, b = wp.tid()
        for r in range(wp.static(NUMBERS)):
            own = real(0.0)
            for k in range(w * number, (w + 1) * number):
                own += found[r, k, a, b]
            out[r, w, a, b] = out[r, w, a, b] + own

    return pieces, total


@cache
def side_kernels(kind: Kind, real):
    """first(...) and second(...): add derivatives by a number of pairs to the things of either side (things of all worlds,)."""
    Sides = sides_struct(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def first(
        count: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        partners: wp.array(dtype=int),
        values: wp.array(dtype=real),
        out: wp.array(dtype=real),
    ):
        i = wp.tid()
        own = real(0.0)
        if count[0] > 0:
            for p in range(starts[i], starts[i] + partners[i]):
                own += values[p]
        out[i] = out[i] + own

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def second(
        pairs: wp.array(dtype=wp.vec2i),
        sides: Sides,
        places: wp.array(dtype=int),
        number: wp.array(dtype=int),
        items: wp.array(dtype=int),
        values: wp.array(dtype=real),
        out: wp.array(dtype=real),
    ):
        """By the items of the first node of things, of all nodes."""
        j = wp.tid()
        w = j / sides.counts[1]
        node = sides.second.nodes[j - w * sides.counts[1], 0] + w * sides.first.nodes_a_world
        own = real(0.0)
        for k in range(places[node], places[node] + number[node]):
            p, slot = taken_apart(items[k])
            if slot == wp.static(kind.first) and pairs[p][1] == j:
                own += values[p]
        out[j] = out[j] + own

    return first, second


@cache
def direction_kernels(real):
    """things(...): sums of derivatives by directions of first things; gather(...) adds them to the nodes that these lead between."""
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def things(
        count: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        partners: wp.array(dtype=int),
        directions: wp.array(dtype=V),
        out: wp.array(dtype=V),
    ):
        i = wp.tid()
        own = V()
        if count[0] > 0:
            for p in range(starts[i], starts[i] + partners[i]):
                own += directions[p]
        out[i] = own

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        starts: wp.array(dtype=int), items: wp.array(dtype=int), found: wp.array2d(dtype=V), out: wp.array2d(dtype=V)
    ):
        """An item is twice the number of a thing in its world, and one more where it leads to the node."""
        w, k = wp.tid()
        own = V()
        for index in range(starts[k], starts[k + 1]):
            by = found[w, items[index] / 2]
            own += wp.where(items[index] % 2 == 1, by, -by)
        out[w, k] = out[w, k] + own

    return things, gather


@cache
def body_kernel(real):
    """bodies(...): add what the things of each body have, which lie in a row."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def bodies(found: wp.array(dtype=real), starts: wp.array(dtype=int), things: int, out: wp.array2d(dtype=real)):
        w, body = wp.tid()
        own = real(0.0)
        for k in range(starts[body], starts[body + 1]):
            own += found[w * things + k]
        out[w, body] = out[w, body] + own

    return bodies

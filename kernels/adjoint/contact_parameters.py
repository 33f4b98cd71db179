"""Gradients by contact parameters of pairs, summed in a fixed order by pairs of groups or by bodies."""

from functools import cache

import warp as wp

from ddg_warp.kernels.adjoint.contact import NUMBERS
from ddg_warp.kernels.collision.contact.assembly import unpacked
from ddg_warp.kernels.collision.contact.pair_evaluation import groups_function, law_struct
from ddg_warp.kernels.collision.primitives import Kind, sides_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def group_kernels(real):
    """Build the kernels of sums by groups.

    `pieces`: sum the pairs of a run of first primitives by groups.
    `total`: add the pieces of each world.
    """
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
        size: int,
        out: wp.array4d(dtype=real),
    ):
        """Sum pairs by groups; a world has `number` pieces of `size` primitives."""
        piece = wp.tid()
        for r in range(out.shape[0]):
            for a in range(out.shape[2]):
                for b in range(out.shape[3]):
                    out[r, piece, a, b] = real(0.0)
        if count[0] == 0:
            return
        world = piece / number
        first = (piece - world * number) * size
        for k in range(first, wp.min(first + size, sides.counts[0])):
            i = k + world * sides.counts[0]
            for p in range(starts[i], starts[i] + partners[i]):
                _w, _i, _j, a, b = groups(law, sides, pairs[p])
                for r in range(wp.static(NUMBERS)):
                    out[r, piece, a, b] = out[r, piece, a, b] + numbers[r, p]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def total(piece_sums: wp.array4d(dtype=real), number: int, out: wp.array4d(dtype=real)):
        w, a, b = wp.tid()
        for r in range(wp.static(NUMBERS)):
            value = real(0.0)
            for k in range(w * number, (w + 1) * number):
                value += piece_sums[r, k, a, b]
            out[r, w, a, b] = out[r, w, a, b] + value

    return pieces, total


@cache
def side_kernels(kind: Kind, real):
    """Build the kernels of sums by primitives (primitives of all worlds,).

    `first`: add gradients by a parameter of pairs to first primitives.
    `second`: add gradients by a parameter of pairs to second primitives.
    """
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
        value = real(0.0)
        if count[0] > 0:
            for p in range(starts[i], starts[i] + partners[i]):
                value += values[p]
        out[i] = out[i] + value

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
        """Add gradients to second primitives, by the items of their first node."""
        j = wp.tid()
        w = j / sides.counts[1]
        node = sides.second.nodes[j - w * sides.counts[1], 0] + w * sides.first.nodes_a_world
        value = real(0.0)
        for k in range(places[node], places[node] + number[node]):
            p, local = unpacked(items[k])
            if local == wp.static(kind.first) and pairs[p][1] == j:
                value += values[p]
        out[j] = out[j] + value

    return first, second


@cache
def direction_kernels(real):
    """Build the kernels of gradients by directions of first primitives.

    `primitives`: sum gradients by the direction of each first primitive.
    `gather`: add them to the two nodes of each direction.
    """
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def primitives(
        count: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        partners: wp.array(dtype=int),
        directions: wp.array(dtype=V),
        out: wp.array(dtype=V),
    ):
        i = wp.tid()
        value = V()
        if count[0] > 0:
            for p in range(starts[i], starts[i] + partners[i]):
                value += directions[p]
        out[i] = value

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        gradients: wp.array2d(dtype=V),
        out: wp.array2d(dtype=V),
    ):
        """Add gradients to nodes.

        An item is twice the index of a primitive in its world, plus 1 at the end of its direction.
        """
        w, k = wp.tid()
        value = V()
        for index in range(starts[k], starts[k + 1]):
            gradient = gradients[w, items[index] / 2]
            value += wp.where(items[index] % 2 == 1, gradient, -gradient)
        out[w, k] = out[w, k] + value

    return primitives, gather


@cache
def body_kernel(real):
    """Build the kernel of sums by bodies.

    `bodies`: add the values of the primitives of each body, which are consecutive.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def bodies(values: wp.array(dtype=real), starts: wp.array(dtype=int), primitives: int, out: wp.array2d(dtype=real)):
        w, body = wp.tid()
        value = real(0.0)
        for k in range(starts[body], starts[body + 1]):
            value += values[w * primitives + k]
        out[w, body] = out[w, body] + value

    return bodies

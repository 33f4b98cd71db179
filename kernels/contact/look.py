"""What pairs in contact look like: gaps and places, for whoever asks."""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.motion import corners_function
from ddg_warp.kernels.contact.surfaces import Kind, pair_functions, sides_struct, things_function
from ddg_warp.kernels.threads import CPU_OPTIONS


@cache
def look_kernel(kind: Kind, real):
    """Gap [m] of each pair, and the place between its closest points [m]."""
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    (slots, _, thickness, closest), corners = pair_functions(kind, real), corners_function(real)
    things = things_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def look(
        pairs: wp.array(dtype=wp.vec2i),
        sides: Sides,
        x: wp.array(dtype=X),
        gap_out: wp.array(dtype=real),
        point_out: wp.array(dtype=X),
    ):
        p = wp.tid()
        w, i, j = things(sides, pairs[p])
        nodes = slots(sides, i, j, w)
        r, weights = closest(corners(x, nodes))
        gap_out[p] = wp.length(r) - thickness(sides, i, j, w)
        point = real(-0.5) * r
        for k in range(wp.static(kind.first)):
            point += x[nodes[k]] * weights[k]
        point_out[p] = point

    return look


@cache
def closest_kernel(kind: Kind, real):
    """Of each pair the way from the second thing to the first between their closest points [m], the nodes, their shares of these
    points, negative on the second, and the thickness [m]."""
    Sides, X, W = sides_struct(real), wp.types.vector(3, real), wp.types.vector(4, real)
    (slots, _, thickness, closest), corners = pair_functions(kind, real), corners_function(real)
    things = things_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def closest_points(
        pairs: wp.array(dtype=wp.vec2i),
        sides: Sides,
        x: wp.array(dtype=X),
        way_out: wp.array(dtype=X),
        nodes_out: wp.array(dtype=wp.vec4i),
        shares_out: wp.array(dtype=W),
        thickness_out: wp.array(dtype=real),
    ):
        p = wp.tid()
        w, i, j = things(sides, pairs[p])
        nodes = slots(sides, i, j, w)
        way, shares = closest(corners(x, nodes))
        way_out[p] = way
        shares_out[p] = shares
        nodes_out[p] = nodes
        thickness_out[p] = thickness(sides, i, j, w)

    return closest_points

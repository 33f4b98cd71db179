"""Contact query: gaps, contact points, offsets and weights of pairs, on request."""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.broad_phase.candidate_validity import corners_function
from ddg_warp.kernels.collision.primitives import Kind, pair_functions, primitives_function, sides_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def query_kernel(kind: Kind, real):
    """Build the kernel of gaps and contact points.

    `look`: write the gap [m] of each pair, and the midpoint of its closest points [m].
    """
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    (pair_nodes, _, thickness, closest), corners = pair_functions(kind, real), corners_function(real)
    locate = primitives_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def look(
        pairs: wp.array(dtype=wp.vec2i),
        sides: Sides,
        x: wp.array(dtype=X),
        gap_out: wp.array(dtype=real),
        point_out: wp.array(dtype=X),
    ):
        p = wp.tid()
        w, i, j = locate(sides, pairs[p])
        nodes = pair_nodes(sides, i, j, w)
        r, weights = closest(corners(x, nodes))
        gap_out[p] = wp.length(r) - thickness(sides, i, j, w)
        point = real(-0.5) * r
        for k in range(wp.static(kind.first)):
            point += x[nodes[k]] * weights[k]
        point_out[p] = point

    return look


@cache
def closest_kernel(kind: Kind, real):
    """Build the kernel of closest points.

    `closest_points`: write the offset from the second to the first closest point [m], nodes, weights and thickness [m] of each pair.

    Weights of nodes of the second primitive are negative.
    """
    Sides, X, W = sides_struct(real), wp.types.vector(3, real), wp.types.vector(4, real)
    (pair_nodes, _, thickness, closest), corners = pair_functions(kind, real), corners_function(real)
    locate = primitives_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def closest_points(
        pairs: wp.array(dtype=wp.vec2i),
        sides: Sides,
        x: wp.array(dtype=X),
        offset_out: wp.array(dtype=X),
        nodes_out: wp.array(dtype=wp.vec4i),
        weights_out: wp.array(dtype=W),
        thickness_out: wp.array(dtype=real),
    ):
        p = wp.tid()
        w, i, j = locate(sides, pairs[p])
        nodes = pair_nodes(sides, i, j, w)
        offset, weights = closest(corners(x, nodes))
        offset_out[p] = offset
        weights_out[p] = weights
        nodes_out[p] = nodes
        thickness_out[p] = thickness(sides, i, j, w)

    return closest_points

"""Distance of a point from an edge and from a triangle [m], whichever of its vertices, edges and inside is closest.

Nodes: the point, then those of the edge or triangle. For derivatives see `closest_points`. Singular where the point lies on it.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures.closest_points import distance_functions, point_edge, point_triangle


def _functions(measure_of, closest_of):
    @cache
    def functions(real):
        measure = measure_of()
        Q, S, E, M = measure.types(real)
        size = measure.size
        H = wp.types.vector(size * (size + 1) // 2, real)
        _, _, slope_of, bend = distance_functions(closest_of, size, real)

        @wp.func
        def strains(q: Q, s: S, w: real):
            d, _row = slope_of(q)
            return E(d)

        @wp.func
        def jacobian(q: Q, s: S, w: real):
            d, row = slope_of(q)
            return E(d), wp.matrix_from_rows(row)

        @wp.func
        def curvature(q: Q, s: S, w: real, slope: E):
            g, first, second, rho, inverse = bend(q)
            near = w * slope[0] * inverse
            h = H()
            for i in range(wp.static(size)):
                for j in range(i, wp.static(size)):
                    value = -g[i] * g[j] - first[i] * first[j] - second[i] * second[j]
                    if i % 3 == j % 3:
                        value += rho[i // 3] * rho[j // 3]
                    h[i * wp.static(size) - i * (i - 1) // 2 + j - i] = near * value  # `packed_index`
            return h

        return strains, jacobian, None, curvature

    return functions


point_edge_distance = Measure(
    "point_edge_distance",
    3,
    ((0, 1), (1, 2)),
    ("distance [m]",),
    _functions(lambda: point_edge_distance, point_edge),
    apart=True,
    sample=lambda random, count: {"nodes": [[0.4, 0.1, 0.35], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]},
)
point_triangle_distance = Measure(
    "point_triangle_distance",
    3,
    ((0, 1), (1, 2), (2, 3)),
    ("distance [m]",),
    _functions(lambda: point_triangle_distance, point_triangle),
    apart=True,
    sample=lambda random, count: {"nodes": [[0.4, 0.3, 0.4], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]},
)

"""Stretch of an edge, lambda = |x1 - x0| / w with w the rest length [m]. Singular where the edge has no length.

The second derivative of lambda is (I - t t^T) / (|e| w): positive semi-definite under tension, negative under compression.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.measures import Measure


def _functions(measure_of):
    @cache
    def functions(real):
        Q, S, E, M = measure_of().types(real)

        @wp.func
        def strains(q: Q, s: S, w: real):
            return E(wp.length(q) / w)

        @wp.func
        def jacobian(q: Q, s: S, w: real):
            length = wp.length(q)
            return E(length / w), wp.matrix_from_rows(q / (length * w))

        @wp.func
        def tension(q: Q, w: real, slope: E):
            c = slope[0] / wp.length(q)
            return c, E(-c * w)

        return strains, jacobian, tension, None

    return functions


edge_stretch = Measure("edge_stretch", 3, ((0, 1),), ("stretch [1]",), _functions(lambda: edge_stretch), tensions=1)
edge_stretch_2d = Measure(
    "edge_stretch_2d", 2, ((0, 1),), ("stretch [1]",), _functions(lambda: edge_stretch_2d), tensions=1
)

"""Curvature of a planar rod at a vertex, kappa = 2 tan(phi/2) / w with phi the turning angle and w the Voronoi length [m].

2 tan(phi/2) = 2 e x f / (|e| |f| + e . f), as in discrete elastic rods (Bergou et al. 2008), so that a planar rod and a
three-dimensional one agree to rounding. Singular where the rod folds back by 180 degrees.

With K = 2 tan(phi/2): K' = 1 + K^2/4 and K'' = K K'/2 in phi = arg f - arg e, and d arg e = (-y, x) . de / r^2.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.measures import Measure


@cache
def _functions(real):
    Q, S, E, M = planar_curvature.types(real)
    H = wp.types.vector(10, real)

    @wp.func
    def doubled_tangent(q: Q):
        le = wp.sqrt(q[0] * q[0] + q[1] * q[1])
        lf = wp.sqrt(q[2] * q[2] + q[3] * q[3])
        return real(2.0) * (q[0] * q[3] - q[1] * q[2]) / (le * lf + q[0] * q[2] + q[1] * q[3])

    @wp.func
    def strains(q: Q, s: S, w: real):
        return E(doubled_tangent(q) / w)

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        k = doubled_tangent(q)
        c = (real(1.0) + real(0.25) * k * k) / w  # d(2 tan(phi/2)) = (1 + tan^2(phi/2)) dphi
        a = c / (q[0] * q[0] + q[1] * q[1])
        b = c / (q[2] * q[2] + q[3] * q[3])
        return E(k / w), wp.matrix_from_rows(Q(q[1] * a, -q[0] * a, -q[3] * b, q[2] * b))

    @wp.func
    def curvature(q: Q, s: S, w: real, slope: E):
        k = doubled_tangent(q)
        first = (real(1.0) + real(0.25) * k * k) * slope[0]
        second = real(0.5) * k * first
        e = real(1.0) / (q[0] * q[0] + q[1] * q[1])
        f = real(1.0) / (q[2] * q[2] + q[3] * q[3])
        d0 = q[1] * e
        d1 = -q[0] * e
        d2 = -q[3] * f
        d3 = q[2] * f
        ee = real(2.0) * first * d0 * d1
        ff = real(2.0) * first * d2 * d3
        return H(
            second * d0 * d0 + ee,
            second * d0 * d1 + first * (d1 * d1 - d0 * d0),
            second * d0 * d2,
            second * d0 * d3,
            second * d1 * d1 - ee,
            second * d1 * d2,
            second * d1 * d3,
            second * d2 * d2 - ff,
            second * d2 * d3 + first * (d2 * d2 - d3 * d3),
            second * d3 * d3 + ff,
        )

    return strains, jacobian, None, curvature


planar_curvature = Measure("planar_curvature", 2, ((0, 1), (1, 2)), ("curvature [1/m]",), _functions)

"""First fundamental form of a triangle, (a11, a12, a22) / 2 [m^2], a_ij = a_i . a_j in the basis a1 = x1 - x0, a2 = x2 - x0.

With half the rest metric as rest strain, the difference is the Green strain E_ij in that basis, constant over the triangle (constant
strain triangle). The rest area is w [m^2]. Polynomial: never singular, and blind to inversion.

The strains are quadratic in q: d2(a11 / 2) = I in block (1, 1), d2(a12 / 2) = I / 2 in blocks (1, 2) and (2, 1), d2(a22 / 2) = I
in block (2, 2). So the geometric stiffness is w (s1, s2 / 2, s3), exact, with s the slope of the density.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.measures import Measure


@cache
def _functions(real):
    Q, S, E, M = triangle_metric.types(real)
    V = wp.types.vector(3, real)

    @wp.func
    def strains(q: Q, s: S, w: real):
        a1 = V(q[0], q[1], q[2])
        a2 = V(q[3], q[4], q[5])
        half = real(0.5)
        return E(half * wp.dot(a1, a1), half * wp.dot(a1, a2), half * wp.dot(a2, a2))

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        zero = real(0.0)
        half = real(0.5)
        return strains(q, s, w), wp.matrix_from_rows(
            Q(q[0], q[1], q[2], zero, zero, zero),
            Q(half * q[3], half * q[4], half * q[5], half * q[0], half * q[1], half * q[2]),
            Q(zero, zero, zero, q[3], q[4], q[5]),
        )

    @wp.func
    def tension(q: Q, w: real, slope: E):
        return V(w * slope[0], real(0.5) * w * slope[1], w * slope[2]), E()

    return strains, jacobian, tension, None


triangle_metric = Measure(
    "triangle_metric",
    3,
    ((0, 1), (0, 2)),
    ("a11/2 [m^2]", "a12/2 [m^2]", "a22/2 [m^2]"),
    _functions,
    tensions=3,
)

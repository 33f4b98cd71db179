"""First fundamental form of a surface of revolution over a meridian edge, (a_ss, a_st, a_tt) / 2 [m^2].

With the meridian in the plane of x (the radius r) and z, coordinates s from 0 to 1 along the edge and t the angle around the axis,

    a_ss = |x1 - x0|^2,    a_st = 0,    a_tt = r^2 with r = (r0 + r1) / 2, in the middle of the edge.

With half the rest metric as rest strain, the difference is the Green strain along the meridian and around the axis (Reissner 1950).
The dofs q are the edge and the position of its first node; y is not read. The rest area w is 2 pi r times the length [m^2].

The strains are quadratic in q: d2(a_ss / 2) = I on the edge, and d2(a_tt / 2) = g g^T with g the derivative of r. So the geometric
stiffness is w s1 I plus w J^T diag(0, 0, s3 / r^2) J with s the slope of the density.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.measures import Measure


@cache
def _functions(real):
    Q, S, E, M = axisymmetric_metric.types(real)

    @wp.func
    def strains(q: Q, s: S, w: real):
        half = real(0.5)
        r = q[3] + half * q[0]
        return E(half * (q[0] * q[0] + q[2] * q[2]), real(0.0), half * r * r)

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        zero = real(0.0)
        r = q[3] + real(0.5) * q[0]
        return strains(q, s, w), wp.matrix_from_rows(
            Q(q[0], zero, q[2], zero, zero, zero), Q(), Q(real(0.5) * r, zero, zero, r, zero, zero)
        )

    @wp.func
    def tension(q: Q, w: real, slope: E):
        r = q[3] + real(0.5) * q[0]
        return w * slope[0], E(real(0.0), real(0.0), slope[2] / (r * r))

    return strains, jacobian, tension, None


axisymmetric_metric = Measure(
    "axisymmetric_metric",
    3,
    ((0, 1),),
    ("a_ss/2 [m^2]", "a_st/2 [m^2]", "a_tt/2 [m^2]"),
    _functions,
    tensions=1,
    points=1,
    revolved=True,
)

"""Curvature by the angle between edges: phi / w instead of the 2 tan(phi/2) / w of other measures, w the Voronoi length [m].

Both are discrete curvatures of second order (Crane and Wardetzky, A glimpse into discrete differential geometry, Notices of the AMS
64, 2017). With phi a regular polygon has exactly the curvature and energy of a circle. At a fold the curvature stays finite, and a
rod can pass through the fold. Singular where the rod folds back by 180 degrees: curvature has no direction there.

A bending strain k of the other measure becomes a(y) k with a = atan(sqrt y) / sqrt y and y = (w |k| / 2)^2 = tan^2(phi/2); twist
stays. Let g = w^2 / 2, so that dy = g k . dk. This map has the Jacobian D = a I + a' g k k^T, and the second derivative, contracted
with a slope M, in the bending strains

    X = a' g (M k^T + k M^T) + (a' g I + a'' g^2 k k^T) (M . k) .

The chain rule gives D J of the other measure's Jacobian, and its second derivative contracted with D^T M, plus J^T X J.

This needs |k| = 2 tan(phi/2) / w. Means of the directors of both edges see it reduced by cos(m/2) where these differ by the twist m.
So the directors of each edge are rotated towards the other's by m/2 (`between`): they then coincide, and rotate smoothly with m, over
any number of revolutions. Strains k(q, c) about directors rotated by c = m/2 towards each other do not change with c to first order,
and d2k/dc2 = -k. So J is as for constant c, and k (dm/2)^2 is added to the second derivative: (w^2 / 4) (D^T M . k) in X for the
twist, which is m / w.
"""

from dataclasses import replace
from functools import cache, partial

import warp as wp

from ddg_warp.kernels.measures import Measure, joint_curvature_twist, rod_curvature_twist
from ddg_warp.kernels.measures.curvature_binormal import curvature_binormal
from ddg_warp.kernels.measures.planar_curvature import planar_curvature

# Limit of y up to which 14 terms of the series of atan are exact in float64; above, differences lose less than 3 digits.
NEAR = 1.0 / 16.0


@cache
def ratio_function(real):
    """Return the device function `ratio(y) -> (a, a', a'')` of a = atan(sqrt y) / sqrt y."""
    near = wp.constant(real(NEAR))

    @wp.func
    def ratio(y: real):
        a = real(0.0)
        first = real(0.0)
        second = real(0.0)
        for i in range(14):  # Horner's rule for sum (-y)^n / (2 n + 1) and its derivatives
            second = first - y * second
            first = a - y * first
            a = real(1.0) / real(27 - 2 * i) - y * a
        first = -first
        second = real(2.0) * second
        if y > near:
            root = wp.sqrt(y)
            inverse = real(1.0) / (real(1.0) + y)
            a = wp.atan(root) / root
            first = real(0.5) * (inverse - a) / y
            second = real(-0.5) * (inverse * inverse + real(3.0) * first) / y
        return a, first, second

    return ratio


def _functions(tangent: Measure, functions, real):
    Q, S, E, M = tangent.types(real)
    size = tangent.size
    H = wp.types.vector(size * (size + 1) // 2, real)
    strains_of, jacobian_of, _, curvature_of = functions(real)
    ratio = ratio_function(real)
    bends = E(*(0.0 if name.startswith("twist") else 1.0 for name in tangent.strains))
    twists = E(*(1.0 if name.startswith("twist") else 0.0 for name in tangent.strains))

    @wp.func
    def strains(q: Q, s: S, w: real):
        e = strains_of(q, s, w)
        k = wp.cw_mul(e, bends)
        a, _first, _second = ratio(real(0.25) * w * w * wp.dot(k, k))
        return k * a + wp.cw_mul(e, twists)

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        e, j = jacobian_of(q, s, w)
        k = wp.cw_mul(e, bends)
        a, first, _second = ratio(real(0.25) * w * w * wp.dot(k, k))
        D = wp.diag(bends * a + twists) + wp.outer(k, k) * (real(0.5) * w * w * first)
        return k * a + wp.cw_mul(e, twists), D * j

    if curvature_of is None:
        return strains, jacobian, None, None

    @wp.func
    def curvature(q: Q, s: S, w: real, slope: E):
        e, j = jacobian_of(q, s, w)
        k = wp.cw_mul(e, bends)
        m = wp.cw_mul(slope, bends)
        g = real(0.5) * w * w
        a, first, second = ratio(real(0.5) * g * wp.dot(k, k))
        along = g * wp.dot(m, k)
        inner = m * a + k * (first * along)
        x = (wp.outer(m, k) + wp.outer(k, m)) * (g * first) + wp.outer(k, k) * (g * second * along)
        x += wp.diag(bends * (first * along) + twists * (real(0.5) * g * wp.dot(inner, k)))
        added = wp.transpose(j) * ((x * w) * j)
        h = curvature_of(q, s, w, inner + wp.cw_mul(slope, twists))
        total = H()
        for row in range(wp.static(size)):
            for column in range(row, wp.static(size)):
                entry = row * wp.static(size) - row * (row - 1) // 2 + column - row  # `packed_index`
                total[entry] = h[entry] + added[row, column]
        return total

    return strains, jacobian, None, curvature


def _by_angle(tangent: Measure, functions) -> Measure:
    return replace(
        tangent,
        name=f"{tangent.name}_angle",
        functions=cache(partial(_functions, tangent, functions)),
        by_angle=True,
        prepared=None,
    )


rod_curvature_twist_angle = _by_angle(
    rod_curvature_twist.rod_curvature_twist, partial(rod_curvature_twist.functions, between=True)
)
joint_curvature_twist_angle = _by_angle(
    joint_curvature_twist.joint_curvature_twist, partial(joint_curvature_twist.functions, between=True)
)
curvature_binormal_angle = _by_angle(curvature_binormal, curvature_binormal.functions)
planar_curvature_angle = _by_angle(planar_curvature, planar_curvature.functions)

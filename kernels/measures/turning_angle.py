"""Curvature by the turning angle: phi / w where the other measures of rods have 2 tan(phi/2) / w, w the Voronoi length [m].

The constant curvature of a circle then is that of a regular polygon exactly, and energy stays finite at a fold. Both converge with
second order; phi is twice the logarithm of the rotation between the tangents, as in the Cosserat rods of Spillmann and Teschner
(CoRdE, 2007) and Lang, Linn and Arnold (2011).

A bending strain k of the other measure becomes a(y) k with a = atan(sqrt y) / sqrt y and y = (w |k| / 2)^2 = tan^2(phi/2); twist
stays. With g = w^2 / 2, so that dy = g k . dk, the map has the Jacobian D = a I + a' g k k^T, and contracted with a slope M its second
derivative is

    X = a' g (M k^T + k M^T) + (a' g I + a'' g^2 k k^T) (M . k)

in the bending strains, from which the chain rule makes D J, and D^T M : d2k + J^T X J, of the other measure's J and d2k.

For that, |k| has to be 2 tan(phi/2) / w. Means of the directors of both edges make it less by cos(m/2), m the twist between them; so
directors are those of each edge, turned by m/2 towards the other (`between`): they are one direction, whatever the twist, and no turn
of it jumps. To first order that turn changes no strain, as both edges then see curvature alike. To second order it takes
|dk/dm|^2: X has (w^2 / 4) (D^T M . k) for twist with twist.
"""

from dataclasses import replace
from functools import cache, partial

import warp as wp

from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures import joint_curvature_twist as joint
from ddg_warp.kernels.measures import rod_curvature_twist as rod
from ddg_warp.kernels.measures.curvature_binormal import curvature_binormal
from ddg_warp.kernels.measures.planar_curvature import planar_curvature

NEAR = (
    1.0 / 16.0
)  # y up to which 14 terms of the series of atan are exact in float64; above, differences lose less than 3 digits


@cache
def ratio_function(real):
    """ratio(y) -> a, a', a'' of a = atan(sqrt y) / sqrt y."""
    near = wp.constant(real(NEAR))

    @wp.func
    def ratio(y: real):
        a = real(0.0)
        first = real(0.0)
        second = real(0.0)
        for i in range(14):  # Horner's rule for sum (-y)^n / (2 n + 1), of each by the one before
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
        turn = wp.diag(bends * a + twists) + wp.outer(k, k) * (real(0.5) * w * w * first)
        return k * a + wp.cw_mul(e, twists), turn * j

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
                at = row * wp.static(size) - row * (row - 1) // 2 + column - row  # `packed_index`
                total[at] = h[at] + added[row, column]
        return total

    return strains, jacobian, None, curvature


def _by_angle(tangent: Measure, functions) -> Measure:
    return replace(
        tangent,
        name=f"{tangent.name}_angle",
        functions=cache(partial(_functions, tangent, functions)),
        by_angle=True,
    )


rod_curvature_twist_angle = _by_angle(rod.rod_curvature_twist, partial(rod.functions, between=True))
joint_curvature_twist_angle = _by_angle(joint.joint_curvature_twist, partial(joint.functions, between=True))
curvature_binormal_angle = _by_angle(curvature_binormal, curvature_binormal.functions)
planar_curvature_angle = _by_angle(planar_curvature, planar_curvature.functions)

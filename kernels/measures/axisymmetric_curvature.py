"""Curvatures of a surface of revolution at a node of the meridian, and at the ends of the meridian [1/m].

The meridian lies in the plane of x (the radius) and z; phi is the angle of its tangent from x. Along the meridian the curvature is
that of a planar rod, 2 tan(dphi / 2) / l with l the rest length of the cell (Bergou et al. 2008). Around the axis it is sin(phi) / R
with R the rest radius, the mean of both edges (Reissner 1950). Both are per rest length, so that a uniform stretch of the surface
changes neither. y is not read.

    axisymmetric_curvature  nodes with two edges; data: l, R.
    axisymmetric_rim        an end, with the one edge there is, run as the meridian runs. With K = 2 tan(dphi / 2) from the unit
                            vector (tx, tz) to the edge, and S = sin(phi) of the edge, the strains are
                            (c1 K, 0, c2 K + c3 S + c4 tz); data: tx, ty = 0, tz, c1, c2, c3, c4.
                            A pole, where the meridian goes on as its mirror image across the axis and the surface is
                            curved alike in all directions: c1 = c2 = 2 / l, (tx, tz) = (1, 0). A clamped rim, with (tx, tz)
                            as the clamp has it: c1 = 2 / l, c4 = 1 / R. A rim that is free to rotate, without moment along
                            the meridian: c3 = 1 / R with R in the middle of the edge, all else zero.

Derivatives: K' = 1 + K^2 / 4 in phi, phi' = (-z, x) / (x^2 + z^2), sin(phi)' = cos(phi) phi'.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.measures import Measure

NAMES = ("curvature along the meridian [1/m]", "none [1/m]", "curvature around the axis [1/m]")


@cache
def _functions(real):
    Q, S, E, M = axisymmetric_curvature.types(real)

    @wp.func
    def doubled_tangent(q: Q):
        lengths = wp.sqrt((q[0] * q[0] + q[2] * q[2]) * (q[3] * q[3] + q[5] * q[5]))
        return real(2.0) * (q[0] * q[5] - q[2] * q[3]) / (lengths + q[0] * q[3] + q[2] * q[5])

    @wp.func
    def strains(q: Q, s: S, w: real):
        k = doubled_tangent(q)
        le = wp.sqrt(q[0] * q[0] + q[2] * q[2])
        lf = wp.sqrt(q[3] * q[3] + q[5] * q[5])
        return E(k / s[0], real(0.0), real(0.5) * (q[2] / le + q[5] / lf) / s[1])

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        zero = real(0.0)
        k = doubled_tangent(q)
        ee = q[0] * q[0] + q[2] * q[2]
        ff = q[3] * q[3] + q[5] * q[5]
        c = (real(1.0) + real(0.25) * k * k) / s[0]
        a = real(0.5) * q[0] / (s[1] * wp.sqrt(ee))  # half the cosines, over the radius
        b = real(0.5) * q[3] / (s[1] * wp.sqrt(ff))
        return strains(q, s, w), wp.matrix_from_rows(
            Q(q[2] * c / ee, zero, -q[0] * c / ee, -q[5] * c / ff, zero, q[3] * c / ff),
            Q(),
            Q(-q[2] * a / ee, zero, q[0] * a / ee, -q[5] * b / ff, zero, q[3] * b / ff),
        )

    return strains, jacobian, None, None


@cache
def _rim_functions(real):
    Q, S, E, M = axisymmetric_rim.types(real)

    @wp.func
    def turning(q: Q, s: S, length: real):
        """Return K; zero without a direction."""
        return real(2.0) * (s[0] * q[2] - s[2] * q[0]) / (length + s[0] * q[0] + s[2] * q[2])

    @wp.func
    def strains(q: Q, s: S, w: real):
        length = wp.sqrt(q[0] * q[0] + q[2] * q[2])
        k = turning(q, s, length)
        return E(s[3] * k, real(0.0), s[4] * k + s[5] * q[2] / length + s[6] * s[2])

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        zero = real(0.0)
        ee = q[0] * q[0] + q[2] * q[2]
        k = turning(q, s, wp.sqrt(ee))
        turn = real(1.0) + real(0.25) * k * k
        a = s[3] * turn / ee
        b = (s[4] * turn + s[5] * q[0] / wp.sqrt(ee)) / ee
        return strains(q, s, w), wp.matrix_from_rows(Q(-q[2] * a, zero, q[0] * a), Q(), Q(-q[2] * b, zero, q[0] * b))

    return strains, jacobian, None, None


def _rim_sample(random, count: int) -> dict:
    """Return clamps a little off the radius."""
    data, angle = random.uniform(0.5, 1.5, size=(7, count)), random.uniform(0.0, 0.3, count)
    data[[0, 2]] = np.cos(angle), np.sin(angle)
    return {"data": data}


axisymmetric_curvature = Measure(
    "axisymmetric_curvature", 3, ((0, 1), (1, 2)), NAMES, _functions, data_size=2, revolved=True
)
axisymmetric_rim = Measure(
    "axisymmetric_rim", 3, ((0, 1),), NAMES, _rim_functions, data_size=7, revolved=True, sample=_rim_sample
)

"""Metric of a curved triangle, (a11, a12, a22) / 2 [m^2]: facets with the lengths of arcs as side lengths.

A facet's side is a chord of the surface. With the normal curvature k along a side, a geodesic arc of length s has the chord
s (1 - k^2 s^2 / 24). Bending without stretch thus shortens sides unequally, and a mesh cannot follow it without stress: constant
strain triangles lock, the more the thinner the shell. Here squared lengths of the sides e are

    a(e, e) = |e|^2 + b(e, e)^2 / 12 ,

with b the second fundamental form of `midedge_curvature_dof`, and (a11, a12, a22) follow from the three sides (a1, a2, a2 - a1):

    a11 = |a1|^2 + b11^2 / 12 ,   a22 = |a2|^2 + b22^2 / 12 ,   2 a12 = a11 + a22 - a(a2 - a1, a2 - a1) .

An isometric bending of a smooth surface leaves strains of third order in the length of the sides instead of second. Flat triangles
have the strains of `triangle_metric`. Stencil and data as in `midedge_curvature_dof`; w is the rest area [m^2].
"""

from dataclasses import replace
from functools import cache

import warp as wp

from ddg_warp.kernels.measures.midedge_curvature import midedge_curvature_dof


@cache
def _functions(real):
    Q, S, E, M = midedge_curvature_dof.types(real)
    V, D = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    curvature, curvature_jacobian, *_ = midedge_curvature_dof.functions(real)

    @wp.func
    def metric(q: Q, b: E):
        a1 = V(q[0], q[1], q[2])
        a2 = V(q[3], q[4], q[5])
        half = real(0.5)
        c = b[0] + b[2] - real(2.0) * b[1]  # b of the third side
        part = real(1.0) / real(24.0)
        return E(
            half * wp.dot(a1, a1) + part * b[0] * b[0],
            half * wp.dot(a1, a2) + half * part * (b[0] * b[0] + b[2] * b[2] - c * c),
            half * wp.dot(a2, a2) + part * b[2] * b[2],
        )

    @wp.func
    def strains(q: Q, s: S, w: real):
        return metric(q, curvature(q, s, w))

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        b, rows = curvature_jacobian(q, s, w)
        c = b[0] + b[2] - real(2.0) * b[1]
        zero = real(0.0)
        half = real(0.5)
        part = real(1.0) / real(12.0)
        first = Q()
        mixed = Q()
        last = Q()
        for d in range(3):
            first[d] = q[d]
            mixed[d] = half * q[3 + d]
            mixed[3 + d] = half * q[d]
            last[3 + d] = q[3 + d]
        # fmt: off
        bending = D(part * b[0], zero, zero,
                    half * part * (b[0] - c), part * c, half * part * (b[2] - c),
                    zero, zero, part * b[2])
        # fmt: on
        return metric(q, b), wp.matrix_from_rows(first, mixed, last) + bending * rows

    @wp.func
    def tension(q: Q, w: real, slope: E):
        """Return the geometric stiffness of the chords, without the contribution of b."""
        return V(w * slope[0], real(0.5) * w * slope[1], w * slope[2]), E()

    return strains, jacobian, tension, None


midedge_metric = replace(
    midedge_curvature_dof,
    name="midedge_metric",
    strains=("a11/2 [m^2]", "a12/2 [m^2]", "a22/2 [m^2]"),
    functions=_functions,
    tensions=3,
)

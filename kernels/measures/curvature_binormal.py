"""Curvature binormal of a rod vertex as a vector, kb = 2 te x tf / (1 + te . tf) / w, w the Voronoi length [m].

The measure of a rod without twist: isotropic and straight at rest (Bergou et al. 2008, eq. 1). With unit tangents,
d(kb) = (2 dte x tf - kb (dte . tf)) / (1 + te . tf), dte = (I - te te^T) de / |e|, and likewise for f. Singular where the rod
folds back by 180 degrees.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.measures import Measure, bending_second_variation


@cache
def _functions(real):
    Q, S, E, M = curvature_binormal.types(real)
    V, H, M3 = wp.types.vector(3, real), wp.types.vector(21, real), wp.types.matrix((3, 3), real)
    turning_of, across, lengthening = bending_second_variation.functions(real)

    @wp.func
    def strains(q: Q, s: S, w: real):
        te = wp.normalize(V(q[0], q[1], q[2]))
        tf = wp.normalize(V(q[3], q[4], q[5]))
        kb = wp.cross(te, tf) * (real(2.0) / ((real(1.0) + wp.dot(te, tf)) * w))
        return E(kb[0], kb[1], kb[2])

    @wp.func
    def row(axis: V, k: real, te: V, tf: V, ie: real, i_f: real):
        """Return the derivative of the component k of kb along `axis`; ie, i_f are 1/(chi |e|), 1/(chi |f|)."""
        a = real(2.0) * wp.cross(tf, axis) - k * tf
        b = real(2.0) * wp.cross(axis, te) - k * te
        a = (a - te * wp.dot(a, te)) * ie
        b = (b - tf * wp.dot(b, tf)) * i_f
        return Q(a[0], a[1], a[2], b[0], b[1], b[2])

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        e = V(q[0], q[1], q[2])
        f = V(q[3], q[4], q[5])
        te = wp.normalize(e)
        tf = wp.normalize(f)
        chi = real(1.0) + wp.dot(te, tf)
        kb = wp.cross(te, tf) * (real(2.0) / chi)
        ie = real(1.0) / (chi * wp.length(e) * w)
        i_f = real(1.0) / (chi * wp.length(f) * w)
        zero = real(0.0)
        one = real(1.0)
        return E(kb[0] / w, kb[1] / w, kb[2] / w), wp.matrix_from_rows(
            row(V(one, zero, zero), kb[0], te, tf, ie, i_f),
            row(V(zero, one, zero), kb[1], te, tf, ie, i_f),
            row(V(zero, zero, one), kb[2], te, tf, ie, i_f),
        )

    @wp.func
    def packed(ee: M3, ef: M3, ff: M3):
        """Return the upper triangle of the matrix, row by row."""
        h = H()
        for i in range(3):
            for j in range(3):
                if j >= i:
                    h[i * 6 - i * (i - 1) // 2 + j - i] = ee[i, j]
                    h[(i + 3) * 6 - (i + 3) * (i + 2) // 2 + j - i] = ff[i, j]
                h[i * 6 - i * (i - 1) // 2 + 3 + j - i] = ef[i, j]
        return h

    @wp.func
    def curvature(q: Q, s: S, w: real, slope: E):
        e = V(q[0], q[1], q[2])
        f = V(q[3], q[4], q[5])
        ie = real(1.0) / wp.length(e)
        i_f = real(1.0) / wp.length(f)
        te = e * ie
        tf = f * i_f
        i = real(1.0) / (real(1.0) + wp.dot(te, tf))
        g = V(slope[0], slope[1], slope[2]) * real(2.0)
        tt = (te + tf) * i
        k = wp.dot(wp.cross(te, tf), g) * i
        a = wp.cross(tf, g) * i - tt * k
        b = -wp.cross(te, g) * i - tt * k
        vv, uu, vu = turning_of(a, b, tt, g, i, k)
        return packed(
            across(vv, te, te, ie * ie) + lengthening(te, a, ie),
            across(vu, te, tf, ie * i_f),
            across(uu, tf, tf, i_f * i_f) + lengthening(tf, b, i_f),
        )

    return strains, jacobian, None, curvature


curvature_binormal = Measure(
    "curvature_binormal", 3, ((0, 1), (1, 2)), ("kb_x [1/m]", "kb_y [1/m]", "kb_z [1/m]"), _functions
)

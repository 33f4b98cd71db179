"""Material curvatures and twist of a rod vertex, (kappa_1, kappa_2, tau), pointwise [1/m] (Bergou et al. 2008, 2010).

Edges e, f meet at the vertex; m1, m2 are the material frames at angle theta from the reference frames, which are the lagged
ones (u, t0) transported to the current tangent. With kb = 2 te x tf / (1 + te . tf), w the Voronoi length and m_ref the
angle between the reference frames (reference twist, continued past pi from its lagged value),

    kappa_1 = kb . (m2e + m2f) / 2w,   kappa_2 = -kb . (m1e + m1f) / 2w,   tau = (theta_f - theta_e + m_ref) / w.

The published gradients hold the reference frame still; a frame transported in time spins about te by
z . de / |e| with z = (t0 x te) / (1 + t0 . te), which subtracts (d/dtheta_e) z / |e| from every strain's derivative.
Singular where the rod folds back by 180 degrees, or an edge turns by 180 degrees from its lagged tangent.

Lagged data: u_e (3), t_e (3), u_f (3), t_f (3), m_ref (1).
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames
from ddg_warp.kernels.measures import Measure


@cache
def _functions(real):
    Q, S, E, M = rod_curvature_twist.types(real)
    V = wp.types.vector(3, real)
    transport, reference_twist, rotate = frames.functions(real)

    @wp.func
    def material_frames(q: Q, s: S):
        e = V(q[0], q[1], q[2])
        f = V(q[3], q[4], q[5])
        ie = real(1.0) / wp.length(e)
        i_f = real(1.0) / wp.length(f)
        te = e * ie
        tf = f * i_f
        ue = transport(V(s[0], s[1], s[2]), V(s[3], s[4], s[5]), te)
        uf = transport(V(s[6], s[7], s[8]), V(s[9], s[10], s[11]), tf)
        twist = q[7] - q[6] + reference_twist(ue, uf, te, tf, s[12])
        m1e = rotate(ue, te, q[6])
        m1f = rotate(uf, tf, q[7])
        return te, tf, m1e, wp.cross(te, m1e), m1f, wp.cross(tf, m1f), twist, ie, i_f

    @wp.func
    def strains(q: Q, s: S, w: real):
        te, tf, m1e, m2e, m1f, m2f, twist, _ie, _if = material_frames(q, s)
        kb = wp.cross(te, tf) * (real(1.0) / (real(1.0) + wp.dot(te, tf)))
        return E(wp.dot(kb, m2e + m2f) / w, -wp.dot(kb, m1e + m1f) / w, twist / w)

    @wp.func
    def row(a: V, b: V, ta: real, tb: real):
        return Q(a[0], a[1], a[2], b[0], b[1], b[2], ta, tb)

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        te, tf, m1e, m2e, m1f, m2f, twist, inverse_e, inverse_f = material_frames(q, s)
        iw = real(1.0) / w
        ie = iw * inverse_e
        i_f = iw * inverse_f
        ic = real(1.0) / (real(1.0) + wp.dot(te, tf))
        kb = wp.cross(te, tf) * ic  # half of the curvature binormal
        tt = (te + tf) * ic
        s1 = m1e + m1f
        s2 = m2e + m2f
        k1 = wp.dot(kb, s2)
        k2 = -wp.dot(kb, s1)
        a1 = -wp.dot(kb, m1e)
        b1 = -wp.dot(kb, m1f)
        a2 = -wp.dot(kb, m2e)
        b2 = -wp.dot(kb, m2f)
        t0e = V(s[3], s[4], s[5])
        t0f = V(s[9], s[10], s[11])
        ze = wp.cross(t0e, te) / (real(1.0) + wp.dot(t0e, te))
        zf = wp.cross(t0f, tf) / (real(1.0) + wp.dot(t0f, tf))
        k1e = wp.cross(tf, s2) * ic - tt * k1 - ze * a1
        k1f = -wp.cross(te, s2) * ic - tt * k1 - zf * b1
        k2e = -wp.cross(tf, s1) * ic - tt * k2 - ze * a2
        k2f = wp.cross(te, s1) * ic - tt * k2 - zf * b2
        return E(k1 * iw, k2 * iw, twist * iw), wp.matrix_from_rows(
            row(k1e * ie, k1f * i_f, a1 * iw, b1 * iw),
            row(k2e * ie, k2f * i_f, a2 * iw, b2 * iw),
            row((kb + ze) * ie, (kb - zf) * i_f, -iw, iw),
        )

    return strains, jacobian, None


rod_curvature_twist = Measure(
    "rod_curvature_twist",
    3,
    ((0, 1), (1, 2)),
    ("curvature_1 [1/m]", "curvature_2 [1/m]", "twist [1/m]"),
    _functions,
    angles=2,
    frames=2,
    lag_size=13,
)

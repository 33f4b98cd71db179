"""Material curvatures and twist of a rod vertex, (kappa_1, kappa_2, tau), pointwise [1/m] (Bergou et al. 2008, 2010).

Edges e, f meet at the vertex. The material frames m1, m2 are at the angle theta from the reference frames, which are the lagged frames
(u, t0) transported to the current tangent. With kb = 2 te x tf / (1 + te . tf), w the Voronoi length and m_ref the angle between the
reference frames (reference twist, continued past pi from its lagged value),

    kappa_1 = kb . (m2e + m2f) / 2w,   kappa_2 = -kb . (m1e + m1f) / 2w,   tau = (theta_f - theta_e + m_ref) / w.

The published gradients are for a constant reference frame. A frame transported in time spins about te by z . de / |e| with
z = (t0 x te) / (1 + t0 . te), which subtracts (d/dtheta_e) z / |e| from the derivative of every strain.
Singular where the rod folds back by 180 degrees, or an edge rotates by 180 degrees from its lagged tangent.

Second derivatives, contracted with moments M: the spin s_e = dtheta_e - z . de / |e| of a frame changes m1 by s_e m2, m2 by -s_e
    m1, and te changes by v (see `bending_second_variation`). Let h = M1 m1 + M2 m2 and g = M1 m2 - M2 m1 of each edge, b half of
    the curvature binormal, i and tt as in `bending_second_variation`. The derivative of w M . strains along a line is

    A . v + B . u - (b . h_e + M3) s_e - (b . h_f - M3) s_f,   A, B of g = g_e + g_f, plus M3 b,

and its derivative adds to that of `bending_second_variation`: 2 (tt . (v + u)) (b . h_e s_e + b . h_f s_f) + (g_e . v) (b . v) +
    (g_f . u) (b . u) - 2 i s_e (v . tf x h_e - u . te x h_e) - 2 i s_f (v . tf x h_f - u . te x h_f) - b . g_e s_e^2 - b . g_f
    s_f^2 + M3 (tt . (u x v) - (tt . (v + u)) (b . (v + u))), and with the spin's own ds_e = (z . v) (t0 . v) / (1 + t0 . te) + 2
    (te . de) (z . v) / |e| the factors of s_e and s_f times it. (Bergou et al. 2010 give these for frames that do not spin.)

Lagged data: u_e (3), t_e (3), u_f (3), t_f (3), m_ref (1).

The edge between two vertices has one frame, which evaluations along a rod prepare once; see `prepared`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.measures import Measure, bending_second_variation

EDGE = 14  # reals of the prepared data of an edge


@cache
def functions(real, between: bool = False, prepared: bool = False):
    """Return the functions of the measure; if `between`, about directors halfway between both edges (see `turning_angle`).

    If `prepared`, s has prepared data of the two edges and m_ref.
    """
    Q, S, E, M = rod_curvature_twist.types(real)
    V = wp.types.vector(3, real)
    if prepared:
        S = wp.types.vector(2 * EDGE + 1, real)
    H, M3 = wp.types.vector(36, real), wp.types.matrix((3, 3), real)
    transport, reference_twist, rotate = parallel_transport.functions(real)
    turning_of, across, lengthening = bending_second_variation.functions(real)

    @wp.func
    def prepared_frames(q: Q, s: S):
        te = V(s[0], s[1], s[2])
        tf = V(s[14], s[15], s[16])
        m1e = V(s[6], s[7], s[8])
        m1f = V(s[20], s[21], s[22])
        twist = q[7] - q[6] + reference_twist(V(s[3], s[4], s[5]), V(s[17], s[18], s[19]), te, tf, s[28])
        return te, tf, m1e, wp.cross(te, m1e), m1f, wp.cross(tf, m1f), twist, s[12], s[26]

    @wp.func
    def prepared_spins(s: S, te: V, tf: V):
        return V(s[9], s[10], s[11]), V(s[23], s[24], s[25])

    @wp.func
    def lagged_frames(q: Q, s: S):
        e = V(q[0], q[1], q[2])
        f = V(q[3], q[4], q[5])
        ie = real(1.0) / wp.length(e)
        i_f = real(1.0) / wp.length(f)
        te = e * ie
        tf = f * i_f
        ue = transport(V(s[0], s[1], s[2]), V(s[3], s[4], s[5]), te)
        uf = transport(V(s[6], s[7], s[8]), V(s[9], s[10], s[11]), tf)
        twist = q[7] - q[6] + reference_twist(ue, uf, te, tf, s[12])
        angle_e = q[6]
        angle_f = q[7]
        if wp.static(between):
            angle_e = q[6] + real(0.5) * twist
            angle_f = q[7] - real(0.5) * twist
        m1e = rotate(ue, te, angle_e)
        m1f = rotate(uf, tf, angle_f)
        return te, tf, m1e, wp.cross(te, m1e), m1f, wp.cross(tf, m1f), twist, ie, i_f

    @wp.func
    def lagged_spins(s: S, te: V, tf: V):
        """Return t0 / (1 + t0 . t) of both edges, whose product with t is the spin of a frame."""
        t0e = V(s[3], s[4], s[5])
        t0f = V(s[9], s[10], s[11])
        return t0e * (real(1.0) / (real(1.0) + wp.dot(t0e, te))), t0f * (real(1.0) / (real(1.0) + wp.dot(t0f, tf)))

    material_frames, spins = (prepared_frames, prepared_spins) if prepared else (lagged_frames, lagged_spins)

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
        ye, yf = spins(s, te, tf)
        ze = wp.cross(ye, te)
        zf = wp.cross(yf, tf)
        k1e = wp.cross(tf, s2) * ic - tt * k1 - ze * a1
        k1f = -wp.cross(te, s2) * ic - tt * k1 - zf * b1
        k2e = -wp.cross(tf, s1) * ic - tt * k2 - ze * a2
        k2f = wp.cross(te, s1) * ic - tt * k2 - zf * b2
        return E(k1 * iw, k2 * iw, twist * iw), wp.matrix_from_rows(
            row(k1e * ie, k1f * i_f, a1 * iw, b1 * iw),
            row(k2e * ie, k2f * i_f, a2 * iw, b2 * iw),
            row((kb + ze) * ie, (kb - zf) * i_f, -iw, iw),
        )

    @wp.func
    def symmetric(a: V, b: V):
        m = wp.outer(a, b)
        return (m + wp.transpose(m)) * real(0.5)

    @wp.func
    def packed(ee: M3, ef: M3, ff: M3, ea: V, eb: V, fa: V, fb: V, aa: real, bb: real):
        """Return the upper triangle of the matrix, row by row; angles do not couple to each other."""
        h = H()
        for i in range(3):
            for j in range(3):
                if j >= i:
                    h[i * 8 - i * (i - 1) // 2 + j - i] = ee[i, j]
                    h[(i + 3) * 8 - (i + 3) * (i + 2) // 2 + j - i] = ff[i, j]
                h[i * 8 - i * (i - 1) // 2 + 3 + j - i] = ef[i, j]
            h[i * 8 - i * (i - 1) // 2 + 6 - i] = ea[i]
            h[i * 8 - i * (i - 1) // 2 + 7 - i] = eb[i]
            h[(i + 3) * 8 - (i + 3) * (i + 2) // 2 + 3 - i] = fa[i]
            h[(i + 3) * 8 - (i + 3) * (i + 2) // 2 + 4 - i] = fb[i]
        h[33] = aa
        h[35] = bb
        return h

    @wp.func
    def curvature(q: Q, s: S, w: real, slope: E):
        te, tf, m1e, m2e, m1f, m2f, _twist, inverse_e, inverse_f = material_frames(q, s)
        i = real(1.0) / (real(1.0) + wp.dot(te, tf))
        b = wp.cross(te, tf) * i
        tt = (te + tf) * i
        m3 = slope[2]
        ge = m2e * slope[0] - m1e * slope[1]
        gf = m2f * slope[0] - m1f * slope[1]
        he = m1e * slope[0] + m2e * slope[1]
        hf = m1f * slope[0] + m2f * slope[1]
        g = ge + gf
        k = wp.dot(b, g)
        turn_e = wp.cross(tf, g) * i - tt * k
        turn_f = -wp.cross(te, g) * i - tt * k
        vv, uu, vu = turning_of(turn_e, turn_f, tt, g, i, k)
        twisting = symmetric(tt, b) * m3
        vu += wp.skew(tt) * (real(0.5) * m3) - twisting
        # spins: of the frame of e with v and u, then of that of f
        be = wp.dot(b, he)
        bf = wp.dot(b, hf)
        ve = tt * be - wp.cross(tf, he) * i
        ue = tt * be + wp.cross(te, he) * i
        vf = tt * bf - wp.cross(tf, hf) * i
        uf = tt * bf + wp.cross(te, hf) * i
        ee = -wp.dot(b, ge)
        ff = -wp.dot(b, gf)
        # the spin of frames transported in time
        ye, yf = spins(s, te, tf)
        ze = wp.cross(ye, te)
        zf = wp.cross(yf, tf)
        moment_e = -be - m3
        moment_f = -bf + m3
        vv += symmetric(ge, b) - twisting + symmetric(ze, ye * moment_e - ve * real(2.0) + ze * ee)
        uu += symmetric(gf, b) - twisting + symmetric(zf, yf * moment_f - uf * real(2.0) + zf * ff)
        vu -= wp.outer(ze, ue) + wp.outer(vf, zf)
        return packed(
            across(vv, te, te, inverse_e * inverse_e) + lengthening(te, turn_e + b * m3 - ze * moment_e, inverse_e),
            across(vu, te, tf, inverse_e * inverse_f),
            across(uu, tf, tf, inverse_f * inverse_f) + lengthening(tf, turn_f + b * m3 - zf * moment_f, inverse_f),
            (ve - te * wp.dot(te, ve) - ze * ee) * inverse_e,
            (vf - te * wp.dot(te, vf)) * inverse_e,
            (ue - tf * wp.dot(tf, ue)) * inverse_f,
            (uf - tf * wp.dot(tf, uf) - zf * ff) * inverse_f,
            ee,
            ff,
        )

    return strains, jacobian, None, curvature


@cache
def _advance(real):
    Q, S, _, _ = rod_curvature_twist.types(real)
    V, L = wp.types.vector(3, real), wp.types.vector(1, real)
    _, reference_twist, _ = parallel_transport.functions(real)

    @wp.func
    def advance(q: Q, s: S):
        """Return the angle between the reference frames."""
        return L(
            reference_twist(V(s[0], s[1], s[2]), V(s[6], s[7], s[8]), V(s[3], s[4], s[5]), V(s[9], s[10], s[11]), s[12])
        )

    return advance


@cache
def _stale(real):
    Q, S, _, _ = rod_curvature_twist.types(real)
    V = wp.types.vector(3, real)
    stale_of = parallel_transport.stale_function(real)

    @wp.func
    def stale(q: Q, s: S):
        return stale_of(
            V(q[0], q[1], q[2]),
            V(q[3], q[4], q[5]),
            V(s[0], s[1], s[2]),
            V(s[3], s[4], s[5]),
            V(s[6], s[7], s[8]),
            V(s[9], s[10], s[11]),
            s[12],
        )

    return stale


@cache
def _prepared(real):
    Q, _, _, _ = rod_curvature_twist.types(real)
    V, P, S = wp.types.vector(3, real), wp.types.vector(EDGE, real), wp.types.vector(2 * EDGE + 1, real)
    transport, reference_twist, rotate = parallel_transport.functions(real)

    @wp.func
    def edge(e: V, u0: V, t0: V, angle: real):
        """Return tangent, reference and material director, t0 / (1 + t0 . t), the inverse length, and t0 . t of an edge."""
        inverse = real(1.0) / wp.length(e)
        t = e * inverse
        u = transport(u0, t0, t)
        m1 = rotate(u, t, angle)
        c = wp.dot(t0, t)
        y = t0 * (real(1.0) / (real(1.0) + c))
        return P(t[0], t[1], t[2], u[0], u[1], u[2], m1[0], m1[1], m1[2], y[0], y[1], y[2], inverse, c)

    @wp.func
    def stale(q: Q, s: S):
        """Return True if reference frames must be updated before the next step; see `parallel_transport.stale_function`."""
        if s[13] >= real(0.9) and s[27] >= real(0.9):
            return False
        te = V(s[0], s[1], s[2])
        tf = V(s[14], s[15], s[16])
        m = reference_twist(V(s[3], s[4], s[5]), V(s[17], s[18], s[19]), te, tf, s[28])
        return wp.min(s[13], s[27]) < real(0.0) or wp.abs(m - s[28]) > real(1.5)

    return edge, functions(real, prepared=True), stale


rod_curvature_twist = Measure(
    "rod_curvature_twist",
    3,
    ((0, 1), (1, 2)),
    ("curvature_1 [1/m]", "curvature_2 [1/m]", "twist [1/m]"),
    functions,
    angles=2,
    frames=2,
    lag_size=13,
    advance=_advance,
    stale=_stale,
    prepared=_prepared,
)

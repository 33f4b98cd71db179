"""Curvatures and twist between a rigid joint and one of the joint's edges, (kappa_1, kappa_2, tau), pointwise [1/m].

A rigid joint carries, for each of its edges, a ghost edge with the rest tangent and first director of the edge. The ghost rotates
with the joint, by exp(omega) since the last step. Strains between ghost and edge are as at a rod vertex (`rod_curvature_twist`)
with half the edge as Voronoi length, as at a clamped end. Two collinear rods joined rigidly are one rod. The half cells, in series,
twist exactly as its cell. They bend as the cell up to the square of the angle a between the edges: 8 B tan(a/4)^2 / l differs from 2
B tan(a/2)^2 / l.

With phi a rotation of space, a row of the rod's Jacobian (a with respect to the ghost's edge t, b to its angle) becomes t x a + b t.
With the left Jacobian T(omega) of the exponential map (d phi = T d omega) it becomes T^T of that.

Second derivatives, contracted with moments: a rotation phi moves the ghost's edge by phi x t and its angle by t . phi. With the rod's
Hessian in these and with (phi . t) (phi . a), as t x a rotates with the ghost, that is a quadratic form in phi. Along a line in omega
with direction d, phi = T d changes at the rate

    (omega . d) (p' omega x d + q' omega x (omega x d)) + q d x (omega x d),   T = I + p [omega] + q [omega]^2,

where ' is the derivative by |omega| over |omega|, so that the work of t x a + b t on it is added. The spin rate of transported frames
drops out: the ghost's frame is current, z = 0, and dz = t x (phi x t) / 2 is orthogonal to phi x t.

Dofs: edge from the joint outwards (3), twist angle, omega (3). Lagged data: frame (u, t) of the edge; (u, t) of the ghost, reference
twist. Data: +1 where the rod's edge starts at the joint, -1 where it ends there: seen backwards, t and theta change sign.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.measures import Measure, lagged_frames
from ddg_warp.kernels.measures.rod_curvature_twist import rod_curvature_twist


@cache
def rotations(real):
    """Return the device functions `turned`, `transposed`, `tangent` and `bent` of a rotation vector.

    `turned(omega, v)`: exp(omega) v.
    `transposed(omega, v)`: T(omega)^T v.
    `tangent(omega)`: T, the left Jacobian of exp.
    `bent(omega, moment)`: the symmetric component of d(T^T moment) / d omega.
    """
    V = wp.types.vector(3, real)
    small = wp.constant(real(1.0e-3))

    @wp.func
    def coefficients(square: real):
        """Return sin(a) / a, (1 - cos(a)) / a^2, (a - sin(a)) / a^3 for a^2 = `square`, by series if small."""
        s = real(1.0) - square / real(6.0) + square * square / real(120.0)
        c = real(0.5) - square / real(24.0) + square * square / real(720.0)
        d = real(1.0) / real(6.0) - square / real(120.0) + square * square / real(5040.0)
        if square > small:
            a = wp.sqrt(square)
            s = wp.sin(a) / a
            c = (real(1.0) - wp.cos(a)) / square
            d = (a - wp.sin(a)) / (square * a)
        return s, c, d

    @wp.func
    def turned(omega: V, v: V):
        s, c, _d = coefficients(wp.dot(omega, omega))
        across = wp.cross(omega, v)
        return v + across * s + wp.cross(omega, across) * c

    @wp.func
    def transposed(omega: V, v: V):
        _s, c, d = coefficients(wp.dot(omega, omega))
        across = wp.cross(omega, v)
        return v - across * c + wp.cross(omega, across) * d

    @wp.func
    def tangent(omega: V):
        _s, c, d = coefficients(wp.dot(omega, omega))
        w = wp.skew(omega)
        return wp.identity(n=3, dtype=real) + w * c + (w * w) * d

    @wp.func
    def bent(omega: V, moment: V):
        square = wp.dot(omega, omega)
        s, c, d = coefficients(square)
        dc = real(-1.0) / real(12.0) + square / real(180.0)
        dd = real(-1.0) / real(60.0) + square / real(1260.0)
        if square > small:
            dc = (s - real(2.0) * c) / square
            dd = (c - real(3.0) * d) / square
        across = wp.cross(moment, omega)
        g = across * dc + wp.cross(across, omega) * dd - moment * d
        m = wp.outer(omega, g) * real(0.5)
        return m + wp.transpose(m) + wp.identity(n=3, dtype=real) * (d * wp.dot(moment, omega))

    return turned, transposed, tangent, bent


@cache
def functions(real, between: bool = False):
    """Return the functions of the measure; `between` as for a rod vertex."""
    Q, S, E, _ = joint_curvature_twist.types(real)
    R, T, _, _ = rod_curvature_twist.types(real)
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    H = wp.types.vector(28, real)
    rod_strains, rod_jacobian, _, rod_curvature = rod_curvature_twist.functions(real, between)
    turned, transposed, tangent, bent = rotations(real)

    @wp.func
    def vertex(q: Q, s: S):
        """Return dofs and lagged data of the rod vertex between ghost and edge, the ghost's tangent, omega and the sign."""
        omega = V(q[4], q[5], q[6])
        u = turned(omega, V(s[6], s[7], s[8]))
        t = turned(omega, V(s[9], s[10], s[11]))
        sign = s[13]
        r = R(t[0], t[1], t[2], q[0], q[1], q[2], real(0.0), sign * q[3])
        lag = T(u[0], u[1], u[2], t[0], t[1], t[2], s[0], s[1], s[2], sign * s[3], sign * s[4], sign * s[5], s[12])
        return r, lag, t, omega, sign

    @wp.func
    def strains(q: Q, s: S, w: real):
        r, lag, _t, _omega, _sign = vertex(q, s)
        return rod_strains(r, lag, w)

    @wp.func
    def row(j: R, t: V, omega: V, sign: real):
        a = V(j[0], j[1], j[2])
        spin = transposed(omega, wp.cross(t, a) + t * j[6])
        return Q(j[3], j[4], j[5], sign * j[7], spin[0], spin[1], spin[2])

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        r, lag, t, omega, sign = vertex(q, s)
        e, j = rod_jacobian(r, lag, w)
        return e, wp.matrix_from_rows(row(j[0], t, omega, sign), row(j[1], t, omega, sign), row(j[2], t, omega, sign))

    @wp.func
    def curvature(q: Q, s: S, w: real, slope: E):
        r, lag, t, omega, sign = vertex(q, s)
        _e, j = rod_jacobian(r, lag, w)
        f = (slope * w) * j
        h = rod_curvature(r, lag, w, slope)
        gg = M()  # g: ghost edge, a: ghost angle, e: edge, b: its twist angle
        ge = M()
        ee = M()
        ga = V()
        gb = V()
        ea = V()
        eb = V()
        for i in range(3):
            for k in range(3):
                if k >= i:
                    gg[i, k] = h[i * 8 - i * (i - 1) // 2 + k - i]  # `packed_index`
                    ee[i, k] = h[(i + 3) * 8 - (i + 3) * (i + 2) // 2 + k - i]
                else:
                    gg[i, k] = h[k * 8 - k * (k - 1) // 2 + i - k]
                    ee[i, k] = h[(k + 3) * 8 - (k + 3) * (k + 2) // 2 + i - k]
                ge[i, k] = h[i * 8 - i * (i - 1) // 2 + 3 + k - i]
            ga[i] = h[i * 8 - i * (i - 1) // 2 + 6 - i]
            gb[i] = h[i * 8 - i * (i - 1) // 2 + 7 - i]
            ea[i] = h[(i + 3) * 8 - (i + 3) * (i + 2) // 2 + 3 - i]
            eb[i] = h[(i + 3) * 8 - (i + 3) * (i + 2) // 2 + 4 - i]
        x = wp.skew(t)
        a = V(f[0], f[1], f[2])
        mixed = wp.outer(x * ga + a * real(0.5), t)
        spin = mixed + wp.transpose(mixed) + wp.outer(t, t) * h[33] - x * (gg * x)
        T_left = tangent(omega)
        T_transposed = wp.transpose(T_left)
        oo = T_transposed * (spin * T_left) + bent(omega, wp.cross(t, a) + t * f[6])
        oe = T_transposed * (x * ge + wp.outer(t, ea))
        ob = T_transposed * (x * gb) * sign
        return H(
            ee[0, 0],
            ee[0, 1],
            ee[0, 2],
            sign * eb[0],
            oe[0, 0],
            oe[1, 0],
            oe[2, 0],
            ee[1, 1],
            ee[1, 2],
            sign * eb[1],
            oe[0, 1],
            oe[1, 1],
            oe[2, 1],
            ee[2, 2],
            sign * eb[2],
            oe[0, 2],
            oe[1, 2],
            oe[2, 2],
            h[35],
            ob[0],
            ob[1],
            ob[2],
            oo[0, 0],
            oo[0, 1],
            oo[0, 2],
            oo[1, 1],
            oo[1, 2],
            oo[2, 2],
        )

    return strains, jacobian, None, curvature


@cache
def ghost_function(real):
    """Return the device function `ghost(w, u, t)`: director and tangent of a ghost after a rotation vector, orthonormal."""
    V = wp.types.vector(3, real)
    turned, *_ = rotations(real)

    @wp.func
    def ghost(omega: V, director: V, tangent: V):
        t = wp.normalize(turned(omega, tangent))
        u = turned(omega, director)
        return wp.normalize(u - t * wp.dot(u, t)), t

    return ghost


@cache
def _advance(real):
    Q, S, _, _ = joint_curvature_twist.types(real)
    V, L = wp.types.vector(3, real), wp.types.vector(7, real)
    _, reference_twist, _ = parallel_transport.functions(real)
    ghost = ghost_function(real)

    @wp.func
    def advance(q: Q, s: S):
        """Return the ghost frame, rotated by the joint, and the angle from it to the frame of the edge."""
        omega = V(q[4], q[5], q[6])
        u, t = ghost(omega, V(s[6], s[7], s[8]), V(s[9], s[10], s[11]))
        m = reference_twist(u, V(s[0], s[1], s[2]), t, V(s[3], s[4], s[5]) * s[13], s[12])
        return L(u[0], u[1], u[2], t[0], t[1], t[2], m)

    return advance


@cache
def _stale(real):
    Q, S, _, _ = joint_curvature_twist.types(real)
    V = wp.types.vector(3, real)
    stale_of = parallel_transport.stale_function(real)
    turned, *_ = rotations(real)

    @wp.func
    def stale(q: Q, s: S):
        """Return True if the frames of ghost and edge, seen outwards, have to be updated."""
        omega = V(q[4], q[5], q[6])
        u = turned(omega, V(s[6], s[7], s[8]))
        t = turned(omega, V(s[9], s[10], s[11]))
        return stale_of(t, V(q[0], q[1], q[2]), u, t, V(s[0], s[1], s[2]), V(s[3], s[4], s[5]) * s[13], s[12])

    return stale


def _sample(random, count: int) -> dict:
    """Return edges along x of rods of both directions, and ghosts twisted by several revolutions."""
    sign, along = np.where(np.arange(count) % 2, 1.0, -1.0), np.eye(3)[:1]
    ghost = lagged_frames(random, np.repeat(along, count, axis=0))
    return {
        "frame": lagged_frames(random, sign[:, None] * along),
        "lag": np.concatenate([ghost, 6.0 * random.normal(size=(1, count))]),
        "data": sign[None],
    }


joint_curvature_twist = Measure(
    "joint_curvature_twist",
    3,
    ((0, 1),),
    ("curvature_1 [1/m]", "curvature_2 [1/m]", "twist [1/m]"),
    functions,
    angles=1,
    spins=1,
    frames=1,
    lag_size=13,
    data_size=1,
    advance=_advance,
    stale=_stale,
    vectors=(0, 3),  # of the ghost
    sample=_sample,
)

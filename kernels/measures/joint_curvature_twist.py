"""Curvatures and twist between a rigid joint and an edge that meets it, (kappa_1, kappa_2, tau), pointwise [1/m].

A rigid joint carries, for each edge that meets it, a ghost edge with the tangent and the first director that the edge had at rest.
The ghost turns with the joint, by exp(omega) since the last step; between ghost and edge lie the strains of a rod vertex
(`rod_curvature_twist`), with half the edge as Voronoi length, as at a clamped end. Two collinear rods joined rigidly are one rod: the
half cells, in series, twist exactly as its cell and bend as it up to the square of the angle a between the edges, as
8 B tan(a/4)^2 / l differs from 2 B tan(a/2)^2 / l.

With phi the rotation of space, a row of the rod's Jacobian (a with respect to the ghost's edge t, b to its angle) turns into
t x a + b t, and with the left Jacobian T(omega) of the exponential map (d phi = T d omega) into T^T of that.

Dofs: edge from the joint outwards (3), its angle, omega (3). Lagged data: frame (u, t) of the edge; (u, t) of the ghost, reference
twist. Data: +1 where the rod's edge starts at the joint, -1 where it ends there: seen backwards, t and theta change their sign.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures.rod_curvature_twist import rod_curvature_twist


@cache
def rotations(real):
    """turned(omega, v) = exp(omega) v, and transposed(omega, v) = T(omega)^T v with T the left Jacobian of exp."""
    V = wp.types.vector(3, real)
    small = wp.constant(real(1.0e-3))

    @wp.func
    def coefficients(square: real):
        """sin(a) / a, (1 - cos(a)) / a^2, (a - sin(a)) / a^3 of the angle with this square; by series where it is small."""
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

    return turned, transposed


@cache
def functions(real, between: bool = False):
    """Functions of the measure, `between` as for a rod's vertex."""
    Q, S, E, _ = joint_curvature_twist.types(real)
    R, T, _, _ = rod_curvature_twist.types(real)
    V = wp.types.vector(3, real)
    rod_strains, rod_jacobian, *_ = rod_curvature_twist.functions(real, between)
    turned, transposed = rotations(real)

    @wp.func
    def vertex(q: Q, s: S):
        """The rod vertex between the ghost and the edge: its dofs and lagged data, and the ghost's tangent."""
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

    return strains, jacobian, None, None


@cache
def _advance(real):
    Q, S, _, _ = joint_curvature_twist.types(real)
    V, L = wp.types.vector(3, real), wp.types.vector(7, real)
    _, reference_twist, _ = frames.functions(real)
    turned, _ = rotations(real)

    @wp.func
    def advance(q: Q, s: S):
        """The ghost, turned by the joint's rotation, and the angle between its frame and that of the edge."""
        omega = V(q[4], q[5], q[6])
        t = wp.normalize(turned(omega, V(s[9], s[10], s[11])))
        u = turned(omega, V(s[6], s[7], s[8]))
        u = wp.normalize(u - t * wp.dot(u, t))
        m = reference_twist(u, V(s[0], s[1], s[2]), t, V(s[3], s[4], s[5]) * s[13], s[12])
        return L(u[0], u[1], u[2], t[0], t[1], t[2], m)

    return advance


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
)

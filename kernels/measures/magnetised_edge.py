"""Hard-magnetic edges of rods: direction of magnetisation and field at the middle of an edge; orientation of a pair.

The magnetisation is fixed in the material frame (m1, m2, t) of its edge and rotates with it (Zhao, Kim, Cabrera, Ferracin, Nguyen and
Dunn, J. Mech. Phys. Solids 124, 2019, 244; of rods Sano, Pezzulla and Reis, J. Mech. Phys. Solids 160, 2022, 104739). With the unit
vector a in that frame its direction in space is

    n = a1 m1 + a2 m2 + a3 t ,

independent of stretch. A rotation w of the edge changes n by w x n. A change de rotates the edge by t x de / |e|. It rotates the
frame, transported in time, about t by -z . de / |e| with z = (t0 x t) / (1 + t0 . t) (see `rod_curvature_twist`). So for a constant
v and h = n x v

    v . dn = ((h x t - (h . t) z) . de) / |e| + (h . t) dtheta .

A magnetisation along the tangent needs neither frames nor angles: rods without twist have it, too.

In a field: strains n and B(x) = B + G x at the middle x of the edge. Nodes: the two of the edge. Data: a (3), B (3), G (9, row by
row). For a field that changes with time, `ddg_warp.solve.forces.prescribed_element_data` writes B and G.

Pairs: with r = r u between the middles of two edges, strains are the orientation n . n' - 3 (n . u) (n' . u) of two point dipoles and
their distance r. Nodes: two of each edge. Data: a, a' (3 each).
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.measures import Measure

FIELD = 12  # data of the field: B and the rows of its gradient


@cache
def direction_functions(real, framed: bool):
    """Return the device functions `direction` and `turned`.

    `direction(e, theta, u0, t0, a) -> (n, t, z, 1 / |e|)`: direction of the magnetisation.
    `turned(n, v, t, z, inverse)`: derivatives of v . n with respect to e and theta.
    """
    V = wp.types.vector(3, real)
    transport, _, rotate = parallel_transport.functions(real)

    @wp.func
    def along(e: V, theta: real, u0: V, t0: V, a: V):
        inverse = real(1.0) / wp.length(e)
        t = e * inverse
        return t * a[2], t, V(), inverse

    @wp.func
    def general(e: V, theta: real, u0: V, t0: V, a: V):
        inverse = real(1.0) / wp.length(e)
        t = e * inverse
        m1 = rotate(transport(u0, t0, t), t, theta)
        z = wp.cross(t0, t) / (real(1.0) + wp.dot(t0, t))
        return m1 * a[0] + wp.cross(t, m1) * a[1] + t * a[2], t, z, inverse

    @wp.func
    def turned(n: V, v: V, t: V, z: V, inverse: real):
        h = wp.cross(n, v)
        about = wp.dot(h, t)
        return (wp.cross(h, t) - z * about) * inverse, about

    return (general if framed else along), turned


def _in_field(measure_of, framed: bool):
    """Return the functions of one edge in a field; dofs are its vector, twist angle if framed, and first node."""

    @cache
    def functions(real):
        Q, S, E, M = measure_of().types(real)
        V, M3 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
        direction, turned = direction_functions(real, framed)

        if framed:

            @wp.func
            def read(q: Q, s: S):
                """Return edge, angle, first node, lagged director and tangent, a, B and G."""
                u0 = V(s[0], s[1], s[2])
                t0 = V(s[3], s[4], s[5])
                a = V(s[6], s[7], s[8])
                B = V(s[9], s[10], s[11])
                G = M3(s[12], s[13], s[14], s[15], s[16], s[17], s[18], s[19], s[20])
                return V(q[0], q[1], q[2]), q[3], V(q[4], q[5], q[6]), u0, t0, a, B, G

            @wp.func
            def row(de: V, angle: real, dx: V):
                return Q(de[0], de[1], de[2], angle, dx[0], dx[1], dx[2])

        else:

            @wp.func
            def read(q: Q, s: S):
                a = V(s[0], s[1], s[2])
                B = V(s[3], s[4], s[5])
                G = M3(s[6], s[7], s[8], s[9], s[10], s[11], s[12], s[13], s[14])
                return V(q[0], q[1], q[2]), real(0.0), V(q[3], q[4], q[5]), V(), V(), a, B, G

            @wp.func
            def row(de: V, angle: real, dx: V):
                return Q(de[0], de[1], de[2], dx[0], dx[1], dx[2])

        @wp.func
        def strains(q: Q, s: S, w: real):
            e, theta, x, u0, t0, a, B, G = read(q, s)
            n, _t, _z, _i = direction(e, theta, u0, t0, a)
            b = B + G * (x + e * real(0.5))
            return E(n[0], n[1], n[2], b[0], b[1], b[2])

        @wp.func
        def direction_row(n: V, v: V, t: V, z: V, inverse: real):
            de, angle = turned(n, v, t, z, inverse)
            return row(de, angle, V())

        @wp.func
        def jacobian(q: Q, s: S, w: real):
            e, theta, x, u0, t0, a, B, G = read(q, s)
            n, t, z, inverse = direction(e, theta, u0, t0, a)
            b = B + G * (x + e * real(0.5))
            zero, one, half = real(0.0), real(1.0), real(0.5)
            return E(n[0], n[1], n[2], b[0], b[1], b[2]), wp.matrix_from_rows(
                direction_row(n, V(one, zero, zero), t, z, inverse),
                direction_row(n, V(zero, one, zero), t, z, inverse),
                direction_row(n, V(zero, zero, one), t, z, inverse),
                row(G[0] * half, zero, G[0]),
                row(G[1] * half, zero, G[1]),
                row(G[2] * half, zero, G[2]),
            )

        return strains, jacobian, None, None

    return functions


def _pair(measure_of, framed: bool):
    """Return the functions of two edges; dofs are both vectors, the vector between first nodes, and angles if framed."""

    @cache
    def functions(real):
        Q, S, E, M = measure_of().types(real)
        V = wp.types.vector(3, real)
        direction, turned = direction_functions(real, framed)

        if framed:

            @wp.func
            def one(q: Q, s: S):
                """Return the direction of the first dipole, by edge, angle, lagged director and tangent, a."""
                return direction(
                    V(q[0], q[1], q[2]), q[9], V(s[0], s[1], s[2]), V(s[3], s[4], s[5]), V(s[12], s[13], s[14])
                )

            @wp.func
            def other(q: Q, s: S):
                return direction(
                    V(q[3], q[4], q[5]), q[10], V(s[6], s[7], s[8]), V(s[9], s[10], s[11]), V(s[15], s[16], s[17])
                )

            @wp.func
            def row(de: V, df: V, dg: V, first: real, second: real):
                return Q(de[0], de[1], de[2], df[0], df[1], df[2], dg[0], dg[1], dg[2], first, second)

        else:

            @wp.func
            def one(q: Q, s: S):
                return direction(V(q[0], q[1], q[2]), real(0.0), V(), V(), V(s[0], s[1], s[2]))

            @wp.func
            def other(q: Q, s: S):
                return direction(V(q[3], q[4], q[5]), real(0.0), V(), V(), V(s[3], s[4], s[5]))

            @wp.func
            def row(de: V, df: V, dg: V, first: real, second: real):
                return Q(de[0], de[1], de[2], df[0], df[1], df[2], dg[0], dg[1], dg[2])

        @wp.func
        def apart(q: Q):
            """Return the vector between the middles of the edges."""
            return V(q[6], q[7], q[8]) + (V(q[3], q[4], q[5]) - V(q[0], q[1], q[2])) * real(0.5)

        @wp.func
        def strains(q: Q, s: S, w: real):
            n, _t, _z, _i = one(q, s)
            m, _s, _y, _j = other(q, s)
            r = apart(q)
            distance = wp.length(r)
            u = r / distance
            return E(wp.dot(n, m) - real(3.0) * wp.dot(n, u) * wp.dot(m, u), distance)

        @wp.func
        def jacobian(q: Q, s: S, w: real):
            n, t, z, inverse = one(q, s)
            m, t2, z2, inverse2 = other(q, s)
            r = apart(q)
            distance = wp.length(r)
            u = r / distance
            three, half = real(3.0), real(0.5)
            nu = wp.dot(n, u)
            mu = wp.dot(m, u)
            factor = wp.dot(n, m) - three * nu * mu
            de, first = turned(n, m - u * (three * mu), t, z, inverse)
            df, second = turned(m, n - u * (three * nu), t2, z2, inverse2)
            dr = (n * mu + m * nu - u * (real(2.0) * nu * mu)) * (-three / distance)
            return E(factor, distance), wp.matrix_from_rows(
                row(de - dr * half, df + dr * half, dr, first, second),
                row(-u * half, u * half, u, real(0.0), real(0.0)),
            )

        return strains, jacobian, None, None

    return functions


_FIELD_STRAINS = (*(f"direction_{d} [1]" for d in "xyz"), *(f"field_{d} [T]" for d in "xyz"))
_PAIR = ((0, 1), (2, 3), (0, 2))
_PAIR_STRAINS = ("orientation [1]", "distance [m]")

magnetised_edge = Measure(
    "magnetised_edge",
    3,
    ((0, 1),),
    _FIELD_STRAINS,
    _in_field(lambda: magnetised_edge, True),
    angles=1,
    frames=1,
    lag_size=6,
    data_size=3 + FIELD,
    points=1,
    field=FIELD,
)
magnetised_tangent = Measure(
    "magnetised_tangent",
    3,
    ((0, 1),),
    _FIELD_STRAINS,
    _in_field(lambda: magnetised_tangent, False),
    data_size=3 + FIELD,
    points=1,
    field=FIELD,
)
dipole_pair = Measure(
    "dipole_pair",
    3,
    _PAIR,
    _PAIR_STRAINS,
    _pair(lambda: dipole_pair, True),
    angles=2,
    frames=2,
    lag_size=12,
    data_size=6,
    apart=True,
)
dipole_pair_tangent = Measure(
    "dipole_pair_tangent", 3, _PAIR, _PAIR_STRAINS, _pair(lambda: dipole_pair_tangent, False), data_size=6, apart=True
)

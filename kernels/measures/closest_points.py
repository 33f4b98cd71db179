"""Closest points of two simplices, with derivatives of the vector between them and of its length.

The vector is r = sum_k rho_k e_k of the edge vectors e of a sequence of nodes, with coefficients rho that make it shortest:

    point, edge        nodes 0 | 1 2       r = e0 + t e1            0 <= t <= 1
    edge, edge         nodes 0 1 | 2 3     r = s e0 + e1 + t e2     0 <= s, t <= 1, s = 1 at node 0
    point, triangle    nodes 0 | 1 2 3     r = e0 + s e1 + t e2     0 <= t <= s <= 1

The active bounds define the region: a vertex, an edge, or the interior. Free motions in a region are given by up to two directions m,
coefficients with which r changes as sum_k m_k e_k = r_m; one of zeros is none. At the closest points r . r_m = 0, so that
with n = r / |r| the derivative of the distance is (rho_k n)_k in every region: it is continuous where regions meet. The second one is
not. With two directions that are made to have r_m at right angles,

    d2|r| = (rho_k rho_l I - g_k g_l^T - sum_m B_mk B_ml^T / |r_m|^2) / |r| ,   g_k = rho_k n ,   B_mk = rho_k r_m + m_k r ,

the last term from the motion of the closest points (implicit function theorem).

Two lines are closest where r is along e0 x e2. Both crossings are found by products with e0 x e2, which lose no digits for nearly
parallel lines, as differences of squared lengths do. Clamping is by Ericson, Real-Time Collision Detection, 2005, 5.1.9.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.division import nonzero_function

# Square of the sine of the angle below which lines count as parallel, of which any point is as close as any other.
PARALLEL = {wp.float64: 1.0e-20, wp.float32: 1.0e-10}


@cache
def point_edge(real):
    """Return the device function `closest(q) -> (rho, m, zeros)` of a point and an edge."""
    Q, K, V = wp.types.vector(6, real), wp.types.vector(2, real), wp.types.vector(3, real)

    @wp.func
    def closest(q: Q):
        zero, one = real(0.0), real(1.0)
        e = V(q[3], q[4], q[5])
        t = wp.clamp(-wp.dot(V(q[0], q[1], q[2]), e) / wp.dot(e, e), zero, one)
        return K(one, t), K(zero, wp.where(t > zero and t < one, one, zero)), K()

    return closest


@cache
def _edges(real):
    """Return the device function `edges(q)`: the three edges of a sequence of four nodes."""
    Q, V = wp.types.vector(9, real), wp.types.vector(3, real)

    @wp.func
    def edges(q: Q):
        return V(q[0], q[1], q[2]), V(q[3], q[4], q[5]), V(q[6], q[7], q[8])

    return edges


@cache
def edge_edge(real):
    """Return the device function `closest(q) -> (rho, m, m')` of two edges."""
    Q, K = wp.types.vector(9, real), wp.types.vector(3, real)
    parallel, edges = PARALLEL[real], _edges(real)

    @wp.func
    def closest(q: Q):
        zero, one = real(0.0), real(1.0)
        a, b, c = edges(q)
        normal = wp.cross(a, c)
        square = wp.dot(normal, normal)
        crossed = square > real(wp.static(parallel)) * wp.dot(a, a) * wp.dot(c, c)
        start = real(0.5)
        if crossed:
            start = wp.clamp(-wp.dot(wp.cross(b, c), normal) / square, zero, one)
        t = wp.clamp(-(start * wp.dot(a, c) + wp.dot(b, c)) / wp.dot(c, c), zero, one)
        s = wp.clamp(-(t * wp.dot(a, c) + wp.dot(a, b)) / wp.dot(a, a), zero, one)
        first = wp.where(s > zero and s < one, one, zero)
        second = wp.where(t > zero and t < one and (crossed or first == zero), one, zero)
        return K(s, one, t), K(first, zero, zero), K(zero, zero, second)

    return closest


@cache
def point_triangle(real):
    """Return the device function `closest(q) -> (rho, m, m')` of a point and a triangle."""
    Q, K = wp.types.vector(9, real), wp.types.vector(3, real)
    parallel, edges = PARALLEL[real], _edges(real)

    @wp.func
    def along(a: K, e: K):
        """Return the minimiser t of |a + t e| between 0 and 1."""
        return wp.clamp(-wp.dot(a, e) / wp.dot(e, e), real(0.0), real(1.0))

    @wp.func
    def closest(q: Q):
        zero, one = real(0.0), real(1.0)
        a, b, c = edges(q)
        normal = wp.cross(b, c)
        square = wp.dot(normal, normal)
        if square > real(wp.static(parallel)) * wp.dot(b, b) * wp.dot(c, c):
            s = -wp.dot(wp.cross(a, c), normal) / square
            t = wp.dot(wp.cross(a, b), normal) / square
            if wp.min(wp.min(t, s - t), one - s) > zero:
                return K(one, s, t), K(zero, one, zero), K(zero, zero, one)
        first = along(a, b)
        second = along(a + b, c)
        third = along(a, b + c)
        r1 = a + b * first
        r2 = a + b + c * second
        r3 = a + (b + c) * third
        d1, d2, d3 = wp.dot(r1, r1), wp.dot(r2, r2), wp.dot(r3, r3)
        u = first
        rho = K(one, first, zero)
        m = K(zero, one, zero)
        if d2 < d1 and d2 <= d3:
            u = second
            rho = K(one, one, second)
            m = K(zero, zero, one)
        elif d3 < d1:
            u = third
            rho = K(one, third, third)
            m = K(zero, one, one)
        return rho, m * wp.where(u > zero and u < one, one, zero), K()

    return closest


@cache
def distance_functions(closest_of, size: int, real):
    """Return the device functions of a distance, given `closest_of` from above, on `size` local dofs q.

    `between(q, rho)`: r.
    `spread(rho, v)`: (rho_k v)_k.
    `slope(q)`: (|r|, its derivative).
    `bend(q)`: (g, B, B', rho, 1 / |r|) with B / |r_m| of two orthogonal directions, zero for none.
    """
    edges = size // 3
    Q, K, V = wp.types.vector(size, real), wp.types.vector(edges, real), wp.types.vector(3, real)
    closest = closest_of(real)
    nonzero = nonzero_function(real)

    @wp.func
    def between(q: Q, rho: K):
        r = V()
        for k in range(wp.static(edges)):
            r += V(q[3 * k], q[3 * k + 1], q[3 * k + 2]) * rho[k]
        return r

    @wp.func
    def spread(rho: K, v: V):
        f = Q()
        for k in range(wp.static(edges)):
            for d in range(3):
                f[3 * k + d] = rho[k] * v[d]
        return f

    @wp.func
    def slope(q: Q):
        rho, _m, _o = closest(q)
        r = between(q, rho)
        d = wp.length(r)
        return d, spread(rho, r / nonzero(d))

    @wp.func
    def yielding(rho: K, r: V, m: K, rm: V):
        """Return B / |r_m|."""
        return (spread(rho, rm) + spread(m, r)) / nonzero(wp.length(rm))

    @wp.func
    def bend(q: Q):
        rho, m, o = closest(q)
        r = between(q, rho)
        rm = between(q, m)
        across = o - m * (wp.dot(between(q, o), rm) / nonzero(wp.dot(rm, rm)))
        inverse = real(1.0) / nonzero(wp.length(r))
        return (
            spread(rho, r * inverse),
            yielding(rho, r, m, rm),
            yielding(rho, r, across, between(q, across)),
            rho,
            inverse,
        )

    return between, spread, slope, bend

"""Collisions: two primitives with their closest points, as weights of their nodes, a distance and a direction.

A collision has four nodes x_i. The vector between its closest points is r = sum_i w_i x_i with sum_i w_i = 0, so that the distance d =
|r| has the gradient w_i n, n = r / d, in every region of closest points. The weights are continuous wherever the closest points are.

Two lines are closest where r is along a x b. Products with a x b give both crossings without the cancellation of differences of squared
lengths for nearly parallel lines (Ericson, Real-Time Collision Detection, 2005, 5.1.9, for the clamping).

The closest points of two parallel edges jump. The mollifier of two edges (Li et al., ACM Trans. Graph. 39, 2020, 49, parallel-edge
handling) is

    m(y) = y (2 - y) for y < 1, 1 beyond,   y = |a x b|^2 / threshold,   threshold = 1e-3 |a|^2 |b|^2 at rest.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.primitives import EDGE_POINT, EDGES, POINT_POINT, Kind

# Squared sine of the angle below which lines count as parallel.
PARALLEL = {wp.float64: 1.0e-20, wp.float32: 1.0e-10}
MOLLIFIER_FRACTION = 1.0e-3  # threshold of the mollifier over |a|^2 |b|^2 at rest


@cache
def node_types(real):
    """Return the types of nodes of a collision (4, 3), of scalars by node (4,), and of vectors (3,)."""
    return wp.types.matrix((4, 3), real), wp.types.vector(4, real), wp.types.vector(3, real)


@cache
def distance_function(kind: Kind, real):
    """Return the device function `near(x) -> (w, d, n)`: weights (4,), distance [m] and direction of a collision, x (4, 3)."""
    if kind == EDGE_POINT:
        return _edge_point(real)
    if kind == POINT_POINT:
        return _point_point(real)
    if kind.endless:
        return _point_plane(real)
    X, W, V = node_types(real)
    closest = _edge_edge(real) if kind == EDGES else _point_triangle(real)

    @wp.func
    def near(x: X):
        a = x[1] - x[0]
        b = x[2] - x[1]
        c = x[3] - x[2]
        rho = closest(a, b, c)
        r = a * rho[0] + b * rho[1] + c * rho[2]
        d = wp.length(r)
        return W(-rho[0], rho[0] - rho[1], rho[1] - rho[2], rho[2]), d, r / wp.where(d > real(0.0), d, real(1.0))

    return near


@cache
def _edge_edge(real):
    """Return the device function `closest(a, b, c) -> rho` of edges 0 1 and 2 3, with r = rho . (a, b, c).

    The vectors a, b, c lead from each of nodes 0 1 2 3 to the next.
    """
    V = wp.types.vector(3, real)
    parallel = PARALLEL[real]

    @wp.func
    def closest(a: V, b: V, c: V):
        zero, one = real(0.0), real(1.0)
        normal = wp.cross(a, c)
        square = wp.dot(normal, normal)
        start = real(0.5)
        if square > real(wp.static(parallel)) * wp.dot(a, a) * wp.dot(c, c):
            start = wp.clamp(-wp.dot(wp.cross(b, c), normal) / square, zero, one)
        t = wp.clamp(-(start * wp.dot(a, c) + wp.dot(b, c)) / wp.dot(c, c), zero, one)
        s = wp.clamp(-(t * wp.dot(a, c) + wp.dot(a, b)) / wp.dot(a, a), zero, one)
        return V(s, one, t)

    return closest


@cache
def _point_triangle(real):
    """Return the device function `closest(a, b, c) -> rho` of node 0 and triangle 1 2 3; see `_edge_edge`."""
    V = wp.types.vector(3, real)
    parallel = PARALLEL[real]

    @wp.func
    def along(a: V, e: V):
        """Return the t between 0 and 1 that minimises |a + t e|."""
        return wp.clamp(-wp.dot(a, e) / wp.dot(e, e), real(0.0), real(1.0))

    @wp.func
    def closest(a: V, b: V, c: V):
        zero, one = real(0.0), real(1.0)
        normal = wp.cross(b, c)
        square = wp.dot(normal, normal)
        if square > real(wp.static(parallel)) * wp.dot(b, b) * wp.dot(c, c):
            s = -wp.dot(wp.cross(a, c), normal) / square
            t = wp.dot(wp.cross(a, b), normal) / square
            if wp.min(wp.min(t, s - t), one - s) > zero:
                return V(one, s, t)
        first = along(a, b)
        second = along(a + b, c)
        third = along(a, b + c)
        r1 = a + b * first
        r2 = a + b + c * second
        r3 = a + (b + c) * third
        d1, d2, d3 = wp.dot(r1, r1), wp.dot(r2, r2), wp.dot(r3, r3)
        rho = V(one, first, zero)
        if d2 < d1 and d2 <= d3:
            rho = V(one, one, second)
        elif d3 < d1:
            rho = V(one, third, third)
        return rho

    return closest


@cache
def _point_plane(real):
    """Return the device function `near` of a point and a half-space, with negative distances inside."""
    X, W, _ = node_types(real)

    @wp.func
    def near(x: X):
        u = x[2] - x[1]
        v = x[3] - x[1]
        r = x[0] - x[1]
        normal = wp.cross(u, v)
        size = wp.length(normal)
        n = normal / size
        b = wp.dot(wp.cross(r, v), n) / size
        c = wp.dot(wp.cross(u, r), n) / size
        return W(real(1.0), b + c - real(1.0), -b, -c), wp.dot(r, n), n

    return near


@cache
def point_edge_function(real):
    """Return the device function `nearest(p, a, b) -> (t, d, n)` of point p and edge a b.

    t: parameter of the closest point of the edge. d: distance. n: direction from p.
    """
    _, _, V = node_types(real)

    @wp.func
    def nearest(p: V, a: V, b: V):
        u = a - p
        e = b - a
        t = wp.clamp(-wp.dot(u, e) / wp.dot(e, e), real(0.0), real(1.0))
        r = u + e * t
        d = wp.length(r)
        return t, d, r / wp.where(d > real(0.0), d, real(1.0))

    return nearest


@cache
def _edge_point(real):
    """Return the device function `near` of an edge and a point, node 2."""
    X, W, V = node_types(real)
    nearest = point_edge_function(real)

    @wp.func
    def near(x: X):
        t, d, n = nearest(x[2], x[0], x[1])
        return W(real(1.0) - t, t, real(-1.0), real(0.0)), d, n

    return near


@cache
def _point_point(real):
    """Return the device function `near` of points 0 and 1."""
    X, W, _ = node_types(real)

    @wp.func
    def near(x: X):
        r = x[0] - x[1]
        d = wp.length(r)
        return W(real(1.0), real(-1.0), real(0.0), real(0.0)), d, r / wp.where(d > real(0.0), d, real(1.0))

    return near


@cache
def end_function(real):
    """Return the device function `end(x, k) -> (w, d, n)` between node k of two edges and the other edge."""
    X, W, _ = node_types(real)
    nearest = point_edge_function(real)

    @wp.func
    def end(x: X, k: int):
        one, zero = real(1.0), real(0.0)
        first = wp.where(k < 2, 2, 0)
        t, d, n = nearest(x[k], x[first], x[first + 1])
        is_first = wp.where(k == 0 or k == 2, one, zero)
        w = W(-is_first, is_first - one, one - t, t)
        if k >= 2:
            w = W(one - t, t, -is_first, is_first - one)
        return w, d, n

    return end


@cache
def node_function(real):
    """Return the device function `to_node(x, k, j) -> (w, d, n)` between nodes k and j."""
    X, W, _ = node_types(real)

    @wp.func
    def to_node(x: X, k: int, j: int):
        w = W()
        for i in range(4):
            w[i] = wp.where(i == j, real(1.0), real(0.0)) - wp.where(i == k, real(1.0), real(0.0))
        r = x[j] - x[k]
        d = wp.length(r)
        return w, d, r / wp.where(d > real(0.0), d, real(1.0))

    return to_node


@cache
def mollifier_function(real):
    """Return the device function `mollify(x, threshold) -> (m, m')` of x = |a x b|^2 [m^4]."""

    @wp.func
    def mollify(x: real, threshold: real):
        one, two = real(1.0), real(2.0)
        inverse = one / threshold
        y = x * inverse
        if y >= one:
            return one, real(0.0)
        return y * (two - y), two * (one - y) * inverse

    return mollify


@cache
def tangents_function(real):
    """Return the device function `tangents(n) -> (t1, t2)` that completes a unit vector n to an orthonormal basis.

    Source: Duff et al., J. Comput. Graph. Tech. 6, 2017.
    """
    V = wp.types.vector(3, real)

    @wp.func
    def tangents(n: V):
        one = real(1.0)
        sign = wp.where(n[2] < real(0.0), -one, one)
        a = -one / (sign + n[2])
        b = n[0] * n[1] * a
        return V(one + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), V(b, sign + n[1] * n[1] * a, -n[1])

    return tangents

"""Distances between points, edges and triangles, with closest points; values only, for searches and bounds.

The offset r between the closest points is a sum of the four positions, r = sum_k w_k x_k. The weights w_k of the first side add
up to 1 and the weights of the second to -1. A weight is exactly zero if the closest point does not use its node.

Source: Ericson, Real-Time Collision Detection (2005), 5.1, with coordinates of skew lines from the cross product of the edges. If edges
are nearly parallel these coordinates are noise, but the distance errs by no more than rounding of positions.
"""

from functools import cache

import warp as wp


@cache
def distance_functions(real):
    """Return the device functions `segments`, `point_triangle`, `edge_point`, `point_plane` and `point_point`.

    `segments(a0, a1, b0, b1) -> (r, w)`, `point_triangle(p, a, b, c)`, `edge_point(a, b, p, unused)`,
    `point_point(p, a, unused, unused)`: positions may coincide.
    `point_plane(p, a, b, c)`: offset from the half-space behind the plane, zero inside of it.
    """
    X, W = wp.types.vector(3, real), wp.types.vector(4, real)

    @wp.func
    def closest_coordinate(p: X, a: X, u: X):
        """Return s of the point a + s u, 0 <= s <= 1, that is closest to p; 0 if u is zero."""
        square = wp.dot(u, u)
        if square > real(0.0):
            return wp.clamp(wp.dot(p - a, u) / square, real(0.0), real(1.0))
        return real(0.0)

    @wp.func
    def segments(a0: X, a1: X, b0: X, b1: X):
        """Return the offset from edge b0 b1 to edge a0 a1, and weights."""
        u, v, offset = a1 - a0, b1 - b0, b0 - a0
        n = wp.cross(u, v)
        square = wp.dot(n, n)
        s = real(0.0)
        if square > real(0.0):
            s = wp.clamp(wp.dot(wp.cross(offset, v), n) / square, real(0.0), real(1.0))
        t = closest_coordinate(a0 + s * u, b0, v)
        s = closest_coordinate(b0 + t * v, a0, u)
        return s * u - t * v - offset, W(real(1.0) - s, s, t - real(1.0), -t)

    @wp.func
    def point_triangle(p: X, a: X, b: X, c: X):
        """Return the offset from triangle a b c to point p, and weights."""
        u, v, w = b - a, c - a, p - a
        n = wp.cross(u, v)
        square = wp.dot(n, n)
        if square > real(0.0):
            at_b, at_c = wp.dot(wp.cross(w, v), n) / square, wp.dot(wp.cross(u, w), n) / square
            at_a = real(1.0) - at_b - at_c
            if at_a >= real(0.0) and at_b >= real(0.0) and at_c >= real(0.0):
                return wp.dot(w, n) / square * n, W(real(1.0), -at_a, -at_b, -at_c)
        s = closest_coordinate(p, a, u)
        r, best = w - s * u, W(real(1.0), s - real(1.0), -s, real(0.0))
        s = closest_coordinate(p, a, v)
        candidate = w - s * v
        if wp.dot(candidate, candidate) < wp.dot(r, r):
            r, best = candidate, W(real(1.0), s - real(1.0), real(0.0), -s)
        s = closest_coordinate(p, b, c - b)
        candidate = p - b - s * (c - b)
        if wp.dot(candidate, candidate) < wp.dot(r, r):
            r, best = candidate, W(real(1.0), real(0.0), s - real(1.0), -s)
        return r, best

    @wp.func
    def edge_point(a: X, b: X, p: X, unused: X):
        """Return the offset from point p to edge a b, and weights."""
        s = closest_coordinate(p, a, b - a)
        return a + s * (b - a) - p, W(real(1.0) - s, s, real(-1.0), real(0.0))

    @wp.func
    def point_plane(p: X, a: X, b: X, c: X):
        u, v, w = b - a, c - a, p - a
        n = wp.cross(u, v)
        square = wp.dot(n, n)
        at_b, at_c = wp.dot(wp.cross(w, v), n) / square, wp.dot(wp.cross(u, w), n) / square
        return wp.max(wp.dot(w, n), real(0.0)) / square * n, W(real(1.0), at_b + at_c - real(1.0), -at_b, -at_c)

    @wp.func
    def point_point(p: X, a: X, unused: X, repeated: X):
        """Return the offset from point a to point p, and weights."""
        return p - a, W(real(1.0), real(-1.0), real(0.0), real(0.0))

    return segments, point_triangle, edge_point, point_plane, point_point

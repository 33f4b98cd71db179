"""Distances between points, edges and triangles with their closest points; values only, for search and bounds.

The offset r between the closest points is a sum of the four positions, r = sum_k w_k x_k, where the weights w_k of the first side add
up to 1 and those of the second to -1; a weight is exactly zero where the closest point does not use its node. The cases follow
Ericson, Real-Time Collision Detection (2005), 5.1, with the shares of skew lines taken from the cross product of the edges: where
edges are all but parallel those shares are noise, but the distance errs by no more than rounding of positions.
"""

from functools import cache

import warp as wp


@cache
def distance_functions(real):
    """segments(a0, a1, b0, b1), point_triangle(p, a, b, c), edge_point(a, b, p, .) -> r, w; no position needs to be distinct.

    point_plane(p, a, b, c) -> r, w of the half-space behind the plane, zero inside of it.
    """
    X, W = wp.types.vector(3, real), wp.types.vector(4, real)

    @wp.func
    def share(p: X, a: X, u: X):
        """Where a + s u, 0 <= s <= 1, is closest to p; zero where u is."""
        square = wp.dot(u, u)
        if square > real(0.0):
            return wp.clamp(wp.dot(p - a, u) / square, real(0.0), real(1.0))
        return real(0.0)

    @wp.func
    def segments(a0: X, a1: X, b0: X, b1: X):
        """From edge b0 b1 to edge a0 a1."""
        u, v, apart = a1 - a0, b1 - b0, b0 - a0
        n = wp.cross(u, v)
        square = wp.dot(n, n)
        s = real(0.0)
        if square > real(0.0):
            s = wp.clamp(wp.dot(wp.cross(apart, v), n) / square, real(0.0), real(1.0))
        t = share(a0 + s * u, b0, v)
        s = share(b0 + t * v, a0, u)
        return s * u - t * v - apart, W(real(1.0) - s, s, t - real(1.0), -t)

    @wp.func
    def point_triangle(p: X, a: X, b: X, c: X):
        """From triangle a b c to point p."""
        u, v, w = b - a, c - a, p - a
        n = wp.cross(u, v)
        square = wp.dot(n, n)
        if square > real(0.0):
            at_b, at_c = wp.dot(wp.cross(w, v), n) / square, wp.dot(wp.cross(u, w), n) / square
            at_a = real(1.0) - at_b - at_c
            if at_a >= real(0.0) and at_b >= real(0.0) and at_c >= real(0.0):
                return wp.dot(w, n) / square * n, W(real(1.0), -at_a, -at_b, -at_c)
        s = share(p, a, u)
        r, best = w - s * u, W(real(1.0), s - real(1.0), -s, real(0.0))
        s = share(p, a, v)
        other = w - s * v
        if wp.dot(other, other) < wp.dot(r, r):
            r, best = other, W(real(1.0), s - real(1.0), real(0.0), -s)
        s = share(p, b, c - b)
        other = p - b - s * (c - b)
        if wp.dot(other, other) < wp.dot(r, r):
            r, best = other, W(real(1.0), real(0.0), s - real(1.0), -s)
        return r, best

    @wp.func
    def edge_point(a: X, b: X, p: X, unused: X):
        """From point p to edge a b."""
        s = share(p, a, b - a)
        return a + s * (b - a) - p, W(real(1.0) - s, s, real(-1.0), real(0.0))

    @wp.func
    def point_plane(p: X, a: X, b: X, c: X):
        u, v, w = b - a, c - a, p - a
        n = wp.cross(u, v)
        square = wp.dot(n, n)
        at_b, at_c = wp.dot(wp.cross(w, v), n) / square, wp.dot(wp.cross(u, w), n) / square
        return wp.max(wp.dot(w, n), real(0.0)) / square * n, W(real(1.0), at_b + at_c - real(1.0), -at_b, -at_c)

    return segments, point_triangle, edge_point, point_plane

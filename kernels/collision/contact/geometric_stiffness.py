"""Geometric stiffness of a pair, the Hessian of its energy minus the Gauss-Newton matrix.

The distance is D = |r|, r = sum_i w_i x_i. The weights w of the closest points depend on free parameters t_k along edges and in
triangles: w = w^0 + sum_k t_k c_k. The closest points make r orthogonal to e_k = sum_i c_k,i x_i, so that

    D D'' = w w^T (1 - n n^T) - B A^-1 B^T ,   B_k,i = w_i e_k + c_k,i r ,   A_kl = e_k . e_l ,

which is exact if no parameter is at an end. The Hessian of psi(D) is psi' D'' + psi'' D' D'^T. Repulsion, psi' < 0, makes the first
term negative, mostly across the line of the closest points, where point contacts slide off.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.closest_points import PARALLEL
from ddg_warp.kernels.collision.primitives import EDGE_POINT, EDGES, POINT_PLANE, POINT_POINT, POINT_TRIANGLE

KINDS = EDGES, EDGE_POINT, POINT_POINT, POINT_TRIANGLE, POINT_PLANE
POINTS, TRIANGLES = KINDS.index(POINT_POINT), KINDS.index(POINT_TRIANGLE)


@cache
def bend_function(linear):
    """Return the device function `bend(kind, x, w, v)`: D D'' v of nodes x (4, 3) with weights w and displacements v (4, 3).

    `kind` is an index of `KINDS`.
    """
    Y, W = wp.types.matrix((4, 3), linear), wp.types.vector(4, linear)

    @wp.func
    def free(kind: int, w: W):
        """Return c_0 and c_1, zero for parameters that are absent."""
        zero, one = linear(0.0), linear(1.0)
        c0, c1 = W(), W()
        if kind < wp.static(POINTS):
            if w[0] != zero and w[1] != zero:
                c0 = W(-one, one, zero, zero)
            if kind == 0 and w[2] != zero and w[3] != zero:
                c1 = W(zero, zero, one, -one)
        elif kind > wp.static(POINTS):
            endless = kind > wp.static(TRIANGLES)
            b, c, d = w[1] != zero, w[2] != zero, w[3] != zero
            if endless or (b and c):
                c0 = W(zero, one, -one, zero)
            if endless or (b and d):
                c1 = W(zero, one, zero, -one)
            if c and d and not (b or endless):
                c0 = W(zero, zero, one, -one)
        return c0, c1

    @wp.func
    def total(w: W, x: Y):
        return x[0] * w[0] + x[1] * w[1] + x[2] * w[2] + x[3] * w[3]

    @wp.func
    def bend(kind: int, x: Y, w: W, v: Y):
        r, s = total(w, x), total(w, v)
        c0, c1 = free(kind, w)
        e0, e1 = total(c0, x), total(c1, x)
        b0 = wp.dot(e0, s) + wp.dot(r, total(c0, v))
        b1 = wp.dot(e1, s) + wp.dot(r, total(c1, v))
        a00, a11, a01 = wp.dot(e0, e0), wp.dot(e1, e1), wp.dot(e0, e1)
        if a00 == linear(0.0):  # absent parameter with a zero row
            a00 = linear(1.0)
        if a11 == linear(0.0):
            a11 = linear(1.0)
        # scaled by squared lengths against underflow: 1 minus the squared cosine
        k0, k1, u0, u1 = a01 / a00, a01 / a11, b0 / a00, b1 / a11
        sine = wp.max(linear(1.0) - k0 * k1, linear(wp.static(PARALLEL[linear])))
        g0, g1 = (u0 - k0 * u1) / sine, (u1 - k1 * u0) / sine
        n = wp.normalize(r)
        across = s - n * wp.dot(n, s) - e0 * g0 - e1 * g1
        return wp.outer(w, across) - wp.outer(c0 * g0 + c1 * g1, r)

    return bend

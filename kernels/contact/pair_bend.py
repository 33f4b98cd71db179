"""What the turning of a pair brings to the Hessian of its energy, beside its Gauss-Newton matrix.

Of the distance D = |r|, r = sum_i w_i x_i, whose weights w are those of the closest points and change with the free parameters t_k of
these along edges and in triangles, w = w^0 + sum_k t_k c_k, as the closest they make r at right angles to e_k = sum_i c_k,i x_i,

    D D'' = w w^T (1 - n n^T) - B A^-1 B^T ,   B_k,i = w_i e_k + c_k,i r ,   A_kl = e_k . e_l ,

which is exact where no parameter is at an end. The energy psi(D) has psi' D'' of it beside psi'' D' D'^T: with forces that push,
psi' < 0, it takes stiffness away, most of it across the line of the closest points, where what touches at a point slides off.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.gather import SLOTS, factor_struct
from ddg_warp.kernels.contact.surfaces import EDGE_POINT, EDGES, Kind
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function


@cache
def bend_function(kind: Kind, linear):
    """bend(x, w, v) -> D D'' v of nodes x (4, 3) with weights w, times a movement v (4, 3)."""
    Y, W = wp.types.matrix((4, 3), linear), wp.types.vector(4, linear)

    @wp.func
    def free(w: W):
        """c_0 and c_1, zero where there is no such parameter."""
        zero, one = linear(0.0), linear(1.0)
        c0, c1 = W(), W()
        if wp.static(kind == EDGES or kind == EDGE_POINT):
            if w[0] != zero and w[1] != zero:
                c0 = W(-one, one, zero, zero)
            if wp.static(kind == EDGES):
                if w[2] != zero and w[3] != zero:
                    c1 = W(zero, zero, one, -one)
        else:
            b, c, d = w[1] != zero, w[2] != zero, w[3] != zero
            if wp.static(kind.endless) or (b and c):
                c0 = W(zero, one, -one, zero)
            if wp.static(kind.endless) or (b and d):
                c1 = W(zero, one, zero, -one)
            if wp.static(not kind.endless) and c and d and not b:
                c0 = W(zero, zero, one, -one)
        return c0, c1

    @wp.func
    def total(w: W, x: Y):
        return x[0] * w[0] + x[1] * w[1] + x[2] * w[2] + x[3] * w[3]

    @wp.func
    def bend(x: Y, w: W, v: Y):
        tiny = linear(1.0e-30)
        r, s = total(w, x), total(w, v)
        c0, c1 = free(w)
        e0, e1 = total(c0, x), total(c1, x)
        b0 = wp.dot(e0, s) + wp.dot(r, total(c0, v))
        b1 = wp.dot(e1, s) + wp.dot(r, total(c1, v))
        a00, a11, a01 = wp.dot(e0, e0), wp.dot(e1, e1), wp.dot(e0, e1)
        if a00 == linear(0.0):  # without a parameter its row is zero
            a00 = linear(1.0)
        if a11 == linear(0.0):
            a11 = linear(1.0)
        det = wp.max(a00 * a11 - a01 * a01, tiny)
        g0, g1 = (a11 * b0 - a01 * b1) / det, (a00 * b1 - a01 * b0) / det
        across = s - r * (wp.dot(r, s) / wp.max(wp.dot(r, r), tiny)) - e0 * g0 - e1 * g1
        return wp.outer(w, across) - wp.outer(c0 * g0 + c1 * g1, r)

    return bend


@cache
def bend_kernel(kind: Kind, real, linear, serial: bool):
    """Add the product of psi' D'' with v to that of each pair, by slot, in the worlds that want it."""
    Factor, X, V = factor_struct(linear), wp.types.vector(3, real), wp.types.vector(3, linear)
    bend, until = bend_function(kind, linear), until_function(serial)

    @wp.func
    def beside(x: X, y: X):
        """One position beside another, before digits are lost."""
        u = x - y
        return V(linear(u[0]), linear(u[1]), linear(u[2]))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        things: int,
        wanted: wp.array(dtype=int),
        x: wp.array(dtype=X),
        factor: Factor,
        v: wp.array(dtype=V),
        parts: wp.array2d(dtype=V),
    ):
        """things: first things of pairs in one world."""
        tid = wp.tid()
        if tid >= count[0]:
            return
        for p in range(tid, until(tid, count[0])):
            if factor.used[p] != 0 and factor.bend[p] != linear(0.0) and wanted[pairs[p][0] / things] != 0:
                n = factor.nodes[p]
                o = x[n[0]]
                at = wp.matrix_from_rows(V(), beside(x[n[1]], o), beside(x[n[2]], o), beside(x[n[3]], o))
                y = bend(at, factor.weight[0, p], wp.matrix_from_rows(v[n[0]], v[n[1]], v[n[2]], v[n[3]]))
                for slot in range(wp.static(SLOTS)):
                    parts[slot, p] = parts[slot, p] + y[slot] * factor.bend[p]

    return add

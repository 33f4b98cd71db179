"""Variation of an element's energy along a displacement of its local dofs, which Warp's reverse mode differentiates once more.

A column of the Hessian is that of a unit vector. And it is the adjoint of a solve, which makes the residual zero,
f(q; all else) - dE/dq = 0. With the cotangent g of its solution and w from H^T w = g, the derivative of the loss by all else is that of
w . (f - dE/dq) with q and w held (the implicit function theorem). Of -w . dE/dq, what elements bring, the reverse gives the derivatives
by dofs (-H w), lagged data, rest measure and parameters at once.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames
from ddg_warp.kernels.terms import Term


@cache
def variation_functions(term: Term, real):
    """along(q, s, w, p, v, extra): the derivative of the energy of an element along v, with stresses `extra` added to those of the
    law; strained(q, s, w, f): its strains, each times what f says.
    """
    measure, density = term.measure, term.density
    Q, S, E, _ = measure.types(real)
    n = len(measure.strains)
    P = wp.types.vector(density.parameter_size(n), real)
    strains_of, jacobian_of, *_ = measure.functions(real)
    _, slope_of, _ = density.functions(real, n)

    @wp.func
    def along(q: Q, s: S, w: real, p: P, v: Q, extra: E):
        e, jacobian = jacobian_of(q, s, w)
        return wp.dot(((slope_of(e, p) + extra) * w) * jacobian, v)

    @wp.func
    def strained(q: Q, s: S, w: real, f: E):
        return wp.dot(strains_of(q, s, w), f)

    return along, strained


@cache
def carried_function(real, unit: bool = True):
    """carried(e, u, t, du, dt): the reference frame (u, t) of an edge, carried along to the edge e, times (du, dt); `unit`: made
    orthonormal again.
    """
    V = wp.types.vector(3, real)
    transport, *_ = frames.functions(real)

    @wp.func
    def carried(e: V, u: V, t: V, du: V, dt: V):
        new = wp.normalize(e)
        v = transport(u, t, new)
        if wp.static(unit):
            return wp.dot(wp.normalize(v - new * wp.dot(v, new)), du) + wp.dot(new, dt)
        else:
            return wp.dot(v, du) + wp.dot(new, dt)

    return carried


@cache
def angle_function(real):
    """angle(e, u, t, d): angle about the edge e from its reference director, of the frame (u, t) carried along, to the director d."""
    V = wp.types.vector(3, real)
    transport, *_ = frames.functions(real)

    @wp.func
    def angle(e: V, u: V, t: V, d: V):
        new = wp.normalize(e)
        v = transport(u, t, new)
        return wp.atan2(wp.dot(wp.cross(v, d), new), wp.dot(v, d))

    return angle

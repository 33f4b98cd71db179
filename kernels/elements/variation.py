"""Variation of an element's energy along a displacement of local dofs, for differentiation in reverse mode.

A column of the Hessian is the derivative for a unit displacement. The adjoint of a solve, which makes the residual f(q; p) - dE/dq
zero for inputs p, uses the same function. With the cotangent g of the solution and w from H^T w = g, the derivative of the loss with
respect to p is that of w . (f - dE/dq) at constant q and w (implicit function theorem). Reverse mode of the element contribution -w .
dE/dq gives the derivatives with respect to dofs (-H w), lagged data, rest measure and parameters at once.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.terms import Term


@cache
def variation_functions(term: Term, real):
    """Return the device functions `along` and `strained`.

    `along(q, s, w, p, v, extra)`: derivative of an element's energy along v, with stresses `extra` added to the law's.
    `strained(q, s, w, f)`: scalar product of the strains with f.
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
def transported_function(real, unit: bool = True):
    """Return the device function `carried(e, u, t, du, dt)`: scalar product of a transported frame with (du, dt).

    The frame is (u, t), transported to the edge e and, if `unit`, orthonormalised.
    """
    V = wp.types.vector(3, real)
    transport, *_ = parallel_transport.functions(real)

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
    """Return the device function `angle(e, u, t, d)`: angle about e from the transported reference director to d."""
    V = wp.types.vector(3, real)
    transport, *_ = parallel_transport.functions(real)

    @wp.func
    def angle(e: V, u: V, t: V, d: V):
        new = wp.normalize(e)
        v = transport(u, t, new)
        return wp.atan2(wp.dot(wp.cross(v, d), new), wp.dot(v, d))

    return angle

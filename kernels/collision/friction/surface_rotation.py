"""Rotating surfaces: rotation of round obstacles whose surfaces move while their shape stays.

A body of radius R carries markers at c + e_k, k = 1, 2, 3, with orthogonal e_k of length R. If a rotation about an axis k of space
by an angle a, and a translation, move them to c' + e_k',

    phi = sum_k e_k x e_k' / (2 R^2) = sin(a) k ,

and the point of the surface at R n moves by phi x R n relative to c. phi is linear in marker displacements, as slips are in positions.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS

MARKERS = 3


@cache
def spin_kernels(real):
    """Build the kernels of phi and of the vector-Jacobian product.

    `turn`: write phi of each rotating body in all worlds.
    `vjp`: add the gradients by positions and radii, given the gradients by phi and R.
    """
    V = wp.types.vector(3, real)

    @wp.func
    def arm(x: wp.array(dtype=V), indices: wp.vec4i, shift: int, k: int):
        return x[indices[1 + k] + shift] - x[indices[0] + shift]

    @wp.func
    def inverse_square(x: wp.array(dtype=V), indices: wp.vec4i, shift: int):
        """Return 1 / (2 R^2) of a body with nodes x."""
        square = real(0.0)
        for k in range(wp.static(MARKERS)):
            e = arm(x, indices, shift, k)
            square += wp.dot(e, e)
        return real(wp.static(0.5 * MARKERS)) / square

    @wp.func
    def add_arm_gradient(gradient: wp.array(dtype=V), indices: wp.vec4i, shift: int, k: int, value: V):
        m, c = indices[1 + k] + shift, indices[0] + shift
        gradient[m] = gradient[m] + value
        gradient[c] = gradient[c] - value

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        spinning: wp.array(dtype=wp.vec4i),
        nodes: int,
        start: wp.array(dtype=V),
        x: wp.array(dtype=V),
        phi: wp.array2d(dtype=V),
    ):
        """Write phi of bodies.

        `spinning`: centre and markers of each body among the `nodes` of a world, negative for bodies that do not rotate.
        """
        w, body = wp.tid()
        indices, shift, total = spinning[body], w * nodes, V()
        if indices[0] >= 0:
            for k in range(wp.static(MARKERS)):
                total += wp.cross(arm(start, indices, shift, k), arm(x, indices, shift, k))
            phi[w, body] = total * inverse_square(x, indices, shift)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
        spinning: wp.array(dtype=wp.vec4i),
        nodes: int,
        start: wp.array(dtype=V),
        x: wp.array(dtype=V),
        by_phi_radius: wp.array3d(dtype=real),
        by_start: wp.array(dtype=V),
        by_x: wp.array(dtype=V),
        by_radius: wp.array2d(dtype=real),
    ):
        """Add gradients by positions and radii.

        `by_phi_radius` (4, worlds, bodies): gradients by the components of phi and by R. Distances of markers from the centre are
        constant.
        """
        w, body = wp.tid()
        indices, shift = spinning[body], w * nodes
        if indices[0] >= 0:
            by_phi = V(
                by_phi_radius[0, w, body], by_phi_radius[1, w, body], by_phi_radius[2, w, body]
            ) * inverse_square(x, indices, shift)
            by_radius[w, body] = by_radius[w, body] + by_phi_radius[3, w, body]
            for k in range(wp.static(MARKERS)):
                add_arm_gradient(by_start, indices, shift, k, wp.cross(arm(x, indices, shift, k), by_phi))
                add_arm_gradient(by_x, indices, shift, k, wp.cross(by_phi, arm(start, indices, shift, k)))

    return turn, vjp

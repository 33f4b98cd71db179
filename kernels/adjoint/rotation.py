"""Derivatives of the left Jacobian of the exponential map of rotations, in reverse mode."""

from functools import cache

import warp as wp

from ddg_warp.kernels.measures.joint_curvature_twist import rotations


@cache
def work_gradient_function(real):
    """Return the device function `work_gradient(w, u, z)`: gradient of u . T(w) z with respect to the rotation vector w."""
    V = wp.types.vector(3, real)
    _, transposed, *_ = rotations(real)

    @wp.func
    def work(w: V, u: V, z: V):
        return wp.dot(transposed(w, u), z)

    @wp.func
    def work_gradient(w: V, u: V, z: V):
        dw, _du, _dz = wp.grad(work)(w, u, z)
        return dw

    return work_gradient

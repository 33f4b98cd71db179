"""Drag on shells, per area of both sides, from the local velocity relative to the fluid, with v_n along the normal and v_t along the
surface,

    f = -(c_n v_n + c_t v_t) ,  or quadratic  f = -(c_n |v_n| v_n + c_t |v_t| v_t) .

Vertices take a third of the area of each of their triangles, with its normal, at their own velocities. See `kernels.forces.drag` for
the resistance within a step, quadratic drag included.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.islands import INVERSE_STEP, LOAD_SCALE, STEP_PROGRESS
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.forces.drag import block_function, square_function

NORMAL, TANGENTIAL = range(2)  # rows of coefficients of a triangle [N s/m^3], of quadratic drag [kg/m^3]


@cache
def corner_function(real, square: bool):
    """Return the device function `third(area, w, normal, tangential)`: D [N s/m] of a third of a triangle, at velocity w.

    `area` is the vector twice as long as the area. `square`: quadratic drag.
    """
    V = wp.types.vector(3, real)
    along, across = square_function(3, real)

    @wp.func
    def third(area: V, w: V, normal: real, tangential: real):
        n = wp.normalize(area)
        if wp.static(square):
            D = along(w, n) * normal + across(w, n) * tangential
        else:
            D = wp.identity(n=3, dtype=real) * tangential + wp.outer(n, n) * (normal - tangential)
        return D * (wp.length(area) / real(6.0))

    return third


@cache
def resist_kernel(real, square: bool, alone: bool):
    """Build the kernel `resist`: add the drag of shells to the inertia of blocks, or write both if `alone`."""
    V, M, Inertia = wp.types.vector(3, real), wp.types.matrix((3, 3), real), block_inertia(real)
    third, block = corner_function(real, square), block_function(real, square)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def resist(
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        normals: wp.array(dtype=V),
        q: wp.array(dtype=V),
        mass: wp.array2d(dtype=V),
        corners: wp.array2d(dtype=int),
        coefficients: wp.array2d(dtype=real),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        flow: wp.array2d(dtype=V),
        load: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        nodes: int,
        inertia_out: wp.array2d(dtype=Inertia),
    ):
        """Write inertia and drag; items of a block are the triangles of its vertex, with normals of the nodes `normals`.

        Where loads give no scale, drag does. Coefficients (rows, worlds triangles) are world by world.
        """
        i = wp.tid()
        w = i / blocks
        if scalars[STEP_PROGRESS, w] >= real(1.0):
            return
        k = i - w * blocks
        rate = scalars[INVERSE_STEP, w]
        u = V()
        if k < nodes:
            u = flow[k, w]
        D = M()
        for index in range(starts[k], starts[k + 1]):
            t = items[index]
            a = normals[corners[t, 0] + w * blocks]
            area = wp.cross(normals[corners[t, 1] + w * blocks] - a, normals[corners[t, 2] + w * blocks] - a)
            row = t + w * corners.shape[0]
            D += third(area, v0[i] - u, coefficients[wp.static(NORMAL), row], coefficients[wp.static(TANGENTIAL), row])
        if wp.static(alone):
            inertia_out[w, k] = block(mass[w, k], D, q0[i], v0[i], u, rate, k < nodes)
        else:
            written = inertia_out[w, k]
            written.stiffness += D * rate
            inertia_out[w, k] = written
        if k < nodes and load[w] == real(0.0):
            moved = wp.length(q[i] - q0[i]) + wp.length(u) / rate
            wp.atomic_max(scalars, LOAD_SCALE, w, real(nodes) * moved * wp.max(wp.get_diag(D)) * rate)

    return resist

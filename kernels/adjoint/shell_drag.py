"""Vector-Jacobian product of drag on shells; see `kernels.forces.shell_drag` and `kernels.adjoint.drag`.

Gradients are of w . f with the force f of each corner of a triangle. They are evaluated by triangles and gathered by vertices.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.dof_map import row_functions
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.nodes import NodeStorage, state_type
from ddg_warp.kernels.forces.shell_drag import NORMAL, TANGENTIAL, corner_function


@cache
def work_function(real, square: bool):
    """Return the device function `work(a, b, w, z, r, normal, tangential)`: w . f of a corner.

    The triangle has the edges a and b from its first corner. The corner moves at z in the solve, and at r before, relative to the
    fluid. `square`: quadratic drag.
    """
    V, third = wp.types.vector(3, real), corner_function(real, square)

    @wp.func
    def work(a: V, b: V, w: V, z: V, r: V, normal: real, tangential: real):
        D = third(wp.cross(a, b), r, normal, tangential)
        if wp.static(square):
            return -wp.dot(w, D * (z - r * real(0.5)))
        return -wp.dot(w, D * z)

    return work


@cache
def pull_kernels(nodes: NodeStorage, real, midpoint: bool, square: bool, field: bool):
    """Build the kernels of the product, of quadratic drag if `square`, in a flow that depends on position if `field`.

    `triangles`: write gradients by positions of the corners that give normals, and by their velocities before and in the solve. Add
    gradients by coefficients and by the rate.
    `gather`: add gradients by vertices, as that of `kernels.adjoint.drag`. Item i of a vertex is corner i % 3 of triangle i / 3.
    """
    V, State = wp.types.vector(3, real), state_type(nodes, real)
    work, (row, _) = work_function(real, square), row_functions(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def triangles(
        corners: wp.array2d(dtype=int),
        normals: wp.array2d(dtype=V),
        before: State,
        x: wp.array2d(dtype=V),
        coefficients: wp.array3d(dtype=real),
        flow: wp.array2d(dtype=V),
        w: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        position_out: wp.array3d(dtype=V),
        velocity_out: wp.array3d(dtype=V),
        node_out: wp.array3d(dtype=V),
        coefficient_out: wp.array3d(dtype=real),
        rate_out: wp.array2d(dtype=real),
    ):
        t, island = wp.tid()
        first = normals[corners[t, 0], island]
        a = normals[corners[t, 1], island] - first
        b = normals[corners[t, 2], island] - first
        normal = coefficients[wp.static(NORMAL), t, island]
        tangential = coefficients[wp.static(TANGENTIAL), t, island]
        s = rate[island]
        by_a, by_b = V(), V()
        by_normal, by_tangential, by_rate = real(0.0), real(0.0), real(0.0)
        for corner in range(3):
            k = corners[t, corner]
            u = flow[k, island]
            moved = x[k, island] - before.x[k, island]
            da, db, _w, z, r, dn, dt = wp.grad(work)(
                a, b, row(w, k, island), moved * s - u, before.v[k, island] - u, normal, tangential
            )
            by_a += da
            by_b += db
            by_normal += dn
            by_tangential += dt
            by_rate += wp.dot(z, moved)
            velocity_out[corner, t, island] = r
            node_out[corner, t, island] = z * s
        position_out[0, t, island] = -by_a - by_b
        position_out[1, t, island] = by_a
        position_out[2, t, island] = by_b
        coefficient_out[wp.static(NORMAL), t, island] = coefficient_out[wp.static(NORMAL), t, island] + by_normal
        coefficient_out[wp.static(TANGENTIAL), t, island] = (
            coefficient_out[wp.static(TANGENTIAL), t, island] + by_tangential
        )
        rate_out[t, island] = rate_out[t, island] + by_rate

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        position_in: wp.array3d(dtype=V),
        velocity_in: wp.array3d(dtype=V),
        node_in: wp.array3d(dtype=V),
        rate: wp.array(dtype=real),
        normal_out: wp.array3d(dtype=real),
        fixed_out: wp.array3d(dtype=real),
        flow_out: wp.array2d(dtype=V),
        start_out: State,
    ):
        k, island = wp.tid()
        by_position = V()
        by_velocity = V()
        by_node = V()
        for index in range(starts[k], starts[k + 1]):
            t = items[index] / 3
            corner = items[index] - 3 * t
            by_position += position_in[corner, t, island]
            by_velocity += velocity_in[corner, t, island]
            by_node += node_in[corner, t, island]
        if wp.static(field):
            flow_out[k, island] = flow_out[k, island] - by_velocity - by_node / rate[island]
        for d in range(3):
            fixed_out[d, k, island] = fixed_out[d, k, island] + by_node[d]
            if wp.static(midpoint):
                normal_out[d, k, island] = normal_out[d, k, island] + by_position[d]
        if wp.static(not midpoint):
            by_node -= by_position
        start_out.x[k, island] = start_out.x[k, island] - by_node
        start_out.v[k, island] = start_out.v[k, island] + by_velocity

    return triangles, gather

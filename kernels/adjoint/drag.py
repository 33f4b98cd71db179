"""Vector-Jacobian product of drag, with resistance lagged at the start of a step or at the predicted midpoint.

Gradients are of w . f, with the force f = -D (r (x - x_n) - u) on a node of resistance D, in a solve of length 1 / r; see
`kernels.forces.drag`. They are evaluated by edges and gathered by nodes.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.dof_map import row_functions
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.nodes import NodeStorage, state_type
from ddg_warp.kernels.forces.drag import FIRST, LAST, ROTATIONAL, ROWS, resistance_function


@cache
def work_function(dim: int, real, square: bool):
    """Return the device function `work(e, v, p, wa, za, wb, zb, spin, ra, rb)`: w . f of the halves of an edge and of its angle.

    Nodes move at za, zb in the solve, and at ra, rb before, relative to the fluid; `spin` is the rate of the twist angle times its w.
    `square`: quadratic drag, without bodies.
    """
    V, P = wp.types.vector(dim, real), wp.types.vector(ROWS, real)
    half = resistance_function(dim, real, square)

    @wp.func
    def work(e: V, v: V, p: P, wa: V, za: V, wb: V, zb: V, spin: real, ra: V, rb: V):
        if wp.static(square):
            fa = half(e, v, ra, p) * (za - ra * real(0.5))
            fb = half(e, v, rb, p) * (zb - rb * real(0.5))
            return -wp.dot(wa, fa) - wp.dot(wb, fb) - spin * p[wp.static(ROTATIONAL)] * wp.length(e)
        D = half(e, v, ra, p)
        bodies = p[wp.static(FIRST)] * wp.dot(wa, za) + p[wp.static(LAST)] * wp.dot(wb, zb)
        return -wp.dot(wa, D * za) - wp.dot(wb, D * zb) - bodies - spin * p[wp.static(ROTATIONAL)] * wp.length(e)

    return work


@cache
def pull_kernels(nodes: NodeStorage, closed: bool, real, midpoint: bool, square: bool, field: bool):
    """Build the kernels of the product, of quadratic drag if `square`, in a flow that depends on position if `field`.

    `edges`: write gradients by edge vectors of `tangents`, by velocities of edges before and of nodes in the solve, by coefficients.
    Add gradients by the rate and by twist angles; of the coupled system by coefficients, too.
    `gather`: add gradients by nodes; by tangents to `tangent_out` if these are predicted, else to the previous positions. With a
    field, add gradients by the velocity of the fluid at nodes.

    The coupled system has the nodes `ends` of every edge, and the dof block of its angle or -1. The items of a node are edges that
    begin there, and edges that end there plus the number of edges.
    """
    dim, twist, coupled = nodes.dim, nodes.twist, nodes.coupled
    V, P, State = wp.types.vector(dim, real), wp.types.vector(ROWS, real), state_type(nodes, real)
    work, (row, _) = work_function(dim, real, square), row_functions(dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def edges(
        ends: wp.array2d(dtype=int),
        angles: wp.array(dtype=int),
        count: wp.array(dtype=int),
        tangents: wp.array2d(dtype=V),
        before: State,
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        coefficients: wp.array3d(dtype=real),
        flow: wp.array2d(dtype=V),
        w: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        edge_out: wp.array2d(dtype=V),
        velocity_out: wp.array3d(dtype=V),
        node_out: wp.array3d(dtype=V),
        coefficient_out: wp.array3d(dtype=real),
        rate_out: wp.array2d(dtype=real),
        start_out: State,
    ):
        edge, island = wp.tid()
        a = edge
        b = edge + 1
        angle = int(-1)
        if wp.static(coupled):
            a = ends[edge, 0]
            b = ends[edge, 1]
            angle = angles[edge]
        else:
            n = count[island]
            if edge >= n - wp.static(0 if closed else 1):
                return
            if b == n:
                b = 0
        r = rate[island]
        p = P()
        for i in range(wp.static(ROWS)):
            p[i] = coefficients[i, edge, island]
        moved_a = x[a, island] - before.x[a, island]
        moved_b = x[b, island] - before.x[b, island]
        rotated = real(0.0)
        w_angle = real(0.0)
        if wp.static(twist):
            rotated = theta[edge, island] - before.theta[edge, island]
            w_angle = w[wp.static(dim), edge, island]
        if angle >= 0:
            rotated = x[angle, island][0] - before.x[angle, island][0]
            w_angle = w[0, angle, island]
        ua = flow[a, island]
        ub = flow[b, island]
        de, dv, dp, _wa, za, _wb, zb, spin, ra, rb = wp.grad(work)(
            tangents[b, island] - tangents[a, island],
            (before.v[a, island] + before.v[b, island]) * real(0.5) - (ua + ub) * real(0.5),
            p,
            row(w, a, island),
            moved_a * r - ua,
            row(w, b, island),
            moved_b * r - ub,
            w_angle * r * rotated,
            before.v[a, island] - ua,
            before.v[b, island] - ub,
        )
        edge_out[edge, island] = de
        velocity_out[0, edge, island] = dv * real(0.5) + ra
        velocity_out[1, edge, island] = dv * real(0.5) + rb
        node_out[0, edge, island] = za * r
        node_out[1, edge, island] = zb * r
        by_rate = wp.dot(za, moved_a) + wp.dot(zb, moved_b) + spin * w_angle * rotated
        rate_out[edge, island] = rate_out[edge, island] + by_rate
        for i in range(wp.static(ROWS)):
            if wp.static(coupled):
                dp[i] = dp[i] + coefficient_out[i, edge, island]
            coefficient_out[i, edge, island] = dp[i]
        if wp.static(twist):
            start_out.theta[edge, island] = start_out.theta[edge, island] - spin * w_angle * r
        if angle >= 0:
            by_angle = V()
            by_angle[0] = spin * w_angle * r
            start_out.x[angle, island] = start_out.x[angle, island] - by_angle

    @wp.func
    def add(
        edge_in: wp.array2d(dtype=V),
        velocity_in: wp.array3d(dtype=V),
        node_in: wp.array3d(dtype=V),
        side: int,
        edge: int,
        island: int,
        by_tangent: V,
        by_velocity: V,
        by_node: V,
    ):
        sign = real(2 * side - 1)
        by_tangent += edge_in[edge, island] * sign
        by_velocity += velocity_in[side, edge, island]
        by_node += node_in[side, edge, island]
        return by_tangent, by_velocity, by_node

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        count: wp.array(dtype=int),
        fixed: wp.array2d(dtype=wp.uint8),
        edge_in: wp.array2d(dtype=V),
        velocity_in: wp.array3d(dtype=V),
        node_in: wp.array3d(dtype=V),
        rate: wp.array(dtype=real),
        tangent_out: wp.array3d(dtype=real),
        fixed_out: wp.array3d(dtype=real),
        flow_out: wp.array2d(dtype=V),
        start_out: State,
    ):
        k, island = wp.tid()
        by_tangent = V()
        by_velocity = V()
        by_node = V()
        mask = int(255)
        if wp.static(coupled):
            for index in range(starts[k], starts[k + 1]):
                side = items[index] / edge_in.shape[0]
                edge = items[index] - side * edge_in.shape[0]
                by_tangent, by_velocity, by_node = add(
                    edge_in, velocity_in, node_in, side, edge, island, by_tangent, by_velocity, by_node
                )
        else:
            n = count[island]
            if k >= n:
                return
            mask = int(fixed[k, island])
            if wp.static(closed) or k < n - 1:
                by_tangent, by_velocity, by_node = add(
                    edge_in, velocity_in, node_in, 0, k, island, by_tangent, by_velocity, by_node
                )
            b = k - 1
            if wp.static(closed):
                if k == 0:
                    b = n - 1
            if b >= 0:
                by_tangent, by_velocity, by_node = add(
                    edge_in, velocity_in, node_in, 1, b, island, by_tangent, by_velocity, by_node
                )
        if wp.static(field):
            flow_out[k, island] = flow_out[k, island] - by_velocity - by_node / rate[island]
        for d in range(wp.static(dim)):
            if ((mask >> d) & 1) == 1:
                fixed_out[d, k, island] = fixed_out[d, k, island] + by_node[d]
            if wp.static(midpoint):
                tangent_out[d, k, island] = tangent_out[d, k, island] + by_tangent[d]
        if wp.static(not midpoint):
            by_node -= by_tangent
        start_out.x[k, island] = start_out.x[k, island] - by_node
        start_out.v[k, island] = start_out.v[k, island] + by_velocity

    return edges, gather

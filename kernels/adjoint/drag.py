"""Vector-Jacobian product of drag, with resistance lagged at the start of a step or at the predicted midpoint.

Gradients are of w . f, with the force f = -D (r (x - x_n) - u) on a node of resistance D, in a solve of length 1 / r; see
`kernels.forces.drag`.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.dof_map import row_functions
from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions
from ddg_warp.kernels.forces.drag import FIRST, LAST, ROTATIONAL, ROWS, edge_function
from ddg_warp.kernels.residual.rod_residual import node_functions


@cache
def resisted_function(dim: int, real):
    """Return the device function `resisted(e, v, p, wa, za, wb, zb, spin)`: w . f of the halves of an edge and of its twist angle.

    Nodes move at za, zb; `spin` is the rate of the twist angle times its w.
    """
    V, P = wp.types.vector(dim, real), wp.types.vector(ROWS, real)
    half = edge_function(dim, real)

    @wp.func
    def resisted(e: V, v: V, p: P, wa: V, za: V, wb: V, zb: V, spin: real):
        D = half(e, v, p)
        bodies = p[wp.static(FIRST)] * wp.dot(wa, za) + p[wp.static(LAST)] * wp.dot(wb, zb)
        return -wp.dot(wa, D * za) - wp.dot(wb, D * zb) - bodies - spin * p[wp.static(ROTATIONAL)] * wp.length(e)

    return resisted


@cache
def rod_kernels(kind: RodKind, real, midpoint: bool):
    """Build the kernels of uncoupled rods.

    `edges`: write gradients by edge vectors of `tangents`, by mean velocities of edges and by coefficients.
    `nodes`: add gradients by the previous state, by fixed dofs and by the rate, through these and the resistance.
    """
    dim, twist, closed = kind.dim, kind.twist, kind.closed
    V, M, P = wp.types.vector(dim, real), wp.types.matrix((dim, dim), real), wp.types.vector(ROWS, real)
    half, resisted = edge_function(dim, real), resisted_function(dim, real)
    previous, _ = node_functions(kind, real)
    along, *_ = gather_functions(kind, real)
    row, _ = row_functions(dim, real)

    @wp.func
    def law(coefficients: wp.array3d(dtype=real), k: int, r: int):
        p = P()
        for i in range(wp.static(ROWS)):
            p[i] = coefficients[i, k, r]
        return p

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def edges(
        tangents: wp.array2d(dtype=V),
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        theta0: wp.array2d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        coefficients: wp.array3d(dtype=real),
        flow: wp.array(dtype=V),
        w: wp.array3d(dtype=real),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        edge_out: wp.array3d(dtype=real),
        velocity_out: wp.array3d(dtype=real),
        coefficient_out: wp.array3d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k >= n - wp.static(0 if closed else 1):
            return
        b = along(k + 1, n)
        e = tangents[b, r] - tangents[k, r]
        v = (v0[k, r] + v0[b, r]) * real(0.5) - flow[0]
        za = (x[k, r] - x0[k, r]) * rate[r] - flow[0]
        zb = (x[b, r] - x0[b, r]) * rate[r] - flow[0]
        spin_work = real(0.0)
        if wp.static(twist):
            spin_work = w[wp.static(dim), k, r] * rate[r] * (theta[k, r] - theta0[k, r])
        de, dv, dp, _wa, _za, _wb, _zb, _turn = wp.grad(resisted)(
            e, v, law(coefficients, k, r), row(w, k, r), za, row(w, b, r), zb, spin_work
        )
        for d in range(wp.static(dim)):
            edge_out[d, k, r] = de[d]
            velocity_out[d, k, r] = dv[d]
        for i in range(wp.static(ROWS)):
            coefficient_out[i, k, r] = dp[i]

    @wp.func
    def of_edge(
        x: wp.array2d(dtype=V),
        v: wp.array2d(dtype=V),
        coefficients: wp.array3d(dtype=real),
        u: V,
        k: int,
        n: int,
        r: int,
    ):
        b = along(k + 1, n)
        return half(x[b, r] - x[k, r], (v[k, r] + v[b, r]) * real(0.5) - u, law(coefficients, k, r))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def nodes(
        tangents: wp.array2d(dtype=V),
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        theta0: wp.array2d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        coefficients: wp.array3d(dtype=real),
        flow: wp.array(dtype=V),
        w: wp.array3d(dtype=real),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        edge_in: wp.array3d(dtype=real),
        velocity_in: wp.array3d(dtype=real),
        tangent_out: wp.array3d(dtype=real),
        fixed_out: wp.array3d(dtype=real),
        x_out: wp.array2d(dtype=V),
        v_out: wp.array2d(dtype=V),
        theta_out: wp.array2d(dtype=real),
        rate_out: wp.array2d(dtype=real),
    ):
        """Add gradients; by tangents to `tangent_out` if these are predicted, else to the previous positions."""
        k, r = wp.tid()
        n = count[r]
        if k >= n:
            return
        D = M()
        one = wp.identity(n=wp.static(dim), dtype=real)
        by_tangent = V()
        by_velocity = V()
        b = previous(k, n)
        if wp.static(closed) or k < n - 1:
            D += of_edge(tangents, v0, coefficients, flow[0], k, n, r) + one * coefficients[wp.static(FIRST), k, r]
            by_tangent -= row(edge_in, k, r)
            by_velocity += row(velocity_in, k, r)
        if b >= 0:
            D += of_edge(tangents, v0, coefficients, flow[0], b, n, r) + one * coefficients[wp.static(LAST), b, r]
            by_tangent += row(edge_in, b, r)
            by_velocity += row(velocity_in, b, r)
        back = D * row(w, k, r)
        mask = int(fixed[k, r])
        by_start = back * rate[r]
        for d in range(wp.static(dim)):
            if ((mask >> d) & 1) == 1:
                fixed_out[d, k, r] = fixed_out[d, k, r] - by_start[d]
        grad_inverse_step = -wp.dot(back, x[k, r] - x0[k, r])
        if wp.static(midpoint):
            for d in range(wp.static(dim)):
                tangent_out[d, k, r] = tangent_out[d, k, r] + by_tangent[d]
        else:
            by_start += by_tangent
        x_out[k, r] = x_out[k, r] + by_start
        v_out[k, r] = v_out[k, r] + by_velocity * real(0.5)
        if wp.static(twist):
            if wp.static(closed) or k < n - 1:
                e = tangents[along(k + 1, n), r] - tangents[k, r]
                spin = w[wp.static(dim), k, r] * coefficients[wp.static(ROTATIONAL), k, r] * wp.length(e)
                theta_out[k, r] = theta_out[k, r] + spin * rate[r]
                grad_inverse_step -= spin * (theta[k, r] - theta0[k, r])
        rate_out[k, r] = rate_out[k, r] + grad_inverse_step

    return edges, nodes


@cache
def coupled_kernels(real, midpoint: bool):
    """Build the kernels of the coupled system.

    `edges`: write gradients by both nodes of an edge, and add gradients by coefficients.
    `nodes`: add gradients through the resistance by the previous state, by fixed dofs and by the rate.
    """
    V, P = wp.types.vector(3, real), wp.types.vector(ROWS, real)
    Inertia, resisted = block_inertia(real), resisted_function(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def edges(
        tangents: wp.array(dtype=V),
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        q: wp.array(dtype=V),
        ends: wp.array2d(dtype=int),
        angles: wp.array(dtype=int),
        coefficients: wp.array2d(dtype=real),
        flow: wp.array(dtype=V),
        w: wp.array(dtype=V),
        rate: real,
        blocks: int,
        tangent_out: wp.array2d(dtype=V),
        velocity_out: wp.array2d(dtype=V),
        coefficient_out: wp.array2d(dtype=real),
    ):
        """Write gradients of edges; `angles` are dof blocks of their twist angles, -1 for none."""
        tid = wp.tid()
        world = tid / ends.shape[0]
        edge = tid - world * ends.shape[0]
        a = ends[edge, 0] + world * blocks
        b = ends[edge, 1] + world * blocks
        p = P()
        for i in range(wp.static(ROWS)):
            p[i] = coefficients[i, tid]
        u = flow[0]
        spin = real(0.0)
        if angles[edge] >= 0:
            angle = angles[edge] + world * blocks
            spin = w[angle][0] * rate * (q[angle][0] - q0[angle][0])
        de, dv, dp, _wa, _za, _wb, _zb, _turn = wp.grad(resisted)(
            tangents[b] - tangents[a],
            (v0[a] + v0[b]) * real(0.5) - u,
            p,
            w[a],
            (q[a] - q0[a]) * rate - u,
            w[b],
            (q[b] - q0[b]) * rate - u,
            spin,
        )
        tangent_out[0, tid] = -de
        tangent_out[1, tid] = de
        for i in range(2):
            velocity_out[i, tid] = dv * real(0.5)
        for i in range(wp.static(ROWS)):
            coefficient_out[i, tid] = coefficient_out[i, tid] + dp[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def nodes(
        inertia: wp.array2d(dtype=Inertia),
        q0: wp.array(dtype=V),
        q: wp.array(dtype=V),
        w: wp.array(dtype=V),
        rate: real,
        blocks: int,
        fixed_out: wp.array(dtype=V),
        q_out: wp.array(dtype=V),
        rate_out: wp.array(dtype=real),
    ):
        """Add gradients through the resistance, which `inertia` contains."""
        i = wp.tid()
        world = i / blocks
        node = inertia[world, i - world * blocks]
        back = node.stiffness * w[i]
        fixed_out[i] = fixed_out[i] - back
        q_out[i] = q_out[i] + back
        rate_out[i] = rate_out[i] - wp.dot(back, q[i] - q0[i]) / rate

    return edges, nodes

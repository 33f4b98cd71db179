"""Reverse of a step of a rod group; see `kernels.elements.variation`.

Every element writes its own contributions, which nodes then gather, so that sums have one order, without atomics. Cotangents of
dofs are stored like right-hand sides, [component of a node][node][rod]. The first of the terms writes the element windows, the
others add to them; only one term has lagged data.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions
from ddg_warp.kernels.elements.variation import transported_function
from ddg_warp.kernels.residual.rod_residual import node_functions


@cache
def put_function(kind: RodKind, real, first: bool):
    """Return the device function `put(out, k, r, f)`: add f to an element window, or write it if `first`."""
    W = wp.types.vector(kind.window, real)

    @wp.func
    def put(out: wp.array3d(dtype=real), k: int, r: int, f: W):
        for i in range(wp.static(kind.window)):
            if wp.static(first):
                out[i, k, r] = f[i]
            else:
                out[i, k, r] = out[i, k, r] + f[i]

    return put


@cache
def frame_function(kind: RodKind, real, unit: bool):
    """Return the device function `frame_vjp(x, frame, cotangent, k, n, r) -> (edge, director, tangent)`.

    It reverses `kernels.stepping.rod_step.finish_frames_kernel` at edge k, or without `unit` the frame update `relag` of
    `kernels.newton.rod_iterate`: gradients by the edge and by its lagged frame.

    The reference twist is recomputed at every state; the lagged one only selects its multiple of 2 pi.
    """
    V, X = wp.types.vector(kind.dim, real), wp.types.vector(3, real)
    along_node, *_ = gather_functions(kind, real)
    carried = transported_function(real, unit)

    @wp.func
    def three(a: wp.array3d(dtype=real), row: int, k: int, r: int):
        return X(a[row, k, r], a[row + 1, k, r], a[row + 2, k, r])

    @wp.func
    def frame_vjp(
        x: wp.array2d(dtype=V), frame: wp.array3d(dtype=real), cotangent: wp.array3d(dtype=real), k: int, n: int, r: int
    ):
        e = x[along_node(k + 1, n), r] - x[k, r]
        de, du, dt, _u, _t = wp.grad(carried)(
            e, three(frame, 0, k, r), three(frame, 3, k, r), three(cotangent, 0, k, r), three(cotangent, 3, k, r)
        )
        return de, du, dt

    return frame_vjp


@cache
def transport_kernel(kind: RodKind, real):
    """Build the kernel of gradients by frames that a midpoint solve has transported.

    `vjp`: write gradients by the lagged frames, and the windows of the edges; see `frame_function`.
    """
    V, W = wp.types.vector(kind.dim, real), wp.types.vector(kind.window, real)
    frame_vjp, put, closed = frame_function(kind, real, False), put_function(kind, real, True), kind.closed

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
        count: wp.array(dtype=int),
        cotangent: wp.array3d(dtype=real),
        window_out: wp.array3d(dtype=real),
        frame_out: wp.array3d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k >= n - wp.static(0 if closed else 1):
            return
        de, du, dt = frame_vjp(x, frame, cotangent, k, n, r)
        f = W()
        for d in range(3):
            f[d] = de[d]
            frame_out[d, k, r] = du[d]
            frame_out[3 + d, k, r] = dt[d]
        put(window_out, k, r, f)

    return vjp


@cache
def gathered_function(kind: RodKind, real):
    """Return the device function `gathered(windows, k, n, r)`: sum of the element windows at the dofs of node k of n."""
    dim, twist, closed, window = kind.dim, kind.twist, kind.closed, kind.window
    B = wp.types.vector(kind.block, real)
    previous, edge_force = node_functions(kind, real)

    @wp.func
    def gathered(windows: wp.array3d(dtype=real), k: int, n: int, r: int):
        q = B()
        b = previous(k, n)
        has_next = wp.static(closed) or k < n - 1
        if has_next:
            f = edge_force(windows, k, n, r)
            for d in range(wp.static(dim)):
                q[d] = -f[d]
            if wp.static(twist):
                q[wp.static(dim)] = windows[wp.static(window - 2), k, r]
        if b >= 0:
            f = edge_force(windows, b, n, r)
            for d in range(wp.static(dim)):
                q[d] = q[d] + f[d]
            if wp.static(twist):
                if has_next:
                    q[wp.static(dim)] = q[wp.static(dim)] + windows[wp.static(window - 1), b, r]
        return q

    return gathered


@cache
def lagged_function(kind: RodKind, real):
    """Return the device function `add_lagged(lag, frame_out, k, n, r)`: add the lagged data of both vertices of edge k to its frame."""
    previous, _ = node_functions(kind, real)

    @wp.func
    def add_lagged(lag: wp.array3d(dtype=real), frame_out: wp.array3d(dtype=real), k: int, n: int, r: int):
        b = previous(k, n)
        for c in range(6):
            total = lag[c, k, r]
            if b >= 0:
                total += lag[6 + c, b, r]
            frame_out[c, k, r] = frame_out[c, k, r] + total

    return add_lagged


@cache
def gather_kernels(kind: RodKind, real):
    """Build the kernels that assemble element contributions.

    `gather`: add the sums of windows at the dofs of a node. `edges`: add contributions by vertices' lagged data to frames of edges.
    """
    block, closed, gathered = kind.block, kind.closed, gathered_function(kind, real)
    add_lagged = lagged_function(kind, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gather(window_in: wp.array3d(dtype=real), count: wp.array(dtype=int), dof_out: wp.array3d(dtype=real)):
        k, r = wp.tid()
        n = count[r]
        if k >= n:
            return
        q = gathered(window_in, k, n, r)
        for d in range(wp.static(block)):
            dof_out[d, k, r] = dof_out[d, k, r] + q[d]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def edges(lag_in: wp.array3d(dtype=real), count: wp.array(dtype=int), frame_out: wp.array3d(dtype=real)):
        k, r = wp.tid()
        n = count[r]
        if k < n - wp.static(0 if closed else 1):
            add_lagged(lag_in, frame_out, k, n, r)

    return gather, edges

"""Reverse of a step on chains; see `kernels.elements.variation`.

Every element writes its own shares, which nodes then gather, so that sums come in one order, without atomics. Cotangents of dofs lie
as right-hand sides do, [component of a node][node][rod]. The first of the terms writes the windows, others add to them; one term alone
has lagged data.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions
from ddg_warp.kernels.elements.variation import transported_function
from ddg_warp.kernels.residual.rod_residual import node_functions


@cache
def put_function(kind: RodKind, real, first: bool):
    """put(out, k, r, f): what an element brings to its window; the `first` that does writes it."""
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
def frame_kernel(kind: RodKind, real, unit: bool = True, first: bool = True):
    """pull(...): the reverse of `step.finish_frames_kernel`, or, not `unit`, of `search.relag`. Writes derivatives by frames; those by
    windows, of which the first edge alone counts, where it is the `first` to do so, else adds.

    The reference twist is found anew at every state; the lagged one only says which turn it is of.
    """
    V, X = wp.types.vector(kind.dim, real), wp.types.vector(3, real)
    along_node, *_ = gather_functions(kind, real)
    carried = transported_function(real, unit)
    closed = kind.closed
    W, put = wp.types.vector(kind.window, real), put_function(kind, real, first)

    @wp.func
    def three(a: wp.array3d(dtype=real), row: int, k: int, r: int):
        return X(a[row, k, r], a[row + 1, k, r], a[row + 2, k, r])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
        count: wp.array(dtype=int),
        given: wp.array3d(dtype=real),
        window_out: wp.array3d(dtype=real),
        frame_out: wp.array3d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k >= n - wp.static(0 if closed else 1):
            return
        e = x[along_node(k + 1, n), r] - x[k, r]
        de, du, dt, _u, _t = wp.grad(carried)(
            e, three(frame, 0, k, r), three(frame, 3, k, r), three(given, 0, k, r), three(given, 3, k, r)
        )
        f = W()
        for d in range(3):
            f[d] = de[d]
            frame_out[d, k, r] = du[d]
            frame_out[3 + d, k, r] = dt[d]
        put(window_out, k, r, f)

    return pull


@cache
def gathered_function(kind: RodKind, real):
    """gathered(windows, k, n, r): what windows bring to the dofs of node k of a rod of n nodes."""
    dim, twist, closed, window = kind.dim, kind.twist, kind.closed, kind.window
    B = wp.types.vector(kind.block, real)
    _, behind, _, edge_force = node_functions(kind, real)

    @wp.func
    def gathered(windows: wp.array3d(dtype=real), k: int, n: int, r: int):
        q = B()
        b = behind(k, n)
        ahead = wp.static(closed) or k < n - 1
        if ahead:
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
                if ahead:
                    q[wp.static(dim)] = q[wp.static(dim)] + windows[wp.static(window - 1), b, r]
        return q

    return gathered


@cache
def gather_kernels(kind: RodKind, real):
    """end(...) writes what windows bring to the dofs of a node, nodes(...) adds it; edges(...) adds what lagged data of vertices bring
    to frames of edges.
    """
    block, closed, gathered = kind.block, kind.closed, gathered_function(kind, real)
    _, behind, *_ = node_functions(kind, real)

    def gather_kernel(adds: bool):
        @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
        def gather(window_in: wp.array3d(dtype=real), count: wp.array(dtype=int), dof_out: wp.array3d(dtype=real)):
            k, r = wp.tid()
            n = count[r]
            if k >= n:
                return
            q = gathered(window_in, k, n, r)
            for d in range(wp.static(block)):
                if wp.static(adds):
                    dof_out[d, k, r] = dof_out[d, k, r] + q[d]
                else:
                    dof_out[d, k, r] = q[d]

        return gather

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def edges(lag_in: wp.array3d(dtype=real), count: wp.array(dtype=int), frame_out: wp.array3d(dtype=real)):
        k, r = wp.tid()
        n = count[r]
        if k >= n - wp.static(0 if closed else 1):
            return
        b = behind(k, n)
        for c in range(6):
            total = lag_in[c, k, r]
            if b >= 0:
                total += lag_in[6 + c, b, r]
            frame_out[c, k, r] = frame_out[c, k, r] + total

    return gather_kernel(False), gather_kernel(True), edges

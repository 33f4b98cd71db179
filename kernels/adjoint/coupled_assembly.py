"""Assembly of gradients of elements at blocks, edges and data, by incidence lists in a fixed order, without atomics."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.coupled_element import FRAME
from ddg_warp.kernels.elements.variation import transported_function


@cache
def frame_kernel(real):
    """Build the kernel of frame updates, the reverse of `kernels.elements.coupled_frames.edge_kernel`.

    `vjp`: write gradients by the edge vector, and add gradients by the previous frame.
    """
    V = wp.types.vector(3, real)
    carried = transported_function(real)

    @wp.func
    def three(a: wp.array2d(dtype=real), row: int, f: int):
        return V(a[row, f], a[row + 1, f], a[row + 2, f])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
        q: wp.array(dtype=V),
        ends: wp.array2d(dtype=int),
        blocks: int,
        frame: wp.array2d(dtype=real),
        cotangent: wp.array2d(dtype=real),
        edge_out: wp.array2d(dtype=V),
        frame_out: wp.array2d(dtype=real),
    ):
        f = wp.tid()
        world = f / ends.shape[0]
        i = f - world * ends.shape[0]
        e = q[ends[i, 1] + world * blocks] - q[ends[i, 0] + world * blocks]
        de, du, dt, _u, _t = wp.grad(carried)(
            e, three(frame, 0, f), three(frame, 3, f), three(cotangent, 0, f), three(cotangent, 3, f)
        )
        edge_out[0, f] = -de
        edge_out[1, f] = de
        for d in range(3):
            frame_out[d, f] = frame_out[d, f] + du[d]
            frame_out[3 + d, f] = frame_out[3 + d, f] + dt[d]

    return vjp


@cache
def gather_kernels(real):
    """Build the kernels of assembly.

    `slots`: add gradients by local nodes of elements to blocks.
    `frames`: add gradients by lagged data of elements to frames of edges.
    `rows`: add rows of an array, from `first` on, to the rows of another.

    Item i of a list is local node i / `count` of element i % `count`; a world has `count` elements.
    """
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def slots(
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        count: int,
        blocks: int,
        local_in: wp.array2d(dtype=V),
        out: wp.array(dtype=V),
    ):
        tid = wp.tid()
        world = tid / blocks
        k = tid - world * blocks
        total = out[tid]
        for entry in range(starts[k], starts[k + 1]):
            total += local_in[items[entry] / count, items[entry] % count + world * count]
        out[tid] = total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def frames(
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        count: int,
        edges: int,
        lag_in: wp.array2d(dtype=real),
        out: wp.array2d(dtype=real),
    ):
        tid = wp.tid()
        world = tid / edges
        k = tid - world * edges
        for entry in range(starts[k], starts[k + 1]):
            row = items[entry] / count * wp.static(FRAME)
            e = items[entry] % count + world * count
            for c in range(wp.static(FRAME)):
                out[c, tid] = out[c, tid] + lag_in[row + c, e]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def rows(values: wp.array2d(dtype=real), first: int, out: wp.array2d(dtype=real)):
        c, e = wp.tid()
        out[c, e] = out[c, e] + values[first + c, e]

    return slots, frames, rows

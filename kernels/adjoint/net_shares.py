"""Shares of slots of elements, gathered by the blocks, edges and data that they belong to: by lists, so that sums come in one order,
without atomics.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.net.elements import FRAME
from ddg_warp.kernels.threads import CPU_OPTIONS
from ddg_warp.kernels.variation import carried_function


@cache
def frame_kernel(real):
    """pull(...): the reverse of `net.frames.edge_kernel`: by the edge vector, and, added, by the frame of before."""
    V = wp.types.vector(3, real)
    carried = carried_function(real)

    @wp.func
    def three(a: wp.array2d(dtype=real), row: int, f: int):
        return V(a[row, f], a[row + 1, f], a[row + 2, f])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        q: wp.array(dtype=V),
        ends: wp.array2d(dtype=int),
        blocks: int,
        frame: wp.array2d(dtype=real),
        by: wp.array2d(dtype=real),
        edge_out: wp.array2d(dtype=V),
        frame_out: wp.array2d(dtype=real),
    ):
        f = wp.tid()
        world = f / ends.shape[0]
        i = f - world * ends.shape[0]
        e = q[ends[i, 1] + world * blocks] - q[ends[i, 0] + world * blocks]
        de, du, dt, _u, _t = wp.grad(carried)(
            e, three(frame, 0, f), three(frame, 3, f), three(by, 0, f), three(by, 3, f)
        )
        edge_out[0, f] = -de
        edge_out[1, f] = de
        for d in range(3):
            frame_out[d, f] = frame_out[d, f] + du[d]
            frame_out[3 + d, f] = frame_out[3 + d, f] + dt[d]

    return pull


@cache
def gather_kernels(real):
    """slots(...) adds what slots of elements bring to blocks; frames(...) what their lagged data bring to the frames of edges;
    rows(...) adds rows of an array, from the `first` on, to those of another one.

    Item i of a list is slot i / `count` of element i % `count`, of which there are `count` in each world.
    """
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def slots(
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        count: int,
        blocks: int,
        slot_in: wp.array2d(dtype=V),
        out: wp.array(dtype=V),
    ):
        tid = wp.tid()
        world = tid / blocks
        k = tid - world * blocks
        total = out[tid]
        for at in range(starts[k], starts[k + 1]):
            total += slot_in[items[at] / count, items[at] % count + world * count]
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
        for at in range(starts[k], starts[k + 1]):
            row = items[at] / count * wp.static(FRAME)
            e = items[at] % count + world * count
            for c in range(wp.static(FRAME)):
                out[c, tid] = out[c, tid] + lag_in[row + c, e]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def rows(values: wp.array2d(dtype=real), first: int, out: wp.array2d(dtype=real)):
        c, e = wp.tid()
        out[c, e] = out[c, e] + values[first + c, e]

    return slots, frames, rows

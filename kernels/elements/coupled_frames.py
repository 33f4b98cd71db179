"""Time-lagged data of the coupled system: frames of rod edges, and lagged rows of measures.

Worlds in which `moved` is not `wanted` copy the `kept` data.

Why not shared with frames of uncoupled rods: `kernels.stepping.rod_step` and `kernels.newton.rod_iterate` update both edges of a vertex
in one kernel. Here edges and lagged rows of measures take a kernel each, as several elements may meet at an edge.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS, items_function, until_function
from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.elements.coupled_element import FRAME, elements_type, place_function
from ddg_warp.kernels.measures import Measure


@cache
def functions(real):
    """Return the device functions `row(a, i, k) -> v` and `store(a, i, k, v)`: read and write three rows of an array."""
    V = wp.types.vector(3, real)

    @wp.func
    def row(a: wp.array2d(dtype=real), i: int, k: int):
        return V(a[i, k], a[i + 1, k], a[i + 2, k])

    @wp.func
    def store(a: wp.array2d(dtype=real), i: int, k: int, v: V):
        for d in range(3):
            a[i + d, k] = v[d]

    return row, store


@cache
def take_kernel(real):
    """Build the kernel that stores frames.

    `take`: copy frames of rod edges in worlds that moved; others keep the frames of their last solve.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def take(moved: wp.array(dtype=int), edges: int, frame: wp.array2d(dtype=real), frame_out: wp.array2d(dtype=real)):
        f = wp.tid()
        if moved[f / edges] != 0:
            for c in range(6):
                frame_out[c, f] = frame[c, f]

    return take


@cache
def edge_kernel(real, serial: bool):
    """Build the kernel of frame updates.

    `edges`: transport frames of rod edges to the tangents at positions q, and orthonormalise.
    """
    V, first_item, until = wp.types.vector(3, real), items_function(serial), until_function(serial)
    row, store = functions(real)
    transport, *_ = parallel_transport.functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def edges(
        q: wp.array(dtype=V),
        ends: wp.array2d(dtype=int),
        blocks: int,
        moved: wp.array(dtype=int),
        wanted: int,
        kept: wp.array2d(dtype=real),
        frame: wp.array2d(dtype=real),
        frame_out: wp.array2d(dtype=real),
    ):
        world, start = first_item(wp.tid(), ends.shape[0])
        for i in range(start, until(start, ends.shape[0])):
            f = i + world * ends.shape[0]
            if moved[world] != wanted:
                for c in range(6):
                    frame_out[c, f] = kept[c, f]
                continue
            t = wp.normalize(q[ends[i, 1] + world * blocks] - q[ends[i, 0] + world * blocks])
            u = transport(row(frame, 0, f), row(frame, 3, f), t)
            store(frame_out, 0, f, wp.normalize(u - t * wp.dot(u, t)))
            store(frame_out, 3, f, t)

    return edges


@cache
def lag_kernel(measure: Measure, real, serial: bool):
    """Build the kernel of lagged rows of a measure.

    `lag`: write lagged rows of elements from updated frames, dofs and previous rows.

    Within a solve (`within`) rows of ghost nodes are unchanged, as joints continue from their rotations.
    """
    Elements, first_item, until = elements_type(real), items_function(serial), until_function(serial)
    gather, advance = place_function(measure, real), measure.advance(real)
    rows = measure.lag_size - FRAME * measure.frames
    ghosts = 3 * len(measure.vectors) if measure.spins else 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def lag(
        elements: Elements,
        moved: wp.array(dtype=int),
        wanted: int,
        within: int,
        kept: wp.array2d(dtype=real),
        lag_out: wp.array2d(dtype=real),
    ):
        world, start = first_item(wp.tid(), elements.elements)
        for e in range(start, until(start, elements.elements)):
            tid = e + world * elements.elements
            if moved[world] != wanted:
                for c in range(wp.static(rows)):
                    lag_out[c, tid] = kept[c, tid]
                continue
            q, s = gather(elements, elements.q, world, e)
            new = advance(q, s)
            for c in range(wp.static(rows)):
                if within == 0 or c >= wp.static(ghosts):
                    lag_out[c, tid] = new[c]

    return lag


@cache
def reset_kernel(real):
    """Build the kernel that resets joint rotations.

    `reset`: zero rotations of joints after a frame update has absorbed them.
    """
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def reset(first: int, spins: int, blocks: int, q: wp.array(dtype=V)):
        tid = wp.tid()
        q[first + tid % spins + tid / spins * blocks] = V()

    return reset

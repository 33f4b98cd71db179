"""Lagged data of a net: frames of rod edges, and what measures lag beside these.

Worlds in which `moved` is not `wanted` take over what is `kept`, untouched.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.net.elements import FRAME, elements_type, place_function
from ddg_warp.kernels.threads import CPU_OPTIONS, share_function, until_function


@cache
def functions(real):
    """row(a, i, k) -> vector from three rows of an array; put(a, i, k, v)."""
    V = wp.types.vector(3, real)

    @wp.func
    def row(a: wp.array2d(dtype=real), i: int, k: int):
        return V(a[i, k], a[i + 1, k], a[i + 2, k])

    @wp.func
    def put(a: wp.array2d(dtype=real), i: int, k: int, v: V):
        for d in range(3):
            a[i + d, k] = v[d]

    return row, put


@cache
def take_kernel(real):
    """Frames of rod edges of worlds that moved; others keep those that their last solve had."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def take(moved: wp.array(dtype=int), edges: int, frame: wp.array2d(dtype=real), frame_out: wp.array2d(dtype=real)):
        f = wp.tid()
        if moved[f / edges] != 0:
            for c in range(6):
                frame_out[c, f] = frame[c, f]

    return take


@cache
def edge_kernel(real, serial: bool):
    """Frames of rod edges, transported to the tangents of positions q and orthonormalised."""
    V, share, until = wp.types.vector(3, real), share_function(serial), until_function(serial)
    row, put = functions(real)
    transport, *_ = frames.functions(real)

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
        world, start = share(wp.tid(), ends.shape[0])
        for i in range(start, until(start, ends.shape[0])):
            f = i + world * ends.shape[0]
            if moved[world] != wanted:
                for c in range(6):
                    frame_out[c, f] = kept[c, f]
                continue
            t = wp.normalize(q[ends[i, 1] + world * blocks] - q[ends[i, 0] + world * blocks])
            u = transport(row(frame, 0, f), row(frame, 3, f), t)
            put(frame_out, 0, f, wp.normalize(u - t * wp.dot(u, t)))
            put(frame_out, 3, f, t)

    return edges


@cache
def lag_kernel(measure: Measure, real, serial: bool):
    """Own lagged rows of elements of a measure, from frames that are up to date, as the dofs are, and the rows of before.

    Within a solve (`within`), whose joints go on from the rotations they have, ghosts stay as they are.
    """
    Elements, share, until = elements_type(real), share_function(serial), until_function(serial)
    place, advance = place_function(measure, real), measure.advance(real)
    rows = measure.lag_size - FRAME * measure.frames
    ghosts = 3 * len(measure.vectors) if measure.spins else 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def lag(
        given: Elements,
        moved: wp.array(dtype=int),
        wanted: int,
        within: int,
        kept: wp.array2d(dtype=real),
        lag_out: wp.array2d(dtype=real),
    ):
        world, start = share(wp.tid(), given.elements)
        for e in range(start, until(start, given.elements)):
            tid = e + world * given.elements
            if moved[world] != wanted:
                for c in range(wp.static(rows)):
                    lag_out[c, tid] = kept[c, tid]
                continue
            q, s = place(given, given.q, world, e)
            new = advance(q, s)
            for c in range(wp.static(rows)):
                if within == 0 or c >= wp.static(ghosts):
                    lag_out[c, tid] = new[c]

    return lag


@cache
def reset_kernel(real):
    """Rotations of joints start from zero once their frames have taken them over."""
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def reset(first: int, spins: int, blocks: int, q: wp.array(dtype=V)):
        tid = wp.tid()
        q[first + tid % spins + tid / spins * blocks] = V()

    return reset

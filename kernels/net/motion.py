"""What is prescribed in a net: positions of nodes, angles of rod edges and normals of clamped mesh edges by supports that move; the
magnetic field.

Supports are at the end of the part of the step that is taken; for the midpoint rule positions are the mean of those at both of its
ends, so that the extrapolated ones are exact, and angles and normals those in the middle.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames, motion
from ddg_warp.kernels.islands import MOVED, PORTION, PROGRESS


@cache
def motion_kernels(real, midpoint: bool):
    """nodes(...), angles(...) of the iterate; normals(...) for the solve, and turn(...) at the end of the step."""
    V = wp.types.vector(3, real)
    transport, *_ = frames.functions(real)
    turned, placed, branch = motion.functions(real)

    @wp.func
    def reached(progress: real, portion: real):
        """Fraction of the step that a solve is about."""
        if wp.static(midpoint):
            return progress + real(0.5) * portion
        else:
            return progress + portion

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def nodes(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=V),
        pose: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        q: wp.array(dtype=V),
    ):
        """`where` is the block, then the motion of each of its components, -1 for none."""
        i, w = wp.tid()
        if scalars[PROGRESS, w] >= real(1.0):
            return
        k = where[i, 0]
        here = q[k + w * blocks]
        for d in range(3):
            m = where[i, 1 + d]
            if m >= 0:
                p = placed(pose, m, scalars[PROGRESS, w] + scalars[PORTION, w], rest[k])
                if wp.static(midpoint):
                    p = real(0.5) * (p + placed(pose, m, scalars[PROGRESS, w], rest[k]))
                here[d] = p[d]
        q[k + w * blocks] = here

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def angles(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=V),
        pose: wp.array2d(dtype=real),
        ends: wp.array2d(dtype=int),
        frame: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        angle_start: int,
        q: wp.array(dtype=V),
    ):
        """`where` is (rod edge, motion), `rest` the edge's first material director at rest; `frame` are the lagged frames."""
        i, w = wp.tid()
        if scalars[PROGRESS, w] >= real(1.0):
            return
        e = where[i, 0]
        m = where[i, 1]
        f = e + w * ends.shape[0]
        k = e + angle_start + w * blocks
        t = wp.normalize(q[ends[e, 1] + w * blocks] - q[ends[e, 0] + w * blocks])
        u = transport(V(frame[0, f], frame[1, f], frame[2, f]), V(frame[3, f], frame[4, f], frame[5, f]), t)
        at = reached(scalars[PROGRESS, w], scalars[PORTION, w])
        here = q[k]
        here[0] = branch(pose, m, scalars[PROGRESS, w], at, rest[i], u, t, here[0])
        q[k] = here

    @wp.func
    def write(where: wp.array2d(dtype=int), i: int, shift: int, n: V, data: wp.array2d(dtype=real)):
        for d in range(3):
            data[where[i, 1] + d, where[i, 0] + shift] = n[d]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def normals(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=V),
        pose: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        elements: int,
        data_out: wp.array2d(dtype=real),
    ):
        """`where` is (element, first row of its data, motion), `rest` the normal at rest."""
        i, w = wp.tid()
        if scalars[PROGRESS, w] < real(1.0):
            n = turned(pose, where[i, 2], reached(scalars[PROGRESS, w], scalars[PORTION, w]), rest[i])
            write(where, i, w * elements, n, data_out)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def turn(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=V),
        pose: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        elements: int,
        before: wp.array2d(dtype=real),
        data_out: wp.array2d(dtype=real),
    ):
        """Normals at the end of the part of the step, of the worlds that `moved`; others keep theirs."""
        i, w = wp.tid()
        column = where[i, 0] + w * elements
        n = V()
        for d in range(3):
            n[d] = before[where[i, 1] + d, column]
        if flags[MOVED, w] != 0:
            n = turned(pose, where[i, 2], scalars[PROGRESS, w] + scalars[PORTION, w], rest[i])
        write(where, i, w * elements, n, data_out)

    return nodes, angles, normals, turn


@cache
def field_kernel(real):
    """Field and gradient among the data of elements, from row `first` on, in worlds that `moved`; others keep theirs."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def put(
        field: wp.array(dtype=real),
        first: int,
        elements: int,
        moved: wp.array(dtype=int),
        before: wp.array2d(dtype=real),
        data_out: wp.array2d(dtype=real),
    ):
        tid = wp.tid()
        for c in range(field.shape[0]):
            value = field[c]
            if moved[tid / elements] == 0:
                value = before[first + c, tid]
            data_out[first + c, tid] = value

    return put

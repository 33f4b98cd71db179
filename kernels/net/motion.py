"""What supports and a magnetic field prescribe among the data of a net's elements: normals at clamped mesh edges, the field."""

from functools import cache

import warp as wp

from ddg_warp.kernels import motion
from ddg_warp.kernels.islands import MOVED, PORTION, PROGRESS
from ddg_warp.kernels.threads import CPU_OPTIONS


@cache
def normal_kernels(real, midpoint: bool):
    """normals(...) for the solve, and turn(...) at the end of the step."""
    V = wp.types.vector(3, real)
    turned, *_ = motion.functions(real)
    reached, row = motion.reached_function(real, midpoint), motion.row_function(real)

    @wp.func
    def write(where: wp.array2d(dtype=int), i: int, shift: int, n: V, data: wp.array2d(dtype=real)):
        for d in range(3):
            data[where[i, 1] + d, where[i, 0] + shift] = n[d]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def normals(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=V),
        pose: wp.array2d(dtype=real),
        stride: int,
        rows: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        elements: int,
        data_out: wp.array2d(dtype=real),
    ):
        """`where` is (element, first row of its data, motion), `rest` the normal at rest."""
        i, w = wp.tid()
        if scalars[PROGRESS, w] < real(1.0):
            m = where[i, 2] + w * stride + row(scalars, w, rows)
            n = turned(pose, m, reached(scalars, w), rest[i])
            write(where, i, w * elements, n, data_out)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=V),
        pose: wp.array2d(dtype=real),
        stride: int,
        rows: int,
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
            m = where[i, 2] + w * stride + row(scalars, w, rows)
            n = turned(pose, m, scalars[PROGRESS, w] + scalars[PORTION, w], rest[i])
        write(where, i, w * elements, n, data_out)

    return normals, turn


@cache
def field_kernel(real):
    """Field and gradient among the data of elements, from row `first` on, in worlds that `moved`, with a uniform field of their own
    on top; others keep theirs."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def put(
        field: wp.array(dtype=real),
        more: wp.array2d(dtype=real),
        first: int,
        elements: int,
        moved: wp.array(dtype=int),
        before: wp.array2d(dtype=real),
        data_out: wp.array2d(dtype=real),
    ):
        tid = wp.tid()
        for c in range(field.shape[0]):
            value = field[c]
            if c < more.shape[0]:
                value += more[c, tid / elements]
            if moved[tid / elements] == 0:
                value = before[first + c, tid]
            data_out[first + c, tid] = value

    return put

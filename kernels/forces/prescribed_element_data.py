"""Prescribed element data of the coupled system: normals at clamped mesh edges, and the magnetic field."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import STEP_PROGRESS, SUBSTEP_ACCEPTED, SUBSTEP_FRACTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.forces import prescribed_motion


@cache
def normal_kernels(real, midpoint: bool):
    """Build the kernels of prescribed normals.

    `normals`: write normals for the solve.
    `turn`: write normals at the end of the substep.
    """
    V = wp.types.vector(3, real)
    turned, *_ = prescribed_motion.functions(real)
    reached, row = prescribed_motion.reached_function(real, midpoint), prescribed_motion.row_function(real)

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
        """Write normals for the solve, given `where` (element, first data row, motion) and the normal at `rest`."""
        i, w = wp.tid()
        if scalars[STEP_PROGRESS, w] < real(1.0):
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
        """Write normals at the end of the substep, in worlds that moved; others keep previous values."""
        i, w = wp.tid()
        column = where[i, 0] + w * elements
        n = V()
        for d in range(3):
            n[d] = before[where[i, 1] + d, column]
        if flags[SUBSTEP_ACCEPTED, w] != 0:
            m = where[i, 2] + w * stride + row(scalars, w, rows)
            n = turned(pose, m, scalars[STEP_PROGRESS, w] + scalars[SUBSTEP_FRACTION, w], rest[i])
        write(where, i, w * elements, n, data_out)

    return normals, turn


@cache
def field_kernel(real):
    """Build the kernel of the magnetic field.

    `put`: write field and gradient plus the uniform field of a world (`more`) from data row `first` on.

    Worlds that have not `moved` keep previous values.
    """

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

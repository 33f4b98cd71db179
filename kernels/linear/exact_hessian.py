"""Exact Hessian of the coupled system by dof block, from element Hessians in local dofs; stored as in `sliced_ell`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import mass_type
from ddg_warp.kernels.core.islands import INERTIA_COEFFICIENT, NEEDS_DIRECTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.linear.sliced_ell import inertia_function

FIRST, SIGN, COUNT = range(
    3
)  # local dofs of a local node: the first, their sign, and their number (three; one for a twist angle)


@cache
def exact_kernels(real, linear, quadratic: bool, serial: bool):
    """Build the kernels of the exact Hessian.

    `begin`: write the inertia.
    `add`: add the Hessians of one element set.
    """
    M, Mass, until = wp.types.matrix((3, 3), linear), mass_type(real, quadratic), until_function(serial)
    inertia_of = inertia_function(real, linear, quadratic)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(
        mass: Mass,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        rows: wp.array(dtype=int),
        columns: wp.array(dtype=int),
        positions: int,
        matrix: wp.array2d(dtype=linear),
    ):
        start = wp.tid()
        for p in range(start, until(start, matrix.shape[1])):
            w = p / positions
            position = p - w * positions
            row = rows[position]
            if flags[NEEDS_DIRECTION, w] == 0 or row < 0:
                continue  # padding stays zero
            m = M()
            if row == columns[position]:
                m = inertia_of(mass, scalars[INERTIA_COEFFICIENT, w], w, row)
            for i in range(3):
                for j in range(3):
                    matrix[3 * i + j, p] = m[i, j]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(
        hessian: wp.array3d(dtype=real),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        ends: wp.array2d(dtype=int),
        slots: int,
        flags: wp.array2d(dtype=int),
        positions: int,
        matrix: wp.array2d(dtype=linear),
    ):
        """Add element Hessians; see `sliced_ell.sum_function` for items.

        `hessian` is [element][row][column], symmetric up to rounding. `ends (slots * n, 3)` has `FIRST`, `SIGN` and `COUNT` of up to
        n runs of dofs per local node; a sign of zero ends them early.
        """
        start = wp.tid()
        n = ends.shape[0] / slots
        for p in range(start, until(start, matrix.shape[1])):
            w = p / positions
            position = p - w * positions
            if flags[NEEDS_DIRECTION, w] == 0 or starts[position] == starts[position + 1]:
                continue
            elements = hessian.shape[0] / flags.shape[1]
            m = M()
            for index in range(starts[position], starts[position + 1]):
                item = items[index]
                pair = item / slots
                b = item - pair * slots
                e = pair / slots
                a = pair - e * slots
                e += w * elements
                for i in range(n):
                    up = ends[a * n + i, wp.static(SIGN)]
                    if up == 0:
                        break
                    row = ends[a * n + i, wp.static(FIRST)]
                    for j in range(n):
                        sign = up * ends[b * n + j, wp.static(SIGN)]
                        if sign == 0:
                            break
                        column = ends[b * n + j, wp.static(FIRST)]
                        for x in range(3):
                            for y in range(3):
                                if x < ends[a * n + i, wp.static(COUNT)] and y < ends[b * n + j, wp.static(COUNT)]:
                                    both = hessian[e, row + x, column + y] + hessian[e, column + y, row + x]
                                    m[x, y] = m[x, y] + linear(real(0.5) * real(sign) * both)
            for i in range(3):
                for j in range(3):
                    matrix[3 * i + j, p] = matrix[3 * i + j, p] + m[i, j]

    return begin, add

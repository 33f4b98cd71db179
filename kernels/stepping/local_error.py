"""Mass-weighted change of velocities over a step, the local error estimate of implicit Euler."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def differ_kernel(dim: int, real):
    """Build the kernel of the velocity change.

    `differ`: sum m |v1 - v0|^2 over rows, by world of `width` columns, with `threads` threads a column.
    """
    V = wp.types.vector(dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def differ(
        before: wp.array2d(dtype=V),
        after: wp.array2d(dtype=V),
        mass: wp.array2d(dtype=real),
        rows: int,
        width: int,
        threads: int,
        sums_out: wp.array2d(dtype=real),
    ):
        thread, column = wp.tid()
        total = real(0.0)
        for k in range(thread, rows, threads):
            total += mass[k, column] * wp.length_sq(after[k, column] - before[k, column])
        w = column / width
        sums_out[w, (column - w * width) * threads + thread] = total

    return differ

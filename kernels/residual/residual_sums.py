"""Subset residual test: sums of residuals over hierarchical clusters, and limits; see `ddg_warp.compile.residual_tolerance`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import ITERATION, LOAD_SCALE, STATUS, STEP_LENGTH
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function


@cache
def cluster_kernel(real, linear, leaf: bool, serial: bool):
    """Build the kernel of one level of clusters.

    `add`: sum residuals over clusters of the level below, or over blocks (`leaf`), and flag worlds with a sum above its limit.

    Rounding errors of residuals add as independent numbers: as the root of the sum of squares.
    """
    V = wp.types.vector(3, real)
    R = wp.types.vector(3, linear) if leaf else V
    until = until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(
        value: wp.array(dtype=R),
        rounding: wp.array(dtype=real),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        below: int,
        limit: wp.array2d(dtype=real),
        offset: int,
        rtol: real,
        exact: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        value_out: wp.array(dtype=V),
        rounding_out: wp.array(dtype=real),
        ratio_out: wp.array2d(dtype=real),
        unbalanced_out: wp.array(dtype=int),
        drowned_out: wp.array(dtype=int),
    ):
        """Sum residuals over clusters and test the sums.

        The level below has `below` entries a world; `offset` is the index of the first ratio.

        If directions are `exact`, sums after a full step need no test, as for uncoupled rods; see `kernels.residual.rod_residual`.
        """
        start, w = wp.tid()
        if flags[STATUS, w] != 0:
            return
        if exact != 0 and flags[ITERATION, w] > 0 and scalars[STEP_LENGTH, w] == real(1.0):
            for cluster in range(start, until(start, limit.shape[1])):
                ratio_out[w, offset + cluster] = real(0.0)
            return
        for cluster in range(start, until(start, limit.shape[1])):
            total = V()
            square = real(0.0)
            for entry in range(starts[cluster], starts[cluster + 1]):
                i = items[entry] + w * below
                v = value[i]
                total += V(real(v[0]), real(v[1]), real(v[2]))
                rounding_error = rounding[i]
                if wp.static(leaf):
                    rounding_error *= rounding_error
                square += rounding_error
            i = cluster + w * limit.shape[1]
            value_out[i] = total
            rounding_out[i] = square
            largest = wp.max(wp.abs(total))
            ratio_out[w, offset + cluster] = largest / limit[w, cluster]
            if not largest <= rtol * scalars[LOAD_SCALE, w] * limit[w, cluster]:
                drowned_out[w] = 1
                if not largest <= wp.sqrt(square):
                    unbalanced_out[w] = 1

    return add

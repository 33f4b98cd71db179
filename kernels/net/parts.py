"""Sums of the residual over parts of a net, small to large, against what they may be; see `ddg_warp.compile.tolerance`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.islands import ITERATION, LOAD_SCALE, STATUS, STEP_LENGTH
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function


@cache
def part_kernel(real, linear, leaf: bool, serial: bool):
    """Sums of one level from those of the level below, or from blocks (`leaf`); raises the flags of worlds with one too large.

    Rounding of single residuals adds up like that of independent numbers: as the root of the sum of squares.
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
        place: int,
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
        """`below` is how many the level below has in a world; ratios of sums to their limits go to `place` and after.

        Where directions are `exact`, a whole step sees to sums, of joined rods as of those on their own; see `kernels.balance`.
        """
        start, w = wp.tid()
        if flags[STATUS, w] != 0:
            return
        if exact != 0 and flags[ITERATION, w] > 0 and scalars[STEP_LENGTH, w] == real(1.0):
            for part in range(start, until(start, limit.shape[1])):
                ratio_out[w, place + part] = real(0.0)
            return
        for part in range(start, until(start, limit.shape[1])):
            total = V()
            square = real(0.0)
            for at in range(starts[part], starts[part + 1]):
                i = items[at] + w * below
                v = value[i]
                total += V(real(v[0]), real(v[1]), real(v[2]))
                noise = rounding[i]
                if wp.static(leaf):
                    noise *= noise
                square += noise
            i = part + w * limit.shape[1]
            value_out[i] = total
            rounding_out[i] = square
            largest = wp.max(wp.abs(total))
            ratio_out[w, place + part] = largest / limit[w, part]
            if not largest <= rtol * scalars[LOAD_SCALE, w] * limit[w, part]:
                drowned_out[w] = 1
                if not largest <= wp.sqrt(square):
                    unbalanced_out[w] = 1

    return add

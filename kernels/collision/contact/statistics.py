"""Contact statistics over steps: numbers of active pairs and the work of friction, counted on the device."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import STATUS, SUBSTEP_ACCEPTED
from ddg_warp.kernels.core.launch import CPU_OPTIONS

SUM, PARTS, LAST = (
    0,
    1,
    2,
)  # rows of counts: pairs over all substeps, number of substeps, pairs of the last one


@cache
def take_kernel(real):
    """Build the kernel of statistics.

    `take`: add the pairs and the friction work of a substep, in worlds that accepted it.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def take(
        active_pairs: wp.array(dtype=int),
        dissipated: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        counts: wp.array2d(dtype=wp.int64),
        work: wp.array(dtype=wp.float64),
    ):
        w = wp.tid()
        if flags[SUBSTEP_ACCEPTED, w] != 0 and flags[STATUS, w] <= wp.static(outcome.CONVERGED_TO_ROUNDING):
            counts[wp.static(SUM), w] = counts[wp.static(SUM), w] + wp.int64(active_pairs[w])
            counts[wp.static(PARTS), w] = counts[wp.static(PARTS), w] + wp.int64(1)
            counts[wp.static(LAST), w] = wp.int64(active_pairs[w])
            work[w] = work[w] + wp.float64(dissipated[w])

    return take

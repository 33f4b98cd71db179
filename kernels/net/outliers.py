"""Worlds in which all but a few bodies are in balance, and these few nearly so; see `ddg_warp.solve.net.outliers`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.islands import DROWNED, LOAD_SCALE, STATUS, UNBALANCED
from ddg_warp.kernels.threads import CPU_OPTIONS, share_function, until_function

FARTHEST = 10.0  # times the tolerance, that residuals of the few may be


@cache
def outlier_kernels(real, serial: bool):
    """count(...) bodies out of balance; excuse(...) them where they are few."""
    share, until = share_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def count(
        ratio: wp.array2d(dtype=real),
        owner: wp.array(dtype=int),
        bodies: int,
        rtol: real,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        out_of_balance: wp.array(dtype=int),
        number: wp.array(dtype=int),
    ):
        """What belongs to no body counts as more than there are."""
        w, start = share(wp.tid(), owner.shape[0])
        if flags[STATUS, w] != 0:
            return
        for i in range(start, until(start, owner.shape[0])):
            if ratio[w, i] > rtol * scalars[LOAD_SCALE, w]:
                u = owner[i]
                if u < 0:
                    wp.atomic_max(number, w, bodies + 1)
                elif wp.atomic_max(out_of_balance, u + w * bodies, 1) == 0:
                    wp.atomic_add(number, w, 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def excuse(
        number: wp.array(dtype=int),
        most: int,
        worst: wp.array(dtype=real),
        square: wp.array(dtype=real),
        rtol: real,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
    ):
        """What is no number is in no ratio, but in the sum of squares."""
        w = wp.tid()
        near = worst[w] <= real(wp.static(FARTHEST)) * rtol * scalars[LOAD_SCALE, w] and wp.isfinite(square[w])
        if flags[STATUS, w] == 0 and number[w] <= most and near:
            flags[UNBALANCED, w] = 0
            flags[DROWNED, w] = 0

    return count, excuse

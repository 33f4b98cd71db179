"""Relaxed convergence: a few bodies may exceed the tolerance by a bounded factor; see `ddg_warp.solve.newton.relaxed_convergence`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import BELOW_ROUNDING_FLOOR, LOAD_SCALE, NOT_CONVERGED, STATUS
from ddg_warp.kernels.core.launch import CPU_OPTIONS, items_function, until_function

FARTHEST = 10.0  # largest allowed residual of these bodies, over the tolerance


@cache
def outlier_kernels(real, serial: bool):
    """Build the kernels of relaxed convergence.

    `count`: count bodies above the tolerance.
    `excuse`: accept worlds with few such bodies.
    """
    share, until = items_function(serial), until_function(serial)

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
        """Count bodies above the tolerance; a residual of no body counts as more than all."""
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
        """Accept worlds with few bodies above the tolerance; only the sum of squares shows values that are not finite."""
        w = wp.tid()
        near = worst[w] <= real(wp.static(FARTHEST)) * rtol * scalars[LOAD_SCALE, w] and wp.isfinite(square[w])
        if flags[STATUS, w] == 0 and number[w] <= most and near:
            flags[NOT_CONVERGED, w] = 0
            flags[BELOW_ROUNDING_FLOOR, w] = 0

    return count, excuse

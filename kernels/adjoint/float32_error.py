"""Float32 error of the linear system of a rod group, estimated from parameters on the device.

The estimate is that of `ddg_warp.compile.precision`, plus the bending stiffness of zigzag modes. Maxima, minima and sums are taken over
segments of a rod, then over segments, in a fixed order.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions

SEGMENT = 8  # nodes of a segment, one thread each
STIFFEST, SOFTEST, MASS = range(
    3
)  # rows: largest stiffness of an edge or node [N/m], least bending stiffness times length [N m^3], mass [kg]
ROWS = 3


@cache
def stiffness_kernels(kind: RodKind, real):
    """Build the kernels of the estimate.

    `measure`: write stiffnesses and mass of every segment of every rod.
    `flag`: set `poor` if the float32 error of a rod exceeds the allowed one.
    """
    *_, parameter = gather_functions(kind, real)
    rows = []
    for term, (first, *_) in zip(kind.terms, kind.places(), strict=True):
        names = term.parameter_names
        rows.append((first, first + names.index(term.stiffness[0]) if term.stiffness else -1, term.measure.span))
    stretch = next((row for row in rows if row[2] == 1), (0, -1, 1))
    bend = next((row for row in rows if row[2] > 1), (0, -1, 2))
    stretches, bends = stretch[1] >= 0, bend[1] >= 0
    half = 0.5 * float(np.finfo(np.float32).eps)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        mass: wp.array2d(dtype=real),
        count: wp.array(dtype=int),
        out: wp.array3d(dtype=real),
    ):
        segment, r = wp.tid()
        n = count[r]
        stiffest = real(0.0)
        softest = real(wp.inf)
        total = real(0.0)
        for k in range(segment * wp.static(SEGMENT), wp.min(n, (segment + 1) * wp.static(SEGMENT))):
            total += mass[k, r]
            if wp.static(stretches):
                if k + 1 < n:
                    length = parameter(buffer, table, wp.static(stretch[0]), k, r)
                    stiffest = wp.max(stiffest, parameter(buffer, table, wp.static(stretch[1]), k, r) / length)
            if wp.static(bends):
                if k + 2 < n:
                    length = parameter(buffer, table, wp.static(bend[0]), k, r)
                    bending = parameter(buffer, table, wp.static(bend[1]), k, r)
                    stiffest = wp.max(stiffest, real(16.0) * bending / (length * length * length))
                    softest = wp.min(softest, bending * length)
        out[wp.static(STIFFEST), segment, r] = stiffest
        out[wp.static(SOFTEST), segment, r] = softest
        out[wp.static(MASS), segment, r] = total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def flag(
        rows: wp.array3d(dtype=real),
        length: wp.array(dtype=real),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        allowed: real,
        poor: wp.array(dtype=int),
    ):
        """Set `poor` if the float32 error of a rod exceeds the allowed one."""
        r = wp.tid()
        stiffest = real(0.0)
        least = real(wp.inf)
        total = real(0.0)
        for segment in range(rows.shape[1]):
            stiffest = wp.max(stiffest, rows[wp.static(STIFFEST), segment, r])
            least = wp.min(least, rows[wp.static(SOFTEST), segment, r])
            total += rows[wp.static(MASS), segment, r]
        softest = total / real(count[r]) * rate[r] * rate[r]
        if wp.static(bends):
            lowest = real(wp.static(np.pi)) / length[r]
            softest += wp.where(wp.isfinite(least), least, real(0.0)) * lowest * lowest * lowest * lowest
        if not (real(wp.static(half)) * stiffest <= allowed * softest):
            wp.atomic_max(poor, 0, 1)

    return measure, flag

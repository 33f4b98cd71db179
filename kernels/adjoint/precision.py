"""What float32 makes of the linear system of a group of rods, by the parameters that the device holds.

As `ddg_warp.compile.precision` has it of those of the model, and with what bends a node to and fro; maxima, minima and sums are taken
over parts of a rod, then over these, in one order.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.chain import ChainKind, gather_functions
from ddg_warp.kernels.threads import CPU_OPTIONS

PART = 8  # nodes that a thread goes over
STIFFEST, SOFTEST, MASS = range(
    3
)  # rows: largest of an edge or node, least of bending over lengths, sum [N/m, N m^3, kg]
ROWS = 3


@cache
def stiffness_kernels(kind: ChainKind, real):
    """measure(...): of every part of every rod; judge(...): whether a rod's system errs by more than is allowed in float32."""
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
        part, r = wp.tid()
        n = count[r]
        stiffest = real(0.0)
        softest = real(wp.inf)
        total = real(0.0)
        for k in range(part * wp.static(PART), wp.min(n, (part + 1) * wp.static(PART))):
            total += mass[k, r]
            if wp.static(stretches):
                if k + 1 < n:
                    length = parameter(buffer, table, wp.static(stretch[0]), k, r)
                    stiffest = wp.max(stiffest, parameter(buffer, table, wp.static(stretch[1]), k, r) / length)
            if wp.static(bends):
                if k + 2 < n:
                    length = parameter(buffer, table, wp.static(bend[0]), k, r)
                    own = parameter(buffer, table, wp.static(bend[1]), k, r)
                    stiffest = wp.max(stiffest, real(16.0) * own / (length * length * length))
                    softest = wp.min(softest, own * length)
        out[wp.static(STIFFEST), part, r] = stiffest
        out[wp.static(SOFTEST), part, r] = softest
        out[wp.static(MASS), part, r] = total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def judge(
        found: wp.array3d(dtype=real),
        length: wp.array(dtype=real),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        allowed: real,
        poor: wp.array(dtype=int),
    ):
        """Raises `poor`."""
        r = wp.tid()
        stiffest = real(0.0)
        least = real(wp.inf)
        total = real(0.0)
        for part in range(found.shape[1]):
            stiffest = wp.max(stiffest, found[wp.static(STIFFEST), part, r])
            least = wp.min(least, found[wp.static(SOFTEST), part, r])
            total += found[wp.static(MASS), part, r]
        softest = total / real(count[r]) * rate[r] * rate[r]
        if wp.static(bends):
            lowest = real(wp.static(np.pi)) / length[r]
            softest += wp.where(wp.isfinite(least), least, real(0.0)) * lowest * lowest * lowest * lowest
        if not (real(wp.static(half)) * stiffest <= allowed * softest):
            wp.atomic_max(poor, 0, 1)

    return measure, judge

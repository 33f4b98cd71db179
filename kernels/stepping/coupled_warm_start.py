"""Weight of the extrapolated correction in the coupled system; see `kernels.stepping.warm_start`.

Among many contacts some of a correction is gone by the next step. The weight of a world is the mass-weighted cosine between its
correction and the last extrapolated one. It is lower if the correction has grown by more than `GROWTH`. So a shock is not repeated,
and steady accelerations are extrapolated within a few steps. Corrections below the tolerance of the residual have weight zero.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import LOAD_SCALE
from ddg_warp.kernels.core.launch import CPU_OPTIONS, items_function, until_function

GROWTH, LEAST = 4.0, 0.05  # growth of the correction with full weight; smallest weight, from which it recovers
AGREEING, ADDED, BEFORE, FORCE = range(4)  # rows of sums over nodes: m a.b, m a.a, m b.b, m |a|; see `weigh`
SUMS = 4


@cache
def trust_kernels(real, serial: bool):
    """Build the kernels of the weight.

    `weigh`: sum products of the new correction and the last extrapolated one.
    `trust`: write the weight of the correction.
    """
    share, until = items_function(serial), until_function(serial)
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def weigh(
        q: wp.array(dtype=V),
        predicted: wp.array(dtype=V),
        before: wp.array(dtype=V),
        mass: wp.array(dtype=V),
        moved: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        nodes: int,
        blocks: int,
        weights: wp.array3d(dtype=real),
    ):
        """Write sums over the nodes of a thread.

        a is the correction of the solve as an acceleration, b the last extrapolated acceleration.
        """
        w, start = share(wp.tid(), nodes)
        if moved[w] == 0:
            return
        agreeing, added, trusted, force = real(0.0), real(0.0), real(0.0), real(0.0)
        for k in range(start, until(start, nodes)):
            i = k + w * blocks
            m = mass[i][0]
            a = (q[i] - predicted[i]) * (rate[w] * rate[w])
            b = before[i]
            agreeing += m * wp.dot(a, b)
            added += m * wp.dot(a, a)
            trusted += m * wp.dot(b, b)
            force += m * wp.length(a)
        weights[wp.static(AGREEING), w, start] = agreeing
        weights[wp.static(ADDED), w, start] = added
        weights[wp.static(BEFORE), w, start] = trusted
        weights[wp.static(FORCE), w, start] = force

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def trust(
        sums: wp.array2d(dtype=real),
        rtol: real,
        total: wp.array(dtype=real),
        scalars: wp.array2d(dtype=real),
        trust_out: wp.array(dtype=real),
    ):
        """Write the weight of the correction of every world, in [0, 1]."""
        w = wp.tid()
        added, trusted, weight = sums[wp.static(ADDED), w], sums[wp.static(BEFORE), w], real(1.0)
        if added > real(0.0) and trusted > real(0.0):
            cosine = sums[wp.static(AGREEING), w] / wp.sqrt(added * trusted)
            growth = wp.min(real(GROWTH) * wp.sqrt(trusted / added), real(1.0))
            weight = wp.clamp(cosine * growth, real(LEAST), real(1.0))
        if sums[wp.static(FORCE), w] <= rtol * scalars[LOAD_SCALE, w] * total[w]:
            weight = real(0.0)
        trust_out[w] = weight

    return weigh, trust

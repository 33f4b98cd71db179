"""From where the solve of a net's step starts, and what is trusted of what it adds; see `kernels.foresight`.

Among many contacts some of what a solve adds is gone by the next step. What it added is trusted in a world by the cosine of the angle
between that and what was trusted before, weighed by mass, and less where it has grown by more than `GROWTH`: a shock is not foreseen
again, and what goes on is, within a few steps. What takes less than what is left out of balance is none of the motion.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.foresight import ahead_function
from ddg_warp.kernels.islands import LOAD_SCALE, PROGRESS, TODO
from ddg_warp.kernels.search import PLACE
from ddg_warp.kernels.threads import CPU_OPTIONS, share_function, until_function
from ddg_warp.kernels.turns import loose_function

GROWTH, LEAST = 4.0, 0.05  # of what is trusted from one step to the next; the least of it, from which it grows again
AGREEING, ADDED, BEFORE, FORCE = range(4)  # rows of sums over nodes: m a.b, m a.a, m b.b, m |a|
SUMS = 4


@cache
def foresight_kernels(real, linear, serial: bool):
    """foresee(...) where a solve starts, weigh(...) what it added, trust(...) it."""
    share, until = share_function(serial), until_function(serial)
    ahead, loose = ahead_function(real), loose_function(3, real)
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def foresee(
        a: wp.array(dtype=V),
        held: wp.array(dtype=wp.uint8),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        q: wp.array(dtype=V),
        predicted: wp.array(dtype=V),
        direction: wp.array(dtype=H),
    ):
        """Keeps the predictor q of worlds that still have to move, and goes on to where their accelerations lead from there.

        These are a `direction`, along which worlds that turn edges are placed; see `ddg_warp.solve.net.turns`.
        """
        w, start = share(wp.tid(), blocks)
        if scalars[PROGRESS, w] >= real(1.0):
            return
        weight = ahead(flags, scalars, w)
        for k in range(start, until(start, blocks)):
            i = k + w * blocks
            here = q[i]
            predicted[i] = here
            more = loose(int(held[k]), weight * a[i])
            q[i] = here + more
            if flags[TODO, w] == wp.static(PLACE):
                direction[i] = H(linear(more[0]), linear(more[1]), linear(more[2]))

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
        """The sums, of the nodes that a thread takes: a is what the solve added, b what was trusted before."""
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
        """How much of what was added is trusted, of every world."""
        w = wp.tid()
        added, trusted, found = sums[wp.static(ADDED), w], sums[wp.static(BEFORE), w], real(1.0)
        if added > real(0.0) and trusted > real(0.0):
            cosine = sums[wp.static(AGREEING), w] / wp.sqrt(added * trusted)
            growth = wp.min(real(GROWTH) * wp.sqrt(trusted / added), real(1.0))
            found = wp.clamp(cosine * growth, real(LEAST), real(1.0))
        if sums[wp.static(FORCE), w] <= rtol * scalars[LOAD_SCALE, w] * total[w]:
            found = real(0.0)
        trust_out[w] = found

    return foresee, weigh, trust

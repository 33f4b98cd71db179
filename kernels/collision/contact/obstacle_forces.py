"""Sums of contact and friction over the nodes of each obstacle, in a fixed order."""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.assembly import PAIR_NODES
from ddg_warp.kernels.core.islands import SUBSTEP_ACCEPTED, SUBSTEP_FRACTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def pairs_type(real):
    """Return the struct of a list of pairs with forces, by first primitives, `primitives` in a world; see `CandidateList`.

    `first`: number of local nodes of first primitives. `spinning`, `arm`: of friction on rotating surfaces, else empty; see
    `kernels.collision.friction.potential.lagged_struct`.
    """
    V = wp.types.vector(3, real)

    @wp.struct
    class Pairs:
        count: wp.array(dtype=int)
        starts: wp.array(dtype=int)
        partners: wp.array(dtype=int)
        nodes: wp.array(dtype=wp.vec4i)
        used: wp.array(dtype=int)
        gradient: wp.array2d(dtype=V)
        spinning: wp.array(dtype=int)
        arm: wp.array(dtype=V)
        primitives: int
        first: int

    return Pairs


@cache
def obstacle_kernel(real):
    """Build the kernel of forces on obstacles.

    `add`: add reactions of obstacles, minus the forces on their nodes, over an accepted substep to sums (obstacles runs, worlds).
    """
    V, Pairs = wp.types.vector(3, real), pairs_type(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(
        lists: wp.array(dtype=Pairs),
        owner: wp.array(dtype=int),
        of_object: wp.array(dtype=int),
        objects: int,
        runs: int,
        origin: wp.array(dtype=V),
        x: wp.array(dtype=V),
        blocks: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        force_out: wp.array2d(dtype=V),
        moment_out: wp.array2d(dtype=V),
    ):
        """Add the pairs of every `runs`-th first primitive, by obstacles; `owner` is the obstacle of a node, -1 for none."""
        i, w = wp.tid()
        if flags[SUBSTEP_ACCEPTED, w] == 0:
            return
        obstacle = i / runs
        force = V()
        moment = V()
        for s in range(lists.shape[0]):
            pairs = lists[s]
            if pairs.count[0] == 0:
                continue
            for k in range(i - obstacle * runs, pairs.primitives, runs):
                begin = pairs.starts[k + w * pairs.primitives]
                for p in range(begin, begin + pairs.partners[k + w * pairs.primitives]):
                    if pairs.used[p] == 0:
                        continue
                    for n in range(wp.static(PAIR_NODES)):
                        node = pairs.nodes[p][n]
                        if node >= 0:
                            if owner[node % blocks] == obstacle:
                                g = pairs.gradient[n, p]
                                force += g
                                moment += wp.cross(x[node] - origin[obstacle], g)
                    if pairs.spinning.shape[0] > 0:
                        if pairs.spinning[p] >= 0:
                            if of_object[pairs.spinning[p] % objects] == obstacle:
                                on_first = V()
                                for n in range(pairs.first):
                                    on_first -= pairs.gradient[n, p]
                                moment -= wp.cross(pairs.arm[p], on_first)
        fraction = scalars[SUBSTEP_FRACTION, w]
        force_out[i, w] = force_out[i, w] + force * fraction
        moment_out[i, w] = moment_out[i, w] + moment * fraction

    return add

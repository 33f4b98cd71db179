"""Shares of a proposed motion that may be taken so that nothing passes through anything, each unit of nodes its own.

A unit is what shortens as one: a rod, a shell or a node. All moves are straight, at one time: where units a, b go by s_a, s_b of
theirs, the pair is judged by the time of impact t of the motion that is left (`impact`), in which what all move in common does not
count. The first round is of the whole motion; a pair that hits brings its units to t. What then still hits, as one side was stopped by
others, is brought to max(t s, the smallest share in the pair), round by round until nothing changes. Pairs whose shares have not
changed are not asked again: the others are picked by a kernel of its own, as the one that asks takes so many registers that few threads
of it wait for memory at once. A pair is safe where all of it goes by one share up to its first t; so but for rounding no share falls
below the earliest time of its world. Where the last round allowed still changes some, the world goes by that time as a whole, which is
safe.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.impact import impact_functions
from ddg_warp.kernels.contact.motion import corners_function
from ddg_warp.kernels.contact.surfaces import Kind, pair_functions, sides_struct, things_function
from ddg_warp.kernels.threads import CPU_OPTIONS, TWO_BLOCKS, until_function

ROUNDS = 50  # what falls on what has stopped stops layer by layer, one in a round


@cache
def limit_kernels(kind: Kind, real):
    """pick(...) pairs with a share that the last round has changed; limit(...) the shares of units whose pairs hit, and the earliest
    `time` of their worlds."""
    Sides, X, W = sides_struct(real), wp.types.vector(3, real), wp.types.vector(4, real)
    slots, _, thickness, _ = pair_functions(kind, real)
    corners, (impact, _), things = corners_function(real), impact_functions(kind, real), things_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pick(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        unit: wp.array(dtype=int),
        units: int,
        shares: wp.array(dtype=real),
        before: wp.array(dtype=real),
        picked: wp.array(dtype=int),
        number: wp.array(dtype=int),
    ):
        """In any order: what they come to is the least of what each does."""
        for p in range(wp.tid(), count[0], threads):
            w, i, j = things(sides, pairs[p])
            nodes = slots(sides, i, j, w)
            changed = int(0)
            for k in range(4):
                of = unit[nodes[k] - w * sides.first.nodes_a_world]
                if of >= 0:
                    if shares[of + w * units] != before[of + w * units]:
                        changed = 1
            if changed != 0:
                picked[wp.atomic_add(number, 0, 1)] = p

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, launch_bounds=TWO_BLOCKS, module_options=CPU_OPTIONS
    )
    def limit(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        picked: wp.array(dtype=int),
        sides: Sides,
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        keep: real,
        reach: real,
        unit: wp.array(dtype=int),
        units: int,
        shares: wp.array(dtype=real),
        lowered: wp.array(dtype=real),
        time: wp.array(dtype=real),
    ):
        """Of `count` pairs all, or those that are `picked`, if any array of such is given."""
        for n in range(wp.tid(), count[0], threads):
            p = n
            if picked.shape[0] > 0:
                p = picked[n]
            w, i, j = things(sides, pairs[p])
            nodes = slots(sides, i, j, w)
            s = W(real(1.0), real(1.0), real(1.0), real(1.0))
            of = wp.vec4i()
            least, most = real(1.0), real(-1.0)
            for k in range(4):
                of[k] = unit[nodes[k] - w * sides.first.nodes_a_world]
                if of[k] >= 0:
                    of[k] += w * units
                    s[k] = shares[of[k]]
                    least, most = wp.min(least, s[k]), wp.max(most, s[k])
            if most < real(0.0):  # nothing of it is ever shortened
                continue
            m = corners(move, nodes)
            m = wp.matrix_from_rows(s[0] * m[0], s[1] * m[1], s[2] * m[2], s[3] * m[3])
            t = impact(corners(x, nodes), m, keep * thickness(sides, i, j, w), reach)
            if t < real(1.0):
                wp.atomic_min(time, w, t)
                if most == least:
                    least = real(0.0)
                for k in range(4):
                    if of[k] >= 0:
                        wp.atomic_min(lowered, of[k], wp.max(t * s[k], least))

    return pick, limit


@cache
def share_kernels(real, serial: bool):
    """start(...) shares, turn(...) to a round, settle(...) its shares, finish(...) with safe ones, shorten(...) the motion."""
    X, until = wp.types.vector(3, real), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(shares: wp.array(dtype=real), before: wp.array(dtype=real), lowered: wp.array(dtype=real)):
        """The whole motion, and nothing before it."""
        tid = wp.tid()
        for i in range(tid, until(tid, shares.shape[0])):
            shares[i] = real(1.0)
            before[i] = real(-1.0)
            lowered[i] = real(1.0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(open: wp.array(dtype=int), changed: wp.array(dtype=int), rounds: wp.array(dtype=int)):
        w = wp.tid()
        open[w] = 0
        if w == 0:
            changed[0] = 0
            rounds[0] += 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def settle(
        together: wp.array(dtype=int),
        earliest: wp.array(dtype=real),
        lowered: wp.array(dtype=real),
        rounds: wp.array(dtype=int),
        shares: wp.array(dtype=real),
        before: wp.array(dtype=real),
        open: wp.array(dtype=int),
        changed: wp.array(dtype=int),
    ):
        """Worlds are open where shares have changed. Of what goes together all go by the earliest time."""
        tid = wp.tid()
        for i in range(tid, until(tid, shares.shape[0])):
            w = i / (shares.shape[0] / together.shape[0])
            if together[w] != 0:
                shares[i] = earliest[w]
                before[i] = earliest[w]
            else:
                before[i] = shares[i]
                shares[i] = lowered[i]
                if lowered[i] != before[i]:
                    open[w] = 1
                    if rounds[0] < wp.static(ROUNDS):
                        changed[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def finish(
        earliest: wp.array(dtype=real),
        open: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
        shares: wp.array(dtype=real),
        time: wp.array(dtype=real),
        limited: wp.array(dtype=int),
    ):
        """Nothing moves while pairs do not fit."""
        tid = wp.tid()
        for i in range(tid, until(tid, shares.shape[0])):
            w = i / (shares.shape[0] / time.shape[0])
            s = wp.where(open[w] != 0, earliest[w], shares[i])
            s = wp.where(overflow[0] == 0, s, real(0.0))
            shares[i] = s
            if s < real(1.0):
                wp.atomic_min(time, w, s)
                wp.atomic_add(limited, w, 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def shorten(
        base: wp.array(dtype=X),
        move: wp.array(dtype=X),
        unit: wp.array(dtype=int),
        units: int,
        shares: wp.array(dtype=real),
        done: wp.array(dtype=int),
        together: wp.array(dtype=int),
        q: wp.array(dtype=X),
        start: wp.array(dtype=X),
        end: wp.array(dtype=X),
    ):
        """The motion itself and, of worlds that go by one share, where a search that was `done` for it has seen them."""
        tid = wp.tid()
        for i in range(tid, until(tid, q.shape[0])):
            w = i / unit.shape[0]
            of = unit[i - w * unit.shape[0]]
            if of >= 0:
                s = shares[w * units + of]
                if s < real(1.0):
                    q[i] = base[i] + s * move[i]
            if together[w] != 0 and done[0] != 0:
                start[i] = q[i]
                end[i] = q[i]

    return start, turn, settle, finish, shorten

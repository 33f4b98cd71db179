"""When things that move straight come as near as their thickness, and which have passed through each other.

Additive continuous collision detection after Li, Kaufman and Jiang, "Codimensional incremental potential contact", ACM ToG 40(4),
2021, algorithm 1: the distance of a pair falls at most as fast as its fastest nodes of both sides approach, less what all move in
common. Time goes on by the part of the gap that is safe at that speed, until the gap is `REST` of what it was or, in reach, as much as
`NEAR` of that and of the reach: the time found is never late.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.boxes import Trees
from ddg_warp.kernels.contact.candidates import asked_functions, note_needed, turns
from ddg_warp.kernels.contact.motion import corners_function, relative_function
from ddg_warp.kernels.contact.surfaces import Kind, pair_functions, sides_struct, things_function
from ddg_warp.kernels.threads import CPU_OPTIONS

REST, NEAR = 0.1, 0.2  # of the gap: what is left of wide ones; of narrow ones, and of the reach
PARTS = 1000  # in which a motion is followed; where that does not do, the time reached so far is safe, too
PATIENCE = 100_000  # the same for what is to be told apart from passing
BESIDE = 0.1  # of the reach, by which two that pass beside each other have to do so for certain
TOUCHING = 1e-9  # distance of two that pass, over the size of the pair


@cache
def impact_functions(kind: Kind, real):
    """impact(x, p, thickness, reach) -> time; meet(x, p, thickness) -> whether two come as near as their thickness.

    x, p: positions and displacements of the nodes.
    """
    Y = wp.types.matrix((4, 3), real)
    *_, closest = pair_functions(kind, real)
    relative = relative_function(kind, real)
    # of eight digits or sixteen, those that a distance keeps
    touching = TOUCHING if real is wp.float64 else 1e3 * TOUCHING

    @wp.func
    def distance(x: Y, q: Y, t: real):
        r, _ = closest(x + t * q)
        return wp.length(r)

    @wp.func
    def impact(x: Y, p: Y, thickness: real, reach: real):
        """In [0, 1], or 2 where there is none; zero where the pair overlaps at the start."""
        q, speed = relative(x, p)
        gap = distance(x, q, real(0.0)) - thickness
        if gap <= real(0.0):
            return real(0.0)
        if speed == real(0.0):
            return real(2.0)
        least, t = wp.max(real(REST) * gap, real(NEAR) * wp.min(gap, reach)), real(0.0)
        safe = (gap - least) / gap
        step = safe * gap / speed
        for _ in range(wp.static(PARTS)):
            if t + step > real(1.0):
                return real(2.0)
            gap = distance(x, q, t + step) - thickness
            # the first step is safe, also where it ends at the least gap but for rounding
            if gap <= wp.where(t > real(0.0), least, real(0.0)):
                return t
            t += step
            step = safe * gap / speed
        return t

    @wp.func
    def meet(x: Y, p: Y, thickness: real):
        """Whether two come together on their way, or can not be told to stay apart."""
        q, speed = relative(x, p)
        size = speed
        if wp.static(kind.endless):  # whose nodes are 1 m apart, whatever size the others have
            size += distance(x, q, real(0.0))
        else:
            size += wp.length(x[1] - x[0]) + wp.length(x[2] - x[1]) + wp.length(x[3] - x[2])
        least, t = thickness + real(touching) * size, real(0.0)
        for _ in range(wp.static(PATIENCE)):
            apart = distance(x, q, t)
            if apart <= least:
                return True
            t += (apart - thickness) / speed
            if t > real(1.0):
                return False
        return True

    return impact, meet


@cache
def impact_kernel(kind: Kind, passing: bool, real, single: bool):
    """The earliest time of impact of each world or, if `passing`, how many pairs pass through each other and the first of them.

    Pairs are numbered i times the second things of all worlds + j. They are those of bundles whose boxes around the motion have met,
    all of a `single` thing or not.
    """
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    slots, _, thickness, _ = pair_functions(kind, real)
    ranges_of, reaches, asked = asked_functions(kind, real, single)
    impact, meet = impact_functions(kind, real)
    corners = corners_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def impacts(
        threads: int,
        sides: Sides,
        trees: Trees,
        found: wp.array(dtype=int),
        met: wp.array(dtype=wp.vec2i),
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        keep: real,
        reach: real,
        time: wp.array(dtype=real),
        number: wp.array(dtype=int),
        least: wp.array(dtype=wp.int64),
        overflow: wp.array(dtype=int),
        needed: wp.array(dtype=int),
    ):
        if wp.tid() == 0:
            note_needed(found, met, overflow, needed)
        begin, stop, step = turns(wp.tid(), threads, found, met)
        for n in range(begin, stop, step):
            w, start, end, first, last = ranges_of(trees, met[n])
            for l in range(first, last):
                if not reaches(sides, trees, met[n][0], l, w):
                    continue
                for k in range(start, end):
                    if not asked(sides, trees, k, l, w):
                        continue
                    nodes = slots(sides, k, l, w)
                    y, p = corners(x, nodes), corners(move, nodes)
                    if wp.static(passing):
                        if meet(y, p, real(0.0)):
                            wp.atomic_add(number, w, 1)
                            i, j = k + w * sides.counts[0], l + w * sides.counts[1]
                            key = wp.int64(i) * wp.int64(sides.counts[1] * number.shape[0]) + wp.int64(j)
                            wp.atomic_min(least, 0, key)
                    else:
                        t = impact(y, p, keep * thickness(sides, k, l, w), reach)
                        if t < real(1.0):
                            wp.atomic_min(time, w, t)

    return impacts


@cache
def passing_kernel(kind: Kind, real):
    """How many of the pairs of a list pass through each other, or as near as `keep` of their thickness and of a part of the reach."""
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    slots, _, thickness, _ = pair_functions(kind, real)
    _, meet = impact_functions(kind, real)
    corners, things = corners_function(real), things_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def passing(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        keep: real,
        reach: real,
        number: wp.array(dtype=int),
    ):
        for p in range(wp.tid(), count[0], threads):
            w, i, j = things(sides, pairs[p])
            nodes = slots(sides, i, j, w)
            near = real(0.0)
            if keep > real(0.0):
                near = keep * (thickness(sides, i, j, w) + real(wp.static(BESIDE)) * reach)
            if meet(corners(x, nodes), corners(move, nodes), near):
                wp.atomic_add(number, w, 1)

    return passing

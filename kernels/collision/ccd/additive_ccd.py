"""Additive CCD: time of impact of linearly moving primitives with a minimum separation, and a crossing test.

Source: Li, Kaufman and Jiang, "Codimensional incremental potential contact", ACM ToG 40(4), 2021, algorithm 1. The distance of a
pair decreases at most as fast as the fastest nodes of both sides approach, less their common motion. Time advances by the fraction
of the gap that is safe at that speed. It ends when the gap is `REST` of its initial value or, within the search distance, `NEAR` of
it or of the search distance. The time found is never late.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.broad_phase.aabb import BvhPair
from ddg_warp.kernels.collision.broad_phase.candidate_validity import corners_function, relative_function
from ddg_warp.kernels.collision.broad_phase.candidates import note_needed, query_functions, turns
from ddg_warp.kernels.collision.primitives import Kind, pair_functions, primitives_function, sides_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS

REST, NEAR = 0.1, 0.2  # remaining fraction of wide gaps; of narrow gaps, and of the search distance
PARTS = 1000  # largest number of advances; the time reached by then is safe, too
MAX_STEPS = 100_000  # largest number of advances of the crossing test
CLEARANCE = 0.1  # clearance that proves a pair separate, over the search distance
IN_CONTACT = 1e-9  # distance at which a pair crosses, over its size


@cache
def impact_functions(kind: Kind, real):
    """Return the device functions `impact(x, p, thickness, search_distance) -> t` and `meet(x, p, thickness) -> bool`.

    `impact`: time of impact; `meet`: True if the distance falls to the thickness [m]. x, p (4, 3): positions and displacements [m].
    """
    Y = wp.types.matrix((4, 3), real)
    *_, closest = pair_functions(kind, real)
    relative = relative_function(kind, real)
    # rounding of a distance in this precision
    contact_tolerance = IN_CONTACT if real is wp.float64 else 1e3 * IN_CONTACT

    @wp.func
    def distance(x: Y, q: Y, t: real):
        r, _ = closest(x + t * q)
        return wp.length(r)

    @wp.func
    def impact(x: Y, p: Y, thickness: real, search_distance: real):
        """Return the time of impact in [0, 1], 2 for none, or 0 if the pair overlaps at the start."""
        q, speed = relative(x, p)
        gap = distance(x, q, real(0.0)) - thickness
        if gap <= real(0.0):
            return real(0.0)
        if speed == real(0.0):
            return real(2.0)
        least, t = wp.max(real(REST) * gap, real(NEAR) * wp.min(gap, search_distance)), real(0.0)
        safe = (gap - least) / gap
        step = safe * gap / speed
        for _ in range(wp.static(PARTS)):
            if t + step > real(1.0):
                return real(2.0)
            gap = distance(x, q, t + step) - thickness
            # the first step is safe, even if rounding puts it at the least gap
            if gap <= wp.where(t > real(0.0), least, real(0.0)):
                return t
            t += step
            step = safe * gap / speed
        return t

    @wp.func
    def meet(x: Y, p: Y, thickness: real):
        """Return True if the pair collides during the motion, or if separation can not be proved."""
        q, speed = relative(x, p)
        size = speed
        if wp.static(kind.endless):  # nodes of a half-space are 1 m apart, whatever the size of other primitives
            size += distance(x, q, real(0.0))
        else:
            size += wp.length(x[1] - x[0]) + wp.length(x[2] - x[1]) + wp.length(x[3] - x[2])
        least, t = thickness + real(contact_tolerance) * size, real(0.0)
        for _ in range(wp.static(MAX_STEPS)):
            separation = distance(x, q, t)
            if separation <= least:
                return True
            t += (separation - thickness) / speed
            if t > real(1.0):
                return False
        return True

    return impact, meet


@cache
def impact_kernel(kind: Kind, passing: bool, real, single: bool):
    """Build the kernel of CCD over leaf pairs.

    `impacts`: write the earliest time of impact of each world or, if `passing`, the number of crossing pairs and the first of them.

    The key of a pair is i times the number of second primitives in all worlds, plus j. `single`: see `query_functions`.
    """
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    pair_nodes, _, thickness, _ = pair_functions(kind, real)
    ranges_of, reaches, asked = query_functions(kind, real, single)
    impact, meet = impact_functions(kind, real)
    corners = corners_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def impacts(
        threads: int,
        sides: Sides,
        trees: BvhPair,
        num_met: wp.array(dtype=int),
        leaf_pairs: wp.array(dtype=wp.vec2i),
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        min_separation_fraction: real,
        search_distance: real,
        time: wp.array(dtype=real),
        number: wp.array(dtype=int),
        least: wp.array(dtype=wp.int64),
        overflow: wp.array(dtype=int),
        needed: wp.array(dtype=int),
    ):
        if wp.tid() == 0:
            note_needed(num_met, leaf_pairs, overflow, needed)
        begin, stop, step = turns(wp.tid(), threads, num_met, leaf_pairs)
        for n in range(begin, stop, step):
            w, start, end, first, last = ranges_of(trees, leaf_pairs[n])
            for l in range(first, last):
                if not reaches(sides, trees, leaf_pairs[n][0], l, w):
                    continue
                for k in range(start, end):
                    if not asked(sides, trees, k, l, w):
                        continue
                    nodes = pair_nodes(sides, k, l, w)
                    y, p = corners(x, nodes), corners(move, nodes)
                    if wp.static(passing):
                        if meet(y, p, real(0.0)):
                            wp.atomic_add(number, w, 1)
                            i, j = k + w * sides.counts[0], l + w * sides.counts[1]
                            key = wp.int64(i) * wp.int64(sides.counts[1] * number.shape[0]) + wp.int64(j)
                            wp.atomic_min(least, 0, key)
                    else:
                        t = impact(y, p, min_separation_fraction * thickness(sides, k, l, w), search_distance)
                        if t < real(1.0):
                            wp.atomic_min(time, w, t)

    return impacts


@cache
def passing_kernel(kind: Kind, real):
    """Build the kernel of the crossing test.

    `passing`: count the pairs of a list that cross or, with `min_separation_fraction`, whose distance falls below
        `min_separation_fraction` of the thickness plus `CLEARANCE` of `search_distance` [m].
    """
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    pair_nodes, _, thickness, _ = pair_functions(kind, real)
    _, meet = impact_functions(kind, real)
    corners, locate = corners_function(real), primitives_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def passing(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        min_separation_fraction: real,
        search_distance: real,
        number: wp.array(dtype=int),
    ):
        for p in range(wp.tid(), count[0], threads):
            w, i, j = locate(sides, pairs[p])
            nodes = pair_nodes(sides, i, j, w)
            near = real(0.0)
            if min_separation_fraction > real(0.0):
                near = min_separation_fraction * (
                    thickness(sides, i, j, w) + real(wp.static(CLEARANCE)) * search_distance
                )
            if meet(corners(x, nodes), corners(move, nodes), near):
                wp.atomic_add(number, w, 1)

    return passing

"""Rod culling: prove by AABBs of runs of consecutive edges that no two rods come within the search distance.

If AABBs of runs do not overlap, no two rods are near, as long as every edge stays in the AABB of its run; its path does not matter. So
AABBs are made for the motion and a multiple of it, and serve until an edge leaves its AABB. Their frame moves with the mean motion of
the world; any position of the frame would do, if it is the same for the whole world.

Pairs of one rod are excluded along the rod. The distance of midpoints of neighbouring edges is at most the longest edge L of the rod.
If the midpoints of two edges are farther apart than required, by an excess e, the next e / L edges are far enough, too. So a straight
rod needs some tests per edge, growing with the logarithm of their number. `SPARE` of L per edge in between is kept from the excess:
while no edge differs by more from its last value, the rod need not be tested again.

Pairs that these bounds do not exclude may be near: a search decides. Rows of the status array
`RodCulling.known` (rows, worlds) are named here.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.broad_phase.aabb import FAR, outward_function
from ddg_warp.kernels.collision.primitives import EDGES, pair_functions, sides_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS, first_of, items_function, until_function

# Per world: whether primitives may be near; whether AABBs overlap. The multiple of the motion that the next AABBs cover. The age of the
# AABBs in steps; the number of the step.
DOUBT, OVERLAP, AHEAD, STEPS, TICK = range(5)
KNOWN = 5
MOST = 16  # largest multiple of the motion; it is doubled each time, and quartered if AABBs overlap
ROOM = 0.5  # margins by which AABBs are inflated, per multiple of the motion
SPARE = 0.2  # allowed change of an edge vector since its last test, over the longest edge of the rod
STRETCH = 1.03125  # allowed growth of the longest edge
ROUNDING = 3e-7  # bound of the rounding of float32 coordinates in a frame


@cache
def run_kernels(grouped: bool, real, serial: bool):
    """Build the kernels of rod culling.

    `clear`: zero the longest edges.
    `enclose`: write swept AABBs of runs, and the longest edges.
    `meet`: mark worlds in which AABBs of two rods overlap.
    `settle`: clear doubt where no AABBs overlap.
    `hold`: put worlds in doubt in which an edge leaves its AABB.
    `follow`: put worlds in doubt in which edges of one rod may be near.

    All treat worlds that are `tried` (worlds,), and a straight motion from x to y by one fraction of all nodes. `mean`, `mean_after`:
    means of nodes at its ends; frames move by their difference in a step.
    """
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    _, may_touch, thickness, _ = pair_functions(EDGES, real)
    outward, share, until = outward_function(real), items_function(serial), until_function(serial)
    half = wp.constant(real(0.5))

    @wp.func
    def rounded(x: real, frame: real, reach: real):
        """Return the reach plus a rounding bound of a coordinate relative to the frame."""
        return reach + real(ROUNDING) * (wp.abs(x) + wp.abs(frame))

    @wp.func
    def corner(x: X, frame: X, reach: real, sign: float):
        """Return a corner of the AABB of the ball of radius `reach` about x, relative to the frame."""
        box_corner = wp.vec3()
        for d in range(3):
            more = rounded(x[d], frame[d], reach)
            box_corner[d] = outward(x[d] - frame[d] + real(sign) * more, sign)
        return box_corner

    @wp.func
    def inside(x: X, frame: X, reach: real, lower: wp.vec3, upper: wp.vec3):
        is_inside = bool(True)  # becomes False if a coordinate is not finite
        for d in range(3):
            more = rounded(x[d], frame[d], reach)
            is_inside = (
                is_inside and x[d] - frame[d] - more >= real(lower[d]) and x[d] - frame[d] + more <= real(upper[d])
            )
        return is_inside

    @wp.func
    def asked(tried: wp.array(dtype=int), status: wp.array2d(dtype=int), w: int):
        return tried[w] != 0 and status[DOUBT, w] != 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def clear(tried: wp.array(dtype=int), status: wp.array2d(dtype=int), longest: wp.array2d(dtype=real)):
        w, object = wp.tid()
        if asked(tried, status, w):
            longest[w, object] = real(0.0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def enclose(
        sides: Sides,
        runs: wp.array2d(dtype=int),
        x: wp.array(dtype=X),
        y: wp.array(dtype=X),
        mean: wp.array(dtype=X),
        mean_after: wp.array(dtype=X),
        near: real,
        margin: real,
        tried: wp.array(dtype=int),
        status: wp.array2d(dtype=int),
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        longest: wp.array2d(dtype=real),
    ):
        """Write the swept AABB of a run (first edge, edge after its last), one thread each.

        `longest`: longest edge of each rod [m].
        """
        i = wp.tid()
        w = i / runs.shape[0]
        if not asked(tried, status, w):
            return
        first, last = runs[i - w * runs.shape[0], 0], runs[i - w * runs.shape[0], 1]
        offset = first_of(w, sides.first.nodes_a_world)
        object = sides.first.object[first]
        multiple = real(status[AHEAD, w])
        origin, drift = X(), mean_after[w] - mean[w]
        reach = sides.first.radius[w, object] + near
        wide = reach + multiple * real(ROOM) * margin
        far = wp.float32(FAR)
        low, high = wp.vec3(far, far, far), wp.vec3(-far, -far, -far)
        a, b, length = X(), X(), real(0.0)
        for k in range(first, last + 1):
            node = sides.first.nodes[wp.min(k, last - 1), wp.where(k < last, 0, 1)] + offset
            p, q = x[node], y[node]
            if k > first:
                length = wp.max(length, wp.max(wp.length_sq(p - a), wp.length_sq(q - b)))
            a = p
            b = q
            beyond = q - drift + multiple * (q - drift - p)
            if not (wp.isfinite(p) and wp.isfinite(beyond)):
                wp.atomic_max(status, OVERLAP, w, 1)
                beyond = X()
            low = wp.min(
                low, wp.min(corner(p, origin, reach, wp.float32(-1.0)), corner(q, drift, reach, wp.float32(-1.0)))
            )
            high = wp.max(
                high, wp.max(corner(p, origin, reach, wp.float32(1.0)), corner(q, drift, reach, wp.float32(1.0)))
            )
            low = wp.min(low, corner(beyond, origin, wide, wp.float32(-1.0)))
            high = wp.max(high, corner(beyond, origin, wide, wp.float32(1.0)))
        if not (wp.isfinite(low) and wp.isfinite(high)):
            low, high = wp.vec3(), wp.vec3()
        wp.atomic_max(longest, w, object, real(STRETCH) * wp.sqrt(length))
        lower[i] = low
        upper[i] = high

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def meet(
        sides: Sides,
        runs: wp.array2d(dtype=int),
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        tree: wp.uint64,
        tried: wp.array(dtype=int),
        status: wp.array2d(dtype=int),
    ):
        """Mark worlds if AABBs of two rods overlap that may form pairs; one thread a run."""
        i = wp.tid()
        w = i / runs.shape[0]
        if not asked(tried, status, w) or status[OVERLAP, w] != 0:
            return
        root = int(-1)
        if wp.static(grouped):
            root = wp.bvh_get_group_root(tree, w)
        query, j = wp.bvh_query_aabb(tree, lower[i], upper[i], root), int(0)
        k = runs[i - w * runs.shape[0], 0]
        while wp.bvh_query_next(query, j):
            l = runs[j - w * runs.shape[0], 0]
            if j > i and sides.first.object[k] != sides.first.object[l]:
                if may_touch(sides, k, l):
                    status[OVERLAP, w] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def settle(
        mean: wp.array(dtype=X),
        mean_after: wp.array(dtype=X),
        tried: wp.array(dtype=int),
        status: wp.array2d(dtype=int),
        drift: wp.array(dtype=X),
        again: wp.array(dtype=int),
        looks: wp.array(dtype=int),
    ):
        """Clear doubt where AABBs do not overlap, else request smaller ones (`again`) unless they cover the motion alone."""
        w = wp.tid()
        if w == 0:
            looks[0] += 1
        if not asked(tried, status, w):
            return
        multiple = status[AHEAD, w]
        if status[OVERLAP, w] != 0:
            status[OVERLAP, w] = 0
            status[AHEAD, w] = multiple / 4
            if multiple > 0:
                again[0] = 1
            return
        status[DOUBT, w] = 0
        status[AHEAD, w] = wp.clamp(2 * multiple, 1, MOST)
        status[STEPS, w] = 0
        drift[w] = mean_after[w] - mean[w]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def hold(
        sides: Sides,
        run_of: wp.array(dtype=int),
        runs: int,
        x: wp.array(dtype=X),
        y: wp.array(dtype=X),
        near: real,
        drift: wp.array(dtype=X),
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        longest: wp.array2d(dtype=real),
        tested_edges: wp.array2d(dtype=X),
        tried: wp.array(dtype=int),
        status: wp.array2d(dtype=int),
        loose: wp.array2d(dtype=int),
    ):
        """Put worlds in doubt if an edge leaves the AABB of the run.

        Mark rods `loose` if an edge differs from `tested_edges`.
        """
        w, start = share(wp.tid(), sides.counts[0])
        if tried[w] == 0 or status[DOUBT, w] != 0:
            return
        frame = real(status[STEPS, w]) * drift[w]
        after = frame + drift[w]
        offset = first_of(w, sides.first.nodes_a_world)
        for k in range(start, until(start, sides.counts[0])):
            box, object = first_of(w, runs) + run_of[k], sides.first.object[k]
            i, j = sides.first.nodes[k, 0] + offset, sides.first.nodes[k, 1] + offset
            a, b, p, q, tested = x[i], x[j], y[i], y[j], tested_edges[w, k]
            reach, length, low, high = sides.first.radius[w, object] + near, longest[w, object], lower[box], upper[box]
            sound = inside(a, frame, reach, low, high) and inside(b, frame, reach, low, high)
            sound = sound and inside(p, after, reach, low, high) and inside(q, after, reach, low, high)
            if not sound or wp.max(wp.length_sq(b - a), wp.length_sq(q - p)) > length * length:
                status[DOUBT, w] = 1
                return
            spare = real(SPARE) * length
            if not wp.max(wp.length_sq(b - a - tested), wp.length_sq(q - p - tested)) <= spare * spare:
                loose[w, object] = status[TICK, w]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def follow(
        sides: Sides,
        partner_range: wp.array2d(dtype=int),
        x: wp.array(dtype=X),
        y: wp.array(dtype=X),
        near: real,
        longest: wp.array2d(dtype=real),
        loose: wp.array2d(dtype=int),
        tried: wp.array(dtype=int),
        status: wp.array2d(dtype=int),
        tested_edges: wp.array2d(dtype=X),
    ):
        """Put worlds in doubt if edges of one rod may be near.

        Loose rods are tested, or all if AABBs are new.

        `partner_range` (edges, 2): for every edge the first later edge of its rod with which it may form a pair, and the end of the
        rod.
        """
        w, start = share(wp.tid(), sides.counts[0])
        if tried[w] == 0 or status[DOUBT, w] != 0:
            return
        offset = first_of(w, sides.first.nodes_a_world)
        for k in range(start, until(start, sides.counts[0])):
            object = sides.first.object[k]
            if status[STEPS, w] == 0 or loose[w, object] == status[TICK, w]:
                i, j = sides.first.nodes[k, 0] + offset, sides.first.nodes[k, 1] + offset
                # twice the midpoint at half the motion, and the displacement of the midpoint
                mid, mid_move = half * (x[i] + x[j] + (y[i] + y[j])), half * (y[i] + y[j] - (x[i] + x[j]))
                edge, length = half * (x[j] - x[i] + (y[j] - y[i])), longest[w, object]
                spare, least = real(SPARE) * length, thickness(sides, k, k, w) + real(2.0) * near + length
                shorter = real(1.0) / (length + spare)
                # Edges before `low` are excluded; so are edges between `last` and l, if the excesses of both exceed their distance.
                l, end, leap = int(partner_range[k, 0]), partner_range[k, 1], real(1.0) / spare
                low, last, last_excess = int(l), int(l), real(0.0)
                while l < end:
                    i, j = sides.first.nodes[l, 0] + offset, sides.first.nodes[l, 1] + offset
                    sum_before, sum_after = x[i] + x[j], y[i] + y[j]
                    between, relative = (
                        half * (sum_before + sum_after) - mid,
                        half * (sum_after - sum_before) - mid_move,
                    )
                    excess = half * (wp.length(between) - wp.length(relative)) - least - real(l - k) * spare
                    if l > low and not last_excess + excess > real(l - last) * length:
                        l = low
                        leap = real(0.0)
                    elif excess > real(0.0):
                        low = l + 1 + int(wp.min(excess * shorter, real(end)))
                        last = l
                        last_excess = excess
                        l = wp.max(low, wp.min(l + int(wp.min(excess * leap, real(end))), end - 1))
                    elif spare > real(0.0):  # near enough to be tested every time
                        spare = real(0.0)
                        edge = X(real(FAR), real(FAR), real(FAR))
                    elif may_touch(sides, k, l):
                        status[DOUBT, w] = 1
                        return
                    else:
                        l += 1
                        low = l
                tested_edges[w, k] = edge

    return clear, enclose, meet, settle, hold, follow

"""Whether any two edges of rods may come near, without a look at each pair: rods by boxes around runs of edges, each along itself.

Boxes around runs of edges that do not meet say that no two rods are near, as long as every edge stays in the box of its run; how it
came there does not matter. So boxes are made for a motion and for more of it, in a frame that goes along with the mean of a world,
and serve until something leaves them. Any place of the frame would do, as long as it is the same for all of a world.

Midpoints of neighbouring edges are apart by no more than the longest edge of the rod. So where those of two edges are farther apart
than these need to be, as many edges further along are, too, as that excess has of longest edges: what is straight takes some tests for
each edge, their number growing with the logarithm of all. A rod has some of the excess to `SPARE` for each edge between the two: as
long as no edge differs by more from how it was seen, the rod need not be followed again.

What is found near by these bounds may be near: a search for pairs says whether it is. Rows of `known` (rows, worlds) are named here.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.boxes import FAR, outward_function
from ddg_warp.kernels.contact.surfaces import EDGES, pair_functions, sides_struct
from ddg_warp.kernels.threads import CPU_OPTIONS, first_of, share_function, until_function

# whether a world may have anything near, and boxes that meet; how many times the motion at hand the next boxes are for, and how many
# steps ago those that serve were made; the number of the step
DOUBT, MEET, AHEAD, STEPS, TICK = range(5)
KNOWN = 5
MOST = 16  # times the motion that boxes are made for; twice as many each time, a quarter where they meet
ROOM = 0.5  # margins by which boxes are wider, for each time the motion
SPARE = 0.2  # of the longest edge of a rod, by which edges may differ from how they were seen
STRETCH = 1.03125  # of the longest edges, what they may become meanwhile
ROUNDING = 3e-7  # more than that of float32, of a frame's coordinates


@cache
def run_kernels(grouped: bool, real, serial: bool):
    """clear(...) the longest edges; enclose(...) the edges of runs on their way; meet(...) of these boxes; settle(...) whether they do,
    world by world; hold(...): whether edges stay in their boxes; follow(...) rods along themselves.

    All are about worlds that are `tried` (worlds,), and a straight motion from x to y, of which all nodes go one share; `mean`,
    `mean_after` are means of nodes at its ends, their difference by what frames go on in a step.
    """
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    _, may_touch, thickness, _ = pair_functions(EDGES, real)
    outward, share, until = outward_function(real), share_function(serial), until_function(serial)
    half = wp.constant(real(0.5))

    @wp.func
    def rounded(x: real, frame: real, reach: real):
        """The reach, and what rounding may take from a coordinate seen from the frame."""
        return reach + real(ROUNDING) * (wp.abs(x) + wp.abs(frame))

    @wp.func
    def corner(x: X, frame: X, reach: real, sign: float):
        """Of a box around all that is within reach of x, seen from the frame."""
        found = wp.vec3()
        for d in range(3):
            more = rounded(x[d], frame[d], reach)
            found[d] = outward(x[d] - frame[d] + real(sign) * more, sign)
        return found

    @wp.func
    def inside(x: X, frame: X, reach: real, lower: wp.vec3, upper: wp.vec3):
        held = bool(True)  # not by what is no number
        for d in range(3):
            more = rounded(x[d], frame[d], reach)
            held = held and x[d] - frame[d] - more >= real(lower[d]) and x[d] - frame[d] + more <= real(upper[d])
        return held

    @wp.func
    def asked(tried: wp.array(dtype=int), known: wp.array2d(dtype=int), w: int):
        return tried[w] != 0 and known[DOUBT, w] != 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def clear(tried: wp.array(dtype=int), known: wp.array2d(dtype=int), longest: wp.array2d(dtype=real)):
        w, object = wp.tid()
        if asked(tried, known, w):
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
        known: wp.array2d(dtype=int),
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        longest: wp.array2d(dtype=real),
    ):
        """A thread has a run (first edge, edge after its last) of a world; `longest` is the longest edge of a rod."""
        i = wp.tid()
        w = i / runs.shape[0]
        if not asked(tried, known, w):
            return
        first, last = runs[i - w * runs.shape[0], 0], runs[i - w * runs.shape[0], 1]
        offset = first_of(w, sides.first.nodes_a_world)
        object = sides.first.object[first]
        ahead = real(known[AHEAD, w])
        here, drift = X(), mean_after[w] - mean[w]
        reach = sides.first.radius[w, object] + near
        wide = reach + ahead * real(ROOM) * margin
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
            beyond = q - drift + ahead * (q - drift - p)
            if not (wp.isfinite(p) and wp.isfinite(beyond)):
                wp.atomic_max(known, MEET, w, 1)
                beyond = X()
            low = wp.min(
                low, wp.min(corner(p, here, reach, wp.float32(-1.0)), corner(q, drift, reach, wp.float32(-1.0)))
            )
            high = wp.max(
                high, wp.max(corner(p, here, reach, wp.float32(1.0)), corner(q, drift, reach, wp.float32(1.0)))
            )
            low = wp.min(low, corner(beyond, here, wide, wp.float32(-1.0)))
            high = wp.max(high, corner(beyond, here, wide, wp.float32(1.0)))
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
        known: wp.array2d(dtype=int),
    ):
        """Whether boxes of runs of two rods that may touch meet; a thread has a run of a world."""
        i = wp.tid()
        w = i / runs.shape[0]
        if not asked(tried, known, w) or known[MEET, w] != 0:
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
                    known[MEET, w] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def settle(
        mean: wp.array(dtype=X),
        mean_after: wp.array(dtype=X),
        tried: wp.array(dtype=int),
        known: wp.array2d(dtype=int),
        drift: wp.array(dtype=X),
        again: wp.array(dtype=int),
        looks: wp.array(dtype=int),
    ):
        """Nothing is in doubt where boxes do not meet; where they do, smaller ones are to be tried `again`, if there are any."""
        w = wp.tid()
        if w == 0:
            looks[0] += 1
        if not asked(tried, known, w):
            return
        ahead = known[AHEAD, w]
        if known[MEET, w] != 0:
            known[MEET, w] = 0
            known[AHEAD, w] = ahead / 4
            if ahead > 0:
                again[0] = 1
            return
        known[DOUBT, w] = 0
        known[AHEAD, w] = wp.clamp(2 * ahead, 1, MOST)
        known[STEPS, w] = 0
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
        seen: wp.array2d(dtype=X),
        tried: wp.array(dtype=int),
        known: wp.array2d(dtype=int),
        loose: wp.array2d(dtype=int),
    ):
        """Puts worlds in doubt in which an edge leaves the box of its run, and has rods loose of which one is not as it was `seen`."""
        w, start = share(wp.tid(), sides.counts[0])
        if tried[w] == 0 or known[DOUBT, w] != 0:
            return
        frame = real(known[STEPS, w]) * drift[w]
        after = frame + drift[w]
        offset = first_of(w, sides.first.nodes_a_world)
        for k in range(start, until(start, sides.counts[0])):
            box, object = first_of(w, runs) + run_of[k], sides.first.object[k]
            i, j = sides.first.nodes[k, 0] + offset, sides.first.nodes[k, 1] + offset
            a, b, p, q, then = x[i], x[j], y[i], y[j], seen[w, k]
            reach, length, low, high = sides.first.radius[w, object] + near, longest[w, object], lower[box], upper[box]
            sound = inside(a, frame, reach, low, high) and inside(b, frame, reach, low, high)
            sound = sound and inside(p, after, reach, low, high) and inside(q, after, reach, low, high)
            if not sound or wp.max(wp.length_sq(b - a), wp.length_sq(q - p)) > length * length:
                known[DOUBT, w] = 1
                return
            spare = real(SPARE) * length
            if not wp.max(wp.length_sq(b - a - then), wp.length_sq(q - p - then)) <= spare * spare:
                loose[w, object] = known[TICK, w]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def follow(
        sides: Sides,
        ahead: wp.array2d(dtype=int),
        x: wp.array(dtype=X),
        y: wp.array(dtype=X),
        near: real,
        longest: wp.array2d(dtype=real),
        loose: wp.array2d(dtype=int),
        tried: wp.array(dtype=int),
        known: wp.array2d(dtype=int),
        seen: wp.array2d(dtype=X),
    ):
        """Puts worlds in doubt in which edges of one rod may come near, of rods that are loose, and of all of them where boxes are new.

        Of every edge, the first of its rod that it may touch, and the one after the last: `ahead` (edges, 2).
        """
        w, start = share(wp.tid(), sides.counts[0])
        if tried[w] == 0 or known[DOUBT, w] != 0:
            return
        offset = first_of(w, sides.first.nodes_a_world)
        for k in range(start, until(start, sides.counts[0])):
            object = sides.first.object[k]
            if known[STEPS, w] == 0 or loose[w, object] == known[TICK, w]:
                i, j = sides.first.nodes[k, 0] + offset, sides.first.nodes[k, 1] + offset
                # twice where midpoints are in the middle of the way, and how far they then go
                here, way = half * (x[i] + x[j] + (y[i] + y[j])), half * (y[i] + y[j] - (x[i] + x[j]))
                then, length = half * (x[j] - x[i] + (y[j] - y[i])), longest[w, object]
                spare, least = real(SPARE) * length, thickness(sides, k, k, w) + real(2.0) * near + length
                shorter = real(1.0) / (length + spare)
                # all before `low` are known; so is what is between `last` and l, if excesses at both exceed the way between them
                l, end, leap = int(ahead[k, 0]), ahead[k, 1], real(1.0) / spare
                low, last, rest = int(l), int(l), real(0.0)
                while l < end:
                    i, j = sides.first.nodes[l, 0] + offset, sides.first.nodes[l, 1] + offset
                    before, now = x[i] + x[j], y[i] + y[j]
                    between, relative = half * (before + now) - here, half * (now - before) - way
                    excess = half * (wp.length(between) - wp.length(relative)) - least - real(l - k) * spare
                    if l > low and not rest + excess > real(l - last) * length:
                        l = low
                        leap = real(0.0)
                    elif excess > real(0.0):
                        low = l + 1 + int(wp.min(excess * shorter, real(end)))
                        last = l
                        rest = excess
                        l = wp.max(low, wp.min(l + int(wp.min(excess * leap, real(end))), end - 1))
                    elif spare > real(0.0):  # near enough to be looked at every time
                        spare = real(0.0)
                        then = X(real(FAR), real(FAR), real(FAR))
                    elif may_touch(sides, k, l):
                        known[DOUBT, w] = 1
                        return
                    else:
                        l += 1
                        low = l
                seen[w, k] = then

    return clear, enclose, meet, settle, hold, follow

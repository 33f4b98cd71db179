"""Whether any two edges of rods may come near, without a look at each pair: rods by boxes around runs of edges, each along itself.

Midpoints of neighbouring edges are apart by no more than the longest edge of the rod. So where those of two edges are farther apart
than these need to be, as many edges further along are, too, as that excess has of longest edges: what is straight takes some tests for
each edge, their number growing with the logarithm of all.

All nodes of a world are taken to go one share of their way. A world in which they go by shares of their own, and do not rest, may have
anything near, as may what is found near by this bound: a search for pairs says whether there are any.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.boxes import outward_function
from ddg_warp.kernels.contact.surfaces import EDGES, pair_functions, sides_struct
from ddg_warp.kernels.threads import CPU_OPTIONS, share_function, until_function


@cache
def run_kernels(grouped: bool, real, serial: bool):
    """enclose(...) the edges of runs on their way; meet(...) of these boxes; follow(...) every rod along itself."""
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    _, may_touch, thickness, _ = pair_functions(EDGES, real)
    outward, share, until = outward_function(real), share_function(serial), until_function(serial)
    half = wp.constant(real(0.5))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def enclose(
        sides: Sides,
        runs: wp.array2d(dtype=int),
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        together: wp.array(dtype=int),
        shift: wp.array(dtype=X),
        within: real,
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        middle: wp.array2d(dtype=X),
        turn: wp.array2d(dtype=X),
        longest: wp.array2d(dtype=real),
        near: wp.array(dtype=int),
    ):
        """A thread has a run (first edge, edge after its last) of a world; `longest` is the longest edge of a rod on its way.

        Of every edge, twice where its midpoint is in the middle of the way, and how far this then goes.
        """
        i = wp.tid()
        w = i / runs.shape[0]
        first, last = runs[i - w * runs.shape[0], 0], runs[i - w * runs.shape[0], 1]
        offset = w * sides.first.nodes_a_world
        a = x[sides.first.nodes[first, 0] + offset]
        p = move[sides.first.nodes[first, 0] + offset]
        low, high = wp.min(a, a + p - shift[w]), wp.max(a, a + p - shift[w])
        length, speed = real(0.0), wp.length_sq(p)
        for k in range(first, last):
            b = x[sides.first.nodes[k, 1] + offset]
            q = move[sides.first.nodes[k, 1] + offset]
            low = wp.min(low, wp.min(b, b + q - shift[w]))
            high = wp.max(high, wp.max(b, b + q - shift[w]))
            length = wp.max(length, wp.max(wp.length_sq(b - a), wp.length_sq(b + q - a - p)))
            speed = wp.max(speed, wp.length_sq(q))
            way = half * (p + q)
            middle[w, k] = a + b + way
            turn[w, k] = way
            a = b
            p = q
        if not (wp.isfinite(low) and wp.isfinite(high)) or (together[w] == 0 and speed > real(0.0)):
            near[0] = 1
            low, high = X(), X()
        object = sides.first.object[first]
        wp.atomic_max(longest, w, object, wp.sqrt(length))
        reach = sides.first.radius[w, object] + within
        down, up = wp.vec3(), wp.vec3()
        for d in range(3):
            down[d] = outward(low[d] - reach, wp.float32(-1.0))
            up[d] = outward(high[d] + reach, wp.float32(1.0))
        lower[i] = down
        upper[i] = up

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def meet(
        sides: Sides,
        runs: wp.array2d(dtype=int),
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        tree: wp.uint64,
        near: wp.array(dtype=int),
    ):
        """Whether boxes of runs of two rods that may touch meet; a thread has a run of a world."""
        i = wp.tid()
        if near[0] != 0:
            return
        w = i / runs.shape[0]
        root = int(-1)
        if wp.static(grouped):
            root = wp.bvh_get_group_root(tree, w)
        query, j = wp.bvh_query_aabb(tree, lower[i], upper[i], root), int(0)
        k = runs[i - w * runs.shape[0], 0]
        while wp.bvh_query_next(query, j):
            l = runs[j - w * runs.shape[0], 0]
            if j > i and sides.first.object[k] != sides.first.object[l]:
                if may_touch(sides, k, l):
                    near[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def follow(
        sides: Sides,
        ahead: wp.array2d(dtype=int),
        middle: wp.array2d(dtype=X),
        turn: wp.array2d(dtype=X),
        reach: real,
        longest: wp.array2d(dtype=real),
        near: wp.array(dtype=int),
    ):
        """Whether edges of one rod may come near; `ahead` (edges, 2): the first that each may touch, and the one after the last."""
        w, start = share(wp.tid(), sides.counts[0])
        for k in range(start, until(start, sides.counts[0])):
            if near[0] != 0:
                return
            l, end = int(ahead[k, 0]), ahead[k, 1]
            if l < end:
                length = longest[w, sides.first.object[k]]
                least = thickness(sides, k, k, w) + reach + length
                here, way, shorter = middle[w, k], turn[w, k], real(1.0) / length
                while l < end:
                    between, relative = middle[w, wp.max(l, 0)] - here, turn[w, wp.max(l, 0)] - way
                    excess = half * (wp.length(between) - wp.length(relative)) - least
                    if excess > real(0.0):
                        l += 1 + int(wp.min(excess * shorter, real(end)))
                    elif may_touch(sides, k, l):
                        near[0] = 1
                        l = end
                    else:
                        l += 1

    return enclose, meet, follow

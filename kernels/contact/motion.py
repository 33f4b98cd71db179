"""How far nodes are from the ways a search was made for, what of their motion is common, and the smallest gaps of pairs."""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.distance import distance_functions
from ddg_warp.kernels.contact.surfaces import Kind, pair_functions, sides_struct, surface_struct
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function

SAMPLES = 16  # edges of a world whose motion says what is common
# Motions that ways of searches are long: what goes on as it went is found once for two. There are a third more pairs then, and searches
# take 16 % of the time of hair that falls on a head, not 23 (10,000 strands, an H100).
AHEAD = 2.0


@cache
def corners_function(real):
    """corners(x, nodes) -> what four nodes have (4, 3)."""
    X, N = wp.types.vector(3, real), wp.types.vector(4, int)

    @wp.func
    def corners(x: wp.array(dtype=X), nodes: N):
        return wp.matrix_from_rows(x[nodes[0]], x[nodes[1]], x[nodes[2]], x[nodes[3]])

    return corners


@cache
def relative_function(kind: Kind, real):
    """relative(x, p) -> displacements p (4, 3) of nodes at x less their mean, and how far the sides may approach by them.

    Where a half-space turns, its plane moves by more than its nodes, which are 1 m apart: for each metre by S more, S what they move by
    beside each other.
    """
    Y, first = wp.types.matrix((4, 3), real), kind.first
    *_, closest = pair_functions(kind, real)

    @wp.func
    def approach(x: Y, q: Y):
        if wp.static(kind.endless):
            _r, w = closest(x)
            turn = wp.max(wp.length(q[2] - q[1]), wp.length(q[3] - q[1]))
            near = wp.length(q[0] * w[0] + q[1] * w[1] + q[2] * w[2] + q[3] * w[3])
            return near + real(2.0) * turn * (wp.length(q[0] - q[1]) + turn)
        else:
            one, other = real(0.0), real(0.0)
            for k in range(4):
                if k < wp.static(first):
                    one = wp.max(one, wp.length(q[k]))
                else:
                    other = wp.max(other, wp.length(q[k]))
            return one + other

    @wp.func
    def relative(x: Y, p: Y):
        mean = real(0.25) * (p[0] + p[1] + p[2] + p[3])
        q = wp.matrix_from_rows(p[0] - mean, p[1] - mean, p[2] - mean, p[3] - mean)
        return q, approach(x, q)

    return relative


@cache
def motion_kernels(real, serial: bool):
    """watch(...) whether a search is out of date, lengthen(...) the ways of the next, mark(...) it, common(...) what of a motion is
    common."""
    X, Surface, until = wp.types.vector(3, real), surface_struct(real), until_function(serial)
    _, _, beside, _ = distance_functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def watch(
        base: wp.array(dtype=X),
        q: wp.array(dtype=X),
        start: wp.array(dtype=X),
        end: wp.array(dtype=X),
        placed: wp.array(dtype=wp.uint8),
        allowed: real,
        move: wp.array(dtype=X),
        stale: wp.array(dtype=int),
    ):
        """Whether a node that is a place is farther than allowed from the way it was seen on; one that is no number is."""
        tid = wp.tid()
        for i in range(tid, until(tid, q.shape[0])):
            if placed[i % placed.shape[0]] != wp.uint8(0):
                before, _b = beside(start[i], end[i], base[i], base[i])
                now, _n = beside(start[i], end[i], q[i], q[i])
                if not (wp.dot(before, before) <= allowed * allowed and wp.dot(now, now) <= allowed * allowed):
                    stale[0] = 1
            move[i] = q[i] - base[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def lengthen(move: wp.array(dtype=X), together: wp.array(dtype=int), way: wp.array(dtype=X)):
        """`AHEAD` motions, but of worlds that go by one share: what is seen of these is where they come to."""
        tid = wp.tid()
        for i in range(tid, until(tid, move.shape[0])):
            one = together[i / (move.shape[0] / together.shape[0])] != 0
            way[i] = move[i] * wp.where(one, real(1.0), real(AHEAD))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def mark(
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        together: wp.array(dtype=int),
        placed: wp.array(dtype=wp.uint8),
        overflow: wp.array(dtype=int),
        start: wp.array(dtype=X),
        end: wp.array(dtype=X),
        stale: wp.array(dtype=int),
        done: wp.array(dtype=int),
        number: wp.array(dtype=int),
    ):
        """Notes the ways that something was found for, of worlds that go by one share their ends; it is out of date at once if not
        all of it fitted."""
        tid = wp.tid()
        if tid == 0:
            stale[0] = overflow[0]
            done[0] = 1
            number[0] += 1
        for i in range(tid, until(tid, x.shape[0])):
            if placed[i % placed.shape[0]] != wp.uint8(0):
                end[i] = x[i] + move[i]
                start[i] = wp.where(together[i / (x.shape[0] / together.shape[0])] != 0, end[i], x[i])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def common(
        edges: Surface, count: int, move: wp.array(dtype=X), together: wp.array(dtype=int), shift: wp.array(dtype=X)
    ):
        """The mean motion of some edges, spread over them, where a world moves at one share; else zero."""
        w = wp.tid()
        mean, number = X(), wp.min(count, wp.static(SAMPLES))
        if together[w] != 0:
            for k in range(number):
                i = int(wp.int64(k) * wp.int64(count) / wp.int64(number))
                mean += move[edges.nodes[i, 0] + w * edges.nodes_a_world] / real(number)
        if not wp.isfinite(mean):
            mean = X()
        shift[w] = mean

    return watch, lengthen, mark, common


@cache
def gap_kernel(kind: Kind, real):
    """The smallest gap [m] of each world; or one below `enough`, where there is any: others are not looked for then."""
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    slots, _, thickness, closest = pair_functions(kind, real)
    corners = corners_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def gaps(
        threads: int,
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        x: wp.array(dtype=X),
        enough: real,
        gap: wp.array(dtype=real),
    ):
        for p in range(wp.tid(), count[0], threads):
            w = pairs[p][0] / sides.counts[0]
            if gap[w] >= enough:
                i, j = pairs[p][0] - w * sides.counts[0], pairs[p][1] - w * sides.counts[1]
                r, _ = closest(corners(x, slots(sides, i, j, w)))
                wp.atomic_min(gap, w, wp.length(r) - thickness(sides, i, j, w))

    return gaps

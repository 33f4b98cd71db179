"""Candidate validity: deviation of nodes from the searched paths, common motion of worlds, smallest gaps."""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.distance import distance_functions
from ddg_warp.kernels.collision.primitives import Kind, pair_functions, sides_struct, surface_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function

SAMPLES = 16  # edges (or balls) of a world whose mean motion is the common motion
# Length of searched paths, in motions: a steady motion needs one search for two steps.
#
# Measured: a third more pairs, but searches take 16 % instead of 23 % of the time of 10,000 strands of hair falling on a head, an H100.
AHEAD = 2.0


@cache
def corners_function(real):
    """Return the device function `corners(x, nodes) -> y`: the values (4, 3) of four nodes."""
    X, N = wp.types.vector(3, real), wp.types.vector(4, int)

    @wp.func
    def corners(x: wp.array(dtype=X), nodes: N):
        return wp.matrix_from_rows(x[nodes[0]], x[nodes[1]], x[nodes[2]], x[nodes[3]])

    return corners


@cache
def relative_function(kind: Kind, real):
    """Return the device function `relative(x, p) -> (q, approach)` of displacements p (4, 3) of nodes at x.

    `q`: p less its mean; `approach`: bound of the decrease of the distance [m].

    The plane of a rotating half-space moves by more than its nodes, which are 1 m apart: by their relative displacement per metre of
    distance.
    """
    Y, first = wp.types.matrix((4, 3), real), kind.first
    *_, closest = pair_functions(kind, real)

    @wp.func
    def approach(x: Y, q: Y):
        if wp.static(kind.endless):
            _r, w = closest(x)
            rotation = wp.max(wp.length(q[2] - q[1]), wp.length(q[3] - q[1]))
            near = wp.length(q[0] * w[0] + q[1] * w[1] + q[2] * w[2] + q[3] * w[3])
            return near + real(2.0) * rotation * (wp.length(q[0] - q[1]) + rotation)
        else:
            first_most, second_most = real(0.0), real(0.0)
            for k in range(4):
                if k < wp.static(first):
                    first_most = wp.max(first_most, wp.length(q[k]))
                else:
                    second_most = wp.max(second_most, wp.length(q[k]))
            return first_most + second_most

    @wp.func
    def relative(x: Y, p: Y):
        mean = real(0.25) * (p[0] + p[1] + p[2] + p[3])
        q = wp.matrix_from_rows(p[0] - mean, p[1] - mean, p[2] - mean, p[3] - mean)
        return q, approach(x, q)

    return relative


@cache
def motion_kernels(real, serial: bool):
    """Build the kernels of candidate validity.

    `watch`: test whether a search is out of date.
    `lengthen`: write the displacements that the next search covers.
    `mark`: store the paths that a search has covered.
    `common`: write the common motion of each world.
    """
    X, Surface, until = wp.types.vector(3, real), surface_struct(real), until_function(serial)
    _, _, path_offset, *_ = distance_functions(real)

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
        done: wp.array(dtype=int),
    ):
        """Write displacements, clear `done`, and set `stale` if a node has left the margin of its searched path.

        A node that is not finite has left it. Only nodes in `placed` have positions.
        """
        tid = wp.tid()
        if tid == 0:
            done[0] = 0
        for i in range(tid, until(tid, q.shape[0])):
            if placed[i % placed.shape[0]] != wp.uint8(0):
                start_offset, _b = path_offset(start[i], end[i], base[i], base[i])
                end_offset, _n = path_offset(start[i], end[i], q[i], q[i])
                if not (
                    wp.dot(start_offset, start_offset) <= allowed * allowed
                    and wp.dot(end_offset, end_offset) <= allowed * allowed
                ):
                    stale[0] = 1
            move[i] = q[i] - base[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def lengthen(move: wp.array(dtype=X), together: wp.array(dtype=int), path: wp.array(dtype=X)):
        """Write `AHEAD` motions, or the motion itself in worlds that move by one fraction: these search around their end."""
        tid = wp.tid()
        for i in range(tid, until(tid, move.shape[0])):
            single_fraction = together[i / (move.shape[0] / together.shape[0])] != 0
            path[i] = move[i] * wp.where(single_fraction, real(1.0), real(AHEAD))

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
        """Store searched paths, or their ends in worlds that move by one fraction.

        A search that overflowed is out of date.
        """
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
        sampled: Surface, count: int, move: wp.array(dtype=X), together: wp.array(dtype=int), shift: wp.array(dtype=X)
    ):
        """Write the mean motion of a sample of primitives if the world moves by one fraction, else zero."""
        w = wp.tid()
        mean, number = X(), wp.min(count, wp.static(SAMPLES))
        if together[w] != 0:
            for k in range(number):
                i = int(wp.int64(k) * wp.int64(count) / wp.int64(number))
                mean += move[sampled.nodes[i, 0] + w * sampled.nodes_a_world] / real(number)
        if not wp.isfinite(mean):
            mean = X()
        shift[w] = mean

    return watch, lengthen, mark, common


@cache
def gap_kernel(kind: Kind, real):
    """Build the kernel of smallest gaps.

    `gaps`: write the smallest gap [m] of each world, or, once one below `enough` is known, any such gap.
    """
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    pair_nodes, _, thickness, closest = pair_functions(kind, real)
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
                r, _ = closest(corners(x, pair_nodes(sides, i, j, w)))
                wp.atomic_min(gap, w, wp.length(r) - thickness(sides, i, j, w))

    return gaps

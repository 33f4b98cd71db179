"""How far nodes have moved since a search, and how far each may move so that nothing passes.

Node i may move by b_i = min(q min_pairs (d - keep thickness) / 2, (margin + reach) / 2 - moved_i), with 0 < q < 1 and the distance d of
the pairs among the candidates that it belongs to: of a pair both sides take half, and every point of an edge or triangle moves no
farther than one of its nodes; pairs that are no candidates were farther apart than thickness + margin + reach at the search. Bounds
of this kind are those of Chen et al., "Offset geometric contact", ACM ToG 44(4), 2025.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.surfaces import Kind, pair_functions, sides_struct
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function


@cache
def motion_kernels(real, serial: bool):
    """watch(...) whether a search is out of date, mark(...) it, start(...) bounds by what is no candidate, hold(...) a displacement."""
    X, until = wp.types.vector(3, real), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def watch(x: wp.array(dtype=X), seen: wp.array(dtype=X), allowed: real, stale: wp.array(dtype=int)):
        """Whether a node has moved farther than allowed; one that is no number has."""
        tid = wp.tid()
        for i in range(tid, until(tid, x.shape[0])):
            moved = x[i] - seen[i]
            if not (wp.dot(moved, moved) <= allowed * allowed):
                stale[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def mark(
        x: wp.array(dtype=X),
        overflow: wp.array(dtype=int),
        seen: wp.array(dtype=X),
        stale: wp.array(dtype=int),
        searches: wp.array(dtype=int),
    ):
        """Notes where nodes are at a search, which is out of date at once if pairs did not fit."""
        tid = wp.tid()
        if tid == 0:
            stale[0] = overflow[0]
            searches[0] += 1
        for i in range(tid, until(tid, x.shape[0])):
            seen[i] = x[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(
        x: wp.array(dtype=X),
        seen: wp.array(dtype=X),
        allowed: real,
        overflow: wp.array(dtype=int),
        bound: wp.array(dtype=real),
    ):
        tid = wp.tid()
        for i in range(tid, until(tid, x.shape[0])):
            bound[i] = wp.where(overflow[0] == 0, wp.max(allowed - wp.length(x[i] - seen[i]), real(0.0)), real(0.0))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def hold(bound: wp.array(dtype=real), move: wp.array(dtype=X), held: wp.array(dtype=int)):
        """Shortens displacements that are longer than their bound, and counts them."""
        tid = wp.tid()
        for i in range(tid, until(tid, move.shape[0])):
            length = wp.length(move[i])
            if length > bound[i]:
                move[i] = move[i] * (bound[i] / length)
                wp.atomic_add(held, 0, 1)

    return watch, mark, start, hold


@cache
def bound_kernel(kind: Kind, real, serial: bool):
    """Bounds of the nodes of pairs, and the smallest gap [m] of each world."""
    Sides, X = sides_struct(real), wp.types.vector(3, real)
    slots, _, thickness, closest = pair_functions(kind, real)
    until = until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def bounds(
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        sides: Sides,
        x: wp.array(dtype=X),
        share: real,
        keep: real,
        bound: wp.array(dtype=real),
        gap: wp.array(dtype=real),
    ):
        tid = wp.tid()
        if tid >= count[0]:
            return
        for p in range(tid, until(tid, count[0])):
            w = pairs[p][0] / sides.counts[0]
            i, j = pairs[p][0] - w * sides.counts[0], pairs[p][1] - w * sides.counts[1]
            nodes = slots(sides, i, j, w)
            r, _ = closest(x, nodes)
            distance, both = wp.length(r), thickness(sides, i, j)
            wp.atomic_min(gap, w, distance - both)
            b = wp.max(real(0.5) * share * (distance - keep * both), real(0.0))
            for k in range(4):
                wp.atomic_min(bound, nodes[k], b)

    return bounds

"""Candidate pairs: broad phase by a BVH, narrow phase by distance, and lists sorted by index.

The broad phase (`meet`) and the narrow phase (`narrow_phase`) are separate kernels: a BVH traversal waits for memory, and takes so few
registers that many threads wait at once. A leaf of the BVH has consecutive edges of a rod, which need one traversal. The narrow
phase tests all pairs of primitives of two leaves whose AABBs overlap.

Measured: with a loop over primitives and their AABBs in it, the traversal took 2.4 times as long on an H200.

Alternative: larger AABBs whose candidates serve several searches. Falling bodies leave them within a step; bodies at rest gain
nothing, as many more AABBs overlap.

Alternative: a float32 test of edges before the narrow phase. It rejects 72 % of the pairs among 10,000 strands, but the narrow phase
then takes 0.50 ms on an H100 instead of 0.42.

A candidate may come within the search distance anywhere in the motion. Whatever fraction of its displacement a node moves, it stays
between its two end positions. So along any direction the sides are at least as far apart as these positions are. The direction used
joins the closest points at half the motion; along it motionless sides are separated by their distance. Where a world moves by one
fraction, displacements are relative to the mean of the pair, and AABBs move with the world.

Nodes may also deviate from these paths by `around`. Along any direction the separation then decreases by at most twice that, and AABBs
are inflated by it. So no other pair comes within the search distance while its nodes are in the tubes around their paths. Tubes are
convex: a straight motion between two positions in them does not leave them.

Half-spaces have unbounded AABBs. Away from its three nodes, which move by one fraction, a plane moves by more than its nodes, in
proportion to their weights. Its pairs are tested by a bound on the approach of both sides.

If both sides are of one type, the leaf whose AABB begins later along an axis finds the other: its lower face lies within the extent of
the other. So traversals query the lower face alone and visit half as many leaves.

Measured: 1.55 ms instead of 2.03 for 10,000 falling strands on an H100; on the CPU two thirds of the time.

Alternative: capsules around edges instead of AABBs, or BVHs built by surface area, gain 7 %.

A traversal begins at the root, and threads of a warp wait for each other wherever their paths diverge. On CUDA they take leaves in
Morton order. The list of overlapping leaf pairs has segments with a counter each, as threads wait for a counter and its cache line.

Measured: Morton order takes 0.83 ms instead of 1.03 for hair of 10,000 strands on an H200; 1024 counters in 32 lines 0.64 ms, 64
counters in two lines 0.85 ms.

Each primitive has a linked list of partners, in any order, with entries (partner, index of the next entry). Prefix sums then give the
start of its segment in the candidate list. So two runs give the same list bitwise, whatever the order of threads. Lists that overflow
stay empty: `overflow` is set, and `needed` is the length that both lists need.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.broad_phase.aabb import BvhPair, overlap
from ddg_warp.kernels.collision.broad_phase.candidate_validity import corners_function, relative_function
from ddg_warp.kernels.collision.primitives import Kind, pair_functions, sides_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.prefix_sum import add_to_tile
from ddg_warp.kernels.core.vectorised_access import read_function

MOST = 2**31 - 1  # largest number of pairs that can be counted
WARP = 32  # threads that run together
AXIS = 2  # axis along which leaves of one type are ordered
AT_ONCE = 8  # pairs of a leaf that are appended together, as threads wait for the counter


@wp.func
def note_needed(
    num_met: wp.array(dtype=int),
    leaf_pairs: wp.array(dtype=wp.vec2i),
    overflow: wp.array(dtype=int),
    needed: wp.array(dtype=int),
):
    """Note required capacity and overflow, by the fullest segment; counts that wrapped are negative."""
    segments = num_met.shape[0]
    for segment in range(segments):
        number = wp.where(num_met[segment] < 0, wp.static(MOST), num_met[segment])
        if number > leaf_pairs.shape[0] / segments:
            overflow[0] = 1
        needed[1] = wp.max(needed[1], wp.where(number > wp.static(MOST) / segments, wp.static(MOST), number * segments))


@wp.func
def turns(tid: int, threads: int, num_met: wp.array(dtype=int), leaf_pairs: wp.array(dtype=wp.vec2i)):
    """Return the first leaf pair of a thread, and end and number of threads of its segment."""
    segments = num_met.shape[0]
    each, room = threads / segments, leaf_pairs.shape[0] / segments
    segment = tid / each
    if segment >= segments:
        return 0, 0, 1
    first = segment * room
    return first + tid - segment * each, first + wp.min(num_met[segment], room), each


@cache
def overlap_kernel(alike: bool, inner: bool, grouped: bool):
    """Build the kernel of the broad phase.

    `meet`: list pairs of leaves whose AABBs overlap. If sides are `alike`, each pair is listed once, and with `inner` each leaf with
    itself.
    """
    Few, least = wp.types.vector(AT_ONCE, int), 1 - inner

    @wp.func
    def append_pairs(
        num_met: wp.array(dtype=int), leaf_pairs: wp.array(dtype=wp.vec2i), segment: int, i: int, few: Few, number: int
    ):
        room = leaf_pairs.shape[0] / num_met.shape[0]
        first = wp.atomic_add(num_met, segment, number)
        for n in range(number):
            if first + n < room:
                both = wp.vec2i(i, few[n])
                if wp.static(alike):
                    both = wp.vec2i(wp.min(i, few[n]), wp.max(i, few[n]))
                leaf_pairs[segment * room + first + n] = both

    @wp.func
    def finds(trees: BvhPair, i: int, j: int):
        """Return True if leaf i lists the pair with leaf j; ties go to the first leaf."""
        if wp.static(alike):
            first = trees.bundle_lower[j][wp.static(AXIS)] < trees.bundle_lower[i][wp.static(AXIS)]
            return first or j >= i + wp.static(least)
        return True

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def meet(trees: BvhPair, num_met: wp.array(dtype=int), leaf_pairs: wp.array(dtype=wp.vec2i)):
        """Append pairs while there is room, and count all; one thread per leaf of a world."""
        segment = wp.tid() / wp.static(WARP) % num_met.shape[0]
        i = wp.tid()
        if trees.order.shape[0] > 0:
            i = trees.order[i]
        root = int(-1)
        if wp.static(grouped):
            root = wp.bvh_get_group_root(trees.tree, i / (trees.bvh_leaves.shape[0] - 1))
        lower = trees.bundle_lower[i]
        upper = trees.bundle_upper[i]
        if wp.static(alike):
            upper[wp.static(AXIS)] = lower[wp.static(AXIS)]
        query = wp.bvh_query_aabb(trees.tree, lower, upper, root)
        few, number = Few(), int(0)
        j = int(0)
        while wp.bvh_query_next(query, j):
            if finds(trees, i, j):
                few[number] = j
                number += 1
                if number == wp.static(AT_ONCE):
                    append_pairs(num_met, leaf_pairs, segment, i, few, number)
                    number = 0
        if number > 0:
            append_pairs(num_met, leaf_pairs, segment, i, few, number)

    return meet


@cache
def query_functions(kind: Kind, real, single: bool):
    """Return the device functions `ranges_of`, `reaches` and `asked`.

    `ranges_of(trees, both) -> (w, start, end, first, last)`: world and primitives of two leaves.
    `reaches(sides, trees, bundle, l, w)`: True if the AABB of second primitive l overlaps that of a leaf.
    `asked(sides, trees, k, l, w)`: True if the AABBs of two primitives overlap and the two may be a pair.

    Leaves of a `single` primitive have the AABB of the primitive, which has been tested before.
    """
    Sides = sides_struct(real)
    _, may_touch, *_ = pair_functions(kind, real)

    @wp.func
    def ranges_of(trees: BvhPair, both: wp.vec2i):
        w = both[0] / (trees.bvh_leaves.shape[0] - 1)
        first, second = both[0] - w * (trees.bvh_leaves.shape[0] - 1), both[1] - w * (trees.leaves.shape[0] - 1)
        if wp.static(single):
            return w, first, first + 1, second, second + 1
        return w, trees.bvh_leaves[first], trees.bvh_leaves[first + 1], trees.leaves[second], trees.leaves[second + 1]

    @wp.func
    def reaches(sides: Sides, trees: BvhPair, bundle: int, l: int, w: int):
        if wp.static(single):
            return True
        j = l + w * sides.counts[1]
        lower, upper = trees.second_lower[j], trees.second_upper[j]
        return overlap(trees.bundle_lower[bundle], trees.bundle_upper[bundle], lower, upper)

    @wp.func
    def asked(sides: Sides, trees: BvhPair, k: int, l: int, w: int):
        if wp.static(single):
            return may_touch(sides, k, l)
        i, j = k + w * sides.counts[0], l + w * sides.counts[1]
        if overlap(trees.lower[i], trees.upper[i], trees.second_lower[j], trees.second_upper[j]):
            return may_touch(sides, k, l)
        return False

    return ranges_of, reaches, asked


@cache
def candidate_kernels(kind: Kind, real, single: bool):
    """Build the kernels of the narrow phase.

    `narrow_phase`: link and count the candidates among primitives of leaf pairs.
    `fill`: write the candidate list.

    `single`: see `query_functions`.
    """
    Sides, X, Y = sides_struct(real), wp.types.vector(3, real), wp.types.matrix((4, 3), real)
    pair_nodes, _, thickness, closest = pair_functions(kind, real)
    ranges_of, reaches, asked = query_functions(kind, real, single)
    corners, relative = corners_function(real), relative_function(kind, real)
    link_of = read_function(wp.vec2i)
    half, two = wp.constant(real(0.5)), wp.constant(real(2.0))

    @wp.func
    def separation(x: Y, p: Y, around: real):
        """Return a lower bound of the distance [m] over motions by fractions of p with deviations `around`.

        Nodes of a half-space move by one fraction.
        """
        y = x + half * p
        r, w = closest(y)
        if wp.static(kind.endless):
            near = half * (wp.length(p[0]) + wp.length(w[1] * p[1] + w[2] * p[2] + w[3] * p[3]))
            near += around * (real(1.0) + wp.abs(w[1]) + wp.abs(w[2]) + wp.abs(w[3]))
            rotation = half * wp.max(wp.length(p[2] - p[1]), wp.length(p[3] - p[1])) + two * around
            lever = half * (wp.length(p[0]) + wp.length(p[1])) + two * around
            return wp.length(r) - near - two * rotation * (lever + rotation)
        n = wp.normalize(r)
        first, second = real(wp.inf), real(-wp.inf)
        for k in range(4):
            projection, off = wp.dot(n, y[k] - y[0]), half * wp.abs(wp.dot(n, p[k]))
            if k < wp.static(kind.first):
                first = wp.min(first, projection - off)
            else:
                second = wp.max(second, projection + off)
        return first - second - two * around

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def narrow_phase(
        threads: int,
        sides: Sides,
        trees: BvhPair,
        wide: wp.vec2i,
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        together: wp.array(dtype=int),
        search_distance: real,
        around: real,
        num_met: wp.array(dtype=int),
        leaf_pairs: wp.array(dtype=wp.vec2i),
        links: wp.array(dtype=wp.vec2i),
        last_link: wp.array(dtype=int),
        partners: wp.array(dtype=int),
        tiles: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
        needed: wp.array(dtype=int),
    ):
        """Link and count, by first primitive, pairs whose gap may fall below `search_distance` [m] in the motion."""
        if wp.tid() == 0:
            note_needed(num_met, leaf_pairs, overflow, needed)
        begin, stop, step = turns(wp.tid(), threads, num_met, leaf_pairs)
        for n in range(begin, stop, step):
            w, start, end, first, last = ranges_of(trees, leaf_pairs[n])
            for l in range(first, last):
                if not reaches(sides, trees, leaf_pairs[n][0], l, w):
                    continue
                for k in range(start, end):
                    if asked(sides, trees, k, l, w):
                        nodes = pair_nodes(sides, k, l, w)
                        y, p = corners(x, nodes), corners(move, nodes)
                        if together[w] != 0:
                            p, _speed = relative(y, p)
                        if separation(y, p, around) <= thickness(sides, k, l, w) + search_distance:
                            i = k + w * sides.counts[0]
                            link_index = (n * wide[0] + k - start) * wide[1] + l - first
                            links[link_index] = wp.vec2i(
                                l + w * sides.counts[1], wp.atomic_exch(last_link, i, link_index)
                            )
                            wp.atomic_add(partners, i, 1)
                            add_to_tile(tiles, i, 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def fill(
        links: wp.array(dtype=wp.vec2i),
        last_link: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        partners: wp.array(dtype=int),
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
        needed: wp.array(dtype=int),
    ):
        """Write the pairs of a first primitive, in order, by insertion sort; lists are short."""
        i = wp.tid()
        end = starts.shape[0] - 1
        total = starts[end] + partners[end]
        fits = overflow[0] == 0 and total <= pairs.shape[0]
        if i == 0:
            count[0] = wp.where(fits, total, 0)
            needed[0] = wp.max(needed[0], total)
            if total > pairs.shape[0]:
                overflow[0] = 1
        if fits:
            start = starts[i]
            end = start
            entry = last_link[i]
            for _partner in range(partners[i]):
                link = link_of(links, entry)
                k = end
                while k > start and pairs[wp.max(k - 1, 0)][1] > link[0]:
                    pairs[k] = pairs[k - 1]
                    k -= 1
                pairs[k] = wp.vec2i(i, link[0])
                end += 1
                entry = link[1]

    return narrow_phase, fill

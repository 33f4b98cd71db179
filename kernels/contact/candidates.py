"""Pairs that are near: those whose boxes meet, by a tree; judged by their distance; and listed in the order of their indices.

Walking the tree and judging pairs are kernels of their own. A walk waits for memory, and takes so few registers that many threads
wait at once: with a loop over things and their boxes in it, it took 2.4 times as long on an H200. Bundles of edges that follow each
other along a rod share a leaf of the tree, and a walk; all pairs of things of two bundles whose boxes meet are judged, a slot each.
(Larger boxes whose pairs serve several searches were tried: what falls leaves them in a step, and what rests gains nothing, as many
more of them meet. So was to tell edges apart in float32 before they are judged: 72 of 100 that meet are, among 10,000 strands, but it
took an H100 0.50 ms to judge them so, and 0.42 without.)

Of a motion those are found that may come near anywhere on the way. Whatever its share of its way, each node is between both ends of
it; so the sides are as far apart as these ends are along any direction. The one asked is that of the closest points in the middle of
the way, along which what does not move is as far apart as its distance. Where a world moves at one share, ways are what nodes move by
beside the others of the pair, and boxes move with the world.

Nodes may also be beside their ways, by `around`. Along any direction sides are then nearer by no more than twice that, and boxes are
larger by it. So of what is no pair no two come within reach, wherever in the tubes around their ways their nodes are; and as tubes are
convex, a straight motion between two places in them does not leave them. Half-spaces have boxes around all there is. Far from its three
nodes, which go by one share, a plane moves by more than they do, by the weights that they have there: its pairs are judged by a bound
on how far both sides come towards each other.

Of two bundles of things that are alike, the one whose box begins later along an axis finds the other: that side of its box lies between
both sides of the other's. So walks ask for boxes that meet this side alone, and come to half as many (10,000 strands that fall, an
H100: 1.55 ms for 2.03; on the CPU two thirds of the time). Capsules around edges in place of their boxes, or trees by the surfaces of
boxes, gain 7 %.

A walk begins at the root, so that threads of a warp wait for each other wherever their ways part: on CUDA they take bundles in the
order of their places on a Morton curve (10,000 strands of hair, an H200: 0.83 ms for 1.03). What has met lies in parts of the list that
have counters of their own, as threads wait for a counter, too, and for others in its line of the cache (1024 counters in 32 lines: 0.64
ms; 64 in two: 0.85).

Each thing notes its partners in a linked list, in which each pair of those whose boxes meet has a place, (partner, place of the next
one), in any order; running sums then say where its part of the list of pairs starts. So two runs give the same list to the bit,
whatever order threads run in, and lists that do not fit are left out whole: `overflow` says so, and `needed` how long both would be.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.boxes import Trees, overlap
from ddg_warp.kernels.contact.motion import corners_function, relative_function
from ddg_warp.kernels.contact.surfaces import Kind, pair_functions, sides_struct
from ddg_warp.kernels.reading import read_function
from ddg_warp.kernels.threads import CPU_OPTIONS

MOST = 2**31 - 1  # pairs that can be counted; more are told as so many
WARP = 32  # threads that run together
AXIS = 2  # along which boxes of things that are alike begin one after the other
AT_ONCE = 8  # pairs of a bundle that are given places together: threads wait for the counter of places


@wp.func
def note_needed(
    found: wp.array(dtype=int),
    met: wp.array(dtype=wp.vec2i),
    overflow: wp.array(dtype=int),
    needed: wp.array(dtype=int),
):
    """How much room all parts take that have as much as the fullest, and whether it was there; more than can be counted is below 0."""
    parts = found.shape[0]
    for part in range(parts):
        number = wp.where(found[part] < 0, wp.static(MOST), found[part])
        if number > met.shape[0] / parts:
            overflow[0] = 1
        needed[1] = wp.max(needed[1], wp.where(number > wp.static(MOST) / parts, wp.static(MOST), number * parts))


@wp.func
def turns(tid: int, threads: int, found: wp.array(dtype=int), met: wp.array(dtype=wp.vec2i)):
    """Where a thread begins in what has met, where its part ends, and how many threads share that."""
    parts = found.shape[0]
    each, room = threads / parts, met.shape[0] / parts
    part = tid / each
    if part >= parts:
        return 0, 0, 1
    first = part * room
    return first + tid - part * each, first + wp.min(found[part], room), each


@cache
def meet_kernel(alike: bool, inner: bool, grouped: bool):
    """meet(...): bundles whose boxes meet, of things that are alike each two once and, if `inner`, each with itself."""
    Few, least = wp.types.vector(AT_ONCE, int), 1 - inner

    @wp.func
    def put(found: wp.array(dtype=int), met: wp.array(dtype=wp.vec2i), part: int, i: int, few: Few, number: int):
        room = met.shape[0] / found.shape[0]
        first = wp.atomic_add(found, part, number)
        for n in range(number):
            if first + n < room:
                both = wp.vec2i(i, few[n])
                if wp.static(alike):
                    both = wp.vec2i(wp.min(i, few[n]), wp.max(i, few[n]))
                met[part * room + first + n] = both

    @wp.func
    def finds(trees: Trees, i: int, j: int):
        """Whether a bundle finds another that its walk has come to; where both begin at the same place, the first does."""
        if wp.static(alike):
            first = trees.bundle_lower[j][wp.static(AXIS)] < trees.bundle_lower[i][wp.static(AXIS)]
            return first or j >= i + wp.static(least)
        return True

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def meet(trees: Trees, found: wp.array(dtype=int), met: wp.array(dtype=wp.vec2i)):
        """As many as fit, and how many there are. A thread has a bundle of a world."""
        part = wp.tid() / wp.static(WARP) % found.shape[0]
        i = wp.tid()
        if trees.order.shape[0] > 0:
            i = trees.order[i]
        root = int(-1)
        if wp.static(grouped):
            root = wp.bvh_get_group_root(trees.tree, i / (trees.bundles.shape[0] - 1))
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
                    put(found, met, part, i, few, number)
                    number = 0
        if number > 0:
            put(found, met, part, i, few, number)

    return meet


@cache
def asked_functions(kind: Kind, real, single: bool):
    """ranges_of(trees, both): world of two bundles, where the first and the second begin there and end.

    reaches(sides, trees, bundle, l, w): whether the box of a second thing of a world meets that of a bundle.
    asked(sides, trees, k, l, w): whether boxes of things meet that may touch.

    Where bundles are all of a `single` thing, boxes are those that have met.
    """
    Sides = sides_struct(real)
    _, may_touch, *_ = pair_functions(kind, real)

    @wp.func
    def ranges_of(trees: Trees, both: wp.vec2i):
        w = both[0] / (trees.bundles.shape[0] - 1)
        one, other = both[0] - w * (trees.bundles.shape[0] - 1), both[1] - w * (trees.leaves.shape[0] - 1)
        if wp.static(single):
            return w, one, one + 1, other, other + 1
        return w, trees.bundles[one], trees.bundles[one + 1], trees.leaves[other], trees.leaves[other + 1]

    @wp.func
    def reaches(sides: Sides, trees: Trees, bundle: int, l: int, w: int):
        if wp.static(single):
            return True
        j = l + w * sides.counts[1]
        lower, upper = trees.second_lower[j], trees.second_upper[j]
        return overlap(trees.bundle_lower[bundle], trees.bundle_upper[bundle], lower, upper)

    @wp.func
    def asked(sides: Sides, trees: Trees, k: int, l: int, w: int):
        if wp.static(single):
            return may_touch(sides, k, l)
        i, j = k + w * sides.counts[0], l + w * sides.counts[1]
        if overlap(trees.lower[i], trees.upper[i], trees.second_lower[j], trees.second_upper[j]):
            return may_touch(sides, k, l)
        return False

    return ranges_of, reaches, asked


@cache
def candidate_kernels(kind: Kind, real, single: bool):
    """judge(...) by distance, and fill(...) the list of pairs; `single` as of `asked_functions`."""
    Sides, X, Y = sides_struct(real), wp.types.vector(3, real), wp.types.matrix((4, 3), real)
    slots, _, thickness, closest = pair_functions(kind, real)
    ranges_of, reaches, asked = asked_functions(kind, real, single)
    corners, relative = corners_function(real), relative_function(kind, real)
    link_of = read_function(wp.vec2i)
    half, two = wp.constant(real(0.5)), wp.constant(real(2.0))

    @wp.func
    def apart(x: Y, p: Y, around: real):
        """Distance that two keep whose nodes go any share of p, those of a half-space one, and then anywhere within `around`."""
        y = x + half * p
        r, w = closest(y)
        if wp.static(kind.endless):
            near = half * (wp.length(p[0]) + wp.length(w[1] * p[1] + w[2] * p[2] + w[3] * p[3]))
            near += around * (real(1.0) + wp.abs(w[1]) + wp.abs(w[2]) + wp.abs(w[3]))
            turn = half * wp.max(wp.length(p[2] - p[1]), wp.length(p[3] - p[1])) + two * around
            beside = half * (wp.length(p[0]) + wp.length(p[1])) + two * around
            return wp.length(r) - near - two * turn * (beside + turn)
        n = wp.normalize(r)
        first, second = real(wp.inf), real(-wp.inf)
        for k in range(4):
            at, off = wp.dot(n, y[k] - y[0]), half * wp.abs(wp.dot(n, p[k]))
            if k < wp.static(kind.first):
                first = wp.min(first, at - off)
            else:
                second = wp.max(second, at + off)
        return first - second - two * around

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def judge(
        threads: int,
        sides: Sides,
        trees: Trees,
        wide: wp.vec2i,
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        together: wp.array(dtype=int),
        reach: real,
        around: real,
        found: wp.array(dtype=int),
        met: wp.array(dtype=wp.vec2i),
        links: wp.array(dtype=wp.vec2i),
        last_slot: wp.array(dtype=int),
        partners: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
        needed: wp.array(dtype=int),
    ):
        """Which of them may come as near as both radii and `reach` within `around` of their ways: linked, and counted by thing."""
        if wp.tid() == 0:
            note_needed(found, met, overflow, needed)
        begin, stop, step = turns(wp.tid(), threads, found, met)
        for n in range(begin, stop, step):
            w, start, end, first, last = ranges_of(trees, met[n])
            for l in range(first, last):
                if not reaches(sides, trees, met[n][0], l, w):
                    continue
                for k in range(start, end):
                    if asked(sides, trees, k, l, w):
                        nodes = slots(sides, k, l, w)
                        y, p = corners(x, nodes), corners(move, nodes)
                        if together[w] != 0:
                            p, _speed = relative(y, p)
                        if apart(y, p, around) <= thickness(sides, k, l, w) + reach:
                            i = k + w * sides.counts[0]
                            slot = (n * wide[0] + k - start) * wide[1] + l - first
                            links[slot] = wp.vec2i(l + w * sides.counts[1], wp.atomic_exch(last_slot, i, slot))
                            wp.atomic_add(partners, i, 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def fill(
        links: wp.array(dtype=wp.vec2i),
        last_slot: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        partners: wp.array(dtype=int),
        pairs: wp.array(dtype=wp.vec2i),
        count: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
        needed: wp.array(dtype=int),
    ):
        """The pairs of a thing, sorted by insertion; lists are short."""
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
            at = last_slot[i]
            for _partner in range(partners[i]):
                link = link_of(links, at)
                k = end
                while k > start and pairs[wp.max(k - 1, 0)][1] > link[0]:
                    pairs[k] = pairs[k - 1]
                    k -= 1
                pairs[k] = wp.vec2i(i, link[0])
                end += 1
                at = link[1]

    return judge, fill

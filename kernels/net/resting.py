"""Which islands of a net rest while the next direction is found; see `ddg_warp.solve.net.resting`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.gather import set_struct
from ddg_warp.kernels.islands import DRIVEN, LOAD_SCALE, WANTED
from ddg_warp.kernels.matrix.sliced import BARRED
from ddg_warp.kernels.net.newton import ON_THE_WAY
from ddg_warp.kernels.threads import CPU_OPTIONS, share_function, until_function


@wp.func
def first_of(link: wp.array(dtype=int), u: int):
    """The first body of the island that a body is in, by links to earlier ones."""
    v = link[u]
    while v != u:
        u = v
        v = link[u]
    return u


@cache
def resting_kernels(real, linear, serial: bool):
    """begin(...) with bodies on their own; look(...) for those out of balance; join(...) others to what they push; wake(...) islands;
    settle(...) which blocks rest; leave(...) pairs between such."""
    PairSet, share, until = set_struct(real, linear), share_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(link: wp.array(dtype=int), awake: wp.array(dtype=int), any_awake: wp.array(dtype=int)):
        tid = wp.tid()
        for u in range(tid, until(tid, link.shape[0])):
            link[u] = u
            awake[u] = 0
            if u < any_awake.shape[0]:
                any_awake[u] = 0

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def look(
        ratio: wp.array2d(dtype=real),
        owner: wp.array(dtype=int),
        bodies: int,
        bound: real,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        awake: wp.array(dtype=int),
        any_awake: wp.array(dtype=int),
    ):
        """Bodies with a residual, or a sum of some, larger than `bound` over the load scale, or no number."""
        w, start = share(wp.tid(), owner.shape[0])
        if flags[WANTED, w] == 0:
            return
        for i in range(start, until(start, owner.shape[0])):
            u = owner[i]
            if u >= 0:
                if not ratio[w, i] <= bound * scalars[LOAD_SCALE, w]:
                    awake[u + w * bodies] = 1
                    any_awake[w] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def join(
        threads: int,
        sets: wp.array(dtype=PairSet),
        body: wp.array(dtype=int),
        bodies: int,
        awake: wp.array(dtype=int),
        link: wp.array(dtype=int),
    ):
        """Links the first bodies of both islands of a pair, the later one to the earlier one, whatever others link meanwhile.

        Of two that are awake nothing is to be found out.
        """
        for s in range(sets.shape[0]):
            own = sets[s]
            for p in range(wp.tid(), own.count[0], threads):
                if own.used[p] != 0:
                    n = own.nodes[p]  # the first and the third are on either side, whatever the kind
                    w = n[0] / body.shape[0]
                    a = body[n[0] - w * body.shape[0]]
                    b = body[n[2] - w * body.shape[0]]
                    if a >= 0 and b >= 0:
                        a += w * bodies
                        b += w * bodies
                        both = awake[a] + awake[b] == 2
                        while a != b and not both:
                            a = first_of(link, a)
                            b = first_of(link, b)
                            late = wp.max(a, b)
                            early = wp.min(a, b)
                            a = late
                            b = early
                            if late != early:
                                a = wp.atomic_min(link, late, early)
                                if a == late:  # it was the first one still
                                    a = early

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def wake(link: wp.array(dtype=int), awake: wp.array(dtype=int)):
        """The first body of an island tells whether any of it is."""
        tid = wp.tid()
        for u in range(tid, until(tid, link.shape[0])):
            if awake[u] != 0:
                awake[first_of(link, u)] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def settle(
        link: wp.array(dtype=int),
        awake: wp.array(dtype=int),
        any_awake: wp.array(dtype=int),
        bodies: int,
        stalled: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        body: wp.array(dtype=int),
        fixed: wp.array(dtype=wp.uint8),
        where: wp.array(dtype=int),
        width: int,
        barred: wp.array(dtype=wp.uint8),
        idle: wp.array(dtype=int),
    ):
        """Blocks of islands that rest are barred; columns of chains that have no others are idle.

        None rests in worlds that are on their way, or where energies drown in rounding and nothing gets better.
        """
        w, start = share(wp.tid(), body.shape[0])
        every = any_awake[w] == 0 or stalled[w] > 0 or flags[DRIVEN, w] == wp.static(ON_THE_WAY)
        for k in range(start, until(start, body.shape[0])):
            bits = fixed[k]
            rests = False
            if not every and body[k] >= 0:
                rests = awake[first_of(link, body[k] + w * bodies)] == 0
            if rests:
                bits = BARRED
            elif where.shape[0] > 0:
                if where[k] >= 0:
                    idle[w * width + where[k] % width] = 0
            barred[k + w * body.shape[0]] = bits

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def leave(threads: int, sets: wp.array(dtype=PairSet), barred: wp.array(dtype=wp.uint8)):
        """Pairs none of whose nodes can move, nor angles turn."""
        for s in range(sets.shape[0]):
            own = sets[s]
            for p in range(wp.tid(), own.count[0], threads):
                n = own.nodes[p]
                free = int(0)
                for slot in range(4):
                    free += wp.where(barred[n[slot]] != BARRED, 1, 0)
                if own.angles.shape[0] > 0:
                    for side in range(2):
                        angle = own.angles[p][side]
                        if angle >= 0:
                            free += 1 - int(barred[angle] & wp.uint8(1))
                own.idle[p] = wp.uint8(wp.where(free > 0, 0, 1))

    return begin, look, join, wake, settle, leave

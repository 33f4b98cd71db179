"""What pairs come to in each world: energies, how many push each other, and what friction takes, added up in one order."""

from functools import cache

import warp as wp

from ddg_warp.kernels.threads import CPU_OPTIONS, share_function, until_function

ENERGY, TOUCHING, WORK = range(3)
ROWS = 3


@cache
def written_struct(real):
    """A list of pairs by first things (see `PairList`), `things` of them in a world, and what it has written of each pair.

    used: not zero where it has; work: of friction, empty of contact.
    """

    @wp.struct
    class Written:
        count: wp.array(dtype=int)
        starts: wp.array(dtype=int)
        partners: wp.array(dtype=int)
        energy: wp.array(dtype=real)
        used: wp.array(dtype=int)
        work: wp.array(dtype=real)
        things: int

    return Written


@cache
def total_kernels(real, serial: bool):
    """add(...) over pairs of first things, tell(...) the sums over these of each world."""
    Written, share, until = written_struct(real), share_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(lists: wp.array(dtype=Written), worlds: int, sums: wp.array2d(dtype=real)):
        """Row by row of what is added up (ROWS worlds, things), the k-th first things of all lists together."""
        w, start = share(wp.tid(), sums.shape[1])
        for k in range(start, until(start, sums.shape[1])):
            energy, work, touching = real(0.0), real(0.0), int(0)
            for s in range(lists.shape[0]):
                if k < lists[s].things and lists[s].count[0] > 0:
                    own = lists[s]
                    first = own.starts[k + w * own.things]
                    for p in range(first, first + own.partners[k + w * own.things]):
                        if own.used[p] != 0:
                            energy += own.energy[p]
                            if own.work.shape[0] > 0:
                                work += own.work[p]
                            else:
                                touching += 1
            sums[wp.static(ENERGY) * worlds + w, k] = energy
            sums[wp.static(TOUCHING) * worlds + w, k] = real(touching)
            sums[wp.static(WORK) * worlds + w, k] = work

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def tell(
        sums: wp.array2d(dtype=real),
        overflow: wp.array(dtype=int),
        energy: wp.array(dtype=real),
        touching: wp.array(dtype=int),
        dissipated: wp.array(dtype=real),
    ):
        """Energies are infinite while pairs do not fit."""
        w = wp.tid()
        energy[w] = wp.where(overflow[0] == 0, sums[wp.static(ENERGY), w], real(wp.inf))
        touching[w] = int(sums[wp.static(TOUCHING), w])
        dissipated[w] = sums[wp.static(WORK), w]

    return add, tell

"""Sum contact energy, number of active pairs and friction work per world, in a fixed order."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS, items_function, until_function

ENERGY, ACTIVE_PAIRS, WORK = range(3)
ROWS = 3


@cache
def written_struct(real):
    """List of pairs with energies, by first primitives, `primitives` in a world; see `CandidateList`.

    `used`: not zero for active pairs; `work`: work of friction, empty for contact.
    """

    @wp.struct
    class Written:
        count: wp.array(dtype=int)
        starts: wp.array(dtype=int)
        partners: wp.array(dtype=int)
        energy: wp.array(dtype=real)
        used: wp.array(dtype=int)
        work: wp.array(dtype=real)
        primitives: int

    return Written


@cache
def total_kernels(real, serial: bool):
    """Build the kernels of sums per world.

    `add`: sum over the pairs of each first primitive.
    `tell`: write the results of each world.
    """
    Written, share, until = written_struct(real), items_function(serial), until_function(serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(lists: wp.array(dtype=Written), worlds: int, sums: wp.array2d(dtype=real)):
        """Write sums (ROWS worlds, primitives); column k adds the k-th first primitives of all lists."""
        w, start = share(wp.tid(), sums.shape[1])
        for k in range(start, until(start, sums.shape[1])):
            energy, work, active_pairs = real(0.0), real(0.0), int(0)
            for s in range(lists.shape[0]):
                if k < lists[s].primitives and lists[s].count[0] > 0:
                    pair_list = lists[s]
                    first = pair_list.starts[k + w * pair_list.primitives]
                    for p in range(first, first + pair_list.partners[k + w * pair_list.primitives]):
                        if pair_list.used[p] != 0:
                            energy += pair_list.energy[p]
                            if pair_list.work.shape[0] > 0:
                                work += pair_list.work[p]
                            else:
                                active_pairs += 1
            sums[wp.static(ENERGY) * worlds + w, k] = energy
            sums[wp.static(ACTIVE_PAIRS) * worlds + w, k] = real(active_pairs)
            sums[wp.static(WORK) * worlds + w, k] = work

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def tell(
        sums: wp.array2d(dtype=real),
        overflow: wp.array(dtype=int),
        search_distance: real,
        energy: wp.array(dtype=real),
        active_pairs: wp.array(dtype=int),
        dissipated: wp.array(dtype=real),
        least: wp.array(dtype=real),
        gap: wp.array(dtype=real),
    ):
        """Write the results of each world; energies are infinite if pairs overflowed.

        The smallest gap [m] of all pairs, `least`, is reset to `search_distance` for the next evaluation.
        """
        w = wp.tid()
        energy[w] = wp.where(overflow[0] == 0, sums[wp.static(ENERGY), w], real(wp.inf))
        active_pairs[w] = int(sums[wp.static(ACTIVE_PAIRS), w])
        dissipated[w] = sums[wp.static(WORK), w]
        gap[w] = least[w]
        least[w] = search_distance

    return add, tell

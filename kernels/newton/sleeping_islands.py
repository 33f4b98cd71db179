"""Sleeping islands of the coupled system during the next direction; see `ddg_warp.solve.newton.sleeping_islands`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.assembly import set_struct
from ddg_warp.kernels.core.islands import LOAD_SCALE, NEEDS_DIRECTION, SUPPORT_MOTION_PENDING
from ddg_warp.kernels.core.launch import CPU_OPTIONS, items_function, until_function
from ddg_warp.kernels.linear.sliced_ell import ALL_INACTIVE
from ddg_warp.kernels.newton.coupled_newton import SUPPORTS_MOVING


@wp.func
def first_of(link: wp.array(dtype=int), u: int):
    """Return the first body of the island of a body, following links to earlier bodies."""
    v = link[u]
    while v != u:
        u = v
        v = link[u]
    return u


@cache
def resting_kernels(real, linear, serial: bool):
    """Build the kernels of sleeping islands.

    `begin`: make every body an island, asleep.
    `look`: mark bodies awake that have not converged.
    `join`: unite islands of bodies in contact.
    `wake`: wake islands with an awake body.
    `settle`: write the active dofs.
    `leave`: mark pairs without active dofs.
    """
    PairSet, first_item, until = set_struct(real, linear), items_function(serial), until_function(serial)

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
        """Mark bodies awake if a scaled residual, or a subset sum, exceeds `bound` or is not finite."""
        w, start = first_item(wp.tid(), owner.shape[0])
        if flags[NEEDS_DIRECTION, w] == 0:
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
        """Link the first bodies of both islands of a pair, the later to the earlier one, under concurrent links.

        Two awake bodies need no link.
        """
        for s in range(sets.shape[0]):
            pair_set = sets[s]
            for p in range(wp.tid(), pair_set.count[0], threads):
                if pair_set.used[p] != 0:
                    n = pair_set.nodes[p]  # the first and the third node are on different sides in every kind
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
                            later = wp.max(a, b)
                            earlier = wp.min(a, b)
                            a = later
                            b = earlier
                            if later != earlier:
                                a = wp.atomic_min(link, later, earlier)
                                if a == later:  # it was still the first body
                                    a = earlier

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def wake(link: wp.array(dtype=int), awake: wp.array(dtype=int)):
        """Mark the first body of an island awake if any body is."""
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
        inactive_mask: wp.array(dtype=wp.uint8),
        idle: wp.array(dtype=int),
    ):
        """Write masks of inactive dofs, all of a sleeping island, and mark columns of rod paths with active dofs.

        No island sleeps while supports of its world are moving, or if energies are below the rounding floor without progress.
        """
        w, start = first_item(wp.tid(), body.shape[0])
        every = any_awake[w] == 0 or stalled[w] > 0 or flags[SUPPORT_MOTION_PENDING, w] == wp.static(SUPPORTS_MOVING)
        for k in range(start, until(start, body.shape[0])):
            bits = fixed[k]
            sleeps = False
            if not every and body[k] >= 0:
                sleeps = awake[first_of(link, body[k] + w * bodies)] == 0
            if sleeps:
                bits = ALL_INACTIVE
            elif where.shape[0] > 0:
                if where[k] >= 0:
                    idle[w * width + where[k] % width] = 0
            inactive_mask[k + w * body.shape[0]] = bits

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def leave(threads: int, sets: wp.array(dtype=PairSet), inactive_mask: wp.array(dtype=wp.uint8)):
        """Mark pairs without active dofs."""
        for s in range(sets.shape[0]):
            pair_set = sets[s]
            for p in range(wp.tid(), pair_set.count[0], threads):
                n = pair_set.nodes[p]
                free = int(0)
                for local in range(4):
                    free += wp.where(inactive_mask[n[local]] != ALL_INACTIVE, 1, 0)
                if pair_set.angles.shape[0] > 0:
                    for side in range(2):
                        angle = pair_set.angles[p][side]
                        if angle >= 0:
                            free += 1 - int(inactive_mask[angle] & wp.uint8(1))
                pair_set.idle[p] = wp.uint8(wp.where(free > 0, 0, 1))

    return begin, look, join, wake, settle, leave

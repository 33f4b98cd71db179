"""The balance of forces at the blocks of a net, and what a step does to its energy; see `kernels.balance` for rods on their own.

What meets at a block is listed once, so sums come in one order, without atomics.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.drag import mass_type
from ddg_warp.kernels.islands import COEFFICIENT, DOUBTFUL, DROWNED, LOAD_SCALE, SLOT, STATUS, UNBALANCED
from ddg_warp.kernels.judge import ROUNDED, SETTLED
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function


@cache
def meeting_type(real, linear):
    """What the elements of a set bring to the blocks that they meet at; an item is element * `ITEM` + slot.

    The gradient is that of the slots; or `along`, of the local dofs, of which the `ends` (`Measure.ends`) belong to a slot.
    """
    V = wp.types.vector(3, real)

    @wp.struct
    class Meeting:
        gradient: wp.array2d(dtype=V)
        along: wp.array2d(dtype=real)
        ends: wp.array2d(dtype=int)
        energy: wp.array2d(dtype=real)
        stiffness: wp.array(dtype=linear)
        starts: wp.array(dtype=int)
        items: wp.array(dtype=int)
        nodes: int
        elements: int

    return Meeting


@cache
def given_type(real, drag: bool):
    """What the balance of blocks reads beside the elements.

    In contact blocks have forces `push`, and bounds `pressed` on the stiffness of what pushes them. `allowed` is what the residual
    of a block may be at rtol = 1, over `load_scale`; see `ddg_warp.compile.tolerance`. Moments are compared over the length `arm`.
    Nodes that the last step moved by more than `settled` [m] are none that only rounding moves; see `kernels.judge`.
    What rounding leaves of an edge vector follows from the coordinates of both its ends, `longest` apart at most.
    """
    V, Mass = wp.types.vector(3, real), mass_type(real, drag)

    @wp.struct
    class Given:
        q: wp.array(dtype=V)
        base: wp.array(dtype=V)
        target: wp.array(dtype=V)
        mass: Mass
        gravity: wp.array(dtype=V)
        load: wp.array(dtype=V)
        fixed: wp.array(dtype=wp.uint8)
        allowed: wp.array(dtype=real)
        blocks: int
        nodes: int
        arm: real
        longest: real
        settled: real
        rtol: real
        floor: real
        push: wp.array(dtype=V)
        pressed: wp.array(dtype=real)

    return Given


@cache
def found_type(real, linear):
    """What the balance of blocks writes: residuals of free dofs, what rounding leaves there, how often they are what they may be, their
    squares, the change of the energy along the step from `base`, and its rounding."""
    H = wp.types.vector(3, linear)

    @wp.struct
    class Found:
        right: wp.array(dtype=H)
        least: wp.array(dtype=real)
        ratio: wp.array2d(dtype=real)
        square: wp.array2d(dtype=real)
        change: wp.array2d(dtype=real)
        noise: wp.array2d(dtype=real)

    return Found


@cache
def largest_function(real, size: int = 3):
    """largest(v): the largest component by its absolute value, without those that are no numbers.

    `wp.max` looks at both of a pair for what is none, which takes the CPU three times as long.
    """
    V = wp.types.vector(size, real)

    @wp.func
    def largest(v: V):
        m = wp.abs(v[0])
        for d in range(1, wp.static(size)):
            a = wp.abs(v[d])
            m = wp.where(a > m, a, m)
        return m

    return largest


@cache
def residual_functions(real, linear, drag: bool, contact: bool, angle: bool = False):
    """outer(...): loads, gravity, inertia, drag and contact of a block; settle(...): its residual, and whether that balances.

    Of an `angle` of a rod, known as such, vectors have its one dof.
    """
    dofs = 1 if angle else 3
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    X, M, R = wp.types.vector(dofs, real), wp.types.matrix((3, 3), real), wp.types.matrix((dofs, dofs), real)
    Given, Found = given_type(real, drag), found_type(real, linear)
    largest = largest_function(real, dofs)

    @wp.func
    def own(v: V):
        """The dofs of a block."""
        x = X()
        for d in range(wp.static(dofs)):
            x[d] = v[d]
        return x

    @wp.func
    def square(m: M):
        """What acts between them."""
        if wp.static(angle):
            return R(m[0, 0])
        else:
            return m

    @wp.func
    def outer(given: Given, i: int, k: int, w: int, c: real):
        """Force; its size and stiffness, the work along the step, without that of contact, which has an energy."""
        x = own(given.q[i])
        force = own(given.load[i])
        if wp.static(drag):
            m = own(given.mass[w, k].mass)
        else:
            m = own(given.mass[w, k])
        if wp.static(not angle):
            if k < given.nodes:
                force += wp.cw_mul(m, given.gravity[0])
        inertia = wp.cw_mul(m, x - own(given.target[i])) * c
        u = x - own(given.base[i])
        change = wp.dot(u, inertia - wp.cw_mul(m, u) * (real(0.5) * c) - force)
        stiff = c * largest(m)
        if wp.static(drag):
            resistance = square(given.mass[w, k].resistance)
            held_back = resistance * (x - own(given.mass[w, k].carried))
            inertia += held_back
            change += wp.dot(u, held_back - resistance * u * real(0.5))
            stiff += wp.max(wp.get_diag(resistance))
        if wp.static(contact):
            force += own(given.push[i])
            stiff += given.pressed[i]
        return force - inertia, largest(force), stiff, change

    @wp.func
    def settle(
        given: Given,
        found: Found,
        flags: wp.array2d(dtype=int),
        load_scale: real,
        i: int,
        k: int,
        w: int,
        force: X,
        size: real,
        stiff: real,
        change: real,
        noise: real,
    ):
        """See `kernels.balance` for the criterion."""
        mask = int(given.fixed[k])
        reach = largest(own(given.q[i])) + given.longest
        length = real(1.0)
        if wp.static(angle):
            reach += real(1.0)
            length = given.arm
        else:
            if k >= given.nodes:
                reach += real(1.0)
                length = given.arm
        allowed = given.allowed[i]
        limit = given.rtol * load_scale * allowed
        least = given.floor * (stiff * reach + size)
        found.least[i] = least
        r = H()
        total = real(0.0)
        worst = real(0.0)
        moved = True
        if wp.static(real is wp.float32):
            settled = real(wp.static(SETTLED))  # rad
            if k < given.nodes:
                settled = given.settled
            moved = not wp.length(given.q[i] - given.base[i]) < settled
        for d in range(wp.static(dofs)):
            if ((mask >> d) & 1) == 0:
                a = wp.abs(force[d])
                worst = wp.where(a > worst, a, worst)
                r[d] = linear(force[d])
                total += force[d] * force[d]
                if not a <= limit:
                    flags[DROWNED, w] = 1
                    if not a <= least:
                        flags[UNBALANCED, w] = 1
                    if wp.static(real is wp.float32):
                        if a > real(wp.static(ROUNDED)) * load_scale * allowed and moved:
                            flags[DOUBTFUL, w] = 1
        found.right[i] = r
        found.ratio[w, k] = worst / allowed
        found.square[w, k] = total / (length * length)
        found.change[w, k] = change
        found.noise[w, k] = noise + real(0.5) * size * reach

    return outer, settle


ITEM = 16  # in an item, an element of a set counts as much, and its slots one each


@cache
def balance_kernel(real, linear, drag: bool, contact: bool, serial: bool):
    """balance(...) of the blocks `some`, or, where these are none, of all."""
    V, Meeting = wp.types.vector(3, real), meeting_type(real, linear)
    Given, Found, F = given_type(real, drag), found_type(real, linear), wp.types.matrix((3, 3), real)
    until = until_function(serial)
    outer, settle = residual_functions(real, linear, drag, contact)
    largest = largest_function(real)

    @wp.func
    def force_of(own: Meeting, slot: int, e: int):
        if own.ends.shape[0] == 0:
            return own.gradient[slot, e]
        f = V()
        plus = own.ends[slot, 0]
        minus = own.ends[slot, 1]
        if slot >= own.nodes:
            f[0] = own.along[plus, e]
        else:
            for d in range(3):
                if plus >= 0:
                    f[d] = own.along[plus + d, e]
                if minus >= 0:
                    f[d] = f[d] - own.along[minus + d, e]
        return f

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def balance(
        given: Given,
        some: wp.array(dtype=int),
        sets: wp.array(dtype=Meeting),
        oblique: wp.array(dtype=int),
        frames: wp.array(dtype=F),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        count: int,
        total: int,
        found: Found,
    ):
        """`count` blocks in each world, in all worlds `total`. The first slot of an element brings its energy.

        `oblique` is the number of a block's frame among `frames`, -1 without; empty where no block has one.
        """
        start = wp.tid()
        for j in range(start, until(start, total)):
            w = j / count
            if flags[STATUS, w] != 0:
                continue
            k = j - w * count
            if some.shape[0] > 0:
                k = some[k]
            i = k + w * given.blocks
            force, size, stiff, change = outer(given, i, k, w, scalars[COEFFICIENT, w])
            noise = wp.abs(change)
            accepted = flags[SLOT, w]
            for n in range(sets.shape[0]):
                own = sets[n]
                f = V()
                large = real(0.0)
                stiffness = linear(0.0)
                more = real(0.0)
                rounding = real(0.0)
                for at in range(own.starts[k], own.starts[k + 1]):
                    item = own.items[at]
                    slot = item % wp.static(ITEM)
                    e = item // wp.static(ITEM) + w * own.elements
                    g = force_of(own, slot, e)
                    f += g
                    large += largest(g)
                    stiffness += own.stiffness[e]
                    if slot == 0:
                        new = own.energy[1 - accepted, e]
                        more += new - own.energy[accepted, e]
                        rounding += wp.abs(new)
                force -= f
                size += large
                stiff += real(stiffness)
                change += more
                noise += rounding
            if oblique.shape[0] > 0:
                if oblique[k] >= 0:
                    force = frames[oblique[k]] * force
            settle(given, found, flags, scalars[LOAD_SCALE, w], i, k, w, force, size, stiff, change, noise)

    return balance

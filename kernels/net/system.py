"""The sparse system of a net: balance of forces at blocks, blocks of H, their product with a vector.

H lies in slices of 32 rows (sliced ELLPACK, Kreutzer et al. 2014): position p = start of the slice + 32 * place in the row + row of
the slice, so that neighbouring threads, on neighbouring rows, touch neighbouring memory; [component][position]. Both lists, of what
meets at a block and of what adds to a position, are made once, so sums come in one order, without atomics.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.drag import block_inertia
from ddg_warp.kernels.element import CPU_OPTIONS, until_function
from ddg_warp.kernels.islands import (
    CLAMPED,
    COEFFICIENT,
    DROWNED,
    ITERATION,
    LOAD_SCALE,
    SLOT,
    STATUS,
    UNBALANCED,
    WANTED,
)
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.net.elements import factor_type, part_function
from ddg_warp.kernels.terms import Term

SLICE = 32  # rows of a slice of H


@cache
def mass_type(real, drag: bool):
    """Masses of the dofs of blocks, of all worlds; with drag, inertia and drag (worlds, blocks)."""
    return wp.array2d(dtype=block_inertia(real)) if drag else wp.array(dtype=wp.types.vector(3, real))


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

    `allowed` is what the residual of a block may be at rtol = 1, over `load_scale`; see `ddg_warp.compile.tolerance`. Moments are
    compared over the length `arm`. What rounding leaves of an edge vector follows from the coordinates of both its ends, `longest`
    apart at most.
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
        rtol: real
        floor: real

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
def residual_functions(real, linear, drag: bool):
    """outer(...): loads, gravity, inertia and drag of a block; settle(...): its residual, and whether that balances."""
    V, H = wp.types.vector(3, real), wp.types.vector(3, linear)
    Given, Found = given_type(real, drag), found_type(real, linear)

    @wp.func
    def outer(given: Given, i: int, k: int, w: int, c: real):
        """Force; its size and stiffness, the work along the step."""
        x = given.q[i]
        force = given.load[i]
        if wp.static(drag):
            m = given.mass[w, k].mass
        else:
            m = given.mass[k]
        if k < given.nodes:
            force += wp.cw_mul(m, given.gravity[0])
        inertia = wp.cw_mul(m, x - given.target[i]) * c
        u = x - given.base[i]
        change = wp.dot(u, inertia - wp.cw_mul(m, u) * (real(0.5) * c) - force)
        stiff = c * wp.max(m)
        if wp.static(drag):
            resistance = given.mass[w, k].resistance
            held_back = resistance * (x - given.mass[w, k].carried)
            inertia += held_back
            change += wp.dot(u, held_back - resistance * u * real(0.5))
            stiff += wp.max(wp.get_diag(resistance))
        return force - inertia, wp.max(wp.abs(force)), stiff, change

    @wp.func
    def settle(
        given: Given,
        found: Found,
        flags: wp.array2d(dtype=int),
        load_scale: real,
        i: int,
        k: int,
        w: int,
        force: V,
        size: real,
        stiff: real,
        change: real,
        noise: real,
    ):
        """See `kernels.balance` for the criterion."""
        mask = int(given.fixed[k])
        length = wp.where(k < given.nodes, real(1.0), given.arm)
        reach = wp.max(wp.abs(given.q[i])) + given.longest
        if k >= given.nodes:
            reach += real(1.0)
        limit = given.rtol * load_scale * given.allowed[i]
        least = given.floor * (stiff * reach + size)
        found.least[i] = least
        r = H()
        square = real(0.0)
        largest = real(0.0)
        for d in range(3):
            if ((mask >> d) & 1) == 0:
                largest = wp.max(largest, wp.abs(force[d]))
                r[d] = linear(force[d])
                square += force[d] * force[d]
                if not wp.abs(force[d]) <= limit:
                    flags[DROWNED, w] = 1
                    if not wp.abs(force[d]) <= least:
                        flags[UNBALANCED, w] = 1
        found.right[i] = r
        found.ratio[w, k] = largest / given.allowed[i]
        found.square[w, k] = square / (length * length)
        found.change[w, k] = change
        found.noise[w, k] = noise + real(0.5) * size * reach

    return outer, settle


ITEM = 16  # in an item, an element of a set counts as much, and its slots one each


@cache
def balance_kernel(real, linear, drag: bool, serial: bool):
    """balance(...) of the blocks `some`, or, where these are none, of all."""
    V, Meeting = wp.types.vector(3, real), meeting_type(real, linear)
    Given, Found, F = given_type(real, drag), found_type(real, linear), wp.types.matrix((3, 3), real)
    until = until_function(serial)
    outer, settle = residual_functions(real, linear, drag)

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
                    large += wp.max(wp.abs(g))
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


@cache
def contributions(linear, local: bool):
    """What a set adds to H: its factor rows (see `factor_type`), geometric stiffness, second derivatives, items of each position."""
    Factor = factor_type(linear, local)

    @wp.struct
    class Contributions:
        factor: Factor
        tension: wp.array2d(dtype=linear)
        second: wp.array2d(dtype=linear)
        starts: wp.array(dtype=int)
        items: wp.array(dtype=int)
        elements: int

    return Contributions


@cache
def second_function(measure: Measure, linear):
    """block(second, e, a, b): what the packed second derivatives of an element (`Measure.packed`) are between two of its slots."""
    size, angles = measure.size, 3 * len(measure.edges)
    spins = angles + measure.angles
    M, I = wp.types.matrix((3, 3), linear), wp.types.vector(measure.slots, int)
    plus, minus = (I(*of) for of in measure.ends)

    @wp.func
    def part(second: wp.array2d(dtype=linear), e: int, p: int, q: int):
        """Between the dofs from p and those from q on: three of an edge or a rotation, one of an angle; -1 for none."""
        m = M()
        if p >= 0 and q >= 0:
            for i in range(3):
                for j in range(3):
                    if (i == 0 or p < wp.static(angles) or p >= wp.static(spins)) and (
                        j == 0 or q < wp.static(angles) or q >= wp.static(spins)
                    ):
                        low = wp.min(p + i, q + j)
                        m[i, j] = second[low * wp.static(size) - low * (low - 1) / 2 + wp.abs(p + i - q - j), e]
        return m

    @wp.func
    def block(second: wp.array2d(dtype=linear), e: int, a: int, b: int):
        m = part(second, e, plus[a], plus[b]) + part(second, e, minus[a], minus[b])
        return m - part(second, e, plus[a], minus[b]) - part(second, e, minus[a], plus[b])

    return block


@cache
def sum_function(term: Term, linear, exact: bool, local: bool):
    """add(contributions, position, world, late): F^T F and geometric stiffness of one set.

    If `exact`, also the second derivatives, where it is `late` enough for these.

    An item is (element * slots + row's slot) * slots + column's slot.
    """
    measure = term.measure
    M, Contributions = wp.types.matrix((3, 3), linear), contributions(linear, local)
    n, slots, size, tensions = len(measure.strains), measure.slots, measure.size, measure.tensions
    edges = measure.edges[:2]  # geometric stiffness is between the first two
    second_of = second_function(measure, linear) if exact else None
    part = part_function(measure, linear) if local else None

    @wp.func
    def row(own: Contributions, m: int, slot: int, e: int):
        """What a row of the factor has for a slot."""
        if wp.static(local):
            return part(own.factor, m * wp.static(size), slot, e)
        else:
            return own.factor[m * wp.static(slots) + slot, e]

    @wp.func
    def weight(edge_first: int, edge_second: int, slot: int):
        """How an edge vector depends on the node of a slot."""
        c = linear(0.0)
        if slot == edge_first:
            c -= linear(1.0)
        if slot == edge_second:
            c += linear(1.0)
        return c

    @wp.func
    def geometric(tension: wp.array2d(dtype=linear), e: int, a: int, b: int):
        a1 = weight(wp.static(edges[0][0]), wp.static(edges[0][1]), a)
        b1 = weight(wp.static(edges[0][0]), wp.static(edges[0][1]), b)
        c = tension[0, e] * a1 * b1
        if wp.static(tensions == 3):
            a2 = weight(wp.static(edges[-1][0]), wp.static(edges[-1][1]), a)
            b2 = weight(wp.static(edges[-1][0]), wp.static(edges[-1][1]), b)
            c += tension[1, e] * (a1 * b2 + a2 * b1) + tension[2, e] * a2 * b2
        return c

    @wp.func
    def add(own: Contributions, at: int, w: int, late: bool):
        m = M()
        for index in range(own.starts[at], own.starts[at + 1]):
            item = own.items[index]
            pair = item / wp.static(slots)
            b = item - pair * wp.static(slots)
            e = pair / wp.static(slots)
            a = pair - e * wp.static(slots)
            e += w * own.elements
            for i in range(wp.static(n)):
                m += wp.outer(row(own, i, a, e), row(own, i, b, e))
            if wp.static(tensions > 0):
                c = geometric(own.tension, e, a, b)
                for d in range(3):
                    m[d, d] = m[d, d] + c
            if wp.static(exact):
                if late:
                    m += second_of(own.second, e, a, b)
        return m

    return add


SETS = 6  # sets that one launch sums


@cache
def assemble_kernel(
    terms: tuple[Term, ...],
    real,
    linear,
    begins: bool,
    exact_from: tuple[int | None, ...],
    local: tuple[bool, ...],
    drag: bool,
    serial: bool,
):
    """H of up to `SETS` sets, a thread a position, with inertia and drag where it `begins`; else it adds to what is there.

    `exact_from` says of each set from which iteration on it has second derivatives, one for all, or None where it has none; `local`,
    how its factor is written.
    """
    M, Mass, until = wp.types.matrix((3, 3), linear), mass_type(real, drag), until_function(serial)
    sums = tuple(
        sum_function(term, linear, first is not None, own)
        for term, first, own in zip(terms, exact_from, local, strict=True)
    )
    begin = next((first for first in exact_from if first is not None), 0)
    count = len(terms)
    last = count - 1
    Own0, Own1, Own2, Own3, Own4, Own5 = (contributions(linear, local[min(i, last)]) for i in range(SETS))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def assemble(
        mass: Mass,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        rows: wp.array(dtype=int),
        columns: wp.array(dtype=int),
        positions: int,
        own0: Own0,
        own1: Own1,
        own2: Own2,
        own3: Own3,
        own4: Own4,
        own5: Own5,
        matrix: wp.array2d(dtype=linear),
    ):
        start = wp.tid()
        for p in range(start, until(start, matrix.shape[1])):
            w = p / positions
            if flags[WANTED, w] == 0:
                continue
            # what is wanted has been counted as an iteration since it was evaluated
            late = flags[ITERATION, w] > wp.static(begin) and flags[CLAMPED, w] == 0
            at = p - w * positions
            row = rows[at]
            if row < 0:
                continue  # padding stays zero
            m = M()
            if wp.static(begins):
                if row == columns[at]:
                    if wp.static(drag):
                        inertia = mass[w, row].mass * scalars[COEFFICIENT, w]
                    else:
                        inertia = mass[row] * scalars[COEFFICIENT, w]
                    for d in range(3):
                        m[d, d] = linear(inertia[d])
                    if wp.static(drag):
                        resistance = mass[w, row].resistance
                        for i in range(3):
                            for j in range(3):
                                m[i, j] = m[i, j] + linear(resistance[i, j])
            else:
                for i in range(3):
                    for j in range(3):
                        m[i, j] = matrix[3 * i + j, p]
            m += wp.static(sums[0])(own0, at, w, late)
            if wp.static(count > 1):
                m += wp.static(sums[min(1, last)])(own1, at, w, late)
            if wp.static(count > 2):
                m += wp.static(sums[min(2, last)])(own2, at, w, late)
            if wp.static(count > 3):
                m += wp.static(sums[min(3, last)])(own3, at, w, late)
            if wp.static(count > 4):
                m += wp.static(sums[min(4, last)])(own4, at, w, late)
            if wp.static(count > 5):
                m += wp.static(sums[min(5, last)])(own5, at, w, late)
            for i in range(3):
                for j in range(3):
                    matrix[3 * i + j, p] = m[i, j]

    return assemble


@cache
def product_functions(linear):
    """times(...): row of H v; free(mask): 1 at free dofs and 0 at held ones."""
    H = wp.types.vector(3, linear)

    @wp.func
    def free(mask: wp.uint8):
        v = H()
        for d in range(3):
            v[d] = linear(1 - ((int(mask) >> d) & 1))
        return v

    @wp.func
    def times(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        slices: wp.array(dtype=int),
        v: wp.array(dtype=H),
        row: int,
        first: int,
        shift: int,
    ):
        """Row `row` of H of a world whose positions begin at `first` and blocks at `shift`."""
        y = H()
        slice = row / wp.static(SLICE)
        start = slices[slice] + row - slice * wp.static(SLICE)
        for p in range(start, slices[slice + 1], wp.static(SLICE)):
            j = columns[p]
            if j >= 0:
                at = p + first
                x = v[j + shift]
                y[0] = y[0] + matrix[0, at] * x[0] + matrix[1, at] * x[1] + matrix[2, at] * x[2]
                y[1] = y[1] + matrix[3, at] * x[0] + matrix[4, at] * x[1] + matrix[5, at] * x[2]
                y[2] = y[2] + matrix[6, at] * x[0] + matrix[7, at] * x[1] + matrix[8, at] * x[2]
        return y

    return times, free

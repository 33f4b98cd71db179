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
from ddg_warp.kernels.terms import Term

SLICE = 32  # rows of a slice of H


@cache
def mass_type(real, drag: bool):
    """Masses of the dofs of blocks, of all worlds; with drag, inertia and drag (worlds, blocks)."""
    return wp.array2d(dtype=block_inertia(real)) if drag else wp.array(dtype=wp.types.vector(3, real))


@cache
def meeting_type(real, linear):
    """What the elements of a set bring to the blocks that they meet at; an item is element * slots + slot."""
    V = wp.types.vector(3, real)

    @wp.struct
    class Meeting:
        gradient: wp.array2d(dtype=V)
        energy: wp.array2d(dtype=real)
        stiffness: wp.array(dtype=linear)
        starts: wp.array(dtype=int)
        items: wp.array(dtype=int)
        slots: int
        elements: int

    return Meeting


@cache
def balance_kernel(real, linear, drag: bool, serial: bool):
    """balance(...): the residual of every block and whether it balances, the change of its energy along the step from `base`."""
    V, H, Mass = wp.types.vector(3, real), wp.types.vector(3, linear), mass_type(real, drag)
    until = until_function(serial)
    F, Meeting = wp.types.matrix((3, 3), real), meeting_type(real, linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def balance(
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        target: wp.array(dtype=V),
        mass: Mass,
        gravity: wp.array(dtype=V),
        load: wp.array(dtype=V),
        sets: wp.array(dtype=Meeting),
        oblique: wp.array(dtype=int),
        frames: wp.array(dtype=F),
        fixed: wp.array(dtype=wp.uint8),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        allowed: wp.array(dtype=real),
        blocks: int,
        nodes: int,
        arm: real,
        longest: real,
        rtol: real,
        floor: real,
        right_out: wp.array(dtype=H),
        least_out: wp.array(dtype=real),
        ratio_out: wp.array2d(dtype=real),
        square_out: wp.array2d(dtype=real),
        change_out: wp.array2d(dtype=real),
        noise_out: wp.array2d(dtype=real),
    ):
        """Loads, gravity and inertia, then the forces of all sets; the first slot of an element brings its energy.

        Residuals are those of free dofs, their squares with moments over the length `arm`; see `kernels.balance` for the criterion.
        `allowed` is what the residual of a block may be at rtol = 1, over `load_scale`, and `ratio_out` how often it is that; see
        `ddg_warp.compile.tolerance`. What rounding leaves of an edge vector follows from the coordinates of both its ends, `longest`
        apart at most. `oblique` is the number of a block's frame among `frames`, -1 without; empty where no block has one.
        """
        start = wp.tid()
        for i in range(start, until(start, q.shape[0])):
            w = i / blocks
            if flags[STATUS, w] != 0:
                continue
            k = i - w * blocks
            x = q[i]
            force = load[i]
            if wp.static(drag):
                m = mass[w, k].mass
            else:
                m = mass[k]
            if k < nodes:
                force += wp.cw_mul(m, gravity[0])
            c = scalars[COEFFICIENT, w]
            inertia = wp.cw_mul(m, x - target[i]) * c
            u = x - base[i]
            change = wp.dot(u, inertia - wp.cw_mul(m, u) * (real(0.5) * c) - force)
            stiff = c * wp.max(m)
            if wp.static(drag):
                resistance = mass[w, k].resistance
                held_back = resistance * (x - mass[w, k].carried)
                inertia += held_back
                change += wp.dot(u, held_back - resistance * u * real(0.5))
                stiff += wp.max(wp.get_diag(resistance))
            size = wp.max(wp.abs(force))
            force -= inertia
            noise = wp.abs(change)
            accepted = flags[SLOT, w]
            for j in range(sets.shape[0]):
                own = sets[j]
                f = V()
                large = real(0.0)
                stiffness = linear(0.0)
                more = real(0.0)
                rounding = real(0.0)
                for at in range(own.starts[k], own.starts[k + 1]):
                    item = own.items[at]
                    e = item / own.slots
                    s = item - e * own.slots
                    e += w * own.elements
                    g = own.gradient[s, e]
                    f += g
                    large += wp.max(wp.abs(g))
                    stiffness += own.stiffness[e]
                    if s == 0:
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
            mask = int(fixed[k])
            length = wp.where(k < nodes, real(1.0), arm)
            reach = wp.max(wp.abs(x)) + longest
            if k >= nodes:
                reach += real(1.0)
            limit = rtol * scalars[LOAD_SCALE, w] * allowed[i]
            least = floor * (stiff * reach + size)
            least_out[i] = least
            r = H()
            square = real(0.0)
            ratio = real(0.0)
            for d in range(3):
                if ((mask >> d) & 1) == 0:
                    ratio = wp.max(ratio, wp.abs(force[d]) / allowed[i])
                    r[d] = linear(force[d])
                    square += force[d] * force[d] / (length * length)
                    if not wp.abs(force[d]) <= limit:
                        flags[DROWNED, w] = 1
                        if not wp.abs(force[d]) <= least:
                            flags[UNBALANCED, w] = 1
            right_out[i] = r
            ratio_out[w, k] = ratio
            square_out[w, k] = square
            change_out[w, k] = change
            noise_out[w, k] = noise + real(0.5) * size * reach

    return balance


@cache
def contributions(linear):
    """What a set adds to H: its factor rows, geometric stiffness, second derivatives, and the items of each position."""
    H = wp.types.vector(3, linear)

    @wp.struct
    class Contributions:
        factor: wp.array2d(dtype=H)
        tension: wp.array2d(dtype=linear)
        second: wp.array2d(dtype=linear)
        starts: wp.array(dtype=int)
        items: wp.array(dtype=int)
        elements: int

    return Contributions


@cache
def second_function(measure: Measure, linear):
    """block(second, e, a, b): what the packed second derivatives of an element (`Measure.packed`) are between two of its slots.

    A node sees the edge that ends in it with weight 1 and that which starts in it with -1, angles and rotations see themselves.
    """
    size, angles = measure.size, 3 * len(measure.edges)
    spins = angles + measure.angles
    own = [*range(angles, spins), *range(spins, size, 3)]  # first dofs of angles and rotations
    ends = [{edge[end]: 3 * i for i, edge in enumerate(measure.edges)} for end in (0, 1)]
    M, I = wp.types.matrix((3, 3), linear), wp.types.vector(measure.slots, int)
    minus, plus = (
        I(*(end.get(node, -1) for node in range(measure.nodes)), *more)
        for end, more in zip(ends, ([-1] * len(own), own), strict=True)
    )

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
def sum_function(term: Term, linear, exact: bool):
    """add(contributions, position, world, late): F^T F and geometric stiffness of one set.

    If `exact`, also the second derivatives, where it is `late` enough for these.

    An item is (element * slots + row's slot) * slots + column's slot.
    """
    measure = term.measure
    M, Contributions = wp.types.matrix((3, 3), linear), contributions(linear)
    n, slots, tensions = len(measure.strains), measure.slots, measure.tensions
    edges = measure.edges[:2]  # geometric stiffness is between the first two
    second_of = second_function(measure, linear) if exact else None

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
                m += wp.outer(own.factor[i * wp.static(slots) + a, e], own.factor[i * wp.static(slots) + b, e])
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
    terms: tuple[Term, ...], real, linear, begins: bool, exact_from: tuple[int | None, ...], drag: bool = False
):
    """H of up to `SETS` sets, a thread a position, with inertia and drag where it `begins`; else it adds to what is there.

    `exact_from` says of each set from which iteration on it has second derivatives, one for all, or None where it has none.
    """
    M, Mass = wp.types.matrix((3, 3), linear), mass_type(real, drag)
    Contributions = contributions(linear)
    sums = tuple(sum_function(term, linear, first is not None) for term, first in zip(terms, exact_from, strict=True))
    begin = next((first for first in exact_from if first is not None), 0)
    count = len(terms)
    last = count - 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def assemble(
        mass: Mass,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        rows: wp.array(dtype=int),
        columns: wp.array(dtype=int),
        positions: int,
        own0: Contributions,
        own1: Contributions,
        own2: Contributions,
        own3: Contributions,
        own4: Contributions,
        own5: Contributions,
        matrix: wp.array2d(dtype=linear),
    ):
        p = wp.tid()
        w = p / positions
        if flags[WANTED, w] == 0:
            return
        # what is wanted has been counted as an iteration since it was evaluated
        late = flags[ITERATION, w] > wp.static(begin) and flags[CLAMPED, w] == 0
        at = p - w * positions
        row = rows[at]
        if row < 0:
            return  # padding stays zero
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

"""The sparse system of a net: blocks of H by index, their product with a vector.

H lies in slices of 32 rows (sliced ELLPACK, Kreutzer et al. 2014): position p = start of the slice + 32 * place in the row + row of
the slice, so that neighbouring threads, on neighbouring rows, touch neighbouring memory; [component][position]. What adds to a position
is listed once, so sums come in one order, without atomics.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.drag import mass_type
from ddg_warp.kernels.islands import CLAMPED, COEFFICIENT, ITERATION, WANTED
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.net.elements import factor_type, part_function
from ddg_warp.kernels.terms import Term
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function

SLICE = 32  # rows of a slice of H
BARRED = wp.constant(wp.uint8(7))  # bits of a block none of whose dofs takes part in a direction


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
    size, (angles, spins, _) = measure.size, measure.starts
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


@cache
def inertia_function(real, linear, drag: bool):
    """inertia_of(mass, coefficient, world, block): what inertia and drag bring to H."""
    M, Mass = wp.types.matrix((3, 3), linear), mass_type(real, drag)

    @wp.func
    def inertia_of(mass: Mass, coefficient: real, w: int, block: int):
        m = M()
        if wp.static(drag):
            inertia = mass[w, block].mass * coefficient
        else:
            inertia = mass[w, block] * coefficient
        for d in range(3):
            m[d, d] = linear(inertia[d])
        if wp.static(drag):
            resistance = mass[w, block].resistance
            for i in range(3):
                for j in range(3):
                    m[i, j] = m[i, j] + linear(resistance[i, j])
        return m

    return inertia_of


# Sets that one launch sums, each an argument of its own. As one array of structs, which is read from memory instead of the constants of
# a launch, the kernel took 64 registers for sm_90 instead of 48, and 3 % longer on the CPU.
SETS = 6


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
    inertia_of = inertia_function(real, linear, drag)
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
                    m = inertia_of(mass, scalars[COEFFICIENT, w], w, row)
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


@cache
def settle_function(linear):
    """settle(...): writes H p of a block with y, what else comes to it, on dofs that are not barred, and p . H p."""
    H = wp.types.vector(3, linear)
    times, free = product_functions(linear)

    @wp.func
    def settle(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        slices: wp.array(dtype=int),
        barred: wp.array(dtype=wp.uint8),
        p: wp.array(dtype=H),
        blocks: int,
        positions: int,
        b: int,
        w: int,
        y: H,
        product_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        i = b + w * blocks
        if barred[i] == BARRED:
            y = H()
        else:
            y += times(matrix, columns, slices, p, b, w * positions, w * blocks)
            y = wp.cw_mul(y, free(barred[i]))
        product_out[i] = y
        dots_out[w, b] = wp.dot(p[i], y)

    return settle

"""Sparse matrix of the coupled system: blocks of H by dof block, and their product with a vector.

H is stored in slices of 32 rows (sliced ELLPACK, Kreutzer et al. 2014). Position p = start of the slice + 32 * index in the row + row
of the slice: neighbouring threads, on neighbouring rows, read neighbouring memory. Arrays are [component][position]. Contributions to
a position are listed, so that sums have a fixed order, without atomics.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import mass_type
from ddg_warp.kernels.core.islands import DROP_COMPRESSION, INERTIA_COEFFICIENT, ITERATION, NEEDS_DIRECTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.elements.coupled_element import factor_type, part_function
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.terms import Term

SLICE = 32  # rows of a slice of H
ALL_INACTIVE = wp.constant(wp.uint8(7))  # bits of a dof block without active dofs


@cache
def contributions(linear, local: bool):
    """Return the struct of a set's data for H: factor rows (see `factor_type`), geometric stiffness, incidence list."""
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
    """Return the device function `block(second, e, a, b)`: second derivatives between local nodes a and b of an element.

    They are packed as in `Measure.packed`.
    """
    size, (angles, spins, _) = measure.size, measure.starts
    M, I = wp.types.matrix((3, 3), linear), wp.types.vector(measure.slots, int)
    plus, minus = (I(*first_dofs) for first_dofs in measure.ends)

    @wp.func
    def part(second: wp.array2d(dtype=linear), e: int, p: int, q: int):
        """Return the block of dofs from p and q on: three of an edge or a rotation, one of a twist angle; -1 for none."""
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
    """Return the device function `add(contributions, position, world, with_second)`: F^T F and geometric stiffness of one set.

    If `exact`, second derivatives are added where `with_second`. Items are
    `(element * slots + a) * slots + b` with the local nodes a of the row and b of the column.
    """
    measure = term.measure
    M, Contributions = wp.types.matrix((3, 3), linear), contributions(linear, local)
    n, slots, size, tensions = len(measure.strains), measure.slots, measure.size, measure.tensions
    edges = measure.edges[:2]  # geometric stiffness concerns the first two
    second_of = second_function(measure, linear) if exact else None
    part = part_function(measure, linear) if local else None

    @wp.func
    def row(element_set: Contributions, m: int, local_node: int, e: int):
        """Return the entries of a factor row at a local node."""
        if wp.static(local):
            return part(element_set.factor, m * wp.static(size), local_node, e)
        else:
            return element_set.factor[m * wp.static(slots) + local_node, e]

    @wp.func
    def weight(edge_first: int, edge_second: int, local_node: int):
        """Return the derivative of an edge vector with respect to a local node."""
        c = linear(0.0)
        if local_node == edge_first:
            c -= linear(1.0)
        if local_node == edge_second:
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
    def add(element_set: Contributions, position: int, w: int, with_second: bool):
        m = M()
        for index in range(element_set.starts[position], element_set.starts[position + 1]):
            item = element_set.items[index]
            pair = item / wp.static(slots)
            b = item - pair * wp.static(slots)
            e = pair / wp.static(slots)
            a = pair - e * wp.static(slots)
            e += w * element_set.elements
            for i in range(wp.static(n)):
                m += wp.outer(row(element_set, i, a, e), row(element_set, i, b, e))
            if wp.static(tensions > 0):
                c = geometric(element_set.tension, e, a, b)
                for d in range(3):
                    m[d, d] = m[d, d] + c
            if wp.static(exact):
                if with_second:
                    m += second_of(element_set.second, e, a, b)
        return m

    return add


@cache
def inertia_function(real, linear, quadratic: bool):
    """Return the device function `inertia_of(mass, coefficient, w, block)`: the inertia of a dof block in H."""
    M, Mass = wp.types.matrix((3, 3), linear), mass_type(real, quadratic)

    @wp.func
    def inertia_of(mass: Mass, coefficient: real, w: int, block: int):
        m = M()
        if wp.static(quadratic):
            inertia = mass[w, block].mass * coefficient
        else:
            inertia = mass[w, block] * coefficient
        for d in range(3):
            m[d, d] = linear(inertia[d])
        if wp.static(quadratic):
            stiffness = mass[w, block].stiffness
            for i in range(3):
                for j in range(3):
                    m[i, j] = m[i, j] + linear(stiffness[i, j])
        return m

    return inertia_of


# Element sets summed in one launch, each an argument. Measured: as one array of structs, read from memory instead of launch
# constants, the kernel takes 64 registers for sm_90 instead of 48, and 3 % more time on the CPU.
SETS = 6


@cache
def assemble_kernel(
    terms: tuple[Term, ...],
    real,
    linear,
    begins: bool,
    exact_from: tuple[int | None, ...],
    local: tuple[bool, ...],
    quadratic: bool,
    angles: bool,
    serial: bool,
):
    """Build the kernel of assembly.

    `assemble`: write or update H with up to `SETS` element sets, one thread a position.

    The kernel that `begins` adds the inertia; others add to H. `exact_from`: for each set, the first iteration with second
    derivatives, the same for all, or None without. `local`: layout of the set's factor. `angles`:
    True if some blocks are twist angles, see `product_functions`.
    """
    M, Mass, until = wp.types.matrix((3, 3), linear), mass_type(real, quadratic), until_function(serial)
    sums = tuple(
        sum_function(term, linear, first is not None, is_local)
        for term, first, is_local in zip(terms, exact_from, local, strict=True)
    )
    begin = next((first for first in exact_from if first is not None), 0)
    inertia_of = inertia_function(real, linear, quadratic)
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
        nodes: int,
        angles_end: int,
        set0: Own0,
        set1: Own1,
        set2: Own2,
        set3: Own3,
        set4: Own4,
        set5: Own5,
        matrix: wp.array2d(dtype=linear),
    ):
        start = wp.tid()
        for p in range(start, until(start, matrix.shape[1])):
            w = p / positions
            if flags[NEEDS_DIRECTION, w] == 0:
                continue
            # the iteration has been counted since its evaluation
            with_second = flags[ITERATION, w] > wp.static(begin) and flags[DROP_COMPRESSION, w] == 0
            position = p - w * positions
            row = rows[position]
            if row < 0:
                continue  # padding stays zero
            m = M()
            if wp.static(begins):
                if row == columns[position]:
                    m = inertia_of(mass, scalars[INERTIA_COEFFICIENT, w], w, row)
            else:
                for i in range(3):
                    for j in range(3):
                        m[i, j] = matrix[3 * i + j, p]
            m += wp.static(sums[0])(set0, position, w, with_second)
            if wp.static(count > 1):
                m += wp.static(sums[min(1, last)])(set1, position, w, with_second)
            if wp.static(count > 2):
                m += wp.static(sums[min(2, last)])(set2, position, w, with_second)
            if wp.static(count > 3):
                m += wp.static(sums[min(3, last)])(set3, position, w, with_second)
            if wp.static(count > 4):
                m += wp.static(sums[min(4, last)])(set4, position, w, with_second)
            if wp.static(count > 5):
                m += wp.static(sums[min(5, last)])(set5, position, w, with_second)
            whole_row, whole_column = True, True
            if wp.static(angles):
                column = columns[position]
                whole_row = row < nodes or row >= angles_end
                whole_column = column < nodes or column >= angles_end
            for i in range(3):
                for j in range(3):
                    if (i == 0 or whole_row) and (j == 0 or whole_column):
                        matrix[3 * i + j, p] = m[i, j]

    return assemble


@cache
def product_functions(linear, angles: bool = False):
    """Return the device functions `times` and `free`.

    `times(...)`: one row of H v; with `angles` among the blocks if true.
    `free(mask)`: 1 at free dofs, 0 at fixed ones.
    """
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
        nodes: int,
        angles_end: int,
    ):
        """Return row `row` of H v in a world with positions from `first` and dof blocks from `shift` on.

        Blocks from `nodes` to `angles_end` are twist angles: other components than the first are zero, and not read.
        """
        y = H()
        whole_row = row < nodes or row >= angles_end
        slice = row / wp.static(SLICE)
        start = slices[slice] + row - slice * wp.static(SLICE)
        for p in range(start, slices[slice + 1], wp.static(SLICE)):
            j = columns[p]
            if j >= 0:
                entry = p + first
                x = v[j + shift]
                if wp.static(angles):
                    if j >= nodes and j < angles_end:
                        y[0] = y[0] + matrix[0, entry] * x[0]
                        if whole_row:
                            y[1] = y[1] + matrix[3, entry] * x[0]
                            y[2] = y[2] + matrix[6, entry] * x[0]
                        continue
                    if not whole_row:
                        y[0] = y[0] + matrix[0, entry] * x[0] + matrix[1, entry] * x[1] + matrix[2, entry] * x[2]
                        continue
                y[0] = y[0] + matrix[0, entry] * x[0] + matrix[1, entry] * x[1] + matrix[2, entry] * x[2]
                y[1] = y[1] + matrix[3, entry] * x[0] + matrix[4, entry] * x[1] + matrix[5, entry] * x[2]
                y[2] = y[2] + matrix[6, entry] * x[0] + matrix[7, entry] * x[1] + matrix[8, entry] * x[2]
        return y

    return times, free


@cache
def settle_function(linear, angles: bool = False):
    """Return the device function `settle(...)`, which writes H p of a dof block, and p . H p.

    `y` is added to H p; inactive dofs get zero. `angles`: see `product_functions`.
    """
    H = wp.types.vector(3, linear)
    times, free = product_functions(linear, angles)

    @wp.func
    def settle(
        matrix: wp.array2d(dtype=linear),
        columns: wp.array(dtype=int),
        slices: wp.array(dtype=int),
        inactive_mask: wp.array(dtype=wp.uint8),
        p: wp.array(dtype=H),
        blocks: int,
        positions: int,
        nodes: int,
        angles_end: int,
        b: int,
        w: int,
        y: H,
        product_out: wp.array(dtype=H),
        dots_out: wp.array2d(dtype=linear),
    ):
        i = b + w * blocks
        if inactive_mask[i] == ALL_INACTIVE:
            y = H()
        else:
            y += times(matrix, columns, slices, p, b, w * positions, w * blocks, nodes, angles_end)
            y = wp.cw_mul(y, free(inactive_mask[i]))
        product_out[i] = y
        dots_out[w, b] = wp.dot(p[i], y)

    return settle

"""Elements of the coupled system: their dofs, found by index, and their storage.

All dofs lie in blocks of three reals: positions of nodes, then an angle each (in component 0), then rotation vectors of rigid
joints. The *local nodes* of an element are its nodes, its angles and its rotation vectors, each with the index of a block.
Derivatives are written by local node, so that their assembly needs block indices only. Worlds are consecutive: block i of world w
is w * blocks + i, element i of world w is w * elements + i. Topology and constant data are stored once.

The lagged data of an element are, in this order: (u, t) of the rod edges its angles belong to, its own lagged rows, its data. Data
are common to all worlds, except where supports rotate normals among them.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.elements.element_path import (
    ElementStorage,
    TermAccess,
    measure_functions,
    parameter_function,
    write_rows_function,
)
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.terms import Term

FRAME = 6  # reals of the reference frame of an edge: first director and tangent


@cache
def elements_type(real):
    """Return the struct that every kernel of a term reads: dofs and lagged data of the coupled system, and an element set."""
    V, R, I = wp.types.vector(3, real), wp.array2d(dtype=real), wp.array2d(dtype=int)

    @wp.struct
    class Elements:
        q: wp.array(dtype=V)
        frame: R
        lag: R
        last: R  # strains of the last step
        rate: wp.array(dtype=real)
        buffer: wp.array(dtype=real)
        table: I
        slots: I
        data: R
        blocks: int
        angle_start: int
        edges: int
        elements: int

    return Elements


@cache
def edge_ends(measure: Measure):
    """Return the first and second nodes of a stencil's edges as Warp constants, which a loop variable may index.

    Alternative: `wp.static` of an edge. It is resolved only when a kernel is built, and would make the hash of every kernel depend
    on the kernels built before it.
    """
    I = wp.types.vector(max(1, len(measure.edges)), int)
    return tuple(I(*(edge[end] for edge in measure.edges)) for end in (0, 1))


@cache
def place_function(measure: Measure, real):
    """Return the device function `place(inputs, q, w, e) -> (q, s)`: local dofs and lagged data of element e of world w."""
    Elements = elements_type(real)
    V = wp.types.vector(3, real)
    Q, S, _, _ = measure.types(real)
    nodes, angles, spins, edge_count = measure.nodes, measure.angles, measure.spins, len(measure.edges)
    frames, own_rows, data_size = measure.frames, measure.lag_size - FRAME * measure.frames, measure.data_size
    points, (angle_row, spin_row, point_row), (first, second) = measure.points, measure.starts, edge_ends(measure)

    @wp.func
    def place(inputs: Elements, q: wp.array(dtype=V), w: int, e: int):
        tid = e + w * inputs.elements
        shift = w * inputs.blocks
        local = Q()
        for i in range(wp.static(edge_count)):
            edge = q[inputs.slots[second[i], e] + shift] - q[inputs.slots[first[i], e] + shift]
            for d in range(3):
                local[3 * i + d] = edge[d]
        for i in range(wp.static(angles)):
            angle = q[inputs.slots[wp.static(nodes) + i, e] + shift]
            local[wp.static(angle_row) + i] = angle[0]
        for i in range(wp.static(spins)):
            spin = q[inputs.slots[wp.static(nodes + angles) + i, e] + shift]
            for d in range(3):
                local[wp.static(spin_row) + 3 * i + d] = spin[d]
        for i in range(wp.static(points)):
            position = q[inputs.slots[i, e] + shift]
            for d in range(3):
                local[wp.static(point_row) + 3 * i + d] = position[d]
        s = S()
        for i in range(wp.static(frames)):
            f = inputs.slots[wp.static(nodes) + i, e] - inputs.angle_start + w * inputs.edges
            for c in range(wp.static(FRAME)):
                s[wp.static(FRAME) * i + c] = inputs.frame[c, f]
        for c in range(wp.static(own_rows)):
            s[wp.static(FRAME * frames) + c] = inputs.lag[c, tid]
        if wp.static(data_size > 0):
            column = wp.where(inputs.data.shape[1] > inputs.elements, tid, e)
            for c in range(wp.static(data_size)):
                s[wp.static(FRAME * frames + own_rows) + c] = inputs.data[c, column]
        return local, s

    return place


@cache
def spread_function(measure: Measure, real):
    """Return the device function `spread(f, slot)`: derivative by the dof block of a local node, from that by the local dofs."""
    V = wp.types.vector(3, real)
    Q, _, _, _ = measure.types(real)
    nodes, angles, spins, edge_count = measure.nodes, measure.angles, measure.spins, len(measure.edges)
    points, (angle_row, spin_row, point_row), (first, second) = measure.points, measure.starts, edge_ends(measure)

    @wp.func
    def spread(f: Q, slot: int):
        """Return the three reals of a local node; `slot` is a constant where this is unrolled."""
        v = V()
        for i in range(wp.static(edge_count)):
            if slot == first[i]:
                v -= V(f[3 * i], f[3 * i + 1], f[3 * i + 2])
            if slot == second[i]:
                v += V(f[3 * i], f[3 * i + 1], f[3 * i + 2])
        for i in range(wp.static(angles)):
            if slot == wp.static(nodes) + i:
                v[0] = f[wp.static(angle_row) + i]
        for i in range(wp.static(spins)):
            if slot == wp.static(nodes + angles) + i:
                for d in range(3):
                    v[d] = f[wp.static(spin_row) + 3 * i + d]
        for i in range(wp.static(points)):
            if slot == i:
                v += V(
                    f[wp.static(point_row) + 3 * i],
                    f[wp.static(point_row + 1) + 3 * i],
                    f[wp.static(point_row + 2) + 3 * i],
                )
        return v

    return spread


def factor_type(linear, local: bool):
    """Return the type of factor rows: reals of the local dofs, or vectors by local node."""
    return wp.array2d(dtype=linear if local else wp.types.vector(3, linear))


@cache
def part_function(measure: Measure, real):
    """Return the device function `part(f, row, slot, e)`: block of a local node of element e in local-dof rows from `row` on.

    For measures whose nodes end at most one edge and start at most one; see `Measure.ends`.
    """
    V, I = wp.types.vector(3, real), wp.types.vector(measure.slots, int)
    plus, minus = (I(*ends) for ends in measure.ends)
    first, spins, _ = measure.starts

    @wp.func
    def part(f: wp.array2d(dtype=real), row: int, slot: int, e: int):
        up = V()
        down = V()
        p = plus[slot]
        m = minus[slot]
        if p >= wp.static(first) and p < wp.static(spins):
            up[0] = f[row + p, e]
        else:
            for d in range(3):
                if p >= 0:
                    up[d] = f[row + p + d, e]
                if m >= 0:
                    down[d] = f[row + m + d, e]
        return up - down

    return part


@cache
def coupled_storage(term: Term, real, slots: bool = True, serial: bool = False) -> ElementStorage:
    """Return the storage of an element set: an island is a world, and dof blocks are found by index.

    Args:
        slots: True if derivatives are vectors [local node][element], instead of reals of the local dofs.
        serial: True if a thread takes all elements of a world.
    """
    measure, Inputs, V = term.measure, elements_type(real), wp.types.vector(3, real)
    Q, S, _, _ = measure.types(real)
    place, spread = place_function(measure, real), spread_function(measure, real)

    @wp.func
    def same(q: Q):
        return q

    @wp.func
    def same_lagged(s: S):
        return s

    @wp.func
    def items(world: int, first: int):
        return world, first

    @wp.func
    def count(inputs: Inputs, world: int):
        return inputs.elements

    @wp.func
    def column(inputs: Inputs, world: int, e: int):
        return wp.max(e + world * inputs.elements, 0)

    @wp.func
    def whole(inputs: Inputs, world: int, e: int):
        return True

    @wp.func
    def read(inputs: Inputs, world: int, e: int, all: bool):
        return place(inputs, inputs.q, world, e)

    @wp.func
    def reach(inputs: Inputs, world: int, e: int):
        return wp.max(wp.abs(inputs.q[inputs.slots[0, e] + world * inputs.blocks]))

    @wp.func
    def displacement(inputs: Inputs, w: wp.array(dtype=V), world: int, e: int, all: bool):
        q, _s = place(inputs, w, world, e)
        return q

    return ElementStorage(
        terms=(TermAccess(term, same, same_lagged, same, *measure_functions(measure, real), slack=measure.tensions),),
        Inputs=Inputs,
        Window=Q,
        Lagged=S,
        items=items,
        last_item=until_function(serial),
        count=count,
        column=column,
        whole=whole,
        read=read,
        reach=reach,
        displacement=displacement,
        Displacements=wp.array(dtype=V),
        slots=spread if slots else None,
        num_slots=measure.slots if slots else 0,
    )


@cache
def linear_stress_kernel(term: Term, real):
    """Build the kernel of stresses at the linearised strains of a step, e + J step."""
    storage, V, n = coupled_storage(term, real), wp.types.vector(3, real), len(term.measure.strains)
    Inputs, items, read = storage.Inputs, storage.items, storage.read
    displacement, column_of = storage.displacement, storage.column
    _, jacobian_of, *_ = term.measure.functions(real)
    _, slope_of, _ = term.density.functions(real, n)
    parameters, write = (
        parameter_function(storage, 0, real),
        write_rows_function(term.measure.types(real)[2], real, real),
    )

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
    def linear_stress(inputs: Inputs, step: wp.array(dtype=V), stress_out: wp.array2d(dtype=real)):
        i, j = wp.tid()
        world, element = items(i, j)
        column = column_of(inputs, world, element)
        w, p = parameters(inputs, world, element, column)
        q, s = read(inputs, world, element, True)
        e, jacobian = jacobian_of(q, s, w)
        write(stress_out, 0, slope_of(e + jacobian * displacement(inputs, step, world, element, True), p), column)

    return linear_stress

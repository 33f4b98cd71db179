"""The element path of nets: gather by index -> strains and Jacobian -> energy | gradient | factor | Hessian, per element.

All dofs lie in blocks of three reals: positions of nodes, then an angle each (in component 0), then rotation vectors of rigid
joints. An element has *slots*: its nodes, its angles, its rotation vectors, each with the index of a block. Derivatives are
written a slot, so that whoever gathers them knows blocks only. Worlds lie behind each other: block i of world w is
w * blocks + i, element i of world w is w * elements + i; topology and constant data are stored once.

The lagged data of an element are, in this order: (u, t) of the rod edges its angles belong to, its own lagged rows, its data. Data
are shared by all worlds, or, where supports turn normals among them, each world has its own.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.evaluate import carried_function, left_out_function
from ddg_warp.kernels.islands import CARRIED, CLAMPED, ITERATION, SLOT, STALE, STATUS
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.terms import Term
from ddg_warp.kernels.threads import CPU_OPTIONS, share_function, until_function
from ddg_warp.kernels.variation import variation_functions

FRAME = 6  # reals of the reference frame of an edge: first director and tangent


@cache
def elements_type(real):
    """What every kernel of a term reads: the dofs and lagged data of the net, and the elements of a set."""
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
    """First and second node of the edges of a stencil.

    These are constants of Warp's, which a loop variable may index: wp.static of one would be resolved only when a kernel is built, and
    so make the hash of every kernel depend on what was built before it.
    """
    I = wp.types.vector(max(1, len(measure.edges)), int)
    return tuple(I(*(edge[end] for edge in measure.edges)) for end in (0, 1))


@cache
def place_function(measure: Measure, real):
    """place(given, q, w, e) -> (q, s) of element e of world w."""
    Elements = elements_type(real)
    V = wp.types.vector(3, real)
    Q, S, _, _ = measure.types(real)
    nodes, angles, spins, edge_count = measure.nodes, measure.angles, measure.spins, len(measure.edges)
    frames, own, data_size = measure.frames, measure.lag_size - FRAME * measure.frames, measure.data_size
    points, (angle_row, spin_row, point_row), (first, second) = measure.points, measure.starts, edge_ends(measure)

    @wp.func
    def place(given: Elements, q: wp.array(dtype=V), w: int, e: int):
        tid = e + w * given.elements
        shift = w * given.blocks
        local = Q()
        for i in range(wp.static(edge_count)):
            edge = q[given.slots[second[i], e] + shift] - q[given.slots[first[i], e] + shift]
            for d in range(3):
                local[3 * i + d] = edge[d]
        for i in range(wp.static(angles)):
            angle = q[given.slots[wp.static(nodes) + i, e] + shift]
            local[wp.static(angle_row) + i] = angle[0]
        for i in range(wp.static(spins)):
            spin = q[given.slots[wp.static(nodes + angles) + i, e] + shift]
            for d in range(3):
                local[wp.static(spin_row) + 3 * i + d] = spin[d]
        for i in range(wp.static(points)):
            position = q[given.slots[i, e] + shift]
            for d in range(3):
                local[wp.static(point_row) + 3 * i + d] = position[d]
        s = S()
        for i in range(wp.static(frames)):
            f = given.slots[wp.static(nodes) + i, e] - given.angle_start + w * given.edges
            for c in range(wp.static(FRAME)):
                s[wp.static(FRAME) * i + c] = given.frame[c, f]
        for c in range(wp.static(own)):
            s[wp.static(FRAME * frames) + c] = given.lag[c, tid]
        if wp.static(data_size > 0):
            column = wp.where(given.data.shape[1] > given.elements, tid, e)
            for c in range(wp.static(data_size)):
                s[wp.static(FRAME * frames + own) + c] = given.data[c, column]
        return local, s

    return place


@cache
def functions(term: Term, real):
    """gather(given, q, world, e) -> (q, s, w, p) of an element; spread(f, slot) -> derivative with respect to the block of a slot."""
    Elements = elements_type(real)
    measure, density = term.measure, term.density
    V = wp.types.vector(3, real)
    Q, _, _, _ = measure.types(real)
    n = len(measure.strains)
    P = wp.types.vector(density.parameter_size(n), real)
    static_size, size = len(term.parameter_names) - 1, density.parameter_size(n)
    nodes, angles, spins, edge_count = measure.nodes, measure.angles, measure.spins, len(measure.edges)
    points, (angle_row, spin_row, point_row), (first, second) = measure.points, measure.starts, edge_ends(measure)
    lagged = density.lagged
    place = place_function(measure, real)

    @wp.func
    def gather(given: Elements, q: wp.array(dtype=V), world: int, e: int):
        local, s = place(given, q, world, e)
        tid = e + world * given.elements
        p = P()
        for i in range(wp.static(static_size)):
            row = i + 1
            p[i] = given.buffer[given.table[row, 0] + e * given.table[row, 1] + world * given.table[row, 2]]
        if wp.static(lagged):
            for i in range(wp.static(n)):
                p[wp.static(static_size) + i] = given.last[i, tid]
            p[wp.static(size - 1)] = given.rate[world]
        return local, s, given.buffer[given.table[0, 0] + e * given.table[0, 1] + world * given.table[0, 2]], p

    @wp.func
    def spread(f: Q, slot: int):
        """The three reals of a slot; `slot` is a constant where this is unrolled."""
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

    return gather, spread


@cache
def term_kernels(term: Term, real, reverse: bool = False):
    """Kernels of one term: energy, gradient (slots, elements), Hessian (elements, size, size), strains, linear stresses.

    With `reverse` the first two have an adjoint, which doubles the time that they take to compile.
    """
    Elements = elements_type(real)
    measure, density = term.measure, term.density
    V = wp.types.vector(3, real)
    Q, S, E, _ = measure.types(real)
    n = len(measure.strains)
    P = wp.types.vector(density.parameter_size(n), real)
    strains_of, jacobian_of, *_ = measure.functions(real)
    energy_of, slope_of, _ = density.functions(real, n)
    gather, spread = functions(term, real)
    along, _ = variation_functions(term, real)
    slots_count, size = measure.slots, measure.size

    @wp.func
    def gradient_at(q: Q, s: S, w: real, p: P):
        e, jacobian = jacobian_of(q, s, w)
        return (slope_of(e, p) * w) * jacobian

    @wp.kernel(module="unique", enable_backward=reverse, module_options=CPU_OPTIONS)
    def energy(
        given: Elements,
        energy_out: wp.array(dtype=real),
    ):
        e = wp.tid()
        world = e / given.elements
        x, s, w, p = gather(given, given.q, world, e - world * given.elements)
        energy_out[e] = w * energy_of(strains_of(x, s, w), p)

    @wp.kernel(module="unique", enable_backward=reverse, module_options=CPU_OPTIONS)
    def gradient(
        given: Elements,
        gradient_out: wp.array2d(dtype=V),
    ):
        e = wp.tid()
        world = e / given.elements
        x, s, w, p = gather(given, given.q, world, e - world * given.elements)
        f = gradient_at(x, s, w, p)
        for i in range(wp.static(slots_count)):
            gradient_out[i, e] = spread(f, i)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def hessian(
        given: Elements,
        extra: wp.array2d(dtype=real),
        hessian_out: wp.array3d(dtype=real),
    ):
        """Exact Hessian in the local dofs, a column a thread: the reverse of the gradient, seeded with unit vectors.

        `extra` (strains, elements) is added to the stresses that the second derivatives of the strains are weighted with.
        """
        e, column = wp.tid()
        world = e / given.elements
        x, s, w, p = gather(given, given.q, world, e - world * given.elements)
        v = Q()
        v[column] = real(1.0)
        more = E()
        for i in range(wp.static(n)):
            more[i] = extra[i, e]
        dq, _ds, _dw, _dp, _dv, _de = wp.grad(along)(x, s, w, p, v, more)
        for i in range(wp.static(size)):
            hessian_out[e, i, column] = dq[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def strains(
        given: Elements,
        stressed: int,
        strain_out: wp.array2d(dtype=real),
        stress_out: wp.array2d(dtype=real),
    ):
        e = wp.tid()
        world = e / given.elements
        x, s, w, p = gather(given, given.q, world, e - world * given.elements)
        strain = strains_of(x, s, w)
        for i in range(wp.static(n)):
            strain_out[i, e] = strain[i]
        if stressed != 0:
            stress = slope_of(strain, p)
            for i in range(wp.static(n)):
                stress_out[i, e] = stress[i]

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
    def linear_stress(
        given: Elements,
        step: wp.array(dtype=V),
        stress_out: wp.array2d(dtype=real),
    ):
        """Stresses of the strains that a step gives to first order, e + J step."""
        tid = wp.tid()
        world = tid / given.elements
        x, s, w, p = gather(given, given.q, world, tid - world * given.elements)
        d, _s, _w, _p = gather(given, step, world, tid - world * given.elements)
        e, jacobian = jacobian_of(x, s, w)
        stress = slope_of(e + jacobian * d, p)
        for i in range(wp.static(n)):
            stress_out[i, tid] = stress[i]

    return energy, gradient, hessian, strains, linear_stress


def factor_type(linear, local: bool):
    """Rows of factors: of the local dofs, or vectors a slot."""
    return wp.array2d(dtype=linear if local else wp.types.vector(3, linear))


@cache
def part_function(measure: Measure, real):
    """part(f, row, slot, e): of rows of local dofs that begin at `row`, what belongs to a slot of element e.

    For measures where one edge at most ends, and one starts, in a node; see `Measure.ends`.
    """
    V, I = wp.types.vector(3, real), wp.types.vector(measure.slots, int)
    plus, minus = (I(*of) for of in measure.ends)
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
def evaluate_kernel(
    term: Term,
    real,
    linear,
    exact_from: int | None = None,
    local: bool = False,
    serial: bool = False,
    split: bool = False,
):
    """The kernel of a Newton iteration: energy, gradient and Gauss-Newton factor of one term, written a slot.

    Factor rows are vectors [strain * slots + slot][element], or if `local` reals [strain * size + dof][element], as the gradient, which
    then is of the local dofs, too; `tension_out` holds the scalars of the geometric stiffness; in
    worlds that are `clamped` they are made positive semi-definite (an edge under compression, a triangle by the eigenvalues of
    its two-by-two stress, leaves out the negative part). Energies go to the half of `energy_out` that the line search does not
    hold. `stiffness_out` is the largest that a strain has against moving the element.

    `stale` is raised in worlds where frames have to be renewed before the next step.

    Of terms whose measure has second derivatives `second_out` holds, from iteration `exact_from` on, what F and the geometric
    stiffness leave out of the exact Hessian, packed over the local dofs; before, and in `clamped` worlds, it is not written.

    With `split`, factors of edges have what the matrix carries of their stiffness, and `tension_out` their slack behind the tension:
    see `kernels.solve.tension`.
    """
    Elements, share, until = elements_type(real), share_function(serial), until_function(serial)
    share_of_edge = carried_function(real) if split else None
    measure, density = term.measure, term.density
    V, F = wp.types.vector(3, real), wp.types.vector(3, linear)
    Q, S, E, _ = measure.types(real)
    n, tensions = len(measure.strains), measure.tensions
    _, jacobian_of, tension_of, curvature_of = measure.functions(real)
    energy_of, slope_of, root_of = density.functions(real, n)
    gather, spread = functions(term, real)
    slots_count, coupled = measure.slots, density.coupled
    C = wp.types.vector(3, real)
    begin, packed = exact_from or 0, measure.packed if exact_from is not None else 0
    left_out = left_out_function(term, real) if packed else None
    stale = measure.stale(real) if measure.stale else None
    options = CPU_OPTIONS | {"max_unroll": packed} if packed else CPU_OPTIONS
    Factor, Gradient = factor_type(linear, local), wp.array2d(dtype=real if local else V)
    size = measure.size

    @wp.func
    def put(factor: Factor, m: int, row: Q, e: int):
        """Row m of the factor."""
        if wp.static(local):
            for i in range(wp.static(size)):
                factor[m * wp.static(size) + i, e] = linear(row[i])
        else:
            for i in range(wp.static(slots_count)):
                v = spread(row, i)
                factor[m * wp.static(slots_count) + i, e] = F(linear(v[0]), linear(v[1]), linear(v[2]))

    @wp.func
    def definite(c: C):
        """The nearest positive semi-definite (c11, c12, c22)."""
        mean = real(0.5) * (c[0] + c[2])
        half = real(0.5) * (c[0] - c[2])
        radius = wp.sqrt(half * half + c[1] * c[1])
        low = mean - radius
        high = mean + radius
        if low >= real(0.0):
            return c
        if high <= real(0.0):
            return C()
        # high * v v^T with v the eigenvector of the larger eigenvalue: (c - low I) high / (high - low)
        scale = high / (high - low)
        return C((c[0] - low) * scale, c[1] * scale, (c[2] - low) * scale)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=options)
    def evaluate(
        given: Elements,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        factor_out: Factor,
        tension_out: wp.array2d(dtype=linear),
        second_out: wp.array2d(dtype=linear),
        gradient_out: Gradient,
        energy_out: wp.array2d(dtype=real),
        stiffness_out: wp.array(dtype=linear),
    ):
        world, start = share(wp.tid(), given.elements)
        if flags[STATUS, world] != 0:
            return
        for element in range(start, until(start, given.elements)):
            tid = element + world * given.elements
            x, s, w, p = gather(given, given.q, world, element)
            if wp.static(stale is not None):
                if stale(x, s):
                    flags[STALE, world] = 1
            e, jacobian = jacobian_of(x, s, w)
            slope = slope_of(e, p)
            energy_out[1 - flags[SLOT, world], tid] = w * energy_of(e, p)
            f = (slope * w) * jacobian
            if wp.static(local):
                for i in range(wp.static(size)):
                    gradient_out[i, tid] = f[i]
            else:
                for i in range(wp.static(slots_count)):
                    gradient_out[i, tid] = spread(f, i)
            shift = E()
            if wp.static(tensions == 1):
                c, shift = tension_of(x, w, slope)
                if c < real(0.0) and flags[CLAMPED, world] != 0:
                    c = real(0.0)
                    shift = E()
                tension_out[0, tid] = linear(c)
            if wp.static(tensions == 3):
                c3, _shift = tension_of(x, w, slope)
                if flags[CLAMPED, world] != 0:
                    c3 = definite(c3)
                for i in range(3):
                    tension_out[i, tid] = linear(c3[i])
            root = root_of(e, p, shift)
            weight = wp.sqrt(w)
            stiffest = real(0.0)
            if wp.static(coupled):
                rows = root * jacobian
                for m in range(wp.static(n)):
                    stiffest = wp.max(stiffest, w * wp.dot(rows[m], rows[m]))
                    put(factor_out, m, rows[m] * weight, tid)
            else:
                for m in range(wp.static(n)):
                    stiffness = w * root[m] * root[m] * wp.dot(jacobian[m], jacobian[m])
                    stiffest = wp.max(stiffest, stiffness)
                    scale = root[m] * weight
                    if wp.static(split):
                        part, slack = share_of_edge(stiffness, scalars[CARRIED, world])
                        tension_out[wp.static(tensions), tid] = linear(slack)
                        scale *= part
                    put(factor_out, m, jacobian[m] * scale, tid)
            stiffness_out[tid] = linear(stiffest)
            if wp.static(packed > 0):
                if flags[ITERATION, world] >= wp.static(begin) and flags[CLAMPED, world] == 0:
                    second = curvature_of(x, s, w, slope)
                    if wp.static(left_out is not None):
                        second = second + left_out(root * weight, e, p, w, jacobian)
                    for i in range(wp.static(packed)):
                        second_out[i, tid] = linear(second[i])

    return evaluate

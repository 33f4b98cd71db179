"""Element path: kernels of energies, gradients, Gauss-Newton factors, Hessians and strains, written once for all storages.

A kernel reads the local dofs of an element, evaluates strains and Jacobian, and writes columns. Storages differ in where dofs lie
and which thread takes which element. An `ElementStorage` holds these as Warp functions that are chosen when a kernel is built.
`kernels.elements.rod_layout.rod_storage` is that of uncoupled rods, `kernels.elements.coupled_element.coupled_storage` that of the
coupled system. `kernels.adjoint.elements` and `kernels.stepping.energy_drift` are written over the same storages. For kernels over
nodes see `kernels.core.nodes`.

Alternative: one source for the solvers around elements. It is separate where the algorithms differ. Residuals have other stopping
rules: sums over a whole rod, or over hierarchical clusters. The line search of rods is fused with their sweep, one thread a rod and
one launch an iteration. Rods update the frames of two edges a vertex in one kernel, the coupled system edge by edge. Matrix blocks
and eliminations cover a rod, or bands and slices with joints.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from ddg_warp.kernels.core.islands import (
    DROP_COMPRESSION,
    ENERGY_BUFFER,
    FRAMES_OUTDATED,
    ITERATION,
    MAX_EDGE_STIFFNESS,
    STATUS,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.variation import variation_functions
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.terms import Term


@dataclass(frozen=True, eq=False)
class TermAccess:
    """Access of one term to the data of an element.

    Attributes:
        local: (window) -> dofs of the term. short: (lagged) -> its lagged data. spread: (f) -> from its dofs to the window.
        parameter, strain, factor, tension, slack: its first row in each array.
        second: rows of its second derivatives, packed; None for all.
        functions, stale: of its measure, for the lagged data of the storage.
    """

    term: Term
    local: Callable
    short: Callable
    spread: Callable
    functions: tuple
    stale: Callable | None
    parameter: int = 0
    strain: int = 0
    factor: int = 0
    tension: int = 0
    slack: int = 1
    second: tuple[int, ...] | None = None


def measure_functions(measure: Measure, real) -> tuple:
    """Return `functions` and `stale` of a `TermAccess`, for lagged data as the measure has them."""
    return measure.functions(real), measure.stale(real) if measure.stale else None


@dataclass(frozen=True, eq=False)
class ElementStorage:
    """Storage of elements. An island is a rod or a world; the data of an element, except dofs, has one column.

    Attributes:
        terms: terms evaluated in one pass, all of a rod or the one of an element set.
        Inputs: struct of arrays that kernels read, with `buffer`, `table`, `last` and `rate`.
        Window, Lagged: vectors of local dofs and of lagged data.
        items: (i, j) -> (island, first element) of a thread.
        last_item: (first, count) -> end of the elements of a thread.
        count: (inputs, island) -> number of elements.
        column: (inputs, island, e) -> column of element e.
        whole: (inputs, island, e) -> True if the element has all edges of its window.
        read: (inputs, island, e, whole) -> (window, lagged).
        reach: (inputs, island, e) -> largest coordinate of the first node [m], whose rounding strains the element.
        displacement: (inputs, w, island, e, whole) -> window of a displacement w of all dofs.
        Displacements: type of the array of such a w.
        slots: (f, local node) -> derivative with respect to a dof block; None if derivatives stay by the window.
        num_slots: number of dof blocks of an element, zero without `slots`.
        stiffness_dofs: number of leading dofs that measure the stiffness; None for all.
    """

    terms: tuple[TermAccess, ...]
    Inputs: Any
    Window: Any
    Lagged: Any
    items: Callable
    last_item: Callable
    count: Callable
    column: Callable
    whole: Callable
    read: Callable
    reach: Callable
    displacement: Callable
    Displacements: Any
    slots: Callable | None = None
    num_slots: int = 0
    stiffness_dofs: int | None = None


@cache
def results_type(real, linear, slots: bool = False):
    """Return the struct that the kernel of an iteration writes; every array has one column an element.

    Rows of the factor and of the gradient are reals of local dofs, or with `slots` vectors of dof blocks.
    """
    F, G = (wp.types.vector(3, scalar) if slots else scalar for scalar in (linear, real))

    @wp.struct
    class Results:
        factor: wp.array2d(dtype=F)
        tension: wp.array2d(dtype=linear)
        second: wp.array2d(dtype=linear)
        gradient: wp.array2d(dtype=G)
        energy: wp.array2d(dtype=real)
        stiffness: wp.array(dtype=linear)

    return Results


@cache
def write_function(storage: ElementStorage, scalar, real, adds: bool = False):
    """Return the device function `write(out, first, f, column)`: write or add a derivative by the window as rows from `first` on."""
    slots, count, W = storage.slots, storage.num_slots, storage.Window
    if not slots:
        return write_rows_function(W, scalar, real, adds)
    X = wp.types.vector(3, scalar)

    @wp.func
    def write(out: wp.array2d(dtype=X), first: int, f: W, column: int):
        for i in range(wp.static(count)):
            v = slots(f, i)
            x = X(scalar(v[0]), scalar(v[1]), scalar(v[2]))
            if wp.static(adds):
                x += out[first + i, column]
            out[first + i, column] = x

    return write


@cache
def write_rows_function(Q, scalar, real, adds: bool = False):
    """Return the device function `write(out, first, f, column)`: write or add the components of a vector as rows from `first` on."""
    size = Q._length_

    @wp.func
    def write(out: wp.array2d(dtype=scalar), first: int, f: Q, column: int):
        for i in range(wp.static(size)):
            x = scalar(f[i])
            if wp.static(adds):
                x += out[first + i, column]
            out[first + i, column] = x

    return write


@cache
def parameter_function(storage: ElementStorage, index: int, real):
    """Return the device function `parameters(inputs, island, e, column)`: rest measure w and parameters p of a term.

    With time-lagged strains, p ends with these strains and the inverse step length.
    """
    access, Inputs = storage.terms[index], storage.Inputs
    n, density, first = len(access.term.measure.strains), access.term.density, access.parameter
    size, static_size, lagged = density.parameter_size(n), len(access.term.parameter_names) - 1, density.lagged
    P, strain = wp.types.vector(size, real), access.strain

    @wp.func
    def one(inputs: Inputs, row: int, island: int, e: int):
        return inputs.buffer[inputs.table[row, 0] + e * inputs.table[row, 1] + island * inputs.table[row, 2]]

    @wp.func
    def parameters(inputs: Inputs, island: int, e: int, column: int):
        p = P()
        for i in range(wp.static(static_size)):
            p[i] = one(inputs, wp.static(first + 1) + i, island, e)
        if wp.static(lagged):
            for i in range(wp.static(n)):
                p[wp.static(static_size) + i] = inputs.last[wp.static(strain) + i, column]
            p[wp.static(size - 1)] = inputs.rate[island]
        return one(inputs, wp.static(first), island, e), p

    return parameters


@cache
def left_out_function(term: Term, real):
    """Return the device function `left_out(root, e, p, w, jacobian)`: negative part of psi'' that the factor F leaves out.

    The matrix w J^T psi'' J - F^T F is returned as its packed upper triangle. None for laws without such a part.
    """
    if not term.density.coupled or term.density.quadratic:
        return None
    n, size = len(term.measure.strains), term.measure.size
    _, _, E, J = term.measure.types(real)
    R, P = wp.types.matrix((n, n), real), wp.types.vector(term.density.parameter_size(n), real)
    G = wp.types.vector(size * (size + 1) // 2, real)
    psi_of = term.density.laws(real, n)[2]

    @wp.func
    def left_out(root: R, e: E, p: P, w: real, jacobian: J):
        m = wp.transpose(jacobian) * ((psi_of(e, p) * w - wp.transpose(root) * root) * jacobian)
        g = G()
        for i in range(wp.static(size)):
            for j in range(i, wp.static(size)):
                g[i * wp.static(size) - i * (i - 1) // 2 + j - i] = m[i, j]  # `packed_index`
        return g

    return left_out


@cache
def stiffness_split_function(real):
    """Return the device function `share(stiffness, carried)`: split an edge stiffness k between the matrix and its axial force.

    It returns the root of k' / k, with k' the stiffness that the matrix carries, and the slack, zero where k' = k. See
    `kernels.linear.mixed_axial_force`.
    """

    @wp.func
    def share(stiffness: real, carried: real):
        if stiffness > carried:
            return wp.sqrt(carried / stiffness), carried / (stiffness - carried)
        return real(1.0), real(0.0)

    return share


@cache
def drop_compression_function(real, tensions: int):
    """Return the device function `drop_compression(c)`: stresses without their negative part, and True if strains lose their shift."""
    if tensions < 3:

        @wp.func
        def drop_compression(c: real):
            return wp.where(c < real(0.0), real(0.0), c), c < real(0.0)

        return drop_compression
    C = wp.types.vector(3, real)

    @wp.func
    def drop_of_triangle(c: C):
        """Return the nearest positive semi-definite (c11, c12, c22)."""
        mean = real(0.5) * (c[0] + c[2])
        half = real(0.5) * (c[0] - c[2])
        radius = wp.sqrt(half * half + c[1] * c[1])
        low = mean - radius
        high = mean + radius
        if low >= real(0.0):
            return c, False
        if high <= real(0.0):
            return C(), False
        # high * v v^T with v the eigenvector of the larger eigenvalue: (c - low I) high / (high - low)
        scale = high / (high - low)
        return C((c[0] - low) * scale, c[1] * scale, (c[2] - low) * scale), False  # strains of triangles have no shift

    return drop_of_triangle


@cache
def evaluate_function(
    storage: ElementStorage, index: int, real, linear, curved: bool, mixed_axial: bool, writes_gradient: bool
):
    """Return the device function `evaluate_at` of one term: write its factor, tensions and second derivatives.

    It returns energy, derivative with respect to the window, and the largest stiffness of a strain. A term that `writes_gradient`
    returns zero derivatives.
    """
    access, Inputs, W, L = storage.terms[index], storage.Inputs, storage.Window, storage.Lagged
    Results, term, measure = results_type(real, linear, storage.slots is not None), access.term, access.term.measure
    n, (Q, _, E, _) = len(measure.strains), measure.types(real)
    _, jacobian_of, tension_of, curvature_of = access.functions
    energy_of, slope_of, root_of = term.density.functions(real, n)
    local, short, spread, parameters = (
        access.local,
        access.short,
        access.spread,
        parameter_function(storage, index, real),
    )
    is_coupled, tensions, stiffness_dofs = (
        term.density.coupled,
        measure.tensions,
        storage.stiffness_dofs or measure.size,
    )
    write = write_function(storage, linear, real) if storage.slots else write_rows_function(Q, linear, real)
    rows = storage.num_slots or measure.size
    splits, bends = mixed_axial and tensions > 0, curved and curvature_of is not None
    drop_compression = drop_compression_function(real, tensions)
    left_out, carried_part = left_out_function(term, real), stiffness_split_function(real)
    write_gradient = write_function(storage, real, real)
    second_rows = access.second or tuple(range(measure.packed))
    where = wp.types.vector(max(1, len(second_rows)), int)(*(second_rows or (0,)))

    @wp.func
    def evaluate_at(
        inputs: Inputs,
        results: Results,
        window: W,
        lagged: L,
        clamped: bool,
        frozen: bool,
        exact: bool,
        carried: real,
        island: int,
        e: int,
        column: int,
    ):
        w, p = parameters(inputs, island, e, column)
        q = local(window)
        strain, jacobian = jacobian_of(q, short(lagged), w)
        slope = slope_of(strain, p)
        energy = w * energy_of(strain, p)
        f = spread((slope * w) * jacobian)
        if wp.static(writes_gradient):  # frees its registers
            write_gradient(results.gradient, 0, f, column)
            f = W()
        shift = E()
        if wp.static(tensions > 0):
            c, shift = tension_of(q, w, slope)
            if clamped:
                c, compressed = drop_compression(c)
                if compressed:
                    shift = E()
            if not frozen:
                if wp.static(tensions == 3):
                    for i in range(3):
                        results.tension[i, column] = linear(c[i])
                else:
                    results.tension[wp.static(access.tension), column] = linear(c)
        root = root_of(strain, p, shift) * wp.sqrt(w)
        if wp.static(is_coupled):
            factor = root * jacobian
        stiffest = real(0.0)
        for m in range(wp.static(n)):
            row = Q()
            stiffness = real(0.0)
            if wp.static(is_coupled):
                row = factor[m]
                for i in range(wp.static(stiffness_dofs)):
                    stiffness += row[i] * row[i]
            else:
                row = jacobian[m] * root[m]
                for i in range(wp.static(stiffness_dofs)):
                    stiffness += jacobian[m, i] * jacobian[m, i]
                stiffness *= root[m] * root[m]
            stiffest = wp.max(stiffest, stiffness)
            if wp.static(splits):
                part, rest = carried_part(stiffness, carried)
                row *= part
                results.tension[wp.static(access.slack), column] = linear(rest)
            if not frozen:
                write(results.factor, wp.static(access.factor) + m * wp.static(rows), row, column)
        if wp.static(bends):
            if exact:
                second = curvature_of(q, short(lagged), w, slope)
                if wp.static(left_out is not None):
                    second = second + left_out(root, strain, p, w, jacobian)
                for i in range(wp.static(len(second_rows))):
                    if wp.static(access.second is None):
                        results.second[i, column] = linear(second[i])
                    else:
                        results.second[where[i], column] = linear(second[i])
        return energy, f, stiffest

    return evaluate_at


@cache
def element_function(
    storage: ElementStorage, real, linear, curved: bool, mixed_axial: bool, writes_gradient: bool = False
):
    """Return the device function `element_at` of all terms: write factors, tensions and second derivatives of an element.

    It takes the window q and lagged data s. It returns energy, derivative with respect to the window, and the largest stiffness of a
    strain. Nothing is written of a `frozen` element that is not `exact`. The flag `frames_outdated` is set where reference frames
    must be updated before the next step. With `writes_gradient` the only term writes its gradient, and the derivative returned is
    zero.
    """
    Inputs, W, L = storage.Inputs, storage.Window, storage.Lagged
    Results = results_type(real, linear, storage.slots is not None)
    measures = [access.term.measure for access in storage.terms]
    # Alternatives: a loop over the terms, or a recursive function.
    # Measured: for wp.static(each[i]) of a loop variable Warp generates all code of a kernel whenever it is defined, compiled or not,
    # 0.3 s each. Recursion costs 5 % of a step on the CPU.
    terms, everywhere = len(measures), measures[0].span == 1 or len(measures) == 1
    first_term, last_term = (
        evaluate_function(storage, index, real, linear, curved, mixed_axial, writes_gradient) for index in (0, -1)
    )
    stale = next((access.stale for access in storage.terms if access.stale), None)

    @wp.func
    def element_at(
        inputs: Inputs,
        flags: wp.array2d(dtype=int),
        results: Results,
        q: W,
        s: L,
        whole: bool,
        clamped: bool,
        frozen: bool,
        exact: bool,
        carried: real,
        island: int,
        e: int,
        column: int,
    ):
        if wp.static(stale is not None):  # before the terms: after them, dofs would occupy 30 to 50 more registers
            if whole and stale(q, s):
                flags[FRAMES_OUTDATED, island] = 1
        energy = real(0.0)
        f = W()
        stiffest = real(0.0)
        if whole or wp.static(everywhere):
            term_energy, part, stiff = first_term(
                inputs, results, q, s, clamped, frozen, exact, carried, island, e, column
            )
            energy += term_energy
            f += part
            stiffest = wp.max(stiffest, stiff)
        if wp.static(terms > 1):
            energy_too, part_too, stiff_too = last_term(
                inputs, results, q, s, clamped, frozen, exact, carried, island, e, column
            )
            energy += energy_too
            f += part_too
            stiffest = wp.max(stiffest, stiff_too)
        return energy, f, stiffest

    return element_at


def element_options(storage: ElementStorage, curved: bool) -> dict:
    """Return the module options of a kernel that calls `element_function`, which unrolls second derivatives."""
    packed = max(access.term.measure.packed for access in storage.terms) if curved else 0
    return CPU_OPTIONS | {"max_unroll": packed} if packed else CPU_OPTIONS


@cache
def evaluate_kernel(storage: ElementStorage, real, linear, curved: bool = False, mixed_axial: bool = False):
    """Build the kernel of a Newton iteration: energy, gradient and Gauss-Newton factor of all terms of an element.

    Compression lowers the stiffness across an edge, which can make the matrix indefinite. Islands flagged `drop_compression` omit
    it, and triangles the negative part of their stress; such islands write no second derivatives. Energies go to the buffer that
    the line search does not use.

    Uncoupled rods take `kernels.residual.rod_residual.evaluate_kernel` instead, which keeps gradients in registers.

    Args:
        curved: True if second derivatives are written, from iteration `exact_from` on; with the factor, compression included, they
            make the exact Hessian. False for a Gauss-Newton matrix.
        mixed_axial: True if rows of edges have only the stiffness that the matrix carries, and slacks are written; see
            `kernels.linear.mixed_axial_force`.
    """
    Inputs, Results = storage.Inputs, results_type(real, linear, storage.slots is not None)
    items, last_item, count_of = storage.items, storage.last_item, storage.count
    whole_of, read, column_of = storage.whole, storage.read, storage.column
    write, several = write_function(storage, real, real), len(storage.terms) > 1
    element_at = element_function(storage, real, linear, curved, mixed_axial, not several)

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, module_options=element_options(storage, curved)
    )
    def evaluate(
        inputs: Inputs, flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), exact_from: int, results: Results
    ):
        i, j = wp.tid()
        island, first = items(i, j)
        count = count_of(inputs, island)
        if flags[STATUS, island] != 0 or first >= count:
            return
        clamped = flags[DROP_COMPRESSION, island] != 0
        exact = flags[ITERATION, island] >= exact_from and not clamped
        slot = 1 - flags[ENERGY_BUFFER, island]
        carried = scalars[MAX_EDGE_STIFFNESS, island]
        for e in range(first, last_item(first, count)):
            column = column_of(inputs, island, e)
            whole = whole_of(inputs, island, e)
            q, s = read(inputs, island, e, whole)
            energy, f, stiffest = element_at(
                inputs, flags, results, q, s, whole, clamped, False, exact, carried, island, e, column
            )
            results.energy[slot, column] = energy
            results.stiffness[column] = linear(stiffest)
            if wp.static(several):
                write(results.gradient, 0, f, column)

    return evaluate


@cache
def term_kernels(storage: ElementStorage, index: int, real, reverse: bool = False):
    """Build the kernels of the energy, the gradient and the exact Hessian of one term.

    `energy`: write energies (columns,). `gradient`: write derivatives with respect to the window. `hessian`: write Hessians on the
    window [dof][dof][column], a column of the matrix a thread; where elements have several terms, add them.

    Args:
        reverse: True if the first two have an adjoint, which doubles their compile time.
    """
    access, Inputs, W, L = storage.terms[index], storage.Inputs, storage.Window, storage.Lagged
    term, span, size, several = access.term, access.term.measure.span, storage.Window._length_, len(storage.terms) > 1
    Q, _, E, _ = term.measure.types(real)
    n = len(term.measure.strains)
    P = wp.types.vector(term.density.parameter_size(n), real)
    strains_of, jacobian_of, *_ = term.measure.functions(real)
    energy_of, slope_of, _ = term.density.functions(real, n)
    along, _ = variation_functions(term, real)
    local, short, spread, parameters = (
        access.local,
        access.short,
        access.spread,
        parameter_function(storage, index, real),
    )
    items, count_of, whole_of = storage.items, storage.count, storage.whole
    read, column_of, write = storage.read, storage.column, write_function(storage, real, real)
    Rows = wp.array2d(dtype=wp.types.vector(3, real) if storage.slots else real)

    @wp.func
    def present(inputs: Inputs, island: int, e: int):
        return e < count_of(inputs, island) and (wp.static(span != 2) or whole_of(inputs, island, e))

    @wp.func
    def gradient_at(q: W, s: L, w: real, p: P):
        e, jacobian = jacobian_of(local(q), short(s), w)
        return spread((slope_of(e, p) * w) * jacobian)

    @wp.kernel(module="unique", enable_backward=reverse, module_options=CPU_OPTIONS)
    def energy(inputs: Inputs, energy_out: wp.array(dtype=real)):
        i, j = wp.tid()
        island, e = items(i, j)
        if present(inputs, island, e):
            element_column = column_of(inputs, island, e)
            w, p = parameters(inputs, island, e, element_column)
            q, s = read(inputs, island, e, wp.static(span == 2))
            energy_out[element_column] = w * energy_of(strains_of(local(q), short(s), w), p)

    @wp.kernel(module="unique", enable_backward=reverse, module_options=CPU_OPTIONS)
    def gradient(inputs: Inputs, gradient_out: Rows):
        i, j = wp.tid()
        island, e = items(i, j)
        if present(inputs, island, e):
            element_column = column_of(inputs, island, e)
            w, p = parameters(inputs, island, e, element_column)
            q, s = read(inputs, island, e, wp.static(span == 2))
            write(gradient_out, 0, gradient_at(q, s, w, p), element_column)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def hessian(inputs: Inputs, extra: wp.array2d(dtype=real), hessian_out: wp.array3d(dtype=real)):
        """Differentiate the gradient in reverse, seeded with unit vectors.

        `extra` (strains, columns), if any, is added to the stresses that second derivatives of strains are weighted with.
        """
        i, j, column = wp.tid()
        island, e = items(i, j)
        if present(inputs, island, e):
            element_column = column_of(inputs, island, e)
            w, p = parameters(inputs, island, e, element_column)
            v = W()
            v[column] = real(1.0)
            more = E()
            if extra.shape[1] > 0:
                for m in range(wp.static(n)):
                    more[m] = extra[m, element_column]
            q, s = read(inputs, island, e, wp.static(span == 2))
            dq, _ds, _dw, _dp, _dv, _de = wp.grad(along)(local(q), short(s), w, p, local(v), more)
            f = spread(dq)
            for m in range(wp.static(size)):
                if wp.static(several):
                    hessian_out[m, column, element_column] = hessian_out[m, column, element_column] + f[m]
                else:
                    hessian_out[m, column, element_column] = f[m]

    return energy, gradient, hessian


@cache
def strain_kernel(storage: ElementStorage, real):
    """Build the kernel of the strains of all terms, and with `stressed` of their conjugate stresses (forces, moments)."""
    Inputs, items, count_of = storage.Inputs, storage.items, storage.count
    whole_of, read, column_of = storage.whole, storage.read, storage.column
    strains_of_all = _strain_function(storage, len(storage.terms) - 1, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def strains(inputs: Inputs, stressed: int, strain_out: wp.array2d(dtype=real), stress_out: wp.array2d(dtype=real)):
        i, j = wp.tid()
        island, e = items(i, j)
        if e < count_of(inputs, island):
            column = column_of(inputs, island, e)
            whole = whole_of(inputs, island, e)
            q, s = read(inputs, island, e, whole)
            strains_of_all(inputs, q, s, whole, stressed, strain_out, stress_out, island, e, column)

    return strains


@cache
def _strain_function(storage: ElementStorage, index: int, real):
    """Return the device function `strains_at`: strains of terms 0 to `index`, by recursion; see `evaluate_kernel` on loops."""
    access, Inputs, W, L = storage.terms[index], storage.Inputs, storage.Window, storage.Lagged
    term, n, first = access.term, len(access.term.measure.strains), access.strain
    everywhere = term.measure.span != 2 or len(storage.terms) == 1
    strains_before = _strain_function(storage, index - 1, real) if index else None
    strains_of, *_ = term.measure.functions(real)
    _, slope_of, _ = term.density.functions(real, n)
    local, short, parameters = access.local, access.short, parameter_function(storage, index, real)
    write = write_rows_function(term.measure.types(real)[2], real, real)

    @wp.func
    def strains_at(
        inputs: Inputs,
        window: W,
        lagged: L,
        whole: bool,
        stressed: int,
        strain_out: wp.array2d(dtype=real),
        stress_out: wp.array2d(dtype=real),
        island: int,
        e: int,
        column: int,
    ):
        if wp.static(index > 0):
            strains_before(inputs, window, lagged, whole, stressed, strain_out, stress_out, island, e, column)
        if whole or wp.static(everywhere):
            w, p = parameters(inputs, island, e, column)
            strain = strains_of(local(window), short(lagged), w)
            write(strain_out, wp.static(first), strain, column)
            if stressed != 0:
                write(stress_out, wp.static(first), slope_of(strain, p), column)

    return strains_at

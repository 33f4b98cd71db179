"""Adjoint of elements, written once for all storages; see `kernels.elements.variation` and `kernels.elements.element_path`.

Every element writes its own contribution to each derivative, a column an element. Dofs and edges then sum these in one order,
without atomics.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.element_path import ElementStorage, parameter_function, write_function
from ddg_warp.kernels.elements.variation import variation_functions


@cache
def _write_lagged_function(storage: ElementStorage, index: int, real, adds: bool):
    """Return the device function `write_lagged`: write contributions of a term to lagged data, or add them with `adds`."""
    measure = storage.terms[index].term.measure
    rows, S = measure.lag_size + measure.data_size, measure.types(real)[1]

    @wp.func
    def write_lagged(out: wp.array2d(dtype=real), f: S, column: int):
        for i in range(wp.static(rows)):
            value = f[i]
            if wp.static(adds):
                value += out[i, column]
            out[i, column] = value

    return write_lagged


@cache
def _write_functions(storage: ElementStorage, index: int, real, adds: bool):
    """Return the device functions `present`, `write` and `write_lagged`, which write contributions of a term, or add with
    `adds`.

    The terms of an element have one window: the first writes it, zero where the term has no element, and others add.
    """
    measure, count_of, whole_of = storage.terms[index].term.measure, storage.count, storage.whole
    write, first = write_function(storage, real, real, adds or index > 0), not adds and index == 0
    Inputs, W, Rows = (
        storage.Inputs,
        storage.Window,
        wp.array2d(dtype=wp.types.vector(3, real) if storage.slots else real),
    )

    @wp.func
    def present(inputs: Inputs, island: int, e: int, column: int, window_out: Rows):
        if e < count_of(inputs, island) and (wp.static(measure.span != 2) or whole_of(inputs, island, e)):
            return True
        if wp.static(first):
            write(window_out, 0, W(), column)
        return False

    return present, write, _write_lagged_function(storage, index, real, adds)


@cache
def _pull_function(storage: ElementStorage, index: int, real, adds: bool, measured: bool):
    """Return the device function `pull`: write the derivatives of a term; return the one by the window. See `pull_kernel`."""
    access, Inputs = storage.terms[index], storage.Inputs
    term, density, local, short, spread = access.term, access.term.density, access.local, access.short, access.spread
    n, two = len(term.measure.strains), term.measure.span == 2
    size, rows, lagged = density.parameter_size(n), len(term.parameter_names) - 1, density.lagged
    E, read, displacement = term.measure.types(real)[2], storage.read, storage.displacement
    (along, _), parameters = variation_functions(term, real), parameter_function(storage, index, real)
    write_lagged = _write_lagged_function(storage, index, real, adds)
    row, strain, Displacements, measured = access.parameter, access.strain, storage.Displacements, adds or measured

    @wp.func
    def pull(
        inputs: Inputs,
        w: Displacements,
        lagged_out: wp.array2d(dtype=real),
        parameter_out: wp.array2d(dtype=real),
        last_out: wp.array2d(dtype=real),
        rate_out: wp.array(dtype=real),
        island: int,
        e: int,
        column: int,
    ):
        measure, p = parameters(inputs, island, e, column)
        q, s = read(inputs, island, e, wp.static(two))
        v = -local(displacement(inputs, w, island, e, wp.static(two)))
        dq, ds, dmeasure, dp, _dv, _de = wp.grad(along)(local(q), short(s), measure, p, v, E())
        write_lagged(lagged_out, ds, column)
        if wp.static(measured):
            dmeasure += parameter_out[wp.static(row), column]
        parameter_out[wp.static(row), column] = dmeasure
        for m in range(wp.static(rows)):
            by_parameter = dp[m]
            if wp.static(adds):
                by_parameter += parameter_out[wp.static(row + 1) + m, column]
            parameter_out[wp.static(row + 1) + m, column] = by_parameter
        if wp.static(lagged):
            for m in range(wp.static(n)):
                by_strain = dp[wp.static(rows) + m]
                if wp.static(adds):
                    by_strain += last_out[wp.static(strain) + m, column]
                last_out[wp.static(strain) + m, column] = by_strain
            by_rate = rate_out[column] + dp[wp.static(size - 1)]
            rate_out[column] = by_rate
        return spread(dq)

    return pull


@cache
def pull_kernel(storage: ElementStorage, real, adds: bool, measured: bool, windows: bool = True):
    """Build the reverse of the element forces of all terms: derivatives of -w . dE/dq by all inputs of an element.

    `vjp`: write the derivatives by the window, zero without an element, by lagged and constant data, rest measure, parameters, and
    strains of the last step. Add the derivative by the inverse step length.

    Args:
        adds: True to add all of these.
        measured: True to add the derivatives by the rest measure, where `strain_vjp_kernel` has written some.
        windows: False to leave out the derivative by the window; see `window_kernel`.
    """
    Inputs, W, Displacements = storage.Inputs, storage.Window, storage.Displacements
    items, count_of, whole_of, column_of = storage.items, storage.count, storage.whole, storage.column
    measures = [access.term.measure for access in storage.terms]
    first_everywhere, last_everywhere, several = measures[0].span != 2, measures[-1].span != 2, len(measures) > 1
    first_term, last_term = (_pull_function(storage, index, real, adds, measured) for index in (0, -1))
    write = write_function(storage, real, real, adds)
    Rows = wp.array2d(dtype=wp.types.vector(3, real) if storage.slots else real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
        inputs: Inputs,
        w: Displacements,
        window_out: Rows,
        lagged_out: wp.array2d(dtype=real),
        parameter_out: wp.array2d(dtype=real),
        last_out: wp.array2d(dtype=real),
        rate_out: wp.array(dtype=real),
    ):
        i, j = wp.tid()
        island, e = items(i, j)
        column = column_of(inputs, island, e)
        f = W()
        if e < count_of(inputs, island):
            whole = whole_of(inputs, island, e)
            if wp.static(several):
                if wp.static(last_everywhere) or whole:
                    f += last_term(inputs, w, lagged_out, parameter_out, last_out, rate_out, island, e, column)
            if wp.static(first_everywhere) or whole:
                f += first_term(inputs, w, lagged_out, parameter_out, last_out, rate_out, island, e, column)
        elif wp.static(adds):
            return
        if wp.static(windows):
            write(window_out, 0, f, column)

    return vjp


@cache
def _window_function(storage: ElementStorage, index: int, real):
    """Return the device function `window_of`: derivative of -w . dE/dq of a term by the window."""
    access, Inputs, Displacements = storage.terms[index], storage.Inputs, storage.Displacements
    term, local, short, spread, two = (
        access.term,
        access.local,
        access.short,
        access.spread,
        access.term.measure.span == 2,
    )
    E, read, displacement = term.measure.types(real)[2], storage.read, storage.displacement
    (along, _), parameters = variation_functions(term, real), parameter_function(storage, index, real)

    @wp.func
    def window_of(inputs: Inputs, w: Displacements, island: int, e: int, column: int):
        measure, p = parameters(inputs, island, e, column)
        q, s = read(inputs, island, e, wp.static(two))
        v = -local(displacement(inputs, w, island, e, wp.static(two)))
        dq, _ds, _dmeasure, _dp, _dv, _de = wp.grad(along)(local(q), short(s), measure, p, v, E())
        return spread(dq)

    return window_of


@cache
def window_kernel(storage: ElementStorage, real):
    """Build the kernel of derivatives of -w . dE/dq by the windows of few elements of a rod.

    `windows`: write them for elements with a node that has dofs outside of the mask `leaves`.

    Measured: derivatives by windows of all elements, with all others, keep 0.5 kB a thread in local memory on a GPU, else nothing.
    """
    Inputs, W, Displacements = storage.Inputs, storage.Window, storage.Displacements
    items, count_of, whole_of, column_of = storage.items, storage.count, storage.whole, storage.column
    measures = [access.term.measure for access in storage.terms]
    first_everywhere, last_everywhere, several = measures[0].span != 2, measures[-1].span != 2, len(measures) > 1
    first_term, last_term = (_window_function(storage, index, real) for index in (0, -1))
    write = write_function(storage, real, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def windows(
        inputs: Inputs, w: Displacements, leaves: wp.array2d(dtype=wp.uint8), window_out: wp.array2d(dtype=real)
    ):
        i, j = wp.tid()
        island, e = items(i, j)
        count = count_of(inputs, island)
        if e >= count:
            return
        stays = False
        for local in range(3):
            k = wp.min(e + local, leaves.shape[0] - 1)
            stays = stays or leaves[k, island] != wp.uint8(255)
            if e + local >= count:  # the first nodes of a closed rod
                stays = stays or leaves[e + local - count, island] != wp.uint8(255)
        if not stays:
            return
        column = column_of(inputs, island, e)
        whole = whole_of(inputs, island, e)
        f = W()
        if wp.static(several):
            if wp.static(last_everywhere) or whole:
                f += last_term(inputs, w, island, e, column)
        if wp.static(first_everywhere) or whole:
            f += first_term(inputs, w, island, e, column)
        write(window_out, 0, f, column)

    return windows


@cache
def strain_vjp_kernel(storage: ElementStorage, index: int, real, adds: bool):
    """Build the reverse of the strains of a term: derivatives by window, lagged and constant data, and rest measure.

    Strains at the end of a step are the reference of the next one in viscous terms; launch before `vjp` of the elements.

    `vjp`: write them, or add them with `adds`, from the derivatives by strains.
    """
    access, Inputs = storage.terms[index], storage.Inputs
    term, local, short, spread = access.term, access.local, access.short, access.spread
    n, two, E = len(term.measure.strains), term.measure.span == 2, term.measure.types(real)[2]
    items, read, column_of = storage.items, storage.read, storage.column
    _, strained = variation_functions(term, real)
    parameters = parameter_function(storage, index, real)
    present, write, write_lagged = _write_functions(storage, index, real, adds)
    Rows, row, strain = (
        wp.array2d(dtype=wp.types.vector(3, real) if storage.slots else real),
        access.parameter,
        access.strain,
    )

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
        inputs: Inputs,
        cotangent: wp.array2d(dtype=real),
        window_out: Rows,
        lagged_out: wp.array2d(dtype=real),
        parameter_out: wp.array2d(dtype=real),
    ):
        i, j = wp.tid()
        island, e = items(i, j)
        column = column_of(inputs, island, e)
        if not present(inputs, island, e, column, window_out):
            return
        measure, _p = parameters(inputs, island, e, column)
        q, s = read(inputs, island, e, wp.static(two))
        f = E()
        for m in range(wp.static(n)):
            f[m] = cotangent[wp.static(strain) + m, column]
        dq, ds, dmeasure, _df = wp.grad(strained)(local(q), short(s), measure, f)
        write(window_out, 0, spread(dq), column)
        write_lagged(lagged_out, ds, column)
        if wp.static(adds):
            dmeasure += parameter_out[wp.static(row), column]
        parameter_out[wp.static(row), column] = dmeasure

    return vjp

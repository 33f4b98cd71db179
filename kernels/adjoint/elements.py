"""Adjoint of elements, written once for all storages; see `kernels.elements.variation` and `kernels.elements.element_path`.

Every element writes its own share of each derivative, a column an element. Dofs and edges then sum these in one order, without
atomics.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.element_path import ElementStorage, parameter_function, write_function
from ddg_warp.kernels.elements.variation import variation_functions


@cache
def _write_functions(storage: ElementStorage, index: int, real, adds: bool):
    """Build `present`, `write_window` and `write_lagged`, which write shares of a term, or add them with `adds`.

    Terms of one element share its window: the first writes it, zero where the term has no element, and others add.
    """
    own, Inputs, W = storage.terms[index], storage.Inputs, storage.Window
    measure, count_of, whole_of = own.term.measure, storage.count, storage.whole
    span, rows = measure.span, measure.lag_size + measure.data_size
    write, first = write_function(storage, real, real, adds or index > 0), not adds and index == 0
    Rows, S = wp.array2d(dtype=wp.types.vector(3, real) if storage.slots else real), measure.types(real)[1]

    @wp.func
    def present(inputs: Inputs, island: int, e: int, at: int, window_out: Rows):
        if e < count_of(inputs, island) and (wp.static(span != 2) or whole_of(inputs, island, e)):
            return True
        if wp.static(first):
            write(window_out, 0, W(), at)
        return False

    @wp.func
    def write_lagged(out: wp.array2d(dtype=real), f: S, at: int):
        for i in range(wp.static(rows)):
            if wp.static(adds):
                out[i, at] = out[i, at] + f[i]
            else:
                out[i, at] = f[i]

    return present, write, write_lagged


@cache
def pull_kernel(storage: ElementStorage, index: int, real, adds: bool, measured: bool):
    """Build the reverse of the element forces of a term: derivatives of -w . dE/dq by everything that an element reads.

    `pull`: write those by the window, by lagged and constant data, by rest measure and parameters in the rows of the term, and by the
    strains of the last step. Add those by the inverse step length.

    Args:
        adds: whether all of these are added.
        measured: whether those by the rest measure are, as `strain_kernel` has written some.
    """
    own, Inputs = storage.terms[index], storage.Inputs
    term, density, local, short, spread = own.term, own.term.density, own.local, own.short, own.spread
    n = len(term.measure.strains)
    size, rows, lagged = density.parameter_size(n), len(term.parameter_names) - 1, density.lagged
    E = term.measure.types(real)[2]
    items, read, displacement, column_of = storage.items, storage.read, storage.displacement, storage.column
    along, _ = variation_functions(term, real)
    parameters, two = parameter_function(storage, index, real), term.measure.span == 2
    present, write, write_lagged = _write_functions(storage, index, real, adds)
    Rows, row, strain = wp.array2d(dtype=wp.types.vector(3, real) if storage.slots else real), own.parameter, own.strain
    Displacements, measured = storage.Displacements, adds or measured

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
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
        at = column_of(inputs, island, e)
        if not present(inputs, island, e, at, window_out):
            return
        measure, p = parameters(inputs, island, e, at)
        q, s = read(inputs, island, e, wp.static(two))
        v = -local(displacement(inputs, w, island, e, wp.static(two)))
        dq, ds, dmeasure, dp, _dv, _de = wp.grad(along)(local(q), short(s), measure, p, v, E())
        write(window_out, 0, spread(dq), at)
        write_lagged(lagged_out, ds, at)
        if wp.static(measured):
            dmeasure += parameter_out[wp.static(row), at]
        parameter_out[wp.static(row), at] = dmeasure
        for m in range(wp.static(rows)):
            if wp.static(adds):
                dp[m] += parameter_out[wp.static(row + 1) + m, at]
            parameter_out[wp.static(row + 1) + m, at] = dp[m]
        if wp.static(lagged):
            for m in range(wp.static(n)):
                if wp.static(adds):
                    dp[wp.static(rows) + m] += last_out[wp.static(strain) + m, at]
                last_out[wp.static(strain) + m, at] = dp[wp.static(rows) + m]
            rate_out[at] = rate_out[at] + dp[wp.static(size - 1)]

    return pull


@cache
def strain_kernel(storage: ElementStorage, index: int, real, adds: bool):
    """Build the reverse of the strains of a term: derivatives by window, lagged and constant data, and rest measure.

    `pull`: write them, or add them with `adds`, from the derivatives by strains.
    """
    own, Inputs = storage.terms[index], storage.Inputs
    term, local, short, spread = own.term, own.local, own.short, own.spread
    n, two, E = len(term.measure.strains), term.measure.span == 2, term.measure.types(real)[2]
    items, read, column_of = storage.items, storage.read, storage.column
    _, strained = variation_functions(term, real)
    parameters = parameter_function(storage, index, real)
    present, write, write_lagged = _write_functions(storage, index, real, adds)
    Rows, row, strain = wp.array2d(dtype=wp.types.vector(3, real) if storage.slots else real), own.parameter, own.strain

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        inputs: Inputs,
        by: wp.array2d(dtype=real),
        window_out: Rows,
        lagged_out: wp.array2d(dtype=real),
        parameter_out: wp.array2d(dtype=real),
    ):
        i, j = wp.tid()
        island, e = items(i, j)
        at = column_of(inputs, island, e)
        if not present(inputs, island, e, at, window_out):
            return
        measure, _p = parameters(inputs, island, e, at)
        q, s = read(inputs, island, e, wp.static(two))
        f = E()
        for m in range(wp.static(n)):
            f[m] = by[wp.static(strain) + m, at]
        dq, ds, dmeasure, _df = wp.grad(strained)(local(q), short(s), measure, f)
        write(window_out, 0, spread(dq), at)
        write_lagged(lagged_out, ds, at)
        if wp.static(adds):
            dmeasure += parameter_out[wp.static(row), at]
        parameter_out[wp.static(row), at] = dmeasure

    return pull

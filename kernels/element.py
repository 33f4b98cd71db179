"""The element path, written once: gather -> strains and Jacobian -> energy | gradient | factor | Hessian -> scatter.

Rods lie in chains: arrays run [component][node][rod], element k of a rod starts at its node k, and edge k runs from node k to
node k + 1 (modulo the nodes of a closed rod). The *window* of an element is q = [edge k, edge k + 1, theta k, theta k + 1], cut to
what the chain has. Element forces and factors are derivatives with respect to the window; forces on nodes are differences.

Parameters of all terms lie in one buffer. Row i of `table` is (offset, stride along the rod, stride across rods), so that one
number, one a rod, one an element or one each are read by the same code.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.chain import ChainKind, gather_functions
from ddg_warp.kernels.threads import CPU_OPTIONS
from ddg_warp.kernels.variation import variation_functions


@cache
def term_functions(kind: ChainKind, index: int, real):
    """Of term `index` in a chain of this kind: its measure's and density's functions on the window.

    Returns:
        load(buffer, table, last, rate, k, r) -> (w, p); local(window) -> q; short(s) -> lagged data as the measure takes them;
        spread(f) -> derivative with respect to the window.
    """
    term = kind.terms[index]
    measure, density = term.measure, term.density
    n = len(measure.strains)
    size, at = density.parameter_size(n), kind.places()[index]
    Q, S, E, _ = measure.types(real)
    W, S13, P = wp.types.vector(kind.window, real), wp.types.vector(13, real), wp.types.vector(size, real)
    *_, parameter = gather_functions(kind, real)
    first, strain_row, static_size = at[0], at[3], len(term.parameter_names) - 1
    edge_dofs, window_angles, angles, lag_size = (
        kind.dim * measure.span,
        kind.dim * kind.span,
        measure.angles,
        measure.lag_size,
    )
    lagged_density = density.lagged

    @wp.func
    def load(
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        last: wp.array3d(dtype=real),
        rate: real,
        k: int,
        r: int,
    ):
        p = P()
        for i in range(wp.static(static_size)):
            p[i] = parameter(buffer, table, wp.static(first + 1) + i, k, r)
        if wp.static(lagged_density):
            for i in range(wp.static(n)):
                p[wp.static(static_size) + i] = last[wp.static(strain_row) + i, k, r]
            p[wp.static(size - 1)] = rate
        return parameter(buffer, table, wp.static(first), k, r), p

    @wp.func
    def local(w: W):
        q = Q()
        for i in range(wp.static(edge_dofs)):
            q[i] = w[i]
        for i in range(wp.static(angles)):
            q[wp.static(edge_dofs) + i] = w[wp.static(window_angles) + i]
        return q

    @wp.func
    def short(s: S13):
        if wp.static(lag_size > 0):
            return s
        else:
            return S()

    @wp.func
    def spread(f: Q):
        w = W()
        for i in range(wp.static(edge_dofs)):
            w[i] = f[i]
        for i in range(wp.static(angles)):
            w[wp.static(window_angles) + i] = f[wp.static(edge_dofs) + i]
        return w

    return load, local, short, spread


@cache
def term_kernels(kind: ChainKind, index: int, real, reverse: bool = False):
    """Kernels of one term: its energy, its gradient on the window, its Hessian on the window.

    With `reverse` the first two have an adjoint, which doubles the time that they take to compile.
    """
    term = kind.terms[index]
    V, W = wp.types.vector(kind.dim, real), wp.types.vector(kind.window, real)
    S13 = wp.types.vector(13, real)
    P = wp.types.vector(term.density.parameter_size(len(term.measure.strains)), real)
    E = wp.types.vector(len(term.measure.strains), real)
    strains_of, jacobian_of, *_ = term.measure.functions(real)
    energy_of, slope_of, _ = term.density.functions(real, len(term.measure.strains))
    along, _ = variation_functions(term, real)
    _, window, lagged, _ = gather_functions(kind, real)
    load, local, short, spread = term_functions(kind, index, real)
    size = kind.window
    missing = 0 if kind.closed else term.measure.span

    @wp.func
    def gradient_at(q: W, s: S13, w: real, p: P):
        e, jacobian = jacobian_of(local(q), short(s), w)
        return spread((slope_of(e, p) * w) * jacobian)

    @wp.kernel(module="unique", enable_backward=reverse, module_options=CPU_OPTIONS)
    def energy(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        energy_out: wp.array2d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k < n - wp.static(missing):
            whole = wp.static(term.measure.span) == 2
            w, p = load(buffer, table, last, rate[r], k, r)
            q = local(window(x, theta, k, n, whole, r))
            energy_out[k, r] = w * energy_of(strains_of(q, short(lagged(frame, k, n, whole, r)), w), p)

    @wp.kernel(module="unique", enable_backward=reverse, module_options=CPU_OPTIONS)
    def gradient(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        gradient_out: wp.array3d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k < n - wp.static(missing):
            whole = wp.static(term.measure.span) == 2
            w, p = load(buffer, table, last, rate[r], k, r)
            f = gradient_at(window(x, theta, k, n, whole, r), lagged(frame, k, n, whole, r), w, p)
            for i in range(wp.static(size)):
                gradient_out[i, k, r] = f[i]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def hessian(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        hessian_out: wp.array3d(dtype=real),
    ):
        """Exact Hessian on the window, column by column: the reverse of the gradient, seeded with unit vectors. Adds."""
        k, r, column = wp.tid()
        n = count[r]
        if k < n - wp.static(missing):
            whole = wp.static(term.measure.span) == 2
            w, p = load(buffer, table, last, rate[r], k, r)
            v = W()
            v[column] = real(1.0)
            q = local(window(x, theta, k, n, whole, r))
            dq, _ds, _dw, _dp, _dv, _de = wp.grad(along)(q, short(lagged(frame, k, n, whole, r)), w, p, local(v), E())
            f = spread(dq)
            for i in range(wp.static(size)):
                hessian_out[i * wp.static(size) + column, k, r] = hessian_out[i * wp.static(size) + column, k, r] + f[i]

    return energy, gradient, hessian


@cache
def strain_kernel(kind: ChainKind, real):
    """Strains of all terms, and their conjugate stresses (force, moments) if asked for."""
    V = wp.types.vector(kind.dim, real)
    _, window, lagged, _ = gather_functions(kind, real)
    strains_of_all = _strain_functions(kind, len(kind.terms) - 1, real)
    closed = kind.closed

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def strains(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        rate: wp.array(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        stressed: int,
        strain_out: wp.array3d(dtype=real),
        stress_out: wp.array3d(dtype=real),
    ):
        k, r = wp.tid()
        n = count[r]
        if k >= n - wp.static(0 if closed else 1):
            return
        whole = wp.static(closed) or k < n - 2
        q = window(x, theta, k, n, whole, r)
        s = lagged(frame, k, n, whole, r)
        strains_of_all(q, s, buffer, table, last, rate[r], whole, stressed, strain_out, stress_out, k, r)

    return strains


@cache
def _strain_functions(kind: ChainKind, index: int, real):
    """strains_at of the terms 0 to `index`, by calling itself for those before the last; see `evaluate_kernel` on loops."""
    term = kind.terms[index]
    everywhere = term.measure.span == 1
    strains_before = _strain_functions(kind, index - 1, real) if index else None
    W, S13 = wp.types.vector(kind.window, real), wp.types.vector(13, real)
    n = len(term.measure.strains)
    strains_of, *_ = term.measure.functions(real)
    _, slope_of, _ = term.density.functions(real, n)
    load, local, short, _ = term_functions(kind, index, real)
    row = kind.places()[index][3]

    @wp.func
    def strains_at(
        window: W,
        s: S13,
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        last: wp.array3d(dtype=real),
        rate: real,
        whole: bool,
        stressed: int,
        strain_out: wp.array3d(dtype=real),
        stress_out: wp.array3d(dtype=real),
        k: int,
        r: int,
    ):
        if wp.static(index > 0):
            strains_before(window, s, buffer, table, last, rate, whole, stressed, strain_out, stress_out, k, r)
        if whole or wp.static(everywhere):
            w, p = load(buffer, table, last, rate, k, r)
            e = strains_of(local(window), short(s), w)
            stress = slope_of(e, p)
            for m in range(wp.static(n)):
                strain_out[wp.static(row) + m, k, r] = e[m]
                if stressed != 0:
                    stress_out[wp.static(row) + m, k, r] = stress[m]

    return strains_at

"""The kernel of a Newton iteration on chains: energy, gradient on the window and Gauss-Newton factor of all terms at once."""

from functools import cache

import warp as wp

from ddg_warp.kernels.chain import ChainKind, gather_functions
from ddg_warp.kernels.element import term_functions
from ddg_warp.kernels.islands import ACTIVE, CARRIED, ITERATION, RATE, SLOT, STALE, STATUS
from ddg_warp.kernels.measures.turning import packed_index
from ddg_warp.kernels.terms import Term
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function


@cache
def left_out_function(term: Term, real):
    """left_out(root, e, p, w, jacobian): the negative part of psi'', which F leaves out: w J^T psi'' J - F^T F, packed; or None."""
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
def carried_function(real):
    """share(k, carried) -> (root of k' / k, s) of an edge, s = 0 where the matrix carries all of k; see `kernels.solve.tension`."""

    @wp.func
    def share(stiffness: real, carried: real):
        if stiffness > carried:
            return wp.sqrt(carried / stiffness), carried / (stiffness - carried)
        return real(1.0), real(0.0)

    return share


@cache
def evaluate_functions(kind: ChainKind, index: int, real, linear, curved: bool, split: bool):
    """evaluate_at of one term: writes its factor rows; returns its energy, derivative with respect to the window, stiffness.

    With `curved`, a term that spans two edges (a rod has one) also writes its geometric stiffness. With `split`, rows of edges have
    what the matrix carries of their stiffness, and factors end with their slack: see `kernels.solve.tension`.
    """
    term = kind.terms[index]
    W, S13 = wp.types.vector(kind.window, real), wp.types.vector(13, real)
    n, size = len(term.measure.strains), term.measure.size
    _, jacobian_of, tension_of, curvature_of = term.measure.functions(real)
    energy_of, slope_of, root_of = term.density.functions(real, n)
    load, local, short, spread = term_functions(kind, index, real)
    _, row, tension_row, _ = kind.places()[index]
    E = wp.types.vector(n, real)
    has_tension, dim = term.measure.tensions > 0, kind.dim
    splits = split and has_tension
    bends = curved and term.measure.span == 2
    left_out, share = left_out_function(term, real), carried_function(real)
    dofs = [*range(dim * term.measure.span), *(dim * kind.span + i for i in range(term.measure.angles))]
    places = tuple(packed_index(kind.window, dofs[i], dofs[j]) for i in range(size) for j in range(i, size))
    where = wp.types.vector(len(places), int)(*places)

    if term.density.coupled:
        R, J = wp.types.matrix((n, n), real), wp.types.matrix((n, size), real)

        @wp.func
        def row_of(root: R, jacobian: J, m: int, i: int):
            total = real(0.0)
            for j in range(wp.static(n)):
                total += root[m, j] * jacobian[j, i]
            return total

        edge_of = row_of

        @wp.func
        def scale_of(root: R, m: int):
            return real(1.0)

    else:
        J = wp.types.matrix((n, size), real)

        @wp.func
        def row_of(root: E, jacobian: J, m: int, i: int):
            return root[m] * jacobian[m, i]

        @wp.func
        def edge_of(root: E, jacobian: J, m: int, i: int):
            return jacobian[m, i]

        @wp.func
        def scale_of(root: E, m: int):
            return root[m] * root[m]

    @wp.func
    def evaluate_at(
        window: W,
        s: S13,
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        last: wp.array3d(dtype=real),
        rate: real,
        clamped: int,
        frozen: bool,
        exact: bool,
        carried: real,
        factor: wp.array3d(dtype=linear),
        geometric: wp.array3d(dtype=linear),
        k: int,
        r: int,
    ):
        w, p = load(buffer, table, last, rate, k, r)
        q = local(window)
        e, jacobian = jacobian_of(q, short(s), w)
        slope = slope_of(e, p)
        shift = E()
        if wp.static(has_tension):
            c, shift = tension_of(q, w, slope)
            if clamped != 0 and c < real(0.0):
                c = real(0.0)
                shift = E()
            if not frozen:
                factor[wp.static(tension_row), k, r] = linear(c)
        root = root_of(e, p, shift) * wp.sqrt(w)
        if wp.static(splits):
            whole = real(0.0)
            for i in range(wp.static(dim)):
                whole += jacobian[0, i] * jacobian[0, i]
            part, rest = share(whole * root[0] * root[0], carried)
            factor[wp.static(kind.factor_rows), k, r] = linear(rest)
        if not frozen:
            for m in range(wp.static(n)):
                for i in range(wp.static(size)):
                    entry = row_of(root, jacobian, m, i)
                    if wp.static(splits):
                        entry *= part
                    factor[wp.static(row) + m * wp.static(size) + i, k, r] = linear(entry)
        if wp.static(bends):
            if exact:
                second = curvature_of(q, short(s), w, slope)
                if wp.static(left_out is not None):
                    second = second + left_out(root, e, p, w, jacobian)
                for i in range(wp.static(len(places))):
                    geometric[where[i], k, r] = linear(second[i])
        stiffness = real(0.0)
        for m in range(wp.static(n)):
            edge = real(0.0)
            for i in range(wp.static(dim)):
                along = edge_of(root, jacobian, m, i)
                edge += along * along
            stiffness = wp.max(stiffness, scale_of(root, m) * edge)
        return w * energy_of(e, p), spread((slope * w) * jacobian), stiffness

    return evaluate_at


@cache
def evaluate_kernel(kind: ChainKind, real, linear, exact_from: int | None = None, split: bool = False):
    """The fused kernel of a Newton iteration: energy, gradient on the window and Gauss-Newton factor of all terms.

    From iteration `exact_from` on also the geometric stiffness of terms that span two edges: the factor, compression included,
    and this make the exact Hessian.

    Compression lowers the stiffness across an edge, which can make the matrix indefinite: `clamped` rods do without that.
    With `reuse` the factor is written once a step, at the first iterate. Energies go to the slot that the line search does not
    hold (`1 - slot[r]`). `stale` is raised where frames have to be renewed before the next step. `stiffness` is the largest a term
    has against moving its first edge [N/m]. Thread (0, 0) clears `active`, which the sweep then raises.
    """
    V = wp.types.vector(kind.dim, real)
    until = until_function(kind.serial)
    _, window, lagged, _ = gather_functions(kind, real)
    curved, begin = exact_from is not None, exact_from or 0
    # Not a loop over the terms: what depends on a loop variable, wp.static(each[i]), Warp resolves by generating all code of a kernel
    # whenever it is defined, compiled before or not, 0.3 s each. A function that calls itself costs a step on the CPU 5 %.
    terms, everywhere = len(kind.terms), kind.terms[0].measure.span == 1
    W = wp.types.vector(kind.window, real)
    evaluate_first, evaluate_last = (evaluate_functions(kind, at, real, linear, curved, split) for at in (0, -1))
    options = CPU_OPTIONS | {"max_unroll": kind.geometric_rows} if curved else CPU_OPTIONS
    stale = next((term.measure.stale(real) for term in kind.terms if term.measure.stale), None)
    size, closed = kind.window, kind.closed

    # three blocks a multiprocessor: 168 registers instead of 170 are worth 30 % at 100,000 rods on an H200; second derivatives in
    # float64 need more, and take a quarter less time with two
    blocks = 2 if curved and linear == wp.float64 else 3

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, launch_bounds=(128, blocks), module_options=options
    )
    def evaluate(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        clamped: wp.array(dtype=int),
        reuse: int,
        factor_out: wp.array3d(dtype=linear),
        geometric_out: wp.array3d(dtype=linear),
        gradient_out: wp.array3d(dtype=real),
        energy_out: wp.array3d(dtype=real),
        stiffness_out: wp.array2d(dtype=linear),
    ):
        start, r = wp.tid()
        if start == 0 and r == 0:
            flags[ACTIVE, 0] = 0
        n = count[r]
        if flags[STATUS, r] != 0 or start >= n - wp.static(0 if closed else 1):
            return
        frozen = reuse != 0 and flags[ITERATION, r] > 0
        exact = flags[ITERATION, r] >= wp.static(begin)
        rate = scalars[RATE, r]
        carried = scalars[CARRIED, r]
        for k in range(start, until(start, n - wp.static(0 if closed else 1))):
            whole = wp.static(closed) or k < n - 2
            q = window(x, theta, k, n, whole, r)
            s = lagged(frame, k, n, whole, r)
            energy = real(0.0)
            f = W()
            stiffest = real(0.0)
            if whole or wp.static(everywhere):
                own, part, stiff = evaluate_first(
                    q,
                    s,
                    buffer,
                    table,
                    last,
                    rate,
                    clamped[r],
                    frozen,
                    exact,
                    carried,
                    factor_out,
                    geometric_out,
                    k,
                    r,
                )
                energy += own
                f += part
                stiffest = wp.max(stiffest, stiff)
            if wp.static(terms > 1):
                own_too, part_too, stiff_too = evaluate_last(
                    q,
                    s,
                    buffer,
                    table,
                    last,
                    rate,
                    clamped[r],
                    frozen,
                    exact,
                    carried,
                    factor_out,
                    geometric_out,
                    k,
                    r,
                )
                energy += own_too
                f += part_too
                stiffest = wp.max(stiffest, stiff_too)
            energy_out[1 - flags[SLOT, r], k, r] = energy
            stiffness_out[k, r] = linear(stiffest)
            for i in range(wp.static(size)):
                gradient_out[i, k, r] = f[i]
            if wp.static(stale is not None):
                if whole and stale(q, s):
                    flags[STALE, r] = 1

    return evaluate

"""What the implicit midpoint rule makes of the energy: of a step from x0 over the midpoint x to x1 = 2 x - x0

    E(x1) - E(x0) - dE/dx(x) . (x1 - x0) + (f - f(x)) . (x1 - x0),

with E the elastic energy and f the loads that follow what they act on, which the rule takes where it predicts x. All else it accounts
for exactly: what its forces do along x1 - x0 is the change of kinetic energy, M (v1 - v0) . (v1 + v0) / 2, the work of loads and
supports, or dissipated. It is zero where E is quadratic in x and nothing follows; where steps turn stiff elements far it adds up, at
worst without a bound (Simo and Tarnow, Z. angew. Math. Phys. 43, 1992, 757).
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import outcome
from ddg_warp.kernels.chain import ChainKind, gather_functions, inertia_type, term_functions
from ddg_warp.kernels.islands import PROGRESS, RATE, STATUS
from ddg_warp.kernels.terms import Term
from ddg_warp.kernels.threads import CPU_OPTIONS

DRIFT, ROUNDING, HELD, DISSIPATED = range(4)  # rows of a balance
ROWS = 4


@cache
def balance_function(term: Term, real):
    """balance(q0, s0, q, s, w, p, floor) of one element -> its rows.

    They are what a step makes of its energy; what rounding may leave in that, `floor` the relative rounding of a position; its
    elastic energy at the end; and what its viscosity takes in. `q0`, `q` are its dofs, `s0`, `s` its lagged data, at the start and in
    the middle, `reach` is how large a position is.
    """
    measure, density = term.measure, term.density
    Q, S, E, _ = measure.types(real)
    n = len(measure.strains)
    size = density.parameter_size(n)
    P, B = wp.types.vector(size, real), wp.types.vector(ROWS, real)
    strains_of, jacobian_of, *_ = measure.functions(real)
    energy_of, slope_of, _ = density.functions(real, n)
    lagged = density.lagged

    @wp.func
    def balance(q0: Q, s0: S, q: Q, s: S, w: real, p: P, reach: real, floor: real):
        elastic = p
        if wp.static(lagged):
            elastic[wp.static(size - 1)] = real(0.0)  # without a rate there are no viscous stresses
        step = (q - q0) * real(2.0)
        middle, jacobian = jacobian_of(q, s, w)
        strain = jacobian * step
        slope = slope_of(middle, elastic)
        start = w * energy_of(strains_of(q0, s0, w), elastic)
        end = w * energy_of(strains_of(q0 + step, s, w), elastic)
        taken = real(0.0)
        if wp.static(lagged):
            taken = w * wp.dot(slope_of(middle, p) - slope, strain)
        force = wp.max(wp.abs((slope * w) * jacobian))
        rounding = floor * (wp.abs(start) + wp.abs(end) + force * reach)
        # that of a magnet may be negative, and counts by its size
        return B(end - start - w * wp.dot(slope, strain), rounding, wp.abs(end), taken)

    return balance


@cache
def window_function(kind: ChainKind, index: int, real):
    """at(window0, lagged0, window, lagged, ...) of the terms 0 to `index` of a chain: the sum of their rows of element k of rod r.

    It calls itself for those before the last: a loop over functions would generate all code whenever the kernel is defined.
    """
    term = kind.terms[index]
    everywhere = term.measure.span == 1
    before = window_function(kind, index - 1, real) if index else None
    load, local, short, _ = term_functions(kind, index, real)
    balance = balance_function(term, real)
    W, S, B = wp.types.vector(kind.window, real), wp.types.vector(13, real), wp.types.vector(ROWS, real)

    @wp.func
    def at(
        window0: W,
        lagged0: S,
        window: W,
        lagged: S,
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        last: wp.array3d(dtype=real),
        rate: real,
        whole: bool,
        reach: real,
        floor: real,
        k: int,
        r: int,
    ):
        rows = B()
        if wp.static(index > 0):
            rows += before(window0, lagged0, window, lagged, buffer, table, last, rate, whole, reach, floor, k, r)
        if whole or wp.static(everywhere):
            w, p = load(buffer, table, last, rate, k, r)
            rows += balance(local(window0), short(lagged0), local(window), short(lagged), w, p, reach, floor)
        return rows

    return at


@cache
def chain_kernel(kind: ChainKind, real, linear):
    """Rows of a step of every rod, summed over ranges: range i holds the nodes i, i + ranges, ... (see `kernels.parallel_search`)."""
    V, B = wp.types.vector(kind.dim, real), wp.types.vector(ROWS, real)
    _, window, lagged, _ = gather_functions(kind, real)
    rows_of_all = window_function(kind, len(kind.terms) - 1, real)
    twist, closed, drag, Inertia = kind.twist, kind.closed, kind.drag, inertia_type(kind, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        theta0: wp.array2d(dtype=real),
        omega0: wp.array2d(dtype=real),
        frame0: wp.array3d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        last: wp.array3d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        buffer: wp.array(dtype=real),
        table: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        mass: wp.array2d(dtype=Inertia),
        rotary: wp.array2d(dtype=real),
        load: wp.array2d(dtype=V),
        load_angle: wp.array2d(dtype=real),
        load_there: wp.array2d(dtype=V),
        load_angle_there: wp.array2d(dtype=real),
        follows: int,
        stiffness: wp.array2d(dtype=linear),
        damping: wp.array(dtype=real),
        floor: real,
        ranges: int,
        rows_out: wp.array3d(dtype=real),
    ):
        """`load` and `load_angle` are those of the iterate, those `there` those that the step was solved with."""
        start, r = wp.tid()
        if scalars[PROGRESS, r] >= real(1.0):
            return
        n = count[r]
        total = B()
        for k in range(start, n, ranges):
            if wp.static(drag):
                m = mass[k, r].mass
            else:
                m = mass[k, r]
            here = x[k, r]
            moved = here - x0[k, r]
            v = moved * (real(2.0) * scalars[RATE, r]) - v0[k, r]
            kinetic = real(0.5) * m * wp.length_sq(v)
            damped = real(2.0) * damping[0] * scalars[RATE, r] * m * wp.length_sq(moved)
            if wp.static(twist):
                turned = theta[k, r] - theta0[k, r]
                spin = turned * (real(2.0) * scalars[RATE, r]) - omega0[k, r]
                kinetic += real(0.5) * rotary[k, r] * spin * spin
                damped += real(2.0) * damping[0] * scalars[RATE, r] * rotary[k, r] * turned * turned
                if wp.static(drag):
                    damped += real(2.0) * mass[k, r].spin * turned * turned
            if wp.static(drag):
                away = here - mass[k, r].carried
                damped += real(2.0) * wp.dot(away, mass[k, r].resistance * away)
            made = real(0.0)
            worked = real(0.0)
            if follows != 0:
                made = wp.dot(load_there[k, r] - load[k, r], moved)
                worked = wp.abs(wp.dot(load[k, r], moved))
                if wp.static(twist):
                    turned = theta[k, r] - theta0[k, r]
                    made += (load_angle_there[k, r] - load_angle[k, r]) * turned
                    worked += wp.abs(load_angle[k, r] * turned)
            total += B(real(2.0) * made, real(2.0) * floor * worked, kinetic, damped)
            if wp.static(closed) or k < n - 1:
                whole = wp.static(closed) or k < n - 2
                reach = wp.max(wp.abs(here))
                q0 = window(x0, theta0, k, n, whole, r)
                q = window(x, theta, k, n, whole, r)
                s0 = lagged(frame0, k, n, whole, r)
                s = lagged(frame, k, n, whole, r)
                total += rows_of_all(q0, s0, q, s, buffer, table, last, scalars[RATE, r], whole, reach, floor, k, r)
                least = floor * reach
                total[wp.static(ROUNDING)] = total[wp.static(ROUNDING)] + real(stiffness[k, r]) * least * least
        for i in range(wp.static(ROWS)):
            rows_out[i, start, r] = total[i]

    return measure


@cache
def judge_kernel(real):
    """Enters a solved step of every rod or world in its account, or has it fail.

    The account holds all that the scheme has made of the energy and what rounding may have, the largest kinetic and elastic energy,
    and all that was dissipated. A step fails that brings what was made beyond the fraction `bound` of the energy held and dissipated,
    and farther from zero.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def judge(
        rows: wp.array3d(dtype=real),
        bound: real,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        account: wp.array2d(dtype=real),
        failed_out: wp.array2d(dtype=real),
    ):
        r = wp.tid()
        if scalars[PROGRESS, r] >= real(1.0) or flags[STATUS, r] > wp.static(outcome.CONVERGED_TO_ROUNDING):
            return
        drift = account[wp.static(DRIFT), r]
        rounding = account[wp.static(ROUNDING), r]
        held = real(0.0)
        dissipated = account[wp.static(DISSIPATED), r]
        before = wp.abs(drift)
        for i in range(rows.shape[1]):
            drift += rows[wp.static(DRIFT), i, r]
            rounding += rows[wp.static(ROUNDING), i, r]
            held += rows[wp.static(HELD), i, r]
            dissipated += rows[wp.static(DISSIPATED), i, r]
        held = wp.max(held, account[wp.static(HELD), r])
        allowed = bound * (held + dissipated) + rounding
        if not wp.abs(drift) <= wp.max(allowed, before):
            flags[STATUS, r] = wp.static(outcome.ENERGY_DRIFT)
            failed_out[0, r] = drift
            failed_out[1, r] = held + dissipated
            return
        account[wp.static(DRIFT), r] = drift
        account[wp.static(ROUNDING), r] = rounding
        account[wp.static(HELD), r] = held
        account[wp.static(DISSIPATED), r] = dissipated

    return judge

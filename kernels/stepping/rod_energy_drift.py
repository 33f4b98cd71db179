"""What the implicit midpoint rule makes of the energy: of a step from x0 over the midpoint x to x1 = 2 x - x0

    E(x1) - E(x0) - dE/dx(x) . (x1 - x0) + (f - f(x)) . (x1 - x0),

with E the elastic energy and f the loads that follow what they act on, which the rule takes where it predicts x. All else it accounts
for exactly: what its forces do along x1 - x0 is the change of kinetic energy, M (v1 - v0) . (v1 + v0) / 2, the work of loads and
supports, or dissipated. It is zero where E is quadratic in x and nothing follows; where steps turn stiff elements far it adds up, at
worst without a bound (Simo and Tarnow, Z. angew. Math. Phys. 43, 1992, 757).
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import INVERSE_STEP, STATUS, STEP_PROGRESS
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.element_path import ElementStorage, parameter_function
from ddg_warp.kernels.elements.rod_layout import RodKind, inertia_type, rod_storage
from ddg_warp.kernels.terms import Term

DRIFT, ROUNDING, FIXED, DISSIPATED = range(4)  # rows of a balance
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
def rows_function(storage: ElementStorage, index: int, real):
    """Build `rows_at`: return the rows of an element, summed over the terms 0 to `index` that it has.

    It calls itself for those before the last: a loop over functions would generate all code whenever the kernel is defined.
    """
    own, Inputs, W, L = storage.terms[index], storage.Inputs, storage.Window, storage.Lagged
    everywhere = own.term.measure.span != 2 or len(storage.terms) == 1
    before = rows_function(storage, index - 1, real) if index else None
    local, short, parameters = own.local, own.short, parameter_function(storage, index, real)
    balance, B = balance_function(own.term, real), wp.types.vector(ROWS, real)

    @wp.func
    def rows_at(
        inputs: Inputs,
        window0: W,
        lagged0: L,
        window: W,
        lagged: L,
        whole: bool,
        reach: real,
        floor: real,
        island: int,
        e: int,
        at: int,
    ):
        rows = B()
        if wp.static(index > 0):
            rows += before(inputs, window0, lagged0, window, lagged, whole, reach, floor, island, e, at)
        if whole or wp.static(everywhere):
            w, p = parameters(inputs, island, e, at)
            rows += balance(local(window0), short(lagged0), local(window), short(lagged), w, p, reach, floor)
        return rows

    return rows_at


@cache
def rod_kernel(kind: RodKind, real, linear):
    """Build the kernel of the rows of a step of every rod, summed over ranges.

    Range i holds the nodes i, i + ranges, ...; see `kernels.newton.line_search_parallel`.
    """
    V, B, storage = wp.types.vector(kind.dim, real), wp.types.vector(ROWS, real), rod_storage(kind, real)
    Inputs, read, column_of, whole_of = storage.Inputs, storage.read, storage.column, storage.whole
    rows_of_all = rows_function(storage, len(kind.terms) - 1, real)
    twist, closed, drag, Inertia = kind.twist, kind.closed, kind.drag, inertia_type(kind, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        start: Inputs,
        middle: Inputs,
        v0: wp.array2d(dtype=V),
        omega0: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
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
        first, r = wp.tid()
        if scalars[STEP_PROGRESS, r] >= real(1.0):
            return
        n = middle.count[r]
        total = B()
        for k in range(first, n, ranges):
            if wp.static(drag):
                m = mass[k, r].mass
            else:
                m = mass[k, r]
            here = middle.x[k, r]
            moved = here - start.x[k, r]
            v = moved * (real(2.0) * scalars[INVERSE_STEP, r]) - v0[k, r]
            kinetic = real(0.5) * m * wp.length_sq(v)
            damped = real(2.0) * damping[0] * scalars[INVERSE_STEP, r] * m * wp.length_sq(moved)
            if wp.static(twist):
                turned = middle.theta[k, r] - start.theta[k, r]
                spin = turned * (real(2.0) * scalars[INVERSE_STEP, r]) - omega0[k, r]
                kinetic += real(0.5) * rotary[k, r] * spin * spin
                damped += real(2.0) * damping[0] * scalars[INVERSE_STEP, r] * rotary[k, r] * turned * turned
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
                    turned = middle.theta[k, r] - start.theta[k, r]
                    made += (load_angle_there[k, r] - load_angle[k, r]) * turned
                    worked += wp.abs(load_angle[k, r] * turned)
            total += B(real(2.0) * made, real(2.0) * floor * worked, kinetic, damped)
            if wp.static(closed) or k < n - 1:
                whole = whole_of(middle, r, k)
                reach = wp.max(wp.abs(here))
                q0, s0 = read(start, r, k, whole)
                q, s = read(middle, r, k, whole)
                at = column_of(middle, r, k)
                total += rows_of_all(middle, q0, s0, q, s, whole, reach, floor, r, k, at)
                least = floor * reach
                total[wp.static(ROUNDING)] = total[wp.static(ROUNDING)] + real(stiffness[k, r]) * least * least
        for i in range(wp.static(ROWS)):
            rows_out[i, first, r] = total[i]

    return measure


@cache
def drift_kernel(real):
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
        if scalars[STEP_PROGRESS, r] >= real(1.0) or flags[STATUS, r] > wp.static(outcome.CONVERGED_TO_ROUNDING):
            return
        drift = account[wp.static(DRIFT), r]
        rounding = account[wp.static(ROUNDING), r]
        held = real(0.0)
        dissipated = account[wp.static(DISSIPATED), r]
        before = wp.abs(drift)
        for i in range(rows.shape[1]):
            drift += rows[wp.static(DRIFT), i, r]
            rounding += rows[wp.static(ROUNDING), i, r]
            held += rows[wp.static(FIXED), i, r]
            dissipated += rows[wp.static(DISSIPATED), i, r]
        held = wp.max(held, account[wp.static(FIXED), r])
        allowed = bound * (held + dissipated) + rounding
        if not wp.abs(drift) <= wp.max(allowed, before):
            flags[STATUS, r] = wp.static(outcome.ENERGY_DRIFT)
            failed_out[0, r] = drift
            failed_out[1, r] = held + dissipated
            return
        account[wp.static(DRIFT), r] = drift
        account[wp.static(ROUNDING), r] = rounding
        account[wp.static(FIXED), r] = held
        account[wp.static(DISSIPATED), r] = dissipated

    return judge

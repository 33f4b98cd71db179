"""Discrete energy balance of the implicit midpoint rule.

The energy drift of a step from x0 over the midpoint x to x1 = 2 x - x0 is

    E(x1) - E(x0) - dE/dx(x) . (x1 - x0) + (f - f(x)) . (x1 - x0),

with E the elastic energy and f the follower loads, which the rule evaluates at the predicted x. All other work is exact: the
forces' work along x1 - x0 is the change of kinetic energy, M (v1 - v0) . (v1 + v0) / 2, the work of loads and supports, or
dissipation. The drift is zero where E is quadratic in x and no load follows. It accumulates, at worst without a bound, where steps
rotate stiff elements far (Simo and Tarnow, Z. angew. Math. Phys. 43, 1992, 757).

Elements and nodes of an island contribute rows, summed over fixed ranges. Range i has the items i, i + ranges, ..., so that
neighbouring threads read neighbouring items. In the coupled system every item is a range, and `Sums` add the rows.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.inertia import block_inertia, node_inertia
from ddg_warp.kernels.core.islands import INVERSE_STEP, STATUS, STEP_PROGRESS
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.nodes import NodeStorage, dof_functions, mass_functions, state_type
from ddg_warp.kernels.elements.element_path import ElementStorage, parameter_function
from ddg_warp.kernels.terms import Term

DRIFT, ROUNDING, ENERGY, DISSIPATED = range(4)  # rows of a balance
ROWS = 4


@cache
def balance_function(term: Term, real):
    """Return the device function `balance(q0, s0, q, s, w, p, magnitude, rounding_factor) -> rows` of one element.

    Rows: energy drift of the step, its rounding bound, elastic energy at the end, viscous dissipation. `q0`, `q` are the dofs and
        `s0`, `s` the lagged data at the start and the midpoint. `magnitude` is the magnitude of positions, `rounding_factor` their
        relative rounding.
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
    def balance(q0: Q, s0: S, q: Q, s: S, w: real, p: P, magnitude: real, rounding_factor: real):
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
        rounding = rounding_factor * (wp.abs(start) + wp.abs(end) + force * magnitude)
        # a magnet's energy may be negative: its magnitude counts
        return B(end - start - w * wp.dot(slope, strain), rounding, wp.abs(end), taken)

    return balance


@cache
def rows_function(storage: ElementStorage, index: int, real):
    """Return the device function `rows_at`: rows of an element, summed over its terms 0 to `index`.

    It recurses over the terms. Alternative: a loop over functions, for which Warp generates all code whenever the kernel is
    defined.
    """
    access, Inputs, W, L = storage.terms[index], storage.Inputs, storage.Window, storage.Lagged
    everywhere = access.term.measure.span != 2 or len(storage.terms) == 1
    before = rows_function(storage, index - 1, real) if index else None
    local, short, parameters = access.local, access.short, parameter_function(storage, index, real)
    balance, B = balance_function(access.term, real), wp.types.vector(ROWS, real)

    @wp.func
    def rows_at(
        inputs: Inputs,
        window0: W,
        lagged0: L,
        window: W,
        lagged: L,
        whole: bool,
        magnitude: real,
        rounding_factor: real,
        island: int,
        e: int,
        column: int,
    ):
        rows = B()
        if wp.static(index > 0):
            rows += before(
                inputs, window0, lagged0, window, lagged, whole, magnitude, rounding_factor, island, e, column
            )
        if whole or wp.static(everywhere):
            w, p = parameters(inputs, island, e, column)
            rows += balance(
                local(window0), short(lagged0), local(window), short(lagged), w, p, magnitude, rounding_factor
            )
        return rows

    return rows_at


@cache
def element_kernel(storage: ElementStorage, real, linear):
    """Build the kernel of the rows of elements.

    `measure`: sum rows of a step over the elements first, first + ranges, ... of an island.

    A start state and a middle, the solution of the solve, come as inputs of elements.
    """
    B, Inputs, items, count_of = wp.types.vector(ROWS, real), storage.Inputs, storage.items, storage.count
    whole_of, read, column_of, reach_of = storage.whole, storage.read, storage.column, storage.reach
    rows_of_all = rows_function(storage, len(storage.terms) - 1, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        start: Inputs,
        middle: Inputs,
        stiffness: wp.array(dtype=linear),
        scalars: wp.array2d(dtype=real),
        rounding_factor: real,
        ranges: int,
        rows_out: wp.array3d(dtype=real),
    ):
        i, j = wp.tid()
        island, first = items(i, j)
        if scalars[STEP_PROGRESS, island] >= real(1.0):
            return
        total = B()
        for e in range(first, count_of(middle, island), ranges):
            column = column_of(middle, island, e)
            whole = whole_of(middle, island, e)
            q0, s0 = read(start, island, e, whole)
            q, s = read(middle, island, e, whole)
            magnitude = reach_of(middle, island, e)
            total += rows_of_all(middle, q0, s0, q, s, whole, magnitude, rounding_factor, island, e, column)
            least = rounding_factor * magnitude
            total[wp.static(ROUNDING)] = total[wp.static(ROUNDING)] + real(stiffness[column]) * least * least
        for row in range(wp.static(ROWS)):
            rows_out[row, first, island] = total[row]

    return measure


@cache
def node_kernel(nodes: NodeStorage, real, quadratic: bool, square: bool):
    """Build the kernel of the rows of nodes; `square`: the quadratic potential is of quadratic drag, see `kernels.forces.drag`.

    `measure`: sum work of follower loads, kinetic energy at the end, and dissipation by damping and the quadratic potential, over the
    nodes first, first + ranges, ... of an island.
    """
    V, M, B = wp.types.vector(nodes.dim, real), nodes.mass_type(real), wp.types.vector(ROWS, real)
    State, (items, _), twist = state_type(nodes, real), nodes.thread_functions, nodes.twist
    (dofs, _), (masses, _) = dof_functions(nodes, real), mass_functions(nodes, real)
    Inertia = block_inertia(real) if nodes.coupled else node_inertia(nodes.dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def measure(
        before: State,
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        mass: wp.array2d(dtype=M),
        rotary: wp.array2d(dtype=real),
        resisted: wp.array2d(dtype=Inertia),
        count: wp.array(dtype=int),
        load: wp.array2d(dtype=V),
        load_angle: wp.array2d(dtype=real),
        load_solved: wp.array2d(dtype=V),
        load_angle_solved: wp.array2d(dtype=real),
        follows: int,
        scalars: wp.array2d(dtype=real),
        damping: wp.array(dtype=real),
        rounding_factor: real,
        ranges: int,
        rows_out: wp.array3d(dtype=real),
    ):
        """Sum rows; `load` is the load at the iterate x, `load_solved` the load of the solve, `resisted` the inertia."""
        i, j = wp.tid()
        island, first = items(i, j)
        if scalars[STEP_PROGRESS, island] >= real(1.0):
            return
        rate = real(2.0) * scalars[INVERSE_STEP, island]
        total = B()
        for k in range(first, count[island], ranges):
            m = masses(mass, rotary, k, island)
            moved = dofs(x, theta, k, island) - dofs(before.x, before.theta, k, island)
            v = moved * rate - dofs(before.v, before.omega, k, island)
            kinetic = real(0.5) * wp.dot(wp.cw_mul(m, v), v)
            damped = damping[0] * rate * wp.dot(wp.cw_mul(m, moved), moved)
            if wp.static(quadratic):
                away = x[k, island] - resisted[k, island].reference
                relative = away  # moved less the fluid
                if wp.static(square):
                    offset = (before.x[k, island] - resisted[k, island].reference) * real(2.0)
                    relative = x[k, island] - before.x[k, island] + offset
                    relative += before.v[k, island] / scalars[INVERSE_STEP, island]
                damped += real(2.0) * wp.dot(relative, resisted[k, island].stiffness * away)
                if wp.static(twist):
                    rotated = moved[wp.static(nodes.dim)]
                    damped += real(2.0) * resisted[k, island].spin * rotated * rotated
            made = real(0.0)
            worked = real(0.0)
            if follows != 0:
                force = dofs(load, load_angle, k, island)
                made = wp.dot(dofs(load_solved, load_angle_solved, k, island) - force, moved)
                worked = wp.abs(wp.dot(force, moved))
            total += B(real(2.0) * made, real(2.0) * rounding_factor * worked, kinetic, damped)
        for row in range(wp.static(ROWS)):
            rows_out[row, first, island] = total[row]

    return measure


@cache
def drift_kernel(real):
    """Build the kernel that accumulates the energy balance of every rod or world.

    `record`: add a solved step to the account, or fail the step. The account holds the total drift and its rounding bound, the
    largest kinetic plus elastic energy, and the total dissipation. A step fails if the total drift exceeds the fraction `bound` of
    that energy plus dissipation, and grows.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def record(
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
        energy = real(0.0)
        dissipated = account[wp.static(DISSIPATED), r]
        before = wp.abs(drift)
        for i in range(rows.shape[1]):
            drift += rows[wp.static(DRIFT), i, r]
            rounding += rows[wp.static(ROUNDING), i, r]
            energy += rows[wp.static(ENERGY), i, r]
            dissipated += rows[wp.static(DISSIPATED), i, r]
        energy = wp.max(energy, account[wp.static(ENERGY), r])
        allowed = bound * (energy + dissipated) + rounding
        if not wp.abs(drift) <= wp.max(allowed, before):
            flags[STATUS, r] = wp.static(outcome.ENERGY_DRIFT)
            failed_out[0, r] = drift
            failed_out[1, r] = energy + dissipated
            return
        account[wp.static(DRIFT), r] = drift
        account[wp.static(ROUNDING), r] = rounding
        account[wp.static(ENERGY), r] = energy
        account[wp.static(DISSIPATED), r] = dissipated

    return record

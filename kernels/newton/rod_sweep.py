"""Block LDL^T sweep of a rod: one thread takes a Newton iteration from element factors and forces to new dofs.

The matrix of an open rod is block-pentadiagonal; a block has the position of a node and the twist angle of the edge that starts
there. It is H = sum F^T F + c I (edges) + inertia, plus the geometric stiffness if enabled.

The sweep forms blocks in registers, reads the residual of `balance` and eliminates node by node. At the end of the rod it knows the
change of the energy and the predicted decrease r^T H^-1 r. Then it either rejects the iterate and shortens the step, or substitutes
back and takes the next step. Physics enters as factor rows only.

Line search (Armijo, c = 1e-4) on the energy, summed as differences per element. If the predicted decrease is below the rounding
floor, a smaller r^T H^-1 r accepts instead (natural monotonicity test; Deuflhard, Newton Methods for Nonlinear Problems, 2004).

Why not shared with `kernels.newton.coupled_newton`: one thread a rod eliminates, decides and moves in one launch an iteration. A world
of the coupled system needs sums over all dof blocks and an iterative solve between these, each in launches of its own.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import (
    ANGLE_STEP_LEFT,
    ANY_ACTIVE,
    BACKTRACKS,
    DROP_COMPRESSION,
    EDGES_ROTATED,
    ENERGY_BUFFER,
    FRAMES_OUTDATED,
    INERTIA_COEFFICIENT,
    ITERATE_ACTION,
    ITERATION,
    LOAD_SCALE,
    LOST_PIVOTS_TOTAL,
    MAX_EDGE_STIFFNESS,
    MAX_RESIDUAL,
    PREDICTED_DECREASE,
    STATUS,
    STEP_LENGTH,
    STRAIGHT_ROTATION_LIMIT,
    projected_limit_function,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, inertia_type
from ddg_warp.kernels.linear import block_ldlt, geometric_stiffness, mixed_axial_force
from ddg_warp.kernels.linear.prefetch import prefetch_functions, read_functions
from ddg_warp.kernels.linear.rod_matrix import block_functions
from ddg_warp.kernels.newton.line_search import line_search_functions
from ddg_warp.kernels.newton.rod_iterate import ROTATE_EDGES, UPDATE_FRAMES, search_functions


@cache
def sweep_kernel(
    kind: RodKind, real, linear, exact_from: int | None = None, fails: bool = False, mixed_axial: bool = False
):
    """Build the kernel of one Newton iteration for one kind of rod.

    `sweep`: eliminate, test the iterate, and shorten the step or take the next one.

    From iteration `exact_from` on, the matrix includes the geometric stiffness G. A lost pivot ends the solve if it `fails`.
    Otherwise the iterate is repeated with `clamped[r]` raised: without compression and, for this iteration, without G. If
        `mixed_axial`, factors end with the slack of edges, and directions with the lengthening of edges; see
        `kernels.linear.mixed_axial_force`.
    """
    balanced, _ = line_search_functions(kind.twist, real)
    out_of_patience = projected_limit_function(real)
    dim, nb, twist, span = kind.dim, kind.block, kind.twist, kind.span
    window, nb2, drag, Inertia = kind.window, kind.block**2, kind.drag, inertia_type(kind, real)
    V, H, M = wp.types.vector(dim, real), wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    factor_block, lower, upper, lower_vector, upper_vector, congruence = block_ldlt.functions(nb, linear)
    *_, shorter = search_functions(kind, real, linear)
    angle, rows = nb - 1, kind.factor_rows + mixed_axial
    # Measured: in float64 prefetching takes more registers than a GPU has; 10 % slower on an H200.
    prefetch = kind.serial or linear == wp.float32
    tension_row = 2 * nb2 + nb  # row of the kept data where tensions begin
    kept_size = tension_row + (mixed_axial_force.kept_rows(nb) if mixed_axial else 0)
    Pending, eliminate = mixed_axial_force.functions(nb, linear)
    longer = mixed_axial_force.longer_function(dim, real, linear)
    vertex_rows, edge_rows, tensions = kind.vertex_strains, kind.edge_strains, kind.tensions
    exact, begin = exact_from is not None, exact_from or 0
    slack_row = kind.factor_rows
    aa, ab, ac, bb, bc, cc = geometric_stiffness.block_functions(kind, linear)
    rows_of, entry, part, with_angle, positions = read_functions(kind, linear, rows, prefetch)
    kept, left_at, times = prefetch_functions(nb, linear, kept_size, prefetch)
    _, store, vector, _ = block_functions(nb, linear)

    # Measured: spilling registers beyond 255 to shared memory gains 8 % on an H200; with tensions it costs 12 %.
    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=128,
        enable_cuda_smem_spilling=not mixed_axial,
        module_options=CPU_OPTIONS,
    )
    def sweep(
        F: wp.array3d(dtype=linear),
        G: wp.array3d(dtype=linear),
        # balance
        rhs: wp.array3d(dtype=linear),
        energy_change: wp.array2d(dtype=real),
        energy_noise: wp.array2d(dtype=linear),
        run: int,
        count: wp.array(dtype=int),
        # inertia
        mass: wp.array2d(dtype=Inertia),
        rotary: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        # options
        rounding_factor: real,
        rotation_cap: real,
        max_iterations: int,
        max_halvings: int,
        # iterate
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        base: wp.array2d(dtype=V),
        Y: wp.array3d(dtype=linear),
        direction: wp.array3d(dtype=linear),
        # state of the line search
    ):
        r = wp.tid()
        if balanced(flags, scalars, r):
            return
        n = count[r]
        first = flags[ITERATION, r] == 0
        taken = scalars[STEP_LENGTH, r]
        c = scalars[INERTIA_COEFFICIENT, r]
        accepted_slot = flags[ENERGY_BUFFER, r]
        Waa = M()
        Wab = M()
        Wac = M()
        Wbb = M()
        Wbc = M()
        Wcc = M()
        ra = H()
        rb = H()
        worst = linear(0.0)  # largest residual
        newton = real(0.0)  # r^T H^-1 r
        lost_here = int(0)
        if wp.static(mixed_axial):
            pending = Pending()
            pending.pivot = linear(1.0)
        # Prefetch: data of the next node is read before this node is processed, since a sweeping thread mostly waits for memory.
        f = rows_of(F, 0, r)
        rj = vector(rhs, 0, 0, r)
        mask = fixed[0, r]
        node_mass = real(0.0)
        spin = real(0.0)
        if wp.static(not drag):
            node_mass = mass[0, r]
        if wp.static(twist):
            spin = rotary[0, r]
        for j in range(n):
            next = wp.min(j + 1, n - 1)
            f_ahead = rows_of(F, next, r)
            r_ahead = vector(rhs, 0, next, r)
            mask_ahead = fixed[next, r]
            node_mass_ahead = real(0.0)
            spin_ahead = real(0.0)
            if wp.static(not drag):
                node_mass_ahead = mass[next, r]
            if wp.static(twist):
                spin_ahead = rotary[next, r]
            if wp.static(span == 2):
                if j < n - 2:
                    for m in range(wp.static(vertex_rows)):
                        row = m * wp.static(window)
                        a = part(f, F, row, j, r)
                        C = part(f, F, row + wp.static(dim), j, r)
                        A = with_angle(f, F, row + wp.static(2 * dim), j, r, -a)
                        B = with_angle(f, F, row + wp.static(2 * dim + 1), j, r, a - C)
                        Waa += wp.outer(A, A)
                        Wab += wp.outer(A, B)
                        Wac += wp.outer(A, C)
                        Wbb += wp.outer(B, B)
                        Wbc += wp.outer(B, C)
                        Wcc += wp.outer(C, C)
                    if wp.static(exact):
                        if flags[DROP_COMPRESSION, r] == 0 and flags[ITERATION, r] >= wp.static(begin):
                            Waa += aa(G, j, r)
                            Wab += ab(G, j, r)
                            Wac += ac(G, j, r)
                            Wbb += bb(G, j, r)
                            Wbc += bc(G, j, r)
                            Wcc += cc(G, j, r)
            if j < n - 1:
                edge_row = wp.static(vertex_rows * window)
                for m in range(wp.static(edge_rows)):
                    t = part(f, F, edge_row + m * wp.static(dim), j, r)
                    S = wp.outer(t, t)
                    Waa += S
                    Wab -= S
                    Wbb += S
                for m in range(wp.static(tensions)):
                    T = positions(entry(f, F, edge_row + wp.static(edge_rows * dim) + m, j, r))
                    Waa += T
                    Wab -= T
                    Wbb += T
            if wp.static(drag):
                inertia = linear(c * mass[j, r].mass)
                resistance = mass[j, r].resistance
                for d in range(wp.static(dim)):
                    for i in range(wp.static(dim)):
                        Waa[d, i] = Waa[d, i] + linear(resistance[d, i])
            else:
                inertia = linear(c * node_mass)
            for d in range(wp.static(dim)):
                Waa[d, d] = Waa[d, d] + inertia
            if wp.static(twist):
                Waa[wp.static(angle), wp.static(angle)] = Waa[wp.static(angle), wp.static(angle)] + linear(c * spin)
            worst = wp.max(worst, wp.max(wp.abs(rj)))
            if wp.static(mixed_axial):
                unmasked = H(linear(1.0))
            if mask != wp.uint8(0):
                free = H()
                for d in range(wp.static(nb)):
                    free[d] = linear(1 - ((int(mask) >> d) & 1))
                rows = wp.outer(free, H(linear(1.0)))
                Waa = wp.cw_mul(Waa, wp.outer(free, free)) + wp.diag(H(linear(1.0)) - free)
                Wab = wp.cw_mul(Wab, rows)
                Wac = wp.cw_mul(Wac, rows)
                ra = wp.cw_mul(ra, free)
                if wp.static(mixed_axial):
                    unmasked = free
            # Columns of fixed dofs ahead stay: the solution there is zero, and gathered values are masked with the rows.

            L, inverse, lost_pivots = factor_block(Waa)
            lost_here += lost_pivots
            z = lower_vector(L, rj + ra)
            newton += real(wp.dot(wp.cw_mul(z, inverse), z))
            y = upper_vector(L, inverse, z)
            if wp.static(not mixed_axial):
                for d in range(wp.static(nb)):
                    Y[wp.static(2 * nb2) + d, j, r] = y[d]
            Zb = lower(L, Wab)
            if wp.static(not mixed_axial):
                store(Y, 0, j, r, upper(L, inverse, Zb))
            zd = wp.cw_mul(z, inverse)
            ra = rb - zd * Zb
            Waa = Wbb - congruence(Zb, inverse, Zb)
            if wp.static(span == 2):
                Zc = lower(L, Wac)
                if wp.static(not mixed_axial):
                    store(Y, wp.static(nb2), j, r, upper(L, inverse, Zc))
                rb = -(zd * Zc)
                Wab = Wbc - congruence(Zb, inverse, Zc)
                Wbb = Wcc - congruence(Zc, inverse, Zc)
                if wp.static(mixed_axial):
                    edge = H()
                    loose = linear(0.0)
                    if j < n - 1:
                        edge = part(f, F, wp.static(vertex_rows * window), j, r)
                        loose = entry(f, F, wp.static(slack_row), j, r)
                    out = eliminate(L, inverse, z, Zb, Zc, pending, edge, loose, unmasked)
                    pending = out.pending
                    near = out.b * out.weight
                    far = out.c * out.weight
                    lag = out.load * out.weight
                    newton -= real(out.load * lag)
                    ra += near * out.load
                    rb += far * out.load
                    Waa += wp.outer(near, out.b)
                    Wab += wp.outer(near, out.c)
                    Wbb += wp.outer(far, out.c)
                    y += out.behind * lag
                    store(Y, 0, j, r, upper(L, inverse, Zb) + wp.outer(out.behind, near))
                    store(Y, wp.static(nb2), j, r, upper(L, inverse, Zc) + wp.outer(out.behind, far))
                    q = out.coupling * out.weight
                    ahead_too = out.ahead + out.behind * q
                    for d in range(wp.static(nb)):
                        Y[wp.static(2 * nb2) + d, j, r] = y[d]
                        Y[wp.static(tension_row) + d, j, r] = ahead_too[d]
                        Y[wp.static(tension_row + nb) + d, j, r] = near[d]
                        Y[wp.static(tension_row + 2 * nb) + d, j, r] = far[d]
                    Y[wp.static(tension_row + 3 * nb), j, r] = q
                    Y[wp.static(tension_row + 3 * nb + 1), j, r] = lag
            else:
                Wab = M()
                Wbb = M()
            Wac = M()
            Wbc = M()
            Wcc = M()
            f = f_ahead
            rj = r_ahead
            mask = mask_ahead
            node_mass = node_mass_ahead
            spin = spin_ahead

        scalars[MAX_RESIDUAL, r] = real(worst)
        change = real(0.0)  # of the energy, from the accepted iterate to this one
        rounding_error = real(0.0)  # rounding of `change`
        if not first:
            for i in range((n + run - 1) / run):
                change += energy_change[i, r]
                rounding_error += real(energy_noise[i, r])
        if first:
            if scalars[LOAD_SCALE, r] == real(0.0):
                scalars[LOAD_SCALE, r] = real(worst)
            flags[LOST_PIVOTS_TOTAL, r] = 0
        finite = wp.isfinite(worst) and wp.isfinite(newton) and wp.isfinite(change)
        if lost_here > 0 and flags[DROP_COMPRESSION, r] == 0:
            if wp.static(fails):
                flags[STATUS, r] = wp.static(outcome.INDEFINITE)
                return
            # The matrix is indefinite: repeat the iterate with compression (or the geometric stiffness) dropped.
            flags[DROP_COMPRESSION, r] = 1
            flags[ANY_ACTIVE, 0] = 1
            return
        accept = first and finite
        if first and not finite:
            flags[STATUS, r] = wp.static(outcome.NON_FINITE)
            return
        if not first and finite:
            expected = taken * scalars[PREDICTED_DECREASE, r]
            rounding_floor = rounding_factor * rounding_error
            if expected > real(10.0) * rounding_floor:
                accept = change <= real(-1.0e-4) * expected + rounding_floor
            else:
                accept = newton <= scalars[PREDICTED_DECREASE, r]
        if not accept:
            flags[BACKTRACKS, r] = flags[BACKTRACKS, r] + 1
            if flags[BACKTRACKS, r] > max_halvings:
                flags[STATUS, r] = wp.static(outcome.LINE_SEARCH_FAILED)
                return
            shortened = shorter(taken, taken * scalars[PREDICTED_DECREASE, r], change, finite)
            scalars[STEP_LENGTH, r] = shortened
            scalars[ANGLE_STEP_LEFT, r] = shortened - taken
            flags[ITERATE_ACTION, r] = wp.static(ROTATE_EDGES)
            flags[ANY_ACTIVE, 0] = 1
            return

        flags[ITERATION, r] = flags[ITERATION, r] + 1
        if flags[ITERATION, r] > max_iterations:
            flags[STATUS, r] = wp.static(outcome.MAX_ITERATIONS)
            return
        if wp.static(exact):
            if out_of_patience(flags, scalars, r):
                return
        flags[ANY_ACTIVE, 0] = 1
        flags[ENERGY_BUFFER, r] = 1 - accepted_slot
        scalars[PREDICTED_DECREASE, r] = newton
        flags[BACKTRACKS, r] = 0
        flags[EDGES_ROTATED, r] = 0
        flags[LOST_PIVOTS_TOTAL, r] = flags[LOST_PIVOTS_TOTAL, r] + lost_here
        if wp.static(twist):
            if flags[FRAMES_OUTDATED, r] != 0:
                # Twist angles change meaning in updated frames: take no step, and compute a direction there.
                flags[FRAMES_OUTDATED, r] = 0
                scalars[PREDICTED_DECREASE, r] = real(1.0e30)
                scalars[STEP_LENGTH, r] = real(0.0)
                flags[ITERATE_ACTION, r] = wp.static(UPDATE_FRAMES)
                return
        e1 = H()
        e2 = H()
        if wp.static(mixed_axial):
            next_axial_force = linear(0.0)
            axial_force = linear(0.0)
            per_root = linear(real(1.0) / wp.sqrt(scalars[MAX_EDGE_STIFFNESS, r]))
        rotation = real(0.0)
        x_ahead = V()
        left = kept(Y, n - 1, r)
        x_j = x[n - 1, r]
        twist_angle = real(0.0)
        if wp.static(twist):
            twist_angle = theta[n - 1, r]
        for i in range(n):
            j = n - 1 - i
            before = wp.max(j - 1, 0)
            left_before = kept(Y, before, r)
            x_before = x[before, r]
            twist_angle_before = real(0.0)
            if wp.static(twist):
                twist_angle_before = theta[before, r]
            step = -times(left, Y, 0, j, r, e1)
            if wp.static(span == 2):
                step -= times(left, Y, wp.static(nb2), j, r, e2)
            if wp.static(mixed_axial):
                # The tension ahead is known from the node there; the tension of the edge behind is for the node before.
                tension_behind = left_at(left, Y, wp.static(tension_row + 3 * nb), j, r) * next_axial_force
                tension_behind -= left_at(left, Y, wp.static(tension_row + 3 * nb + 1), j, r)
                for d in range(wp.static(nb)):
                    step[d] = step[d] - left_at(left, Y, wp.static(tension_row) + d, j, r) * next_axial_force
                    tension_behind += left_at(left, Y, wp.static(tension_row + nb) + d, j, r) * e1[d]
                    tension_behind += left_at(left, Y, wp.static(tension_row + 2 * nb) + d, j, r) * e2[d]
                axial_force = next_axial_force
                next_axial_force = tension_behind
            for d in range(wp.static(nb)):
                step[d] = step[d] + left_at(left, Y, wp.static(2 * nb2) + d, j, r)
                direction[d, j, r] = step[d]
            dx = V()
            bent = V()
            for d in range(wp.static(dim)):
                dx[d] = real(step[d])
                bent[d] = real(e1[d] - step[d])
            if i > 0:
                span_sq = wp.length_sq(x_ahead - x_j)
                rotation = wp.max(rotation, wp.length_sq(bent) / span_sq)
                if wp.static(mixed_axial):
                    slack = F[wp.static(slack_row), j, r]
                    direction[wp.static(nb), j, r] = longer(slack, axial_force, per_root, x_ahead - x_j, bent)
            x_ahead = x_j
            x[j, r] = x_j + dx
            if wp.static(twist):
                theta[j, r] = twist_angle + real(step[wp.static(angle)])
            e2 = e1
            e1 = step
            left = left_before
            x_j = x_before
            twist_angle = twist_angle_before
        whole = real(1.0)
        if rotation > rotation_cap * rotation_cap:
            whole = rotation_cap / wp.sqrt(rotation)
        if rotation > scalars[STRAIGHT_ROTATION_LIMIT, r] * scalars[STRAIGHT_ROTATION_LIMIT, r]:
            scalars[ANGLE_STEP_LEFT, r] = whole - real(1.0)
            flags[ITERATE_ACTION, r] = wp.static(ROTATE_EDGES)
        scalars[STEP_LENGTH, r] = whole

    return sweep

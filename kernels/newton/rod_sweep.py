"""Block LDL^T sweep of a rod: one thread takes a Newton iteration from element factors and forces to new dofs.

The matrix of an open rod is block-pentadiagonal; a block has the position of a node and the twist angle of the edge that starts
there. It is H = sum F^T F + c I (edges) + inertia, plus the geometric stiffness if enabled.

The sweep forms blocks in registers, reads the residual of `balance` and eliminates node by node. At the end of the rod it knows the
change of the energy and the predicted decrease r^T H^-1 r. Then it either rejects the iterate and shortens the step, or substitutes
back and takes the next step. Physics enters as factor rows only.

Line search (Armijo, c = 1e-4) on the energy, summed as differences per element. If the predicted decrease is below the rounding
floor, a smaller r^T H^-1 r accepts instead (natural monotonicity test; Deuflhard, Newton Methods for Nonlinear Problems, 2004).

Few rods give too few threads for a GPU. There, `two_sided_kernels` eliminate from both ends, by the same functions. Measured: 10,000
rods of 64 nodes in mixed precision, an H100: 0.15 ms an iteration instead of 0.20.

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
    NEEDS_DIRECTION,
    PREDICTED_DECREASE,
    STATUS,
    STEP_LENGTH,
    projected_limit_function,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, inertia_type
from ddg_warp.kernels.linear import block_ldlt, geometric_stiffness, mixed_axial_force
from ddg_warp.kernels.linear.prefetch import prefetch_functions, read_functions
from ddg_warp.kernels.linear.rod_matrix import block_functions
from ddg_warp.kernels.linear.twisted_factorisation import share
from ddg_warp.kernels.newton.line_search import converged_function, line_search_functions
from ddg_warp.kernels.newton.rod_iterate import ROTATE_EDGES, UPDATE_FRAMES, shorter_function, take_function


@cache
def kept_rows(kind: RodKind, mixed_axial: bool = False, sides: int = 1) -> int:
    """Return the number of reals of an eliminated node: U, the columns of V that may be nonzero, and data of tensions."""
    nb = kind.block
    return nb**2 + nb * _far_columns(kind, sides) + (mixed_axial_force.kept_rows(nb) if mixed_axial else 0)


def _far_columns(kind: RodKind, sides: int) -> int:
    """Return the columns of V: the twist angle of the edge after next is in no element with this node.

    From the far end of a rod, it is the twist angle of this node that is in no element with the node after next.
    """
    if kind.span == 1:
        return 0
    return kind.dim if sides == 1 else kind.block


@cache
def data_type(kind: RodKind, real, linear):
    """Return the struct of the arrays of a sweep: elements, residual, inertia, iterate, kept data and direction.

    The elimination replaces the residual of a node by y, the direction that it would have alone.
    """
    V, Inertia = wp.types.vector(kind.dim, real), inertia_type(kind, real)

    @wp.struct
    class Data:
        factor: wp.array3d(dtype=linear)
        second: wp.array3d(dtype=linear)
        rhs: wp.array3d(dtype=linear)
        change: wp.array2d(dtype=real)
        rounding_error: wp.array2d(dtype=linear)
        run: int
        count: wp.array(dtype=int)
        mass: wp.array2d(dtype=Inertia)
        rotary: wp.array2d(dtype=real)
        fixed: wp.array2d(dtype=wp.uint8)
        x: wp.array2d(dtype=V)
        theta: wp.array2d(dtype=real)
        kept: wp.array3d(dtype=linear)
        direction: wp.array3d(dtype=linear)

    return Data


@cache
def eliminate_function(kind: RodKind, real, linear, exact_from: int | None, mixed_axial: bool, sides: int):
    """Return the structs `Data` and `Front`, and the device function `eliminate` of some nodes of a rod, in order.

    `Front` is the state of an elimination: blocks and right-hand sides of the next node (a) and the one after (b), and sums.

    `eliminate(..., side, begin, end, vertices, edges, front)` eliminates nodes number `begin` to `end` of a side; elements start at
    the first `vertices` and `edges` of its nodes. Side 1 is the rod in reverse, whose elements start at their last node.
    """
    Data = data_type(kind, real, linear)
    dim, nb, twist, span = kind.dim, kind.block, kind.twist, kind.span
    window, nb2, quadratic = kind.window, kind.block**2, kind.quadratic
    H, M = wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    factor_block, lower, upper, lower_vector, upper_vector, congruence = block_ldlt.functions(nb, linear)
    angle, rows = nb - 1, kind.factor_rows + mixed_axial
    # Measured: in float64 prefetching takes more registers than a GPU has; 10 % slower on an H200.
    prefetch = kind.serial or linear == wp.float32
    columns = _far_columns(kind, sides)
    tension_row = nb2 + nb * columns  # row of the kept data where tensions begin
    Pending, eliminate_tension = mixed_axial_force.functions(nb, linear)
    vertex_rows, edge_rows, tensions = kind.vertex_strains, kind.edge_strains, kind.tensions
    exact, begin_exact = exact_from is not None, exact_from or 0
    slack_row = kind.factor_rows
    aa, ab, ac, bb, bc, cc = geometric_stiffness.block_functions(kind, linear)
    rows_of, entry, part, with_angle, positions = read_functions(kind, linear, rows, prefetch)
    _, store, vector, store_vector = block_functions(nb, linear)

    @wp.struct
    class Front:
        aa: M
        ab: M
        bb: M
        ra: H
        rb: H
        worst: linear  # largest residual
        newton: real  # r^T H^-1 r
        lost: int  # pivots

    @wp.func
    def indices(j: int, n: int, side: int):
        """Return node, vertex and edge that start at a side's j-th node; the nearest existing ones past the end."""
        if wp.static(sides == 1):
            return j, j, j
        if side == 0:
            return j, j, j
        return n - 1 - j, wp.max(n - 3 - j, 0), wp.max(n - 2 - j, 0)

    @wp.func
    def store_far(Y: wp.array3d(dtype=linear), k: int, r: int, m: M):
        for i in range(wp.static(nb)):
            for d in range(wp.static(columns)):
                Y[wp.static(nb2) + i * wp.static(columns) + d, k, r] = m[i, d]

    @wp.func
    def eliminate(
        data: Data,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        r: int,
        n: int,
        side: int,
        begin: int,
        end: int,
        vertices: int,
        edges: int,
        front: Front,
    ):
        c = scalars[INERTIA_COEFFICIENT, r]
        Waa = front.aa
        Wab = front.ab
        Wac = M()
        Wbb = front.bb
        Wbc = M()
        Wcc = M()
        ra = front.ra
        rb = front.rb
        worst = front.worst
        newton = front.newton
        lost = front.lost
        if wp.static(mixed_axial):
            pending = Pending()
            pending.pivot = linear(1.0)
        # Prefetch: data of the next node is read before this node is processed, since a sweeping thread mostly waits for memory.
        k, vertex, edge = indices(begin, n, side)
        f = rows_of(data.factor, vertex, edge, r)
        rj = vector(data.rhs, 0, k, r)
        mask = data.fixed[k, r]
        node_mass = real(0.0)
        spin = real(0.0)
        if wp.static(not quadratic):
            node_mass = data.mass[k, r]
        if wp.static(twist):
            spin = data.rotary[k, r]
        for j in range(begin, end):
            k, vertex, edge = indices(j, n, side)
            k_ahead, vertex_ahead, edge_ahead = indices(wp.min(j + 1, n - 1), n, side)
            f_ahead = rows_of(data.factor, vertex_ahead, edge_ahead, r)
            r_ahead = vector(data.rhs, 0, k_ahead, r)
            mask_ahead = data.fixed[k_ahead, r]
            node_mass_ahead = real(0.0)
            spin_ahead = real(0.0)
            if wp.static(not quadratic):
                node_mass_ahead = data.mass[k_ahead, r]
            if wp.static(twist):
                spin_ahead = data.rotary[k_ahead, r]
            if wp.static(span == 2):
                if j < vertices:
                    for m in range(wp.static(vertex_rows)):
                        row = m * wp.static(window)
                        a = part(f, data.factor, row, vertex, r)
                        C = part(f, data.factor, row + wp.static(dim), vertex, r)
                        A = with_angle(f, data.factor, row + wp.static(2 * dim), vertex, r, -a)
                        B = with_angle(f, data.factor, row + wp.static(2 * dim + 1), vertex, r, a - C)
                        if wp.static(sides == 2):
                            if side == 1:
                                first = A
                                A = C
                                C = first
                        Waa += wp.outer(A, A)
                        Wab += wp.outer(A, B)
                        Wac += wp.outer(A, C)
                        Wbb += wp.outer(B, B)
                        Wbc += wp.outer(B, C)
                        Wcc += wp.outer(C, C)
                    if wp.static(exact):
                        if flags[DROP_COMPRESSION, r] == 0 and flags[ITERATION, r] >= wp.static(begin_exact):
                            if wp.static(sides == 1) or side == 0:
                                Waa += aa(data.second, vertex, r)
                                Wab += ab(data.second, vertex, r)
                                Wac += ac(data.second, vertex, r)
                                Wbb += bb(data.second, vertex, r)
                                Wbc += bc(data.second, vertex, r)
                                Wcc += cc(data.second, vertex, r)
                            else:
                                Waa += cc(data.second, vertex, r)
                                Wab += wp.transpose(bc(data.second, vertex, r))
                                Wac += wp.transpose(ac(data.second, vertex, r))
                                Wbb += bb(data.second, vertex, r)
                                Wbc += wp.transpose(ab(data.second, vertex, r))
                                Wcc += aa(data.second, vertex, r)
            if j < edges:
                edge_row = wp.static(vertex_rows * window)
                for m in range(wp.static(edge_rows)):
                    t = part(f, data.factor, edge_row + m * wp.static(dim), edge, r)
                    S = wp.outer(t, t)
                    Waa += S
                    Wab -= S
                    Wbb += S
                for m in range(wp.static(tensions)):
                    T = positions(entry(f, data.factor, edge_row + wp.static(edge_rows * dim) + m, edge, r))
                    Waa += T
                    Wab -= T
                    Wbb += T
            if wp.static(quadratic):
                inertia = linear(c * data.mass[k, r].mass)
                stiffness = data.mass[k, r].stiffness
                for d in range(wp.static(dim)):
                    for i in range(wp.static(dim)):
                        Waa[d, i] = Waa[d, i] + linear(stiffness[d, i])
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
            lost += lost_pivots
            z = lower_vector(L, rj + ra)
            newton += real(wp.dot(wp.cw_mul(z, inverse), z))
            y = upper_vector(L, inverse, z)
            if wp.static(not mixed_axial):
                store_vector(data.rhs, 0, k, r, y)
            Zb = lower(L, Wab)
            if wp.static(not mixed_axial):
                store(data.kept, 0, k, r, upper(L, inverse, Zb))
            zd = wp.cw_mul(z, inverse)
            ra = rb - zd * Zb
            Waa = Wbb - congruence(Zb, inverse, Zb)
            if wp.static(span == 2):
                Zc = lower(L, Wac)
                if wp.static(not mixed_axial):
                    store_far(data.kept, k, r, upper(L, inverse, Zc))
                rb = -(zd * Zc)
                Wab = Wbc - congruence(Zb, inverse, Zc)
                Wbb = Wcc - congruence(Zc, inverse, Zc)
                if wp.static(mixed_axial):
                    tangent = H()
                    loose = linear(0.0)
                    if j < edges:
                        tangent = part(f, data.factor, wp.static(vertex_rows * window), edge, r)
                        loose = entry(f, data.factor, wp.static(slack_row), edge, r)
                    out = eliminate_tension(L, inverse, z, Zb, Zc, pending, tangent, loose, unmasked)
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
                    store(data.kept, 0, k, r, upper(L, inverse, Zb) + wp.outer(out.behind, near))
                    store_far(data.kept, k, r, upper(L, inverse, Zc) + wp.outer(out.behind, far))
                    q = out.coupling * out.weight
                    store_vector(data.rhs, 0, k, r, y)
                    store_vector(data.kept, wp.static(tension_row), k, r, out.ahead + out.behind * q)
                    store_vector(data.kept, wp.static(tension_row + nb), k, r, near)
                    store_vector(data.kept, wp.static(tension_row + 2 * nb), k, r, far)
                    data.kept[wp.static(tension_row + 3 * nb), k, r] = q
                    data.kept[wp.static(tension_row + 3 * nb + 1), k, r] = lag
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
        out_front = Front()
        out_front.aa = Waa
        out_front.ab = Wab
        out_front.bb = Wbb
        out_front.ra = ra
        out_front.rb = rb
        out_front.worst = worst
        out_front.newton = newton
        out_front.lost = lost
        return out_front

    return Data, Front, eliminate


@cache
def decide_function(kind: RodKind, real, linear, exact: bool, fails: bool):
    """Return the device function `decide(data, ..., worst, newton, lost) -> True if the iterate is accepted and a step follows`.

    It rejects the iterate and shortens the step, or ends the solve, or repeats the iterate with another matrix. A lost pivot ends
    the solve if it `fails`.
    """
    Data = data_type(kind, real, linear)
    shorter, out_of_patience, twist = shorter_function(real), projected_limit_function(real), kind.twist

    @wp.func
    def decide(
        data: Data,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        rounding_factor: real,
        max_iterations: int,
        max_halvings: int,
        worst: linear,
        newton: real,
        lost: int,
        n: int,
        r: int,
    ):
        first = flags[ITERATION, r] == 0
        taken = scalars[STEP_LENGTH, r]
        scalars[MAX_RESIDUAL, r] = real(worst)
        change = real(0.0)  # of the energy, from the accepted iterate to this one
        rounding_error = real(0.0)  # rounding of `change`
        if first:
            if scalars[LOAD_SCALE, r] == real(0.0):
                scalars[LOAD_SCALE, r] = real(worst)
            flags[LOST_PIVOTS_TOTAL, r] = 0
        else:
            for i in range((n + data.run - 1) / data.run):
                change += data.change[i, r]
                rounding_error += real(data.rounding_error[i, r])
        finite = wp.isfinite(worst) and wp.isfinite(newton) and wp.isfinite(change)
        if lost > 0 and flags[DROP_COMPRESSION, r] == 0:
            if wp.static(fails):
                flags[STATUS, r] = wp.static(outcome.INDEFINITE)
                return False
            # The matrix is indefinite: repeat the iterate with compression (or the geometric stiffness) dropped.
            flags[DROP_COMPRESSION, r] = 1
            flags[ANY_ACTIVE, 0] = 1
            return False
        accept = first and finite
        if first and not finite:
            flags[STATUS, r] = wp.static(outcome.NON_FINITE)
            return False
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
                return False
            shortened = shorter(taken, taken * scalars[PREDICTED_DECREASE, r], change, finite)
            scalars[STEP_LENGTH, r] = shortened
            scalars[ANGLE_STEP_LEFT, r] = shortened - taken
            flags[ITERATE_ACTION, r] = wp.static(ROTATE_EDGES)
            flags[ANY_ACTIVE, 0] = 1
            return False

        flags[ITERATION, r] = flags[ITERATION, r] + 1
        if flags[ITERATION, r] > max_iterations:
            flags[STATUS, r] = wp.static(outcome.MAX_ITERATIONS)
            return False
        if wp.static(exact):
            if out_of_patience(flags, scalars, r):
                return False
        flags[ANY_ACTIVE, 0] = 1
        flags[ENERGY_BUFFER, r] = 1 - flags[ENERGY_BUFFER, r]
        scalars[PREDICTED_DECREASE, r] = newton
        flags[BACKTRACKS, r] = 0
        flags[EDGES_ROTATED, r] = 0
        flags[LOST_PIVOTS_TOTAL, r] = flags[LOST_PIVOTS_TOTAL, r] + lost
        if wp.static(twist):
            if flags[FRAMES_OUTDATED, r] != 0:
                # Twist angles change meaning in updated frames: take no step, and compute a direction there.
                flags[FRAMES_OUTDATED, r] = 0
                scalars[PREDICTED_DECREASE, r] = real(1.0e30)
                scalars[STEP_LENGTH, r] = real(0.0)
                flags[ITERATE_ACTION, r] = wp.static(UPDATE_FRAMES)
                return False
        return True

    return decide


@cache
def substitute_function(kind: RodKind, real, linear, mixed_axial: bool, sides: int):
    """Return the struct `NextNode` and the device function `substitute` of some nodes of a rod, in order.

    `NextNode` has the steps of the two nodes before, the position of the nearer one before its step, and the largest squared rotation
    of an edge so far. `substitute(..., start, stride, number, started, next_node)` solves for `number` nodes start, start + stride,
    ..., and moves them; `next_node` has a node if `started`.
    """
    Data = data_type(kind, real, linear)
    dim, nb, twist, span, nb2, angle = kind.dim, kind.block, kind.twist, kind.span, kind.block**2, kind.block - 1
    V, H, columns = wp.types.vector(dim, real), wp.types.vector(nb, linear), _far_columns(kind, sides)
    tension_row, slack_row = nb2 + nb * columns, kind.factor_rows
    prefetch = kind.serial or linear == wp.float32
    longer = mixed_axial_force.longer_function(dim, real, linear)
    size = kept_rows(kind, mixed_axial, sides)
    kept, left_at, times, times_far = prefetch_functions(nb, linear, size, prefetch, columns)
    _, _, vector, store_vector = block_functions(nb, linear)

    @wp.struct
    class NextNode:
        e1: H
        e2: H
        x: V
        rotation: real

    @wp.func
    def substitute(
        data: Data,
        scalars: wp.array2d(dtype=real),
        r: int,
        start: int,
        stride: int,
        number: int,
        started: bool,
        next_node: NextNode,
    ):
        e1 = next_node.e1
        e2 = next_node.e2
        x_ahead = next_node.x
        rotation = next_node.rotation
        if wp.static(mixed_axial):
            next_axial_force = linear(0.0)
            axial_force = linear(0.0)
            per_root = linear(real(1.0) / wp.sqrt(scalars[MAX_EDGE_STIFFNESS, r]))
        left = kept(data.kept, start, r)
        y = vector(data.rhs, 0, start, r)
        x_j = data.x[start, r]
        twist_angle = real(0.0)
        if wp.static(twist):
            twist_angle = data.theta[start, r]
        for i in range(number):
            j = start + i * stride
            before = start + wp.min(i + 1, number - 1) * stride
            left_before = kept(data.kept, before, r)
            y_before = vector(data.rhs, 0, before, r)
            x_before = data.x[before, r]
            twist_angle_before = real(0.0)
            if wp.static(twist):
                twist_angle_before = data.theta[before, r]
            step = -times(left, data.kept, 0, j, r, e1)
            if wp.static(span == 2):
                step -= times_far(left, data.kept, wp.static(nb2), j, r, e2)
            if wp.static(mixed_axial):
                # The tension ahead is known from the node there; the tension of the edge behind is for the node before.
                tension_behind = left_at(left, data.kept, wp.static(tension_row + 3 * nb), j, r) * next_axial_force
                tension_behind -= left_at(left, data.kept, wp.static(tension_row + 3 * nb + 1), j, r)
                for d in range(wp.static(nb)):
                    step[d] = step[d] - left_at(left, data.kept, wp.static(tension_row) + d, j, r) * next_axial_force
                    tension_behind += left_at(left, data.kept, wp.static(tension_row + nb) + d, j, r) * e1[d]
                    tension_behind += left_at(left, data.kept, wp.static(tension_row + 2 * nb) + d, j, r) * e2[d]
                axial_force = next_axial_force
                next_axial_force = tension_behind
            step += y
            store_vector(data.direction, 0, j, r, step)
            dx = V()
            bent = V()
            for d in range(wp.static(dim)):
                dx[d] = real(step[d])
                bent[d] = real(e1[d] - step[d])
            if started or i > 0:
                span_sq = wp.length_sq(x_ahead - x_j)
                rotation = wp.max(rotation, wp.length_sq(bent) / span_sq)
                if wp.static(mixed_axial):
                    slack = data.factor[wp.static(slack_row), j, r]
                    data.direction[wp.static(nb), j, r] = longer(slack, axial_force, per_root, x_ahead - x_j, bent)
            x_ahead = x_j
            data.x[j, r] = x_j + dx
            if wp.static(twist):
                data.theta[j, r] = twist_angle + real(step[wp.static(angle)])
            e2 = e1
            e1 = step
            left = left_before
            y = y_before
            x_j = x_before
            twist_angle = twist_angle_before
        out = NextNode()
        out.e1 = e1
        out.e2 = e2
        out.x = x_ahead
        out.rotation = rotation
        return out

    return NextNode, substitute


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
    Data, Front, eliminate = eliminate_function(kind, real, linear, exact_from, mixed_axial, 1)
    decide = decide_function(kind, real, linear, exact_from is not None, fails)
    NextNode, substitute = substitute_function(kind, real, linear, mixed_axial, 1)
    take = take_function(real)

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
        data: Data,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        rounding_factor: real,
        rotation_cap: real,
        max_iterations: int,
        max_halvings: int,
    ):
        r = wp.tid()
        if balanced(flags, scalars, r):
            return
        n = data.count[r]
        front = eliminate(data, flags, scalars, r, n, 0, 0, n, n - 2, n - 1, Front())
        if not decide(
            data,
            flags,
            scalars,
            rounding_factor,
            max_iterations,
            max_halvings,
            front.worst,
            front.newton,
            front.lost,
            n,
            r,
        ):
            return
        next_node = substitute(data, scalars, r, n - 1, -1, n, False, NextNode())
        take(flags, scalars, next_node.rotation, rotation_cap, r)

    return sweep


@cache
def two_sided_kernels(kind: RodKind, real, linear, exact_from: int | None = None, fails: bool = False):
    """Build the kernels of one Newton iteration from both ends of a rod; see `kernels.linear.twisted_factorisation`.

    `inward`: eliminate all nodes but the two in the middle, one thread a side.
    `middle`: eliminate the middle nodes h - 1 and h = n / 2, and test the iterate as `sweep_kernel` does; move them if accepted.
    `outward`: substitute back from the middle to both ends, one thread a side; `rod_iterate.adjust_kernel` takes the step's length.
    """
    balanced, _ = line_search_functions(kind.twist, real)
    rests = converged_function(real)
    Data, Front, eliminate = eliminate_function(kind, real, linear, exact_from, False, 2)
    decide = decide_function(kind, real, linear, exact_from is not None, fails)
    NextNode, substitute = substitute_function(kind, real, linear, False, 2)
    nb, nb2, V = kind.block, kind.block**2, wp.types.vector(kind.dim, real)
    load, store, vector, store_vector = block_functions(nb, linear)
    worst_row = 3 * nb2 + 2 * nb

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=128,
        enable_cuda_smem_spilling=True,
        module_options=CPU_OPTIONS,
    )
    def inward(
        data: Data,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        front_out: wp.array3d(dtype=linear),
        sum_out: wp.array2d(dtype=real),
    ):
        side, r = wp.tid()
        if flags[STATUS, r] != 0 or rests(flags, r):
            return
        n = data.count[r]
        number = share(n, side)
        front = eliminate(data, flags, scalars, r, n, side, 0, number, number, number, Front())
        store(front_out, 0, side, r, front.aa)
        store(front_out, wp.static(nb2), side, r, front.ab)
        store(front_out, wp.static(2 * nb2), side, r, front.bb)
        store_vector(front_out, wp.static(3 * nb2), side, r, front.ra)
        store_vector(front_out, wp.static(3 * nb2 + nb), side, r, front.rb)
        front_out[wp.static(worst_row), side, r] = front.worst
        front_out[wp.static(worst_row + 1), side, r] = linear(front.lost)
        sum_out[side, r] = front.newton

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def middle(
        data: Data,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        rounding_factor: real,
        max_iterations: int,
        max_halvings: int,
        fronts: wp.array3d(dtype=linear),
        sums: wp.array2d(dtype=real),
        base: wp.array2d(dtype=V),
    ):
        r = wp.tid()
        flags[NEEDS_DIRECTION, r] = 0
        if balanced(flags, scalars, r):
            return
        n = data.count[r]
        h = n / 2
        front = Front()  # that of side 0, with the updates of side 1 to the same blocks
        front.aa = load(fronts, 0, 0, r) + load(fronts, wp.static(2 * nb2), 1, r)
        front.ab = load(fronts, wp.static(nb2), 0, r) + wp.transpose(load(fronts, wp.static(nb2), 1, r))
        front.bb = load(fronts, wp.static(2 * nb2), 0, r) + load(fronts, 0, 1, r)
        front.ra = vector(fronts, wp.static(3 * nb2), 0, r) + vector(fronts, wp.static(3 * nb2 + nb), 1, r)
        front.rb = vector(fronts, wp.static(3 * nb2 + nb), 0, r) + vector(fronts, wp.static(3 * nb2), 1, r)
        front.worst = wp.max(fronts[wp.static(worst_row), 0, r], fronts[wp.static(worst_row), 1, r])
        front.lost = int(fronts[wp.static(worst_row + 1), 0, r] + fronts[wp.static(worst_row + 1), 1, r])
        front.newton = sums[0, r] + sums[1, r]
        whole = eliminate(data, flags, scalars, r, n, 0, h - 1, h + 1, 0, h, front)
        if not decide(
            data,
            flags,
            scalars,
            rounding_factor,
            max_iterations,
            max_halvings,
            whole.worst,
            whole.newton,
            whole.lost,
            n,
            r,
        ):
            return
        flags[NEEDS_DIRECTION, r] = 1
        base[h - 1, r] = data.x[h - 1, r]
        base[h, r] = data.x[h, r]
        next_node = substitute(data, scalars, r, h, -1, 2, False, NextNode())
        sums[0, r] = next_node.rotation
        sums[1, r] = real(0.0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=128, module_options=CPU_OPTIONS)
    def outward(
        data: Data,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        base: wp.array2d(dtype=V),
        sums: wp.array2d(dtype=real),
    ):
        side, r = wp.tid()
        if flags[NEEDS_DIRECTION, r] == 0:
            return
        n = data.count[r]
        nearer = n / 2 - 1 + side
        next_node = NextNode()
        next_node.e1 = vector(data.direction, 0, nearer, r)
        next_node.e2 = vector(data.direction, 0, n / 2 - side, r)
        next_node.x = base[nearer, r]
        next_node.rotation = sums[side, r]
        stride = 2 * side - 1
        number = share(n, side)
        if number > 0:
            out = substitute(data, scalars, r, nearer + stride, stride, number, True, next_node)
            sums[side, r] = out.rotation

    return inward, middle, outward

"""The chain sweep: one thread a rod takes a Newton iteration from element factors and forces to new dofs.

The matrix of an open rod is block-pentadiagonal (block: position of a node and angle of the edge that starts there):
H = sum F^T F + c I (edges) + inertia, and the geometric stiffness if asked for. The sweep forms its blocks in registers, takes the
residual of `balance`, eliminates node by node, and at the end of the rod knows the change of the energy and the Newton decrement
r^T H^-1 r. It then either rejects the iterate and shortens the step, or substitutes back and takes the next step. No physics
here: strains are rows.

Line search (Armijo, c = 1e-4) on the energy, summed as differences element by element. Where the expected decrease drowns in
rounding, the decrement decides instead (natural monotonicity test; Deuflhard, Newton Methods for Nonlinear Problems, 2004).
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import outcome
from ddg_warp.kernels.chain import ChainKind, inertia_type
from ddg_warp.kernels.islands import (
    ACTIVE,
    ANGLE_CHANGE,
    CARRIED,
    CLAMPED,
    COEFFICIENT,
    DECREMENT,
    HALVINGS,
    ITERATION,
    LOAD_SCALE,
    LOST,
    PLACED,
    RESIDUAL,
    SLOT,
    STALE,
    STATUS,
    STEP_LENGTH,
    TODO,
    TURN,
    patience_function,
)
from ddg_warp.kernels.judge import judge_functions
from ddg_warp.kernels.matrix import geometric
from ddg_warp.kernels.matrix.block_band import block_functions
from ddg_warp.kernels.search import PLACE, RELAG, search_functions
from ddg_warp.kernels.solve import pivot, tension
from ddg_warp.kernels.solve.read_ahead import keep_functions, read_functions
from ddg_warp.kernels.threads import CPU_OPTIONS


@cache
def sweep_kernel(
    kind: ChainKind, real, linear, exact_from: int | None = None, fails: bool = False, split: bool = False
):
    """The sweep for one kind of chain; see the module's text.

    From iteration `exact_from` on, the matrix has the geometric stiffness G. Where a pivot is lost, the same iterate comes again
    with `clamped[r]` raised: without what compression takes away, and, for this iteration, without G; or the solve `fails`.
    With `split`, factors end with the slack of edges, and directions with what edges lengthen by: see `kernels.solve.tension`.
    """
    balanced, _ = judge_functions(kind.twist, real)
    out_of_patience = patience_function(real)
    dim, nb, twist, span = kind.dim, kind.block, kind.twist, kind.span
    window, nb2, drag, Inertia = kind.window, kind.block**2, kind.drag, inertia_type(kind, real)
    V, H, M = wp.types.vector(dim, real), wp.types.vector(nb, linear), wp.types.matrix((nb, nb), linear)
    factor_block, lower, upper, lower_vector, upper_vector, congruence = pivot.functions(nb, linear)
    *_, shorter = search_functions(kind, real, linear)
    angle, rows = nb - 1, kind.factor_rows + split
    # in float64 twice as many registers are more than a GPU has: 10 % slower on an H200
    ahead = kind.serial or linear == wp.float32
    beyond = 2 * nb2 + nb  # of what is kept, where that of tensions begins
    kept_size = beyond + (tension.kept_rows(nb) if split else 0)
    Pending, eliminate = tension.functions(nb, linear)
    longer = tension.longer_function(dim, real, linear)
    vertex_rows, edge_rows, tensions = kind.vertex_strains, kind.edge_strains, kind.tensions
    exact, begin = exact_from is not None, exact_from or 0
    slack_row = kind.factor_rows
    aa, ab, ac, bb, bc, cc = geometric.block_functions(kind, linear)
    rows_of, entry, part, with_angle, positions = read_functions(kind, linear, rows, ahead)
    kept, left_at, times = keep_functions(nb, linear, kept_size, ahead)
    _, store, vector, _ = block_functions(nb, linear)

    # what exceeds 255 registers goes to shared memory: 8 % on an H200; with tensions it is too much, and costs 12 %
    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=128,
        enable_cuda_smem_spilling=not split,
        module_options=CPU_OPTIONS,
    )
    def sweep(
        F: wp.array3d(dtype=linear),
        G: wp.array3d(dtype=linear),
        # balance
        right: wp.array3d(dtype=linear),
        energy_change: wp.array2d(dtype=real),
        energy_noise: wp.array2d(dtype=linear),
        count: wp.array(dtype=int),
        # inertia
        mass: wp.array2d(dtype=Inertia),
        rotary: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        # options
        floor: real,
        rotation_cap: real,
        max_iterations: int,
        max_halvings: int,
        # iterate
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        base: wp.array2d(dtype=V),
        Y: wp.array3d(dtype=linear),
        direction: wp.array3d(dtype=linear),
        # state of the search
    ):
        r = wp.tid()
        if balanced(flags, scalars, r):
            return
        n = count[r]
        first = flags[ITERATION, r] == 0
        taken = scalars[STEP_LENGTH, r]
        c = scalars[COEFFICIENT, r]
        accepted_slot = flags[SLOT, r]
        Waa = M()
        Wab = M()
        Wac = M()
        Wbb = M()
        Wbc = M()
        Wcc = M()
        ra = H()
        rb = H()
        worst = linear(0.0)  # largest residual
        change = real(0.0)  # of the energy, from the accepted iterate to this one
        noise = real(0.0)  # rounding of `change`
        newton = real(0.0)  # r^T H^-1 r
        lost_here = int(0)
        if wp.static(split):
            pending = Pending()
            pending.pivot = linear(1.0)
        # What the next node has is read before this one is dealt with: a thread that walks waits for memory most of the time.
        f = rows_of(F, 0, r)
        rj = vector(right, 0, 0, r)
        mask = fixed[0, r]
        more = energy_change[0, r]
        rounding = energy_noise[0, r]
        own = real(0.0)
        spin = real(0.0)
        if wp.static(not drag):
            own = mass[0, r]
        if wp.static(twist):
            spin = rotary[0, r]
        for j in range(n):
            next = wp.min(j + 1, n - 1)
            f_ahead = rows_of(F, next, r)
            r_ahead = vector(right, 0, next, r)
            mask_ahead = fixed[next, r]
            more_ahead = energy_change[next, r]
            rounding_ahead = energy_noise[next, r]
            own_ahead = real(0.0)
            spin_ahead = real(0.0)
            if wp.static(not drag):
                own_ahead = mass[next, r]
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
                        if flags[CLAMPED, r] == 0 and flags[ITERATION, r] >= wp.static(begin):
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
                inertia = linear(c * own)
            for d in range(wp.static(dim)):
                Waa[d, d] = Waa[d, d] + inertia
            if wp.static(twist):
                Waa[wp.static(angle), wp.static(angle)] = Waa[wp.static(angle), wp.static(angle)] + linear(c * spin)
            worst = wp.max(worst, wp.max(wp.abs(rj)))
            if not first:
                change += more
                noise += real(rounding)
            if wp.static(split):
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
                if wp.static(split):
                    unmasked = free
            # columns of held dofs ahead stay: their solution is zero, and what they gather is masked with their rows

            L, inverse, bad = factor_block(Waa)
            lost_here += bad
            z = lower_vector(L, rj + ra)
            newton += real(wp.dot(wp.cw_mul(z, inverse), z))
            y = upper_vector(L, inverse, z)
            if wp.static(not split):
                for d in range(wp.static(nb)):
                    Y[wp.static(2 * nb2) + d, j, r] = y[d]
            Zb = lower(L, Wab)
            if wp.static(not split):
                store(Y, 0, j, r, upper(L, inverse, Zb))
            zd = wp.cw_mul(z, inverse)
            ra = rb - zd * Zb
            Waa = Wbb - congruence(Zb, inverse, Zb)
            if wp.static(span == 2):
                Zc = lower(L, Wac)
                if wp.static(not split):
                    store(Y, wp.static(nb2), j, r, upper(L, inverse, Zc))
                rb = -(zd * Zc)
                Wab = Wbc - congruence(Zb, inverse, Zc)
                Wbb = Wcc - congruence(Zc, inverse, Zc)
                if wp.static(split):
                    edge = H()
                    loose = linear(0.0)
                    if j < n - 1:
                        edge = part(f, F, wp.static(vertex_rows * window), j, r)
                        loose = entry(f, F, wp.static(slack_row), j, r)
                    out = eliminate(L, inverse, z, Zb, Zc, pending, edge, loose, unmasked)
                    pending = out.pending
                    near = out.b * out.weight
                    far = out.c * out.weight
                    lag = out.right * out.weight
                    newton -= real(out.right * lag)
                    ra += near * out.right
                    rb += far * out.right
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
                        Y[wp.static(beyond) + d, j, r] = ahead_too[d]
                        Y[wp.static(beyond + nb) + d, j, r] = near[d]
                        Y[wp.static(beyond + 2 * nb) + d, j, r] = far[d]
                    Y[wp.static(beyond + 3 * nb), j, r] = q
                    Y[wp.static(beyond + 3 * nb + 1), j, r] = lag
            else:
                Wab = M()
                Wbb = M()
            Wac = M()
            Wbc = M()
            Wcc = M()
            f = f_ahead
            rj = r_ahead
            mask = mask_ahead
            more = more_ahead
            rounding = rounding_ahead
            own = own_ahead
            spin = spin_ahead

        scalars[RESIDUAL, r] = real(worst)
        if first:
            if scalars[LOAD_SCALE, r] == real(0.0):
                scalars[LOAD_SCALE, r] = real(worst)
            flags[LOST, r] = 0
            change = real(0.0)
        finite = wp.isfinite(worst) and wp.isfinite(newton) and wp.isfinite(change)
        if lost_here > 0 and flags[CLAMPED, r] == 0:
            if wp.static(fails):
                flags[STATUS, r] = wp.static(outcome.INDEFINITE)
                return
            # the matrix is indefinite: the same iterate again, without what compression (or curvature) takes away
            flags[CLAMPED, r] = 1
            flags[ACTIVE, 0] = 1
            return
        accept = first and finite
        if first and not finite:
            flags[STATUS, r] = wp.static(outcome.NON_FINITE)
            return
        if not first and finite:
            expected = taken * scalars[DECREMENT, r]
            drowning = floor * noise
            if expected > real(10.0) * drowning:
                accept = change <= real(-1.0e-4) * expected + drowning
            else:
                accept = newton <= scalars[DECREMENT, r]
        if not accept:
            flags[HALVINGS, r] = flags[HALVINGS, r] + 1
            if flags[HALVINGS, r] > max_halvings:
                flags[STATUS, r] = wp.static(outcome.LINE_SEARCH_FAILED)
                return
            less = shorter(taken, taken * scalars[DECREMENT, r], change, finite)
            scalars[STEP_LENGTH, r] = less
            scalars[ANGLE_CHANGE, r] = less - taken
            flags[TODO, r] = wp.static(PLACE)
            flags[ACTIVE, 0] = 1
            return

        flags[ITERATION, r] = flags[ITERATION, r] + 1
        if flags[ITERATION, r] > max_iterations:
            flags[STATUS, r] = wp.static(outcome.MAX_ITERATIONS)
            return
        if wp.static(exact):
            if out_of_patience(flags, scalars, r):
                return
        flags[ACTIVE, 0] = 1
        flags[SLOT, r] = 1 - accepted_slot
        scalars[DECREMENT, r] = newton
        flags[HALVINGS, r] = 0
        flags[PLACED, r] = 0
        flags[LOST, r] = flags[LOST, r] + lost_here
        if wp.static(twist):
            if flags[STALE, r] != 0:
                # angles mean something else in new frames: take no step, and ask for a direction there
                flags[STALE, r] = 0
                scalars[DECREMENT, r] = real(1.0e30)
                scalars[STEP_LENGTH, r] = real(0.0)
                flags[TODO, r] = wp.static(RELAG)
                return
        e1 = H()
        e2 = H()
        if wp.static(split):
            pulled = linear(0.0)
            pull = linear(0.0)
            per_root = linear(real(1.0) / wp.sqrt(scalars[CARRIED, r]))
        rotation = real(0.0)
        x_ahead = V()
        left = kept(Y, n - 1, r)
        here = x[n - 1, r]
        turned = real(0.0)
        if wp.static(twist):
            turned = theta[n - 1, r]
        for i in range(n):
            j = n - 1 - i
            before = wp.max(j - 1, 0)
            left_before = kept(Y, before, r)
            here_before = x[before, r]
            turned_before = real(0.0)
            if wp.static(twist):
                turned_before = theta[before, r]
            step = -times(left, Y, 0, j, r, e1)
            if wp.static(span == 2):
                step -= times(left, Y, wp.static(nb2), j, r, e2)
            if wp.static(split):
                # the tension ahead is known from the node there; that of the edge behind is for the node before
                behind = left_at(left, Y, wp.static(beyond + 3 * nb), j, r) * pulled
                behind -= left_at(left, Y, wp.static(beyond + 3 * nb + 1), j, r)
                for d in range(wp.static(nb)):
                    step[d] = step[d] - left_at(left, Y, wp.static(beyond) + d, j, r) * pulled
                    behind += left_at(left, Y, wp.static(beyond + nb) + d, j, r) * e1[d]
                    behind += left_at(left, Y, wp.static(beyond + 2 * nb) + d, j, r) * e2[d]
                pull = pulled
                pulled = behind
            for d in range(wp.static(nb)):
                step[d] = step[d] + left_at(left, Y, wp.static(2 * nb2) + d, j, r)
                direction[d, j, r] = step[d]
            dx = V()
            bent = V()
            for d in range(wp.static(dim)):
                dx[d] = real(step[d])
                bent[d] = real(e1[d] - step[d])
            if i > 0:
                span_sq = wp.length_sq(x_ahead - here)
                rotation = wp.max(rotation, wp.length_sq(bent) / span_sq)
                if wp.static(split):
                    slack = F[wp.static(slack_row), j, r]
                    direction[wp.static(nb), j, r] = longer(slack, pull, per_root, x_ahead - here, bent)
            x_ahead = here
            x[j, r] = here + dx
            if wp.static(twist):
                theta[j, r] = turned + real(step[wp.static(angle)])
            e2 = e1
            e1 = step
            left = left_before
            here = here_before
            turned = turned_before
        whole = real(1.0)
        if rotation > rotation_cap * rotation_cap:
            whole = rotation_cap / wp.sqrt(rotation)
        if rotation > scalars[TURN, r] * scalars[TURN, r]:
            scalars[ANGLE_CHANGE, r] = whole - real(1.0)
            flags[TODO, r] = wp.static(PLACE)
        scalars[STEP_LENGTH, r] = whole

    return sweep

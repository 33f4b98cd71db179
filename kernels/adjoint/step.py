"""Reverse of what surrounds the solve of a step on chains: end update, inertia and predictor. See `kernels.step` for the schemes.

Both solve m (c (x - x_n) - r v_n) + ... = 0 with r = 1 / s and c = r (r + alpha). Implicit Euler ends at x, with r (x - x_n); the
midpoint rule at 2 x - x_n, with 2 r (x - x_n) - v_n.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import outcome
from ddg_warp.kernels.chain import ChainKind
from ddg_warp.kernels.gather import column_of, point_functions
from ddg_warp.kernels.islands import PORTION, RETRIES, STATUS
from ddg_warp.kernels.motion import functions as motion_functions
from ddg_warp.kernels.motion import reached_function
from ddg_warp.kernels.threads import CPU_OPTIONS
from ddg_warp.kernels.variation import angle_function


@cache
def step_kernels(kind: ChainKind, real, midpoint: bool, more_to_start: bool):
    """solution(...): derivatives by the dofs that a solve has found, from those by the end of the step; start(...): by the start of the
    step, masses and what all nodes share, from those and from w.

    `more` is what came to the dofs of the end through its frames and strains. `more_to_start`: whether other kernels have written
    derivatives by positions, velocities and angles of the start, to which is added.
    """
    dim, twist = kind.dim, kind.twist
    settles = kind.drag and midpoint  # rates of what has no inertia are means over the step; see `drag.chain_kernels`
    V = wp.types.vector(dim, real)
    share = real(2.0 if midpoint else 1.0)  # of the solution in the end
    kept = real(1.0 if midpoint else 0.0)  # of minus the start in the end

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solution(
        x: wp.array2d(dtype=V),
        v: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        omega: wp.array2d(dtype=real),
        more: wp.array3d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        mass: wp.array2d(dtype=real),
        rotary: wp.array2d(dtype=real),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        dof_out: wp.array3d(dtype=real),
        right_out: wp.array3d(dtype=real),
    ):
        """`right_out` are those by free dofs, zero at held ones."""
        k, r = wp.tid()
        if k >= count[r]:
            return
        mask = int(fixed[k, r])
        swing = share
        if wp.static(settles):
            swing = wp.where(mass[k, r] <= real(0.0), real(1.0), share)
        total = x[k, r] * share + v[k, r] * (rate[r] * swing)
        for d in range(wp.static(dim)):
            own = total[d] + share * more[d, k, r]
            dof_out[d, k, r] = own
            right_out[d, k, r] = wp.where(((mask >> d) & 1) == 0, own, real(0.0))
        if wp.static(twist):
            swing = share
            if wp.static(settles):
                swing = wp.where(rotary[k, r] <= real(0.0), real(1.0), share)
            turn = share * (theta[k, r] + more[wp.static(dim), k, r]) + swing * omega[k, r] * rate[r]
            dof_out[wp.static(dim), k, r] = turn
            right_out[wp.static(dim), k, r] = wp.where(((mask >> wp.static(dim)) & 1) == 0, turn, real(0.0))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(
        # the end: derivatives by it
        x: wp.array2d(dtype=V),
        v: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        omega: wp.array2d(dtype=real),
        more: wp.array3d(dtype=real),
        # the solve: its solution, where it started, w, and what is left at held dofs
        q: wp.array2d(dtype=V),
        angle: wp.array2d(dtype=real),
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        theta0: wp.array2d(dtype=real),
        omega0: wp.array2d(dtype=real),
        w: wp.array3d(dtype=real),
        held: wp.array3d(dtype=real),
        mass: wp.array2d(dtype=real),
        rotary: wp.array2d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        moved: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        damping: wp.array(dtype=real),
        gravity: wp.array(dtype=V),
        world: wp.array(dtype=int),
        # derivatives by the start; by masses; by the rate, the damping and gravity, of every node
        x_out: wp.array2d(dtype=V),
        v_out: wp.array2d(dtype=V),
        theta_out: wp.array2d(dtype=real),
        omega_out: wp.array2d(dtype=real),
        mass_out: wp.array2d(dtype=real),
        rotary_out: wp.array2d(dtype=real),
        rate_out: wp.array2d(dtype=real),
        damping_out: wp.array2d(dtype=real),
        gravity_out: wp.array2d(dtype=V),
    ):
        """`moved` are dofs that a motion puts in place; other held ones stay where the step starts. `gravity` is of worlds, `world`
        that of a column. Adds to derivatives by the rate."""
        k, r = wp.tid()
        if k >= count[r]:
            return
        rho = rate[r]
        alpha = damping[0]
        c = rho * (rho + alpha)
        mask = int(fixed[k, r])
        put = int(moved[k, r])
        m = mass[k, r]
        own = V()
        stays = V()
        by_end = x[k, r]
        for d in range(wp.static(dim)):
            by_end[d] = by_end[d] + more[d, k, r]
            if ((mask >> d) & 1) == 0:
                own[d] = w[d, k, r]
            elif ((put >> d) & 1) == 0:
                stays[d] = held[d, k, r]
        step = q[k, r] - x0[k, r]
        before = v0[k, r]
        ended = v[k, r]
        turned = share
        before_kept = kept
        if wp.static(settles):
            if m <= real(0.0):
                turned = real(1.0)
                before_kept = real(0.0)
        by_x = own * (c * m) + stays - by_end * kept - ended * (rho * turned)
        by_v = own * (rho * m) - ended * before_kept
        if wp.static(more_to_start):
            by_x += x_out[k, r]
            by_v += v_out[k, r]
        x_out[k, r] = by_x
        v_out[k, r] = by_v
        mass_out[k, r] = wp.dot(own, gravity[world[r]] - step * c + before * rho)
        gravity_out[k, r] = own * m
        by_rate = turned * wp.dot(ended, step) - m * wp.dot(own, step * (real(2.0) * rho + alpha) - before)
        by_damping = -m * rho * wp.dot(own, step)
        if wp.static(twist):
            free = real(0.0)
            rests = real(0.0)
            if ((mask >> wp.static(dim)) & 1) == 0:
                free = w[wp.static(dim), k, r]
            elif ((put >> wp.static(dim)) & 1) == 0:
                rests = held[wp.static(dim), k, r]
            j = rotary[k, r]
            turn = angle[k, r] - theta0[k, r]
            spin = omega0[k, r]
            spun = omega[k, r]
            turned = share
            before_kept = kept
            if wp.static(settles):
                if j <= real(0.0):
                    turned = real(1.0)
                    before_kept = real(0.0)
            by_turn = theta[k, r] + more[wp.static(dim), k, r]
            by_angle = free * c * j + rests - by_turn * kept - spun * (rho * turned)
            if wp.static(more_to_start):
                by_angle += theta_out[k, r]
            theta_out[k, r] = by_angle
            omega_out[k, r] = free * rho * j - spun * before_kept
            rotary_out[k, r] = free * (spin * rho - turn * c)
            by_rate += turned * spun * turn - j * free * (turn * (real(2.0) * rho + alpha) - spin)
            by_damping -= j * rho * free * turn
        rate_out[k, r] = rate_out[k, r] + by_rate
        damping_out[k, r] = by_damping

    return solution, start


@cache
def angle_kernel(dim: int, real, midpoint: bool):
    """pull(...): of the angles that motions turn, the reverse of `kernels.motion.support_kernels`.

    Adds to the derivatives by the nodes of their edges (component, node, column) and by the frames that these had; writes those by the
    directors that the motions put there.
    """
    X, V = wp.types.vector(3, real), wp.types.vector(dim, real)
    get, _ = point_functions(dim, real)
    turned, *_ = motion_functions(real)
    reached = reached_function(real, midpoint)
    angle = angle_function(real)
    planar = dim == 2

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=X),
        pose: wp.array2d(dtype=real),
        stride: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        columns: int,
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
        by_angle: wp.array2d(dtype=real),
        node_out: wp.array3d(dtype=real),
        frame_out: wp.array3d(dtype=real),
        director_out: wp.array2d(dtype=X),
    ):
        i, w = wp.tid()
        r = column_of(where[i, 0], w, columns)
        k = where[i, 1] / columns
        d = turned(pose, where[i, 4] + w * stride, reached(scalars, r), rest[i])
        e = get(x, where[i, 3], w, columns) - get(x, where[i, 2], w, columns)
        u = X(frame[0, k, r], frame[1, k, r], frame[2, k, r])
        t = X(frame[3, k, r], frame[4, k, r], frame[5, k, r])
        de, du, dt, dd = wp.grad(angle)(e, u, t, d)
        by = by_angle[where[i, 0] / columns, r]
        director_out[i, w] = dd * by
        for c in range(3):
            frame_out[c, k, r] = frame_out[c, k, r] + by * du[c]
            frame_out[3 + c, k, r] = frame_out[3 + c, k, r] + by * dt[c]
        for c in range(wp.static(dim)):
            share = by * de[wp.static(2 if planar else 1) * c]
            wp.atomic_add(node_out, c, where[i, 3] / columns, r, share)
            wp.atomic_sub(node_out, c, where[i, 2] / columns, r, share)

    return pull


@cache
def smooth_kernel(real):
    """smooth(...): one for islands whose step was one solve in the frames that it began with, else not a number; at the first attempt,
    where that is asked (`once`). Worlds that have another one, and no outcome yet, get that of no gradient, and are told of.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def smooth(
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        once: int,
        frame: wp.array3d(dtype=real),
        began: wp.array3d(dtype=real),
        share: int,
        smooth_out: wp.array(dtype=real),
        codes: wp.array(dtype=int),
        told: wp.array(dtype=int),
    ):
        """Frames (component, edge, island) are those of the last solve and of the start; a world has a `share` of the islands."""
        r = wp.tid()
        same = flags[STATUS, r] <= wp.static(outcome.CONVERGED_TO_ROUNDING) and scalars[PORTION, r] == real(1.0)
        same = same and (once == 0 or flags[RETRIES, r] == 0)
        for k in range(frame.shape[1]):
            for c in range(frame.shape[0]):
                same = same and frame[c, k, r] == began[c, k, r]
        smooth_out[r] = wp.where(same, real(1.0), real(wp.nan))
        if not same:
            told[0] = 1
            wp.atomic_cas(codes, r / share, 0, wp.static(outcome.NO_GRADIENT))

    return smooth


@cache
def flag_kernels(real):
    """solved(...): flags of islands, not numbers where their linear system has failed; excuse(...): one instead where nothing was
    asked; failed(...): which worlds failed.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solved(
        failed: wp.array(dtype=int),
        flags: wp.array(dtype=real),
        out: wp.array(dtype=real),
        asked: wp.array(dtype=int),
        lost: wp.array(dtype=int),
        told: wp.array(dtype=int),
    ):
        r = wp.tid()
        out[r] = wp.where(failed[r] == 0, flags[r], real(wp.nan))
        asked[r] = 0
        if wp.isnan(out[r]):
            lost[0] = 1
            if not wp.isnan(flags[r]):
                told[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def excuse(asked: wp.array(dtype=int), out: wp.array(dtype=real)):
        r = wp.tid()
        if asked[r] == 0:
            out[r] = real(1.0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def failed(codes: wp.array(dtype=int), mask: wp.array(dtype=int), any_failed: wp.array(dtype=int)):
        w = wp.tid()
        mask[w] = wp.where(codes[w] != 0 and codes[w] != wp.static(outcome.NO_GRADIENT), 1, 0)
        if mask[w] != 0:
            any_failed[0] = 1

    return solved, excuse, failed


@cache
def asked_kernel(dtype, real):
    """asked(...): whether derivatives by an array are other than zero in an island whose flag is not a number; each has a `share`."""
    several = hasattr(dtype, "_wp_scalar_type_")

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def asked(flags: wp.array(dtype=real), given: wp.array3d(dtype=dtype), share: int, asked_out: wp.array(dtype=int)):
        i, j, k = wp.tid()
        if wp.isnan(flags[k / share]):
            value = given[i, j, k]
            if wp.static(several):
                if wp.length_sq(value) != real(0.0):
                    asked_out[k / share] = 1
            else:
                if value != real(0.0):
                    asked_out[k / share] = 1

    return asked

"""Vector-Jacobian product of a rod step around the solve: end update, inertia and predictor; see `kernels.stepping.rod_step`.

Both solve m (c (x - x_n) - r v_n) + ... = 0 with r = 1 / s and c = r (r + alpha). Implicit Euler ends at x, with r (x - x_n); the
midpoint rule at 2 x - x_n, with 2 r (x - x_n) - v_n.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.dof_map import column_of, point_functions
from ddg_warp.kernels.core.islands import RETRIES, STATUS, SUBSTEP_FRACTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.elements.variation import angle_function
from ddg_warp.kernels.forces.prescribed_motion import functions, reached_function


@cache
def motion_type(dim: int, real):
    """Return the struct of positions, angles and their rates of rods, or of gradients by them."""
    V = wp.types.vector(dim, real)

    @wp.struct
    class Motion:
        x: wp.array2d(dtype=V)
        v: wp.array2d(dtype=V)
        theta: wp.array2d(dtype=real)
        omega: wp.array2d(dtype=real)

    return Motion


@cache
def inertia_type(dim: int, real):
    """Return the struct of gradients by masses, and by rate, damping and gravity per node."""
    V = wp.types.vector(dim, real)

    @wp.struct
    class Inertia:
        mass: wp.array2d(dtype=real)
        rotary: wp.array2d(dtype=real)
        rate: wp.array2d(dtype=real)
        damping: wp.array2d(dtype=real)
        gravity: wp.array2d(dtype=V)

    return Inertia


@cache
def step_kernels(kind: RodKind, real, midpoint: bool, more_to_start: bool):
    """Build the kernels of the end update and of inertia.

    `solution`: write gradients by the dofs of the solve, given gradients by the end of the step.
    `start`: write gradients by the start of the step, masses, rate, damping and gravity, given these and the adjoint w.

    `more`: gradients by the dofs of the end through its frames and strains. `more_to_start`: True to add to gradients by the start that
    other kernels have written.
    """
    dim, twist = kind.dim, kind.twist
    settles = kind.drag and midpoint  # velocities of massless dofs are means over the step; see `drag.rod_kernels`
    V, Motion, Inertia = wp.types.vector(dim, real), motion_type(dim, real), inertia_type(dim, real)
    end_weight = real(2.0 if midpoint else 1.0)  # derivative of the end by the solution
    start_weight = real(1.0 if midpoint else 0.0)  # derivative of the end by minus the start

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solution(
        by_end: Motion,
        more: wp.array3d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        mass: wp.array2d(dtype=real),
        rotary: wp.array2d(dtype=real),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        dof_out: wp.array3d(dtype=real),
        right_out: wp.array3d(dtype=real),
    ):
        """Write gradients by dofs, and the right-hand side of the adjoint solve, which is zero at fixed dofs."""
        k, r = wp.tid()
        if k >= count[r]:
            return
        mask = int(fixed[k, r])
        swing = end_weight
        if wp.static(settles):
            swing = wp.where(mass[k, r] <= real(0.0), real(1.0), end_weight)
        total = by_end.x[k, r] * end_weight + by_end.v[k, r] * (rate[r] * swing)
        for d in range(wp.static(dim)):
            gradient = total[d] + end_weight * more[d, k, r]
            dof_out[d, k, r] = gradient
            right_out[d, k, r] = wp.where(((mask >> d) & 1) == 0, gradient, real(0.0))
        if wp.static(twist):
            swing = end_weight
            if wp.static(settles):
                swing = wp.where(rotary[k, r] <= real(0.0), real(1.0), end_weight)
            by_angle = (
                end_weight * (by_end.theta[k, r] + more[wp.static(dim), k, r]) + swing * by_end.omega[k, r] * rate[r]
            )
            dof_out[wp.static(dim), k, r] = by_angle
            right_out[wp.static(dim), k, r] = wp.where(((mask >> wp.static(dim)) & 1) == 0, by_angle, real(0.0))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(
        by_end: Motion,
        more: wp.array3d(dtype=real),
        # the solution, the start, the adjoint w, and cotangents at fixed dofs
        q: wp.array2d(dtype=V),
        angle: wp.array2d(dtype=real),
        before: Motion,
        w: wp.array3d(dtype=real),
        cotangent_fixed: wp.array3d(dtype=real),
        mass: wp.array2d(dtype=real),
        rotary: wp.array2d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        moved: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        damping: wp.array(dtype=real),
        gravity: wp.array(dtype=V),
        world: wp.array(dtype=int),
        by_start: Motion,
        by_inertia: Inertia,
    ):
        """Write gradients by the start and by masses; add to gradients by the rate.

        `moved`: mask of dofs with prescribed motion; other fixed dofs stay at the start. `world`: world of a column.
        """
        k, r = wp.tid()
        if k >= count[r]:
            return
        rho = rate[r]
        alpha = damping[0]
        c = rho * (rho + alpha)
        mask = int(fixed[k, r])
        prescribed = int(moved[k, r])
        m = mass[k, r]
        w_free = V()
        fixed_at_start = V()
        by_x_end = by_end.x[k, r]
        for d in range(wp.static(dim)):
            by_x_end[d] = by_x_end[d] + more[d, k, r]
            if ((mask >> d) & 1) == 0:
                w_free[d] = w[d, k, r]
            elif ((prescribed >> d) & 1) == 0:
                fixed_at_start[d] = cotangent_fixed[d, k, r]
        step = q[k, r] - before.x[k, r]
        v0 = before.v[k, r]
        ended = by_end.v[k, r]
        velocity_weight = end_weight
        before_kept = start_weight
        if wp.static(settles):
            if m <= real(0.0):
                velocity_weight = real(1.0)
                before_kept = real(0.0)
        by_x = w_free * (c * m) + fixed_at_start - by_x_end * start_weight - ended * (rho * velocity_weight)
        by_v = w_free * (rho * m) - ended * before_kept
        if wp.static(more_to_start):
            by_x += by_start.x[k, r]
            by_v += by_start.v[k, r]
        by_start.x[k, r] = by_x
        by_start.v[k, r] = by_v
        by_inertia.mass[k, r] = wp.dot(w_free, gravity[world[r]] - step * c + v0 * rho)
        by_inertia.gravity[k, r] = w_free * m
        grad_inverse_step = velocity_weight * wp.dot(ended, step) - m * wp.dot(
            w_free, step * (real(2.0) * rho + alpha) - v0
        )
        by_damping = -m * rho * wp.dot(w_free, step)
        if wp.static(twist):
            free = real(0.0)
            angle_at_start = real(0.0)
            if ((mask >> wp.static(dim)) & 1) == 0:
                free = w[wp.static(dim), k, r]
            elif ((prescribed >> wp.static(dim)) & 1) == 0:
                angle_at_start = cotangent_fixed[wp.static(dim), k, r]
            j = rotary[k, r]
            rotation = angle[k, r] - before.theta[k, r]
            spin = before.omega[k, r]
            spun = by_end.omega[k, r]
            velocity_weight = end_weight
            before_kept = start_weight
            if wp.static(settles):
                if j <= real(0.0):
                    velocity_weight = real(1.0)
                    before_kept = real(0.0)
            by_end_angle = by_end.theta[k, r] + more[wp.static(dim), k, r]
            by_angle = free * c * j + angle_at_start - by_end_angle * start_weight - spun * (rho * velocity_weight)
            if wp.static(more_to_start):
                by_angle += by_start.theta[k, r]
            by_start.theta[k, r] = by_angle
            by_start.omega[k, r] = free * rho * j - spun * before_kept
            by_inertia.rotary[k, r] = free * (spin * rho - rotation * c)
            grad_inverse_step += velocity_weight * spun * rotation - j * free * (
                rotation * (real(2.0) * rho + alpha) - spin
            )
            by_damping -= j * rho * free * rotation
        by_inertia.rate[k, r] = by_inertia.rate[k, r] + grad_inverse_step
        by_inertia.damping[k, r] = by_damping

    return solution, start


@cache
def angle_kernel(dim: int, real, midpoint: bool):
    """Build the kernel of twist angles with prescribed motion, the reverse of `kernels.forces.prescribed_motion.support_kernels`.

    `pull`: add gradients by nodes of edges (component, node, column) and by previous frames; write gradients by prescribed directors.
    """
    X, V = wp.types.vector(3, real), wp.types.vector(dim, real)
    get, _ = point_functions(dim, real)
    turned, *_ = functions(real)
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
        cotangent = by_angle[where[i, 0] / columns, r]
        director_out[i, w] = dd * cotangent
        for c in range(3):
            frame_out[c, k, r] = frame_out[c, k, r] + cotangent * du[c]
            frame_out[3 + c, k, r] = frame_out[3 + c, k, r] + cotangent * dt[c]
        for c in range(wp.static(dim)):
            by_node = cotangent * de[wp.static(2 if planar else 1) * c]
            wp.atomic_add(node_out, c, where[i, 3] / columns, r, by_node)
            wp.atomic_sub(node_out, c, where[i, 2] / columns, r, by_node)

    return pull


@cache
def smooth_kernel(real):
    """Build the kernel of differentiable steps.

    `smooth`: write 1 for islands whose step was one solve with unchanged frames (at the first attempt if `once`), else NaN.

    Worlds with another island, and no outcome yet, get the outcome NO_GRADIENT and set a flag.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def smooth(
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        once: int,
        frame: wp.array3d(dtype=real),
        began: wp.array3d(dtype=real),
        per_world: int,
        smooth_out: wp.array(dtype=real),
        codes: wp.array(dtype=int),
        any_rough: wp.array(dtype=int),
    ):
        """Compare frames (component, edge, island) of the last solve and of the start; a world has `per_world` islands."""
        r = wp.tid()
        same = flags[STATUS, r] <= wp.static(outcome.CONVERGED_TO_ROUNDING) and scalars[SUBSTEP_FRACTION, r] == real(
            1.0
        )
        same = same and (once == 0 or flags[RETRIES, r] == 0)
        for k in range(frame.shape[1]):
            for c in range(frame.shape[0]):
                same = same and frame[c, k, r] == began[c, k, r]
        smooth_out[r] = wp.where(same, real(1.0), real(wp.nan))
        if not same:
            any_rough[0] = 1
            wp.atomic_cas(codes, r / per_world, 0, wp.static(outcome.NO_GRADIENT))

    return smooth


@cache
def flag_kernels(real):
    """Build the kernels of flags.

    `solved`: write flags of islands, NaN if the linear solve has failed.
    `excuse`: write 1 for islands with zero cotangents.
    `failed`: mark worlds that failed.
    """

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solved(
        failed: wp.array(dtype=int),
        flags: wp.array(dtype=real),
        out: wp.array(dtype=real),
        has_cotangent: wp.array(dtype=int),
        lost: wp.array(dtype=int),
        any_failed: wp.array(dtype=int),
    ):
        r = wp.tid()
        out[r] = wp.where(failed[r] == 0, flags[r], real(wp.nan))
        has_cotangent[r] = 0
        if wp.isnan(out[r]):
            lost[0] = 1
            if not wp.isnan(flags[r]):
                any_failed[0] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def excuse(has_cotangent: wp.array(dtype=int), out: wp.array(dtype=real)):
        r = wp.tid()
        if has_cotangent[r] == 0:
            out[r] = real(1.0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def failed(codes: wp.array(dtype=int), mask: wp.array(dtype=int), any_failed: wp.array(dtype=int)):
        w = wp.tid()
        mask[w] = wp.where(codes[w] != 0 and codes[w] != wp.static(outcome.NO_GRADIENT), 1, 0)
        if mask[w] != 0:
            any_failed[0] = 1

    return solved, excuse, failed


@cache
def requested_kernel(dtype, real):
    """Build the kernel that finds non-zero cotangents.

    `asked`: mark islands with NaN flags that have a non-zero cotangent; each has `per_island` columns.
    """
    several = hasattr(dtype, "_wp_scalar_type_")

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def asked(
        flags: wp.array(dtype=real),
        cotangent: wp.array3d(dtype=dtype),
        per_island: int,
        has_cotangent_out: wp.array(dtype=int),
    ):
        i, j, k = wp.tid()
        if wp.isnan(flags[k / per_island]):
            value = cotangent[i, j, k]
            if wp.static(several):
                if wp.length_sq(value) != real(0.0):
                    has_cotangent_out[k / per_island] = 1
            else:
                if value != real(0.0):
                    has_cotangent_out[k / per_island] = 1

    return asked

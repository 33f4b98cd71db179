"""Vector-Jacobian product of a step around the solve: end update, inertia, prescribed angles; see `kernels.stepping.time_step`.

Both solve m (c (x - x_n) - r v_n) + ... = 0 with r = 1 / s and c = r (r + alpha). Implicit Euler ends at x, with r (x - x_n); the
midpoint rule at 2 x - x_n, with 2 r (x - x_n) - v_n.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.dof_map import column_of, point_functions, row_functions
from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.islands import RETRIES, STATUS, SUBSTEP_FRACTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.nodes import NodeStorage, dof_functions, mass_functions, state_type
from ddg_warp.kernels.elements.variation import angle_function
from ddg_warp.kernels.forces.prescribed_motion import functions, reached_function
from ddg_warp.kernels.newton.edge_rotation import loose_function


@cache
def step_functions(nodes: NodeStorage, real, midpoint: bool, quadratic: bool):
    """Build the device functions of the end update and of inertia, for a node.

    `solution_of(...)`: gradient by the dofs of the solve, given gradients by the end of the step and `more`.
    `inertia_of(...) -> (x, v, mass, gravity, rate, damping)`: gradients by the start of the step and the inputs of inertia, given the
    adjoint w of the solve.
    `start_of(...) -> (x, v, rate)`: these gradients with the contributions of the end update and of dofs that stay at the start.

    `more`: gradients by the dofs of the end through its frames and strains. `resisted`: the inertia of the coupled system. The
    first `positions` nodes have weight.
    """
    coupled, dim, block = nodes.coupled, nodes.dim, nodes.block
    settles = quadratic and midpoint  # then velocities of massless dofs are means over the step
    V, B, State = wp.types.vector(dim, real), wp.types.vector(block, real), state_type(nodes, real)
    (dofs, _), free_components = dof_functions(nodes, real), loose_function(block, real)
    end_weight = real(2.0 if midpoint else 1.0)  # derivative of the end by the solution
    Inertia = block_inertia(real)

    @wp.func
    def rate_weight(m: B, resisted: wp.array2d(dtype=Inertia), k: int, island: int):
        """Return the derivative of the velocities at the end by the mean velocities of the solve."""
        result = B()
        for d in range(wp.static(block)):
            result[d] = end_weight
            if wp.static(settles):
                settled = m[d] <= real(0.0)
                if wp.static(coupled):
                    settled = settled and resisted[k, island].stiffness[d, d] > real(0.0)
                if settled:
                    result[d] = real(1.0)
        return result

    @wp.func
    def solution_of(
        end: State, more: B, m: B, resisted: wp.array2d(dtype=Inertia), inert: int, rate: real, k: int, island: int
    ):
        total = more * end_weight
        if k < inert:
            v = wp.cw_mul(rate_weight(m, resisted, k, island), dofs(end.v, end.omega, k, island))
            total += dofs(end.x, end.theta, k, island) * end_weight + v * rate
        return total

    @wp.func
    def inertia_of(
        solution: B,
        before: State,
        w: B,
        m: B,
        positions: int,
        rate: real,
        damping: real,
        gravity: V,
        k: int,
        island: int,
    ):
        c = rate * (rate + damping)
        weighted = wp.cw_mul(m, w)
        step = solution - dofs(before.x, before.theta, k, island)
        velocity = dofs(before.v, before.omega, k, island)
        force = velocity * rate - step * c
        by_gravity = V()
        if k < positions:
            for d in range(wp.static(dim)):
                force[d] = force[d] + gravity[d]
                by_gravity[d] = weighted[d]
        by_rate = -wp.dot(weighted, step * (real(2.0) * rate + damping) - velocity)
        by_damping = -rate * wp.dot(weighted, step)
        return weighted * c, weighted * rate, wp.cw_mul(w, force), by_gravity, by_rate, by_damping

    @wp.func
    def start_of(
        by_x: B,
        by_v: B,
        by_rate: real,
        end: State,
        more: wp.array3d(dtype=real),
        solution: B,
        before: State,
        by_dofs: B,
        leaves: int,
        m: B,
        resisted: wp.array2d(dtype=Inertia),
        rate: real,
        k: int,
        island: int,
    ):
        velocity = dofs(end.v, end.omega, k, island)
        ended = wp.cw_mul(rate_weight(m, resisted, k, island), velocity)
        x = by_x + free_components(leaves, by_dofs)
        v = by_v
        if wp.static(midpoint):  # the end is twice the solution less the start
            for d in range(wp.static(block)):
                x[d] = x[d] - more[d, k, island]
            x -= dofs(end.x, end.theta, k, island)
            v -= ended - velocity
        step = solution - dofs(before.x, before.theta, k, island)
        return x - ended * rate, v, by_rate + wp.dot(ended, step)

    return solution_of, inertia_of, start_of


@cache
def step_kernels(nodes: NodeStorage, real, midpoint: bool, quadratic: bool):
    """Build the kernels of the end update and of inertia; see `step_functions`.

    `solution`: write gradients by the dofs of the solve, given gradients by the end of the step.
    `inertia`: add gradients by the start of the step, loads, masses, rate, damping and gravity, given the adjoint w of the solve. The
    coupled system may solve again for each friction lag.
    `start`: add gradients by the start of the step and by the rate, through the end update and fixed dofs.

    The first `inert` nodes have inertia: joint rotations begin every step at zero. The first two are of the coupled system; see
    `rod_step` for rods.
    """
    dim, block, mass_type = nodes.dim, nodes.block, nodes.mass_type(real)
    V, State, Inertia = wp.types.vector(dim, real), state_type(nodes, real), block_inertia(real)
    items, _ = nodes.thread_functions
    (dofs, store), (masses, store_masses) = dof_functions(nodes, real), mass_functions(nodes, real)
    row_of, store_row = row_functions(block, real)
    solution_of, inertia_of, start_of = step_functions(nodes, real, midpoint, quadratic)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solution(
        end: State,
        more: wp.array3d(dtype=real),
        mass: wp.array2d(dtype=mass_type),
        rotary: wp.array2d(dtype=real),
        resisted: wp.array2d(dtype=Inertia),
        count: wp.array(dtype=int),
        inert: int,
        rate: wp.array(dtype=real),
        dof_out: wp.array3d(dtype=real),
    ):
        i, j = wp.tid()
        island, k = items(i, j)
        if k >= count[island]:
            return
        m = masses(mass, rotary, k, island)
        total = solution_of(end, row_of(more, k, island), m, resisted, inert, rate[island], k, island)
        store_row(dof_out, k, island, total)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def inertia(
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        before: State,
        w: wp.array3d(dtype=real),
        mass: wp.array2d(dtype=mass_type),
        rotary: wp.array2d(dtype=real),
        count: wp.array(dtype=int),
        positions: int,
        inert: int,
        rate: wp.array(dtype=real),
        damping: wp.array(dtype=real),
        gravity: wp.array(dtype=V),
        world: wp.array(dtype=int),
        out: State,
        mass_out: wp.array2d(dtype=mass_type),
        rotary_out: wp.array2d(dtype=real),
        rate_out: wp.array2d(dtype=real),
        damping_out: wp.array2d(dtype=real),
        gravity_out: wp.array2d(dtype=V),
        load_out: wp.array3d(dtype=real),
    ):
        """Add gradients of the residual; x and theta are the solution, `gravity` is by world."""
        i, j = wp.tid()
        island, k = items(i, j)
        if k >= count[island]:
            return
        residual = row_of(w, k, island)
        store_row(load_out, k, island, row_of(load_out, k, island) + residual)
        if k >= inert:
            return
        solution, m, g = dofs(x, theta, k, island), masses(mass, rotary, k, island), gravity[world[island]]
        by_x, by_v, by_mass, by_gravity, by_rate, by_damping = inertia_of(
            solution, before, residual, m, positions, rate[island], damping[0], g, k, island
        )
        store(out.x, out.theta, k, island, by_x + dofs(out.x, out.theta, k, island))
        store(out.v, out.omega, k, island, by_v + dofs(out.v, out.omega, k, island))
        store_masses(mass_out, rotary_out, k, island, by_mass + masses(mass_out, rotary_out, k, island))
        gravity_out[k, island] = by_gravity + gravity_out[k, island]
        rate_out[k, island] = by_rate + rate_out[k, island]
        damping_out[k, island] = by_damping + damping_out[k, island]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(
        end: State,
        more: wp.array3d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        before: State,
        dof_gradient: wp.array3d(dtype=real),
        leaves: wp.array2d(dtype=wp.uint8),
        mass: wp.array2d(dtype=mass_type),
        rotary: wp.array2d(dtype=real),
        resisted: wp.array2d(dtype=Inertia),
        count: wp.array(dtype=int),
        inert: int,
        rate: wp.array(dtype=real),
        out: State,
        rate_out: wp.array2d(dtype=real),
    ):
        """Add gradients; dofs outside the mask `leaves` stay at the start, so that `dof_gradient` is a gradient by the start."""
        i, j = wp.tid()
        island, k = items(i, j)
        if k >= count[island] or k >= inert:
            return
        by_x, by_v, by_rate = start_of(
            dofs(out.x, out.theta, k, island),
            dofs(out.v, out.omega, k, island),
            rate_out[k, island],
            end,
            more,
            dofs(x, theta, k, island),
            before,
            row_of(dof_gradient, k, island),
            int(leaves[k, island]),
            masses(mass, rotary, k, island),
            resisted,
            rate[island],
            k,
            island,
        )
        store(out.x, out.theta, k, island, by_x)
        store(out.v, out.omega, k, island, by_v)
        rate_out[k, island] = by_rate

    return solution, inertia, start


@cache
def angle_kernel(dim: int, real, midpoint: bool):
    """Build the kernel of twist angles with prescribed motion, the reverse of `kernels.forces.prescribed_motion.support_kernels`.

    `vjp`: add gradients by nodes of edges (component, node, column) and by previous frames; write gradients by prescribed directors.
    """
    X, V = wp.types.vector(3, real), wp.types.vector(dim, real)
    get, _ = point_functions(dim, real)
    turned, *_ = functions(real)
    reached = reached_function(real, midpoint)
    angle = angle_function(real)
    planar = dim == 2

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
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

    return vjp


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
    `failed`: mark worlds that failed; set `any_failed` for them, and for NaN of the last backward pass (`lost`).
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
    def failed(
        codes: wp.array(dtype=int),
        lost: wp.array(dtype=int),
        mask: wp.array(dtype=int),
        any_failed: wp.array(dtype=int),
    ):
        w = wp.tid()
        mask[w] = wp.where(codes[w] != 0 and codes[w] != wp.static(outcome.NO_GRADIENT), 1, 0)
        if mask[w] != 0 or lost[0] != 0:
            any_failed[0] = 1

    return solved, excuse, failed


@cache
def requested_kernels(dtype, real):
    """Build the kernels of islands with NaN flags; each has `per_island` columns.

    `asked`: mark islands with a non-zero cotangent.
    `spoil`: replace their gradients by NaN.
    """
    several, square = hasattr(dtype, "_wp_scalar_type_"), len(getattr(dtype, "_shape_", ())) == 2

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
            if wp.static(square):
                if wp.ddot(value, value) != real(0.0):
                    has_cotangent_out[k / per_island] = 1
            elif wp.static(several):
                if wp.length_sq(value) != real(0.0):
                    has_cotangent_out[k / per_island] = 1
            else:
                if value != real(0.0):
                    has_cotangent_out[k / per_island] = 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def spoil(flags: wp.array(dtype=real), per_island: int, gradient: wp.array3d(dtype=dtype)):
        i, j, k = wp.tid()
        if wp.isnan(flags[k / per_island]):
            gradient[i, j, k] = dtype(real(wp.nan))

    return asked, spoil

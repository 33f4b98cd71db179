"""Vector-Jacobian product of a step of uncoupled rods around the solve, node by node; see `time_step` and `rod_elements`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.adjoint.rod_elements import frame_function, gathered_function, lagged_function
from ddg_warp.kernels.adjoint.time_step import step_functions
from ddg_warp.kernels.core.dof_map import row_functions
from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.nodes import dof_functions, mass_functions, state_type
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.newton.edge_rotation import loose_function
from ddg_warp.kernels.residual.rod_residual import node_functions


@cache
def rod_step_kernels(kind: RodKind, real, midpoint: bool, complete: bool):
    """Build the kernels before and after the adjoint solve.

    `end`: write gradients by the dofs of the solve and by its lagged frames, given gradients by the end of the step, and the right-hand
    side of the adjoint solve. If `complete`, gradients by dofs are of nodes with dofs that stay at the start alone.
    `start`: write gradients by the start of the step and the inputs of inertia, given the adjoint w of the solve. Add the element
    contributions to gradients by dofs and frames. If `complete`, include the end update; else see `time_step.step_kernels`.
    """
    nodes, block, twist, closed, viscous = kind.nodes, kind.block, kind.twist, kind.closed, kind.viscous
    V, B, State = wp.types.vector(kind.dim, real), wp.types.vector(block, real), state_type(nodes, real)
    Inertia, free_components = block_inertia(real), loose_function(block, real)
    (dofs, store), (masses, store_masses) = dof_functions(nodes, real), mass_functions(nodes, real)
    row_of, store_row = row_functions(block, real)
    solution_of, inertia_of, start_of = step_functions(nodes, real, midpoint, kind.quadratic)
    gathered, (previous, _) = gathered_function(kind, real), node_functions(kind, real)
    frame_vjp = frame_function(kind, real, True) if twist else None
    add_lagged = lagged_function(kind, real) if twist else None

    @wp.func
    def has_edge(k: int, n: int):
        return wp.static(closed) or k < n - 1

    @wp.func
    def stays(leaves: wp.array2d(dtype=wp.uint8), k: int, r: int):
        """Return True if gradients by the dofs of a node are needed: not if all leave the start."""
        return wp.static(not complete) or leaves[k, r] != wp.uint8(255)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def end(
        cotangent: State,
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
        by_frame: wp.array3d(dtype=real),
        window: wp.array3d(dtype=real),
        fixed: wp.array2d(dtype=wp.uint8),
        leaves: wp.array2d(dtype=wp.uint8),
        mass: wp.array2d(dtype=real),
        rotary: wp.array2d(dtype=real),
        resisted: wp.array2d(dtype=Inertia),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        frame_out: wp.array3d(dtype=real),
        more_out: wp.array3d(dtype=real),
        dof_out: wp.array3d(dtype=real),
        right_out: wp.array3d(dtype=real),
    ):
        """Take frames at x, transported from `frame`; `window` has gradients through the strains at the end of viscous rods."""
        k, r = wp.tid()
        n = count[r]
        if k >= n:
            return
        more = B()
        if wp.static(viscous):
            more = gathered(window, k, n, r)
        if wp.static(twist):
            if has_edge(k, n):
                de, du, dt = frame_vjp(x, frame, by_frame, k, n, r)
                for d in range(3):
                    more[d] = more[d] - de[d]
                    frame_out[d, k, r] = du[d]
                    frame_out[3 + d, k, r] = dt[d]
            b = previous(k, n)
            if b >= 0:
                edge_before, _du, _dt = frame_vjp(x, frame, by_frame, b, n, r)
                for d in range(3):
                    more[d] = more[d] + edge_before[d]
        if wp.static(midpoint):
            store_row(more_out, k, r, more)
        total = solution_of(cotangent, more, masses(mass, rotary, k, r), resisted, n, rate[r], k, r)
        if stays(leaves, k, r):
            store_row(dof_out, k, r, total)
        store_row(right_out, k, r, free_components(int(fixed[k, r]), total))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(
        cotangent: State,
        more: wp.array3d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        before: State,
        w: wp.array3d(dtype=real),
        window: wp.array3d(dtype=real),
        lag: wp.array3d(dtype=real),
        leaves: wp.array2d(dtype=wp.uint8),
        mass: wp.array2d(dtype=real),
        rotary: wp.array2d(dtype=real),
        resisted: wp.array2d(dtype=Inertia),
        count: wp.array(dtype=int),
        rate: wp.array(dtype=real),
        damping: wp.array(dtype=real),
        gravity: wp.array(dtype=V),
        world: wp.array(dtype=int),
        dof_out: wp.array3d(dtype=real),
        frame_out: wp.array3d(dtype=real),
        out: State,
        mass_out: wp.array2d(dtype=real),
        rotary_out: wp.array2d(dtype=real),
        rate_out: wp.array2d(dtype=real),
        damping_out: wp.array2d(dtype=real),
        gravity_out: wp.array2d(dtype=V),
    ):
        """Take x and theta for the solution, and `gravity` by world; viscous elements have written gradients by the rate."""
        k, r = wp.tid()
        n = count[r]
        if k >= n:
            return
        solution, m, rho = dofs(x, theta, k, r), masses(mass, rotary, k, r), rate[r]
        by_x, by_v, by_mass, by_gravity, by_rate, by_damping = inertia_of(
            solution, before, row_of(w, k, r), m, n, rho, damping[0], gravity[world[r]], k, r
        )
        if wp.static(viscous):
            by_rate += rate_out[k, r]
        by_dofs = B()
        if stays(leaves, k, r):
            by_dofs = row_of(dof_out, k, r) + gathered(window, k, n, r)
            store_row(dof_out, k, r, by_dofs)
        if wp.static(twist):
            if has_edge(k, n):
                add_lagged(lag, frame_out, k, n, r)
        if wp.static(complete):
            by_x, by_v, by_rate = start_of(
                by_x,
                by_v,
                by_rate,
                cotangent,
                more,
                solution,
                before,
                by_dofs,
                int(leaves[k, r]),
                m,
                resisted,
                rho,
                k,
                r,
            )
        store(out.x, out.theta, k, r, by_x)
        store(out.v, out.omega, k, r, by_v)
        store_masses(mass_out, rotary_out, k, r, by_mass)
        gravity_out[k, r] = by_gravity
        rate_out[k, r] = by_rate
        damping_out[k, r] = by_damping

    return end, start

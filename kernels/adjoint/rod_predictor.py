"""Vector-Jacobian product of predictors of uncoupled rods; see `kernels.adjoint.edge_rotation`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.adjoint.edge_rotation import excess_function, unplace_function
from ddg_warp.kernels.core.dof_map import row_functions
from ddg_warp.kernels.core.islands import INVERSE_STEP, ROTATE_PREDICTOR, STRAIGHT_ROTATION_LIMIT
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions
from ddg_warp.kernels.newton.edge_rotation import loose_function
from ddg_warp.kernels.stepping.rod_step import predicted_function


@cache
def predict_kernel(kind: RodKind, real, midpoint: bool):
    """Build the kernel of predictors of `time_step.begin_kernel` and `rod_step.predict_kernel` of `kernels.stepping`, one thread a rod.

    `vjp`: add gradients by fixed dofs, by positions and velocities at the start, and by the rate.

    `excess_out` and `added_out` are scratch.
    """
    dim, closed, every = kind.dim, kind.closed, (1 << kind.dim) - 1
    V = wp.types.vector(dim, real)
    along, *_ = gather_functions(kind, real)
    excess_product, predicted = excess_function(dim, real, midpoint), predicted_function(dim, real)
    free_components, (row_of, store_row) = loose_function(dim, real), row_functions(dim, real)

    @wp.struct
    class Rod:
        given: wp.array3d(dtype=real)
        excess: wp.array3d(dtype=real)
        added: wp.array3d(dtype=real)
        fixed: wp.array2d(dtype=wp.uint8)
        count: int
        closed: int
        anchor: int
        r: int

    @wp.func
    def mask_of(rod: Rod, j: int):
        return int(rod.fixed[along(j, rod.count), rod.r])

    @wp.func
    def anchored(rod: Rod, j: int):
        return (mask_of(rod, j) & wp.static(every)) == wp.static(every)

    @wp.func
    def by_shift(rod: Rod, j: int):
        return free_components(mask_of(rod, j), row_of(rod.given, along(j, rod.count), rod.r))

    @wp.func
    def free_part(rod: Rod, j: int, v: V):
        return free_components(mask_of(rod, j), v)

    @wp.func
    def store_excess(rod: Rod, j: int, v: V):
        store_row(rod.excess, along(j, rod.count), rod.r, v)

    @wp.func
    def add_anchor(rod: Rod, j: int, v: V):
        k = along(j, rod.count)
        store_row(rod.added, k, rod.r, row_of(rod.added, k, rod.r) + v)

    unplace = unplace_function(dim, real, Rod, anchored, by_shift, free_part, store_excess, add_anchor)

    @wp.func
    def edge_gradient(
        x: wp.array2d(dtype=V),
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        fixed: wp.array2d(dtype=wp.uint8),
        rate: real,
        straight: real,
        excess: wp.array3d(dtype=real),
        k: int,
        n: int,
        r: int,
    ):
        """Return gradients by base and step of edge k, through its excess."""
        b = along(k + 1, n)
        e = x0[b, r] - x0[k, r]
        step = predicted(x[b, r], x0[b, r], v0[b, r], int(fixed[b, r]), 0, rate)
        step -= predicted(x[k, r], x0[k, r], v0[k, r], int(fixed[k, r]), 0, rate)
        by_e, by_step, _f, _straight = wp.grad(excess_product)(e, step, row_of(excess, k, r), straight)
        return by_e, by_step

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
        x: wp.array2d(dtype=V),
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        fixed: wp.array2d(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        cotangent: wp.array3d(dtype=real),
        excess_out: wp.array3d(dtype=real),
        added_out: wp.array3d(dtype=real),
        fixed_out: wp.array3d(dtype=real),
        x_out: wp.array2d(dtype=V),
        v_out: wp.array2d(dtype=V),
        rate_out: wp.array2d(dtype=real),
    ):
        r = wp.tid()
        n = count[r]
        rate = scalars[INVERSE_STEP, r]
        bent = flags[ROTATE_PREDICTOR, r] != 0
        edges = int(0)
        if bent:
            for k in range(n):
                store_row(added_out, k, r, V())
            rod = Rod()
            rod.given = cotangent
            rod.excess = excess_out
            rod.added = added_out
            rod.fixed = fixed
            rod.count = n
            rod.closed = wp.static(int(closed))
            rod.anchor = anchor[r]
            rod.r = r
            unplace(rod)
            edges = n - wp.static(0 if closed else 1)
        previous = V()
        previous_step = V()
        if wp.static(closed):
            if bent:
                previous, previous_step = edge_gradient(
                    x, x0, v0, fixed, rate, scalars[STRAIGHT_ROTATION_LIMIT, r], excess_out, n - 1, n, r
                )
        for k in range(n):
            mask = int(fixed[k, r])
            is_fixed = (mask & wp.static(every)) == wp.static(every)
            gradient = row_of(cotangent, k, r)
            by_base = gradient
            if is_fixed:
                by_base = V()
                if bent:
                    by_base = -row_of(added_out, k, r)
                gradient -= by_base
            by_step = by_base
            if k < edges:
                following, following_step = edge_gradient(
                    x, x0, v0, fixed, rate, scalars[STRAIGHT_ROTATION_LIMIT, r], excess_out, k, n, r
                )
                by_base -= following
                by_step -= following_step
                by_base += previous
                by_step += previous_step
                previous = following
                previous_step = following_step
            elif bent:
                by_base += previous
                by_step += previous_step
            grad_inverse_step = V()
            for d in range(wp.static(dim)):
                if is_fixed:
                    fixed_out[d, k, r] = fixed_out[d, k, r] + gradient[d]
                    grad_inverse_step[d] = by_step[d]
                elif ((mask >> d) & 1) == 1:
                    fixed_out[d, k, r] = fixed_out[d, k, r] + by_step[d]
                    by_base[d] = by_base[d] - by_step[d]
                else:
                    grad_inverse_step[d] = by_step[d]
            x_out[k, r] = x_out[k, r] + by_base
            v_out[k, r] = v_out[k, r] + grad_inverse_step / rate
            rate_out[k, r] = rate_out[k, r] - wp.dot(grad_inverse_step, v0[k, r]) / (rate * rate)

    return vjp

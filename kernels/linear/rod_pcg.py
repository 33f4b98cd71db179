"""Preconditioned conjugate gradients on uncoupled rods: each rod is solved by itself, with its own scalars on the device.

An iteration computes H p (one thread a node), then step length, update of solution and residual, preconditioning, test and new
direction (one thread a rod). Residuals are measured in the norm of the preconditioner, relative to the first. Curvature that is not
positive beyond rounding ends a solve with the solution so far.

Why not shared with `kernels.linear.coupled_pcg`: one thread a rod takes all sums and preconditions between two products. In the coupled
system sums run over tiles of dof blocks, and preconditioners are launches of their own.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.islands import (
    DROP_COMPRESSION,
    ENERGY_BUFFER,
    ITERATION,
    LOST_PIVOTS_TOTAL,
    NEEDS_DIRECTION,
    PREDICTED_DECREASE,
    STATUS,
    STEP_LENGTH,
    STRAIGHT_ROTATION_LIMIT,
    projected_limit_function,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.linear import block_ldlt
from ddg_warp.kernels.linear.rod_matrix import block_functions, product_function, substitute_function
from ddg_warp.kernels.newton.rod_iterate import search_functions

PRECONDITIONERS = ("jacobi", "block_jacobi", "chain")


@cache
def solver_kernels(kind: RodKind, linear, preconditioner: str):
    """Build the kernels of conjugate gradients with one preconditioner.

    `start`: set solution, residual and first search direction.
    `product`: compute q = H p.
    `advance`: take one iteration.
    """
    nb = kind.block
    H = wp.types.vector(nb, linear)
    load, _, vector, store_vector = block_functions(nb, linear)
    times = product_function(kind, linear)
    substitute = substitute_function(nb, kind.span, linear, dotted=True)
    factor, _, _, lower_vector, upper_vector, _ = block_ldlt.functions(nb, linear)
    eps = wp.constant(linear(1.0e-15 if linear == wp.float64 else 1.0e-7))
    by_chain = preconditioner == "chain"

    if preconditioner == "jacobi":

        @wp.func
        def precondition(blocks: wp.array3d(dtype=linear), v: H, k: int, r: int):
            u = H()
            for d in range(wp.static(nb)):
                u[d] = v[d] / blocks[d * wp.static(nb + 1), k, r]
            return u

    else:

        @wp.func
        def precondition(blocks: wp.array3d(dtype=linear), v: H, k: int, r: int):
            L, inverse, _lost = factor(load(blocks, 0, k, r))
            return upper_vector(L, inverse, lower_vector(L, v))

    @wp.func
    def apply(
        blocks: wp.array3d(dtype=linear),
        factors: wp.array3d(dtype=linear),
        v: wp.array3d(dtype=linear),
        z: wp.array3d(dtype=linear),
        n: int,
        r: int,
    ):
        """Write z = M^-1 v along one rod; return v . z."""
        if wp.static(by_chain):
            return substitute(factors, v, z, n, r, r)
        total = linear(0.0)
        for k in range(n):
            v_k = vector(v, 0, k, r)
            u = precondition(blocks, v_k, k, r)
            store_vector(z, 0, k, r, u)
            total += wp.dot(v_k, u)
        return total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(
        blocks: wp.array3d(dtype=linear),
        factors: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        rhs: wp.array3d(dtype=linear),
        residual: wp.array3d(dtype=linear),
        solution: wp.array3d(dtype=linear),
        z: wp.array3d(dtype=linear),
        p: wp.array3d(dtype=linear),
        rho: wp.array(dtype=linear),
        rho_first: wp.array(dtype=linear),
        iterations: wp.array(dtype=int),
        busy: wp.array(dtype=int),
    ):
        """Set the solution to zero, the residual to the right-hand side and p to M^-1 r; raise `busy`."""
        r = wp.tid()
        if wanted[r] == 0:
            return
        n = count[r]
        total = apply(blocks, factors, rhs, z, n, r)
        for k in range(n):
            store_vector(residual, 0, k, r, vector(rhs, 0, k, r))
            store_vector(p, 0, k, r, vector(z, 0, k, r))
            store_vector(solution, 0, k, r, H())
        rho[r] = total
        rho_first[r] = total
        iterations[r] = 0
        if total > linear(0.0):
            busy[0] = 1
        else:
            wanted[r] = 2

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def product(
        blocks: wp.array3d(dtype=linear),
        p: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        q_out: wp.array3d(dtype=linear),
        busy_out: wp.array(dtype=int),
    ):
        """Write q = H p."""
        k, r = wp.tid()
        if k == 0 and r == 0:
            busy_out[0] = 0
        if wanted[r] == 1 and k < count[r]:
            store_vector(q_out, 0, k, r, times(blocks, p, k, count[r], r))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def advance(
        blocks: wp.array3d(dtype=linear),
        factors: wp.array3d(dtype=linear),
        count: wp.array(dtype=int),
        rtol: linear,
        limit: int,
        q: wp.array3d(dtype=linear),
        residual: wp.array3d(dtype=linear),
        solution: wp.array3d(dtype=linear),
        z: wp.array3d(dtype=linear),
        p: wp.array3d(dtype=linear),
        rho: wp.array(dtype=linear),
        rho_first: wp.array(dtype=linear),
        iterations: wp.array(dtype=int),
        wanted: wp.array(dtype=int),
        busy: wp.array(dtype=int),
        negative: wp.array(dtype=int),
    ):
        """Take a step, precondition, test, and set the new direction; `wanted` becomes 2 when a rod is done."""
        r = wp.tid()
        if wanted[r] != 1:
            return
        n = count[r]
        curvature = linear(0.0)
        size = linear(0.0)
        for k in range(n):
            pk = vector(p, 0, k, r)
            qk = vector(q, 0, k, r)
            curvature += wp.dot(pk, qk)
            size += wp.length(pk) * wp.length(qk)
        if not curvature > eps * size:
            if curvature < -linear(10.0) * eps * size:
                negative[r] = negative[r] + 1
            wanted[r] = 2
            return
        alpha = rho[r] / curvature
        for k in range(n):
            store_vector(solution, 0, k, r, vector(solution, 0, k, r) + alpha * vector(p, 0, k, r))
            store_vector(residual, 0, k, r, vector(residual, 0, k, r) - alpha * vector(q, 0, k, r))
        total = apply(blocks, factors, residual, z, n, r)
        iterations[r] = iterations[r] + 1
        beta = total / rho[r]
        rho[r] = total
        if not total > rtol * rtol * rho_first[r] or iterations[r] >= limit:
            wanted[r] = 2
            return
        for k in range(n):
            store_vector(p, 0, k, r, vector(z, 0, k, r) + beta * vector(p, 0, k, r))
        busy[0] = 1

    return start, product, advance


@cache
def repeat_kernel(real, fails: bool, exact: bool = True):
    """Build the kernel that handles an indefinite exact Hessian.

    `repeat`: end the solve (if it `fails`), or undo the acceptance and repeat the iterate.

    `negative` counts lost pivots and negative curvatures of this iteration. `drop_compression` then drops the geometric stiffness and
    compression from the next matrix, and the line search accepts again on the same numbers. `done`: the direction has been computed.
    `exact`: the matrix is the exact Hessian unless that is indefinite.
    """

    out_of_patience = projected_limit_function(real)

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
    def repeat(done: int, flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), negative: wp.array(dtype=int)):
        r = wp.tid()
        if flags[NEEDS_DIRECTION, r] == 0:
            return
        if negative[r] > 0 and flags[DROP_COMPRESSION, r] == 0:
            flags[NEEDS_DIRECTION, r] = 0
            negative[r] = 0
            if wp.static(fails):
                flags[STATUS, r] = wp.static(outcome.INDEFINITE)
                return
            flags[DROP_COMPRESSION, r] = 1
            flags[ITERATION, r] = flags[ITERATION, r] - 1
            flags[ENERGY_BUFFER, r] = 1 - flags[ENERGY_BUFFER, r]
        elif done != 0:
            flags[LOST_PIVOTS_TOTAL, r] = flags[LOST_PIVOTS_TOTAL, r] + negative[r]
            negative[r] = 0
            if wp.static(exact):
                if out_of_patience(flags, scalars, r):
                    flags[NEEDS_DIRECTION, r] = 0
            else:
                flags[DROP_COMPRESSION, r] = 0

    return repeat


@cache
def take_kernel(kind: RodKind, real, linear):
    """Build the kernel that takes a direction.

    `take`: cap the rotation, move, and store the predicted decrease r . d.
    """
    dim = kind.dim
    V = wp.types.vector(dim, real)
    place, turn_angles, _, _ = search_functions(kind, real, linear)
    nb = kind.block

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def take(
        first_residual: wp.array3d(dtype=linear),
        iterations: wp.array(dtype=int),
        count: wp.array(dtype=int),
        rotation_cap: real,
        direction: wp.array3d(dtype=linear),
        fixed: wp.array2d(dtype=wp.uint8),
        anchor: wp.array(dtype=int),
        base: wp.array2d(dtype=V),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        work: wp.array(dtype=wp.int64),
    ):
        r = wp.tid()
        if flags[NEEDS_DIRECTION, r] == 0:
            return
        n = count[r]
        rotation = real(0.0)
        total = real(0.0)
        for k in range(n):
            base[k, r] = x[k, r]
            for d in range(wp.static(nb)):
                total += real(first_residual[d, k, r]) * real(direction[d, k, r])
            if k > 0:
                bent = V()
                for d in range(wp.static(dim)):
                    bent[d] = real(direction[d, k, r] - direction[d, k - 1, r])
                rotation = wp.max(rotation, wp.length_sq(bent) / wp.length_sq(x[k, r] - x[k - 1, r]))
        whole = real(1.0)
        if rotation > rotation_cap * rotation_cap:
            whole = rotation_cap / wp.sqrt(rotation)
        turn_angles(theta, direction, whole, n, r)
        if rotation > scalars[STRAIGHT_ROTATION_LIMIT, r] * scalars[STRAIGHT_ROTATION_LIMIT, r]:
            place(x, base, base, direction, fixed, anchor, whole, 0, n, r)
        else:
            for k in range(n):
                step = V()
                for d in range(wp.static(dim)):
                    step[d] = real(direction[d, k, r])
                x[k, r] = x[k, r] + step
        scalars[STEP_LENGTH, r] = whole
        scalars[PREDICTED_DECREASE, r] = total
        wp.atomic_add(work, 0, wp.int64(iterations[r]))

    return take

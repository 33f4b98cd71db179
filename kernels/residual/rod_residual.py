"""Residual at the nodes of a rod, and its convergence test.

`check`, one thread a node (on the CPU a rod), runs before a sweep. It writes the residual and the energy change since the accepted
iterate, by node, and tests convergence, so that the last iterate costs no sweep. A rod has converged if at every free dof

    |residual| <= max(rtol * load scale, floor) ,   floor = floor_factor * eps * (H_ii |x| + sum of |element forces|) ,

where the floor bounds the rounding of coordinates and forces. Moments are compared over the length of the rod. Sums of residuals
have to be small, too; see `compile.residual_tolerance`. After a full Newton step they are, of second order. At the start, or after a
shortened step, the limit is divided by the number of nodes instead.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import (
    BELOW_ROUNDING_FLOOR,
    DOUBTFUL,
    EDGES_ROTATED,
    ENERGY_BUFFER,
    INERTIA_COEFFICIENT,
    ITERATION,
    LOAD_SCALE,
    NOT_CONVERGED,
    STATUS,
    STEP_LENGTH,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS, until_function
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions, inertia_type
from ddg_warp.kernels.newton.line_search import ROUNDED, SETTLED


@cache
def node_functions(kind: RodKind, real):
    """Return the device functions `force`, `previous`, `balance` and `edge_force` of a node.

    `force(g, row, k, r)`: three rows of the gradient.
    `previous(k, n)`: element or edge before k.
    `balance(...) -> (force, moment, size, elastic)`: residual force and moment, size of element forces, and elastic moment.
    `edge_force(g, k, n, r)`: dE/de of edge k.
    """
    dim, twist, span, window, closed, drag = kind.dim, kind.twist, kind.span, kind.window, kind.closed, kind.drag
    V, Inertia = wp.types.vector(dim, real), inertia_type(kind, real)

    @wp.func
    def force(g: wp.array3d(dtype=real), row: int, k: int, r: int):
        v = V()
        for d in range(wp.static(dim)):
            v[d] = g[row + d, k, r]
        return v

    @wp.func
    def previous(k: int, n: int):
        """Return the element or edge before k, cyclically in a closed rod; -1 for none."""
        if wp.static(closed):
            if k == 0:
                return n - 1
        return k - 1

    @wp.func
    def edge_force(g: wp.array3d(dtype=real), k: int, n: int, r: int):
        """Return dE/de of edge k."""
        total = force(g, 0, k, r)
        if wp.static(span == 2):
            b = previous(k, n)
            if b >= 0:
                total += force(g, wp.static(dim), b, r)
        return total

    @wp.func
    def balance(
        g: wp.array3d(dtype=real),
        mass: wp.array2d(dtype=Inertia),
        rotary: wp.array2d(dtype=real),
        c: real,
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        target: wp.array2d(dtype=V),
        target_angle: wp.array2d(dtype=real),
        gravity: wp.array(dtype=V),
        load: wp.array2d(dtype=V),
        load_angle: wp.array2d(dtype=real),
        loaded: int,
        k: int,
        n: int,
        r: int,
    ):
        if wp.static(drag):
            m = mass[k, r].mass
        else:
            m = mass[k, r]
        f = gravity[0] * m - (x[k, r] - target[k, r]) * (c * m)
        if wp.static(drag):
            f -= mass[k, r].resistance * (x[k, r] - mass[k, r].carried)
        moment = real(0.0)
        if loaded != 0:
            f += load[k, r]
            if wp.static(twist):
                moment = load_angle[k, r]
        size = real(0.0)
        b = previous(k, n)
        if wp.static(closed) or k < n - 1:
            total = edge_force(g, k, n, r)
            f += total
            size = wp.max(wp.abs(total))
        if b >= 0:
            total = edge_force(g, b, n, r)
            f -= total
            size += wp.max(wp.abs(total))
        elastic = real(0.0)
        if wp.static(twist):
            if wp.static(closed) or k < n - 2:
                elastic = g[wp.static(window - 2), k, r]
            if b >= 0 and (wp.static(closed) or k < n - 1):
                elastic += g[wp.static(window - 1), b, r]
            moment -= elastic + c * rotary[k, r] * (theta[k, r] - target_angle[k, r])
        return f, moment, size, elastic

    return force, previous, balance, edge_force


@cache
def check_kernel(kind: RodKind, real, linear):
    """Build the kernel of the residual and of the convergence test.

    `check`: write residual and energy change at every node, and set `not_converged` of rods with a residual above tolerance and floor.

    `below_rounding_floor` is set if a residual is above the tolerance but within the floor. Residuals of fixed dofs are zero.
    `rounding_error` bounds the rounding of `change`, the sum of element energy differences and of the work of inertia and loads
    along the step.
    """
    dim, nb, twist, closed, drag = kind.dim, kind.block, kind.twist, kind.closed, kind.drag
    V, Inertia = wp.types.vector(dim, real), inertia_type(kind, real)
    _, previous, balance, _ = node_functions(kind, real)
    along, *_ = gather_functions(kind, real)
    until = until_function(kind.serial)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def check(
        g: wp.array3d(dtype=real),
        energy: wp.array3d(dtype=real),
        stiffness: wp.array2d(dtype=linear),
        count: wp.array(dtype=int),
        mass: wp.array2d(dtype=Inertia),
        rotary: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        base: wp.array2d(dtype=V),
        direction: wp.array3d(dtype=linear),
        target: wp.array2d(dtype=V),
        target_angle: wp.array2d(dtype=real),
        gravity: wp.array(dtype=V),
        load: wp.array2d(dtype=V),
        load_angle: wp.array2d(dtype=real),
        loaded: int,
        fixed: wp.array2d(dtype=wp.uint8),
        length: wp.array(dtype=real),
        rtol: real,
        rounding_factor: real,
        right_out: wp.array3d(dtype=linear),
        change_out: wp.array2d(dtype=real),
        noise_out: wp.array2d(dtype=linear),
    ):
        start, r = wp.tid()
        n = count[r]
        if flags[STATUS, r] != 0 or start >= n:
            return
        c = scalars[INERTIA_COEFFICIENT, r]
        accepted = flags[ENERGY_BUFFER, r]
        taken = scalars[STEP_LENGTH, r]
        limit = rtol * scalars[LOAD_SCALE, r]
        doubtful = real(wp.static(ROUNDED)) * scalars[LOAD_SCALE, r]
        if flags[ITERATION, r] == 0 or taken < real(1.0):
            limit /= real(n)
        settled = real(wp.static(SETTLED)) * length[r]
        moved = flags[EDGES_ROTATED, r] != 0
        for k in range(start, until(start, n)):
            f, moment, size, elastic = balance(
                g, mass, rotary, c, x, theta, target, target_angle, gravity, load, load_angle, loaded, k, n, r
            )
            stiff = real(0.0)
            b = previous(k, n)
            if wp.static(closed) or k < n - 1:
                stiff = real(stiffness[k, r])
            if b >= 0:
                stiff = wp.max(stiff, real(stiffness[b, r]))
            position = x[k, r]
            if wp.static(drag):
                m = mass[k, r].mass
            else:
                m = mass[k, r]
            magnitude = wp.max(wp.abs(position))
            least = rounding_factor * ((real(2.0) * stiff + c * m) * magnitude + size)
            if wp.static(drag):
                least += rounding_factor * wp.max(wp.get_diag(mass[k, r].resistance)) * magnitude
            mask = int(fixed[k, r])
            for d in range(wp.static(dim)):
                is_fixed = ((mask >> d) & 1) == 1
                right_out[d, k, r] = linear(wp.where(is_fixed, real(0.0), f[d]))
                if not is_fixed and not wp.abs(f[d]) <= limit:
                    flags[BELOW_ROUNDING_FLOOR, r] = 1
                    if not wp.abs(f[d]) <= least:
                        flags[NOT_CONVERGED, r] = 1
                    if wp.static(real is wp.float32):
                        if wp.abs(f[d]) > doubtful and not wp.abs(real(direction[d, k, r])) < settled:
                            flags[DOUBTFUL, r] = 1
            if wp.static(twist):
                is_fixed = ((mask >> wp.static(dim)) & 1) == 1
                right_out[wp.static(nb - 1), k, r] = linear(wp.where(is_fixed, real(0.0), moment))
                if not is_fixed and not wp.abs(moment) <= limit * length[r]:
                    flags[BELOW_ROUNDING_FLOOR, r] = 1
                    arm = wp.length(x[along(k + 1, n), r] - position)
                    least = rounding_factor * (
                        real(2.0) * stiff * arm * arm * magnitude / length[r]
                        + c * rotary[k, r] * (real(1.0) + wp.abs(theta[k, r]))
                        + wp.abs(elastic)
                    )
                    if not wp.abs(moment) <= least:
                        flags[NOT_CONVERGED, r] = 1
                    if wp.static(real is wp.float32):
                        rotation = wp.abs(real(direction[wp.static(nb - 1), k, r]))
                        if wp.abs(moment) > doubtful * length[r] and not rotation < real(wp.static(SETTLED)):
                            flags[DOUBTFUL, r] = 1
            if flags[ITERATION, r] == 0:
                continue
            change = real(0.0)
            rounding_error = real(0.5) * size * magnitude
            if wp.static(closed) or k < n - 1:
                new = energy[1 - accepted, k, r]
                change = new - energy[accepted, k, r]
                rounding_error += wp.abs(new)
            # energy change of inertia and loads along the step, from products of small differences
            u = V()
            if moved:
                u = position - base[k, r]
            else:
                for d in range(wp.static(dim)):
                    u[d] = taken * real(direction[d, k, r])
            outer = gravity[0] * m
            if loaded != 0:
                outer += load[k, r]
            work = wp.dot(u, (position - target[k, r] - u * real(0.5)) * (c * m) - outer)
            if wp.static(drag):
                work += wp.dot(u, mass[k, r].resistance * (position - mass[k, r].carried - u * real(0.5)))
            if wp.static(twist):
                rotation_step = taken * real(direction[wp.static(nb - 1), k, r])
                work += (
                    rotation_step * c * rotary[k, r] * (theta[k, r] - target_angle[k, r] - real(0.5) * rotation_step)
                )
                if loaded != 0:
                    work -= rotation_step * load_angle[k, r]
            change_out[k, r] = change + work
            noise_out[k, r] = linear(rounding_error + wp.abs(work))

    return check

"""Balance of forces at the nodes of a chain, and where a rod has converged.

`check`, one thread a node (on the CPU a rod), runs before a sweep: it writes the residual, and every node's share of the change of the
energy since the accepted iterate. It decides where a rod has converged, so that the last iterate costs no sweep: at every free dof
|residual| <= max(rtol * load scale, floor), where floor bounds what rounding of coordinates and forces leaves,
floor_factor * eps * (H_ii |x| + sum of |element forces|). Moments are compared over the length of the rod. See `compile.tolerance`:
that residuals do not add up either is what a whole Newton step sees to, whose remainder is of second order; where none has been
made, at the start or after a shortened step, the limit is divided by the nodes, so that they can not.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.chain import ChainKind, gather_functions, inertia_type
from ddg_warp.kernels.islands import (
    COEFFICIENT,
    DOUBTFUL,
    DROWNED,
    ITERATION,
    LOAD_SCALE,
    PLACED,
    SLOT,
    STATUS,
    STEP_LENGTH,
    UNBALANCED,
)
from ddg_warp.kernels.judge import ROUNDED, SETTLED
from ddg_warp.kernels.threads import CPU_OPTIONS, until_function


@cache
def node_functions(kind: ChainKind, real):
    """Gathers for one node: force, behind, balance(...) -> residual and what it is judged by, and edge_force.

    balance returns the residual force and moment, the size of the element forces that meet, and the elastic part of the moment.
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
    def behind(k: int, n: int):
        """The element or edge before k, of a closed rod the last before the first; -1 where there is none."""
        if wp.static(closed):
            if k == 0:
                return n - 1
        return k - 1

    @wp.func
    def edge_force(g: wp.array3d(dtype=real), k: int, n: int, r: int):
        """dE/de of edge k."""
        total = force(g, 0, k, r)
        if wp.static(span == 2):
            b = behind(k, n)
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
        b = behind(k, n)
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

    return force, behind, balance, edge_force


@cache
def check_kernel(kind: ChainKind, real, linear):
    """Residual and change of the energy at every node; raises `unbalanced` for a rod with a dof out of equilibrium.

    `drowned` is raised where only rounding excuses a residual. Residuals of held dofs are written as zero. `noise` bounds the
    rounding in `change`, which sums the differences of the element energies and the work of inertia and loads along the step.
    """
    dim, nb, twist, closed, drag = kind.dim, kind.block, kind.twist, kind.closed, kind.drag
    V, Inertia = wp.types.vector(dim, real), inertia_type(kind, real)
    _, behind, balance, _ = node_functions(kind, real)
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
        floor: real,
        right_out: wp.array3d(dtype=linear),
        change_out: wp.array2d(dtype=real),
        noise_out: wp.array2d(dtype=linear),
    ):
        start, r = wp.tid()
        n = count[r]
        if flags[STATUS, r] != 0 or start >= n:
            return
        c = scalars[COEFFICIENT, r]
        accepted = flags[SLOT, r]
        taken = scalars[STEP_LENGTH, r]
        limit = rtol * scalars[LOAD_SCALE, r]
        doubtful = real(wp.static(ROUNDED)) * scalars[LOAD_SCALE, r]
        if flags[ITERATION, r] == 0 or taken < real(1.0):
            limit /= real(n)
        settled = real(wp.static(SETTLED)) * length[r]
        moved = flags[PLACED, r] != 0
        for k in range(start, until(start, n)):
            f, moment, size, elastic = balance(
                g, mass, rotary, c, x, theta, target, target_angle, gravity, load, load_angle, loaded, k, n, r
            )
            stiff = real(0.0)
            b = behind(k, n)
            if wp.static(closed) or k < n - 1:
                stiff = real(stiffness[k, r])
            if b >= 0:
                stiff = wp.max(stiff, real(stiffness[b, r]))
            here = x[k, r]
            if wp.static(drag):
                m = mass[k, r].mass
            else:
                m = mass[k, r]
            reach = wp.max(wp.abs(here))
            least = floor * ((real(2.0) * stiff + c * m) * reach + size)
            if wp.static(drag):
                least += floor * wp.max(wp.get_diag(mass[k, r].resistance)) * reach
            mask = int(fixed[k, r])
            for d in range(wp.static(dim)):
                held = ((mask >> d) & 1) == 1
                right_out[d, k, r] = linear(wp.where(held, real(0.0), f[d]))
                if not held and not wp.abs(f[d]) <= limit:
                    flags[DROWNED, r] = 1
                    if not wp.abs(f[d]) <= least:
                        flags[UNBALANCED, r] = 1
                    if wp.static(real is wp.float32):
                        if wp.abs(f[d]) > doubtful and not wp.abs(real(direction[d, k, r])) < settled:
                            flags[DOUBTFUL, r] = 1
            if wp.static(twist):
                held = ((mask >> wp.static(dim)) & 1) == 1
                right_out[wp.static(nb - 1), k, r] = linear(wp.where(held, real(0.0), moment))
                if not held and not wp.abs(moment) <= limit * length[r]:
                    flags[DROWNED, r] = 1
                    arm = wp.length(x[along(k + 1, n), r] - here)
                    least = floor * (
                        real(2.0) * stiff * arm * arm * reach / length[r]
                        + c * rotary[k, r] * (real(1.0) + wp.abs(theta[k, r]))
                        + wp.abs(elastic)
                    )
                    if not wp.abs(moment) <= least:
                        flags[UNBALANCED, r] = 1
                    if wp.static(real is wp.float32):
                        turn = wp.abs(real(direction[wp.static(nb - 1), k, r]))
                        if wp.abs(moment) > doubtful * length[r] and not turn < real(wp.static(SETTLED)):
                            flags[DOUBTFUL, r] = 1
            if flags[ITERATION, r] == 0:
                continue
            change = real(0.0)
            noise = real(0.5) * size * reach
            if wp.static(closed) or k < n - 1:
                new = energy[1 - accepted, k, r]
                change = new - energy[accepted, k, r]
                noise += wp.abs(new)
            # the change of inertia's and loads' energy along the step, in exact products of small numbers
            u = V()
            if moved:
                u = here - base[k, r]
            else:
                for d in range(wp.static(dim)):
                    u[d] = taken * real(direction[d, k, r])
            outer = gravity[0] * m
            if loaded != 0:
                outer += load[k, r]
            work = wp.dot(u, (here - target[k, r] - u * real(0.5)) * (c * m) - outer)
            if wp.static(drag):
                work += wp.dot(u, mass[k, r].resistance * (here - mass[k, r].carried - u * real(0.5)))
            if wp.static(twist):
                turned = taken * real(direction[wp.static(nb - 1), k, r])
                work += turned * c * rotary[k, r] * (theta[k, r] - target_angle[k, r] - real(0.5) * turned)
                if loaded != 0:
                    work -= turned * load_angle[k, r]
            change_out[k, r] = change + work
            noise_out[k, r] = linear(noise + wp.abs(work))

    return check

"""Residual at the nodes of a rod, evaluated with its elements, and its convergence test.

`evaluate` runs before a sweep. A thread takes a run of nodes of a rod, on the CPU all of them. It evaluates their elements, keeps
element forces in registers, and writes factors, residual, and the energy change since the accepted iterate, summed over the run. It
also tests convergence, so that the last iterate costs no sweep. The last elements of the run before are evaluated again, for their
forces on the first nodes. A rod has converged if at every free dof

    |residual| <= max(rtol * load scale, floor) ,   floor = floor_factor * eps * (H_ii |x| + sum of |element forces|) ,

where the floor bounds the rounding of coordinates and forces. |x| is the largest coordinate of the node and of the next one. Moments
are compared over the length of the rod. Sums of residuals have to be small, too; see `compile.residual_tolerance`. After a full Newton
step they are, of second order. At the start, or after a shortened step, the limit is divided by the number of nodes instead.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import (
    ANY_ACTIVE,
    BELOW_ROUNDING_FLOOR,
    DOUBTFUL,
    DROP_COMPRESSION,
    EDGES_ROTATED,
    ENERGY_BUFFER,
    INERTIA_COEFFICIENT,
    ITERATION,
    LOAD_SCALE,
    MAX_EDGE_STIFFNESS,
    NOT_CONVERGED,
    STATUS,
    STEP_LENGTH,
)
from ddg_warp.kernels.core.launch import renewed
from ddg_warp.kernels.elements.element_path import element_function, element_options, results_type
from ddg_warp.kernels.elements.rod_layout import RodKind, gather_functions, inertia_type, rod_storage
from ddg_warp.kernels.measures.rod_curvature_twist import EDGE
from ddg_warp.kernels.newton.line_search import ROUNDED, SETTLED


@cache
def node_functions(kind: RodKind, real):
    """Return the device functions `previous` and `edge_force` of a rod's edges.

    `previous(k, n)`: element or edge before k.
    `edge_force(g, k, n, r)`: dE/de of edge k, from gradients by the window.
    """
    dim, span, closed, V = kind.dim, kind.span, kind.closed, wp.types.vector(kind.dim, real)

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

    return previous, edge_force


@cache
def evaluate_kernel(
    kind: RodKind,
    real,
    linear,
    curved: bool = False,
    mixed_axial: bool = False,
    project: bool = False,
    reuse: bool = False,
):
    """Build the kernel of an iterate: elements, residual and convergence test.

    `evaluate`: write factors, energies, stiffnesses and residual of the nodes of a run, and set `not_converged` of rods with a
    residual above tolerance and floor.

    `below_rounding_floor` is set if a residual is above the tolerance but within the floor. Residuals of fixed dofs are zero.
    `change` sums element energy differences and the work of inertia and loads along the step; `rounding_error` bounds its rounding.
    For matrices and flags of elements see `kernels.elements.element_path.evaluate_kernel`.

    Args:
        project: True if all rods drop compression, second derivatives or not.
        reuse: True if factors are written at the first iterate of a step only.
    """
    dim, nb, twist, span, closed, quadratic = kind.dim, kind.block, kind.twist, kind.span, kind.closed, kind.quadratic
    prepared = kind.prepared is not None
    V, Inertia, storage = wp.types.vector(dim, real), inertia_type(kind, real), rod_storage(kind, real, prepared)
    W, Inputs, Results = storage.Window, storage.Inputs, results_type(real, linear, False)
    H, X, L = wp.types.vector(nb, linear), wp.types.vector(3, real), storage.Lagged
    along, *_ = gather_functions(kind, real)
    count_of, column_of, whole_of, window_of = storage.count, storage.column, storage.whole, storage.read
    P, by_window, serial = wp.types.vector(EDGE, real), twist and not prepared, kind.serial
    if prepared:
        edge, *_ = kind.prepared(real)
    element_at, angle = element_function(storage, real, linear, curved, mixed_axial), dim * span

    # Data of an element that the element before it lacks.
    @wp.struct
    class Stencil:
        x: V  # of the node after next
        theta: real  # of the next edge, as its frame
        u: X
        t: X
        lagged_twist: real

    @wp.func
    def index_of(j: int, n: int):
        """Return the index of node j, cyclically in a closed rod; in an open rod, of the nearest existing node."""
        if wp.static(closed):
            if j < 0:
                j += n
            return wp.max(along(j, n), 0)
        return wp.max(wp.min(j, n - 1), 0)

    @wp.func
    def stencil_at(inputs: Inputs, j: int, n: int, r: int):
        """Read the stencil of element j."""
        out = Stencil()
        following = index_of(j + 1, n)
        out.x = inputs.x[index_of(j + 2, n), r]
        if wp.static(twist):
            out.theta = inputs.theta[following, r]
        if wp.static(prepared):
            out.u = X(inputs.frame[0, following, r], inputs.frame[1, following, r], inputs.frame[2, following, r])
            out.t = X(inputs.frame[3, following, r], inputs.frame[4, following, r], inputs.frame[5, following, r])
            out.lagged_twist = inputs.frame[6, index_of(j, n), r]
        return out

    # Measured: 100,000 twisted rods of 64 nodes in mixed precision, an H100: 1.22 ms. With three blocks a multiprocessor registers
    # spill: 2.13 ms. Elements and residual in kernels of their own, with gradients in memory: 1.57 ms.
    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(128, 2),
        module_options=element_options(storage, curved),
    )
    def evaluate(
        inputs: Inputs,
        run: int,
        exact_from: int,
        mass: wp.array2d(dtype=Inertia),
        rotary: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
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
        results: Results,
        right_out: wp.array3d(dtype=linear),
        change_out: wp.array2d(dtype=real),
        noise_out: wp.array2d(dtype=linear),
    ):
        i, rod = wp.tid()
        r = rod
        if i == 0 and r == 0:
            flags[ANY_ACTIVE, 0] = 0
        n = inputs.count[r]
        first = i * run
        if flags[STATUS, r] != 0 or first >= n:
            return
        iteration = flags[ITERATION, r]
        dropped = flags[DROP_COMPRESSION, r] != 0
        clamped = wp.static(project) or dropped
        exact = iteration >= exact_from and not dropped
        accepted = flags[ENERGY_BUFFER, r]
        carried = scalars[MAX_EDGE_STIFFNESS, r]
        change = real(0.0)
        rounding_error = real(0.0)
        # of the edge behind: its force dE/de, and the largest stiffness of its element
        force_behind = V()
        stiff_behind = real(0.0)
        # of the element behind: derivatives by the next edge and its twist angle
        force_ahead = V()
        moment_ahead = real(0.0)
        start = first - wp.static(span)
        if wp.static(not closed):
            start = wp.max(start, 0)
        c = scalars[INERTIA_COEFFICIENT, r]
        taken = scalars[STEP_LENGTH, r]
        limit = rtol * scalars[LOAD_SCALE, r]
        if iteration == 0 or taken < real(1.0):
            limit /= real(n)
        # The first iteration prepares the edge at `start`, of the others each takes a node and the element that starts there.
        # Prefetch, on a GPU: data of the next node are read before this node is processed, since a thread mostly waits for memory.
        position = V()
        next_position = inputs.x[index_of(start, n), r]
        theta = real(0.0)
        near = P()
        next_stencil = Stencil()
        if wp.static(not serial):
            next_stencil = stencil_at(inputs, start - 1, n, r)
        for j in range(start - 1, wp.min(first + run, n)):
            owned = j >= first
            r = wp.max(renewed(rod), 0)
            k = index_of(j, n)
            column = column_of(inputs, r, wp.min(k, count_of(inputs, r) - 1))
            stencil = next_stencil
            read = stencil_at(inputs, j + wp.static(0 if serial else 1), n, r)
            if wp.static(serial):
                stencil = read
            else:
                next_stencil = read
            inertia = mass[k, r]
            goal = target[k, r]
            step = H()
            for d in range(wp.static(nb)):
                step[d] = direction[d, k, r]
            mask = int(fixed[k, r])
            energy_before = results.energy[accepted, column]
            spin = real(0.0)
            goal_angle = real(0.0)
            if wp.static(twist):
                spin = rotary[k, r]
                goal_angle = target_angle[k, r]
            far = P()
            if wp.static(prepared):
                if wp.static(closed) or j < n - 2:
                    far = edge(stencil.x - next_position, stencil.u, stencil.t, stencil.theta)
            energy = real(0.0)
            g = W()
            stiff = real(0.0)
            if j >= start and k < count_of(inputs, r):
                frozen = not owned or (wp.static(reuse) and iteration > 0)
                whole = whole_of(inputs, r, k)
                if wp.static(by_window):
                    q, s = window_of(inputs, r, k, whole)
                else:
                    q = W()
                    s = L()
                    for d in range(wp.static(dim)):
                        q[d] = next_position[d] - position[d]
                        if wp.static(span == 2):
                            q[wp.static(dim) + d] = stencil.x[d] - next_position[d]
                    if wp.static(prepared):
                        q[wp.static(angle)] = theta
                        q[wp.static(angle + 1)] = stencil.theta
                        for row in range(wp.static(EDGE)):
                            s[row] = near[row]
                            s[wp.static(EDGE) + row] = far[row]
                        s[wp.static(2 * EDGE)] = stencil.lagged_twist
                energy, g, stiff = element_at(
                    inputs, flags, results, q, s, whole, clamped, frozen, exact and owned, carried, r, k, column
                )
                if owned:
                    results.energy[1 - accepted, column] = energy
                    results.stiffness[column] = linear(stiff)
            force = V()
            for d in range(wp.static(dim)):
                force[d] = g[d]
            force += force_ahead
            elastic = moment_ahead
            if wp.static(twist):
                elastic = g[wp.static(angle)] + moment_ahead
            if owned:
                if wp.static(quadratic):
                    m = inertia.mass
                else:
                    m = inertia
                f = gravity[0] * m - (position - goal) * (c * m)
                if wp.static(quadratic):
                    f -= inertia.stiffness * (position - inertia.reference)
                moment = real(0.0)
                if loaded != 0:
                    f += load[k, r]
                    if wp.static(twist):
                        moment = load_angle[k, r]
                f += force
                f -= force_behind
                size = wp.max(wp.abs(force)) + wp.max(wp.abs(force_behind))
                if wp.static(twist):
                    moment -= elastic + c * spin * (theta - goal_angle)
                stiffest = wp.max(stiff, stiff_behind)
                # an edge is as exact as the larger one of its ends
                magnitude = wp.max(wp.max(wp.abs(position)), wp.max(wp.abs(next_position)))
                least = rounding_factor * ((real(2.0) * stiffest + c * m) * magnitude + size)
                if wp.static(quadratic):
                    least += rounding_factor * wp.max(wp.get_diag(inertia.stiffness)) * magnitude
                if wp.static(real is wp.float32):
                    doubtful = real(wp.static(ROUNDED)) * scalars[LOAD_SCALE, r]
                    settled = real(wp.static(SETTLED)) * length[r]
                for d in range(wp.static(dim)):
                    is_fixed = ((mask >> d) & 1) == 1
                    right_out[d, k, r] = linear(wp.where(is_fixed, real(0.0), f[d]))
                    if not is_fixed and not wp.abs(f[d]) <= limit:
                        flags[BELOW_ROUNDING_FLOOR, r] = 1
                        if not wp.abs(f[d]) <= least:
                            flags[NOT_CONVERGED, r] = 1
                        if wp.static(real is wp.float32):
                            if wp.abs(f[d]) > doubtful and not wp.abs(real(step[d])) < settled:
                                flags[DOUBTFUL, r] = 1
                if wp.static(twist):
                    is_fixed = ((mask >> wp.static(dim)) & 1) == 1
                    right_out[wp.static(nb - 1), k, r] = linear(wp.where(is_fixed, real(0.0), moment))
                    if not is_fixed and not wp.abs(moment) <= limit * length[r]:
                        flags[BELOW_ROUNDING_FLOOR, r] = 1
                        arm = wp.length(next_position - position)
                        least = rounding_factor * (
                            real(2.0) * stiffest * arm * arm * magnitude / length[r]
                            + c * spin * (real(1.0) + wp.abs(theta))
                            + wp.abs(elastic)
                        )
                        if not wp.abs(moment) <= least:
                            flags[NOT_CONVERGED, r] = 1
                        if wp.static(real is wp.float32):
                            rotation = wp.abs(real(step[wp.static(nb - 1)]))
                            if wp.abs(moment) > doubtful * length[r] and not rotation < real(wp.static(SETTLED)):
                                flags[DOUBTFUL, r] = 1
                if iteration != 0:
                    change_here = real(0.0)
                    rounding_here = real(0.5) * size * magnitude
                    if k < count_of(inputs, r):
                        change_here = energy - energy_before
                        rounding_here += wp.abs(energy)
                    # energy change of inertia and loads along the step, from products of small differences
                    u = V()
                    if flags[EDGES_ROTATED, r] != 0:
                        u = position - base[k, r]
                    else:
                        for d in range(wp.static(dim)):
                            u[d] = taken * real(step[d])
                    outer = gravity[0] * m
                    if loaded != 0:
                        outer += load[k, r]
                    work = wp.dot(u, (position - goal - u * real(0.5)) * (c * m) - outer)
                    if wp.static(quadratic):
                        work += wp.dot(u, inertia.stiffness * (position - inertia.reference - u * real(0.5)))
                    if wp.static(twist):
                        rotation_step = taken * real(step[wp.static(nb - 1)])
                        work += rotation_step * c * spin * (theta - goal_angle - real(0.5) * rotation_step)
                        if loaded != 0:
                            work -= rotation_step * load_angle[k, r]
                    change += change_here + work
                    rounding_error += rounding_here + wp.abs(work)
            position = next_position
            next_position = stencil.x
            theta = stencil.theta
            near = far
            force_behind = force
            stiff_behind = stiff
            if wp.static(span == 2):
                for d in range(wp.static(dim)):
                    force_ahead[d] = g[wp.static(dim) + d]
                if wp.static(twist):
                    moment_ahead = g[wp.static(angle + 1)]
        if iteration != 0:
            change_out[i, r] = change
            noise_out[i, r] = linear(rounding_error)

    return evaluate

"""User-defined forces on nodes, and between all pairs of nodes.

A nodal force is a function `force(x, v, t, p)` of position, velocity in the step, time and parameters. A pair force is a function
`force(d, p, q)` on a node from another at the distance vector d, with the parameters p of the first node and q of the other. The
opposite force acts on the other node, so that `force(-d, q, p)` is `-force(d, p, q)`; the derivative by d is symmetric. All derivatives
come from automatic differentiation.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.inertia import block_inertia, mass_type
from ddg_warp.kernels.core.islands import (
    DROP_COMPRESSION,
    ENERGY_BUFFER,
    INVERSE_STEP,
    NEEDS_DIRECTION,
    STATUS,
    STEP_PROGRESS,
    SUBSTEP_FRACTION,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def parameter_struct(layout: tuple[tuple[str, int], ...], real):
    """Return the struct of the parameters of a node: (name, number of components, 1 or 3) each."""
    fields = {name: real if size == 1 else wp.types.vector(3, real) for name, size in layout}
    return wp.struct(type("Parameters", (), {"__annotations__": fields, "__module__": __name__}))


@cache
def numbers_function(layout: tuple[tuple[str, int], ...], real):
    """Return the device function `numbers(p)`: the components of a parameter struct in one vector. Warp adds no structs."""
    size, struct = sum(size for _, size in layout), parameter_struct(layout, real)
    number = f"wp::{real.__name__}"

    @wp.func_native(
        snippet=f"""
    wp::vec_t<{size}, {number}> result;
    for (int i = 0; i < {size}; ++i) result[i] = reinterpret_cast<const {number}*>(&p)[i];
    return result;
    """
    )
    def numbers(p: struct) -> wp.types.vector(size, real): ...

    return numbers


@cache
def start_kernels(real):
    """Build the kernels that begin evaluations.

    `clock`: write the time at the end of the current substep of each world.
    `begin`: clear the forces of the iterate, and copy the forces of contact.
    `clear`: clear the stiffness of worlds that need a direction.
    `unsymmetric`: mark worlds with an unsymmetric stiffness of a node.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def clock(scalars: wp.array2d(dtype=real), times: wp.array2d(dtype=real), time: wp.array(dtype=real)):
        w = wp.tid()
        fraction = wp.min(scalars[STEP_PROGRESS, w] + scalars[SUBSTEP_FRACTION, w], real(1.0))
        time[w] = times[0, w] + fraction * (times[1, w] - times[0, w])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def begin(
        contact: wp.array(dtype=V),
        pressed: wp.array(dtype=real),
        stiffness: wp.array(dtype=M),
        flags: wp.array2d(dtype=int),
        blocks: int,
        force: wp.array2d(dtype=V),
        total: wp.array(dtype=V),
        bound: wp.array(dtype=real),
    ):
        i = wp.tid()
        w = i / blocks
        if flags[STATUS, w] != 0:
            return
        force[1 - flags[ENERGY_BUFFER, w], i] = V()
        largest = wp.max(wp.abs(wp.get_diag(stiffness[i])))
        if contact.shape[0] > 0:
            total[i] = contact[i]
            bound[i] = pressed[i] + largest
        else:
            total[i] = V()
            bound[i] = largest

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def clear(flags: wp.array2d(dtype=int), blocks: int, stiffness: wp.array(dtype=M)):
        i = wp.tid()
        if flags[NEEDS_DIRECTION, i / blocks] != 0:
            stiffness[i] = M()

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def unsymmetric(stiffness: wp.array(dtype=M), tolerance: real, blocks: int, failed: wp.array(dtype=int)):
        i = wp.tid()
        s = stiffness[i]
        difference = s - wp.transpose(s)
        if wp.ddot(difference, difference) > tolerance * tolerance * wp.ddot(s, s):
            failed[i / blocks] = 1

    return clock, begin, clear, unsymmetric


@cache
def finish_kernels(real, quadratic: bool):
    """Build the kernels that end evaluations.

    `work`: add the mean work of the forces along the step to the change of the energy.
    `inertia`: add the stiffness to the inertia of blocks, which matrices take; where the matrix was indefinite, its projection to
    positive semidefinite blocks.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def work(
        q: wp.array(dtype=V),
        base: wp.array(dtype=V),
        force: wp.array2d(dtype=V),
        flags: wp.array2d(dtype=int),
        blocks: int,
        change: wp.array2d(dtype=real),
        rounding_error: wp.array2d(dtype=real),
    ):
        i = wp.tid()
        w = i / blocks
        if flags[STATUS, w] == 0:
            k = i - w * blocks
            made = real(0.5) * wp.dot(q[i] - base[i], force[0, i] + force[1, i])
            change[w, k] = change[w, k] - made
            rounding_error[w, k] = rounding_error[w, k] + wp.abs(made)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def inertia(
        mass: mass_type(real, quadratic),
        stiffness: wp.array(dtype=M),
        flags: wp.array2d(dtype=int),
        blocks: int,
        out: wp.array2d(dtype=block_inertia(real)),
    ):
        i = wp.tid()
        w = i / blocks
        if flags[NEEDS_DIRECTION, w] == 0:
            return
        k = i - w * blocks
        s = stiffness[i]
        s = real(0.5) * (s + wp.transpose(s))
        if flags[DROP_COMPRESSION, w] != 0 and wp.ddot(s, s) > real(0.0):
            vectors, values = wp.eig3(s)
            s = vectors * wp.diag(wp.max(values, V())) * wp.transpose(vectors)
        if wp.static(quadratic):
            s += mass[w, k].stiffness
            out[w, k].mass = mass[w, k].mass
        else:
            out[w, k].mass = mass[w, k]
        out[w, k].stiffness = s

    return work, inertia


@cache
def nodal_kernels(function, layout: tuple[tuple[str, int], ...], real):
    """Build the kernels of a nodal force: `evaluate`, `stiffen` (minus its derivative), `pull` (its reverse).

    `pull` adds w . df to gradients by positions at the end and at the start, parameters, and the inverse step.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    struct, numbers, force = parameter_struct(layout, real), numbers_function(layout, real), function(real)
    P = wp.types.vector(sum(size for _, size in layout), real)

    @wp.func
    def along(x: V, v: V, t: real, p: struct, w: V):
        return wp.dot(w, force(x, v, t, p))

    derivative = wp.grad(along)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def evaluate(
        nodes: wp.array(dtype=int),
        parameters: wp.array2d(dtype=struct),
        q: wp.array(dtype=V),
        start: wp.array(dtype=V),
        time: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        out: wp.array2d(dtype=V),
        total: wp.array(dtype=V),
        bound: wp.array(dtype=real),
    ):
        w, k = wp.tid()
        if flags[STATUS, w] != 0:
            return
        i = nodes[k] + w * blocks
        f = force(q[i], (q[i] - start[i]) * scalars[INVERSE_STEP, w], time[w], parameters[w, k])
        half = 1 - flags[ENERGY_BUFFER, w]
        out[half, i] = out[half, i] + f
        total[i] = total[i] + f

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def stiffen(
        nodes: wp.array(dtype=int),
        parameters: wp.array2d(dtype=struct),
        q: wp.array(dtype=V),
        start: wp.array(dtype=V),
        time: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        out: wp.array(dtype=M),
    ):
        w, k = wp.tid()
        if flags[NEEDS_DIRECTION, w] == 0:
            return
        i = nodes[k] + w * blocks
        rate = scalars[INVERSE_STEP, w]
        s = M()
        for d in range(3):
            unit = V()
            unit[d] = real(1.0)
            by_x, by_v, _t, _p, _w = derivative(q[i], (q[i] - start[i]) * rate, time[w], parameters[w, k], unit)
            row = by_x + by_v * rate
            for c in range(3):
                s[d, c] = -row[c]
        out[i] = out[i] + s

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        nodes: wp.array(dtype=int),
        parameters: wp.array2d(dtype=struct),
        q: wp.array(dtype=V),
        start: wp.array(dtype=V),
        time: wp.array(dtype=real),
        rates: wp.array(dtype=real),
        w: wp.array(dtype=V),
        blocks: int,
        by_q: wp.array(dtype=V),
        by_start: wp.array(dtype=V),
        by_rate: wp.array(dtype=real),
        by_parameters: wp.array2d(dtype=P),
    ):
        world, k = wp.tid()
        i = nodes[k] + world * blocks
        change = q[i] - start[i]
        rate = rates[world]
        by_x, by_v, _t, by_p, _w = derivative(q[i], change * rate, time[world], parameters[world, k], w[i])
        by_q[i] = by_q[i] + by_x + by_v * rate
        by_start[i] = by_start[i] - by_v * rate
        by_rate[i] = by_rate[i] + wp.dot(by_v, change)
        by_parameters[world, k] = numbers(by_p)

    return evaluate, stiffen, pull


@cache
def pair_functions(function, layout: tuple[tuple[str, int], ...], real):
    """Return the device functions of a pair force.

    `force(d, p, q)`.
    `derivative(d, p, q, w)`: the gradient of w . force by all arguments.
    `jacobian(d, p, q)`: the derivative of the force by d.
    """
    V, M, struct, force = (
        wp.types.vector(3, real),
        wp.types.matrix((3, 3), real),
        parameter_struct(layout, real),
        function(real),
    )

    @wp.func
    def along(d: V, p: struct, q: struct, w: V):
        return wp.dot(w, force(d, p, q))

    derivative = wp.grad(along)

    @wp.func
    def jacobian(d: V, p: struct, q: struct):
        result = M()
        for row in range(3):
            unit = V()
            unit[row] = real(1.0)
            by_d, _p, _q, _w = derivative(d, p, q, unit)
            for c in range(3):
                result[row, c] = by_d[c]
        return result

    return force, derivative, jacobian


@cache
def pair_kernels(function, layout: tuple[tuple[str, int], ...], real, linear):
    """Build the kernels of a pair force; one thread sums over all other nodes, in order.

    `evaluate`: as for a nodal force, with a bound of the stiffness, twice the force of a pair over its distance.
    `multiply`: subtract the change of the force by a vector of displacements.
    `blocks_of`: write the blocks of the stiffness between different nodes.
    `pull`: its reverse.
    """
    V, M, H = wp.types.vector(3, real), wp.types.matrix((3, 3), real), wp.types.vector(3, linear)
    struct, numbers = parameter_struct(layout, real), numbers_function(layout, real)
    force, derivative, jacobian = pair_functions(function, layout, real)
    P = wp.types.vector(sum(size for _, size in layout), real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def evaluate(
        nodes: wp.array(dtype=int),
        parameters: wp.array2d(dtype=struct),
        q: wp.array(dtype=V),
        start: wp.array(dtype=V),
        time: wp.array(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        blocks: int,
        out: wp.array2d(dtype=V),
        total: wp.array(dtype=V),
        bound: wp.array(dtype=real),
    ):
        w, k = wp.tid()
        if flags[STATUS, w] != 0:
            return
        i = nodes[k] + w * blocks
        p = parameters[w, k]
        f = V()
        stiffness = real(0.0)
        for neighbour in range(nodes.shape[0]):
            if neighbour != k:
                d = q[nodes[neighbour] + w * blocks] - q[i]
                pair = force(d, p, parameters[w, neighbour])
                f += pair
                stiffness += wp.length(pair) / wp.length(d)
        half = 1 - flags[ENERGY_BUFFER, w]
        out[half, i] = out[half, i] + f
        total[i] = total[i] + f
        bound[i] = bound[i] + real(2.0) * stiffness

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def multiply(
        nodes: wp.array(dtype=int),
        parameters: wp.array2d(dtype=struct),
        q: wp.array(dtype=V),
        flags: wp.array2d(dtype=int),
        inactive: wp.array(dtype=wp.uint8),
        wanted: wp.array(dtype=int),
        v: wp.array(dtype=H),
        blocks: int,
        out: wp.array(dtype=H),
        dots: wp.array2d(dtype=linear),
    ):
        w, k = wp.tid()
        if wanted[w] != 1 or flags[DROP_COMPRESSION, w] != 0:
            return
        i = nodes[k] + w * blocks
        p = parameters[w, k]
        y = V()
        for neighbour in range(nodes.shape[0]):
            if neighbour != k:
                j = nodes[neighbour] + w * blocks
                u = v[j] - v[i]
                change = V(real(u[0]), real(u[1]), real(u[2]))
                by_d, _p, _q, _w = derivative(q[j] - q[i], p, parameters[w, neighbour], change)
                y += by_d
        mask = int(inactive[i])
        total = out[i]
        for d in range(3):
            if ((mask >> d) & 1) == 0:
                total[d] = total[d] - linear(y[d])
        out[i] = total
        dots[w, nodes[k]] = wp.dot(v[i], total)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def blocks_of(
        nodes: wp.array(dtype=int),
        parameters: wp.array2d(dtype=struct),
        q: wp.array(dtype=V),
        blocks: int,
        out: wp.array3d(dtype=M),
    ):
        w, k, neighbour = wp.tid()
        s = M()
        if neighbour != k:
            d = q[nodes[neighbour] + w * blocks] - q[nodes[k] + w * blocks]
            s = -jacobian(d, parameters[w, k], parameters[w, neighbour])
        out[w, k, neighbour] = s

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        nodes: wp.array(dtype=int),
        parameters: wp.array2d(dtype=struct),
        q: wp.array(dtype=V),
        start: wp.array(dtype=V),
        time: wp.array(dtype=real),
        rates: wp.array(dtype=real),
        w: wp.array(dtype=V),
        blocks: int,
        by_q: wp.array(dtype=V),
        by_start: wp.array(dtype=V),
        by_rate: wp.array(dtype=real),
        by_parameters: wp.array2d(dtype=P),
    ):
        world, k = wp.tid()
        i = nodes[k] + world * blocks
        p = parameters[world, k]
        by_x = V()
        by_p = P()
        for neighbour in range(nodes.shape[0]):
            if neighbour != k:
                j = nodes[neighbour] + world * blocks
                d = q[j] - q[i]
                by_d, first, _q, _w = derivative(d, p, parameters[world, neighbour], w[i])
                back, _p, second, _v = derivative(-d, parameters[world, neighbour], p, w[j])
                by_x += back - by_d
                by_p += numbers(first) + numbers(second)
        by_q[i] = by_q[i] + by_x
        by_parameters[world, k] = by_p

    return evaluate, multiply, blocks_of, pull


@cache
def energy_kernel(potential, layout: tuple[tuple[str, int], ...], pairs: bool, real):
    """Build the kernel `energy`: write the energy of every node, of pairs half of theirs."""
    V, struct, function = wp.types.vector(3, real), parameter_struct(layout, real), potential(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def energy(
        nodes: wp.array(dtype=int),
        parameters: wp.array2d(dtype=struct),
        q: wp.array(dtype=V),
        time: real,
        blocks: int,
        out: wp.array2d(dtype=real),
    ):
        w, k = wp.tid()
        x = q[nodes[k] + w * blocks]
        p = parameters[w, k]
        if wp.static(pairs):
            total = real(0.0)
            for neighbour in range(nodes.shape[0]):
                if neighbour != k:
                    total += function(q[nodes[neighbour] + w * blocks] - x, p, parameters[w, neighbour])
            out[w, k] = real(0.5) * total
        else:
            out[w, k] = function(x, V(), time, p)

    return energy


@cache
def pair_check_kernel(function, layout: tuple[tuple[str, int], ...], real):
    """Build the kernel `check` of pairs of nodes (2, pairs): write four sizes of each.

    They are the force, the sum of the forces on both nodes, the derivative by the distance vector, and its asymmetry.
    """
    V, struct = wp.types.vector(3, real), parameter_struct(layout, real)
    force, _, jacobian = pair_functions(function, layout, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def check(
        x: wp.array(dtype=V),
        parameters: wp.array2d(dtype=struct),
        pairs: wp.array2d(dtype=int),
        out: wp.array2d(dtype=real),
    ):
        pair = wp.tid()
        i, j = pairs[0, pair], pairs[1, pair]
        p, q = parameters[0, i], parameters[0, j]
        d = x[j] - x[i]
        f = force(d, p, q)
        K = jacobian(d, p, q)
        skew = K - wp.transpose(K)
        out[0, pair] = wp.length(f)
        out[1, pair] = wp.length(f + force(-d, q, p))
        out[2, pair] = wp.sqrt(wp.ddot(K, K))
        out[3, pair] = wp.sqrt(wp.ddot(skew, skew))

    return check


@cache
def potential_check_kernel(function, potential, layout: tuple[tuple[str, int], ...], pairs: bool, real):
    """Build the kernel `check` of nodes, or of a node and the one before: write the sizes of force and error of the potential.

    The error is the difference of the force and the negative gradient of the potential (2, nodes), at rest and t = 0.
    """
    V, struct, force, energy = wp.types.vector(3, real), parameter_struct(layout, real), function(real), potential(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def check(x: wp.array(dtype=V), parameters: wp.array2d(dtype=struct), out: wp.array2d(dtype=real)):
        k = wp.tid()
        p = parameters[0, k]
        if wp.static(pairs):
            if k > 0:
                q = parameters[0, k - 1]
                d = x[k - 1] - x[k]
                f = force(d, p, q)
                by_d, _p, _q = wp.grad(energy)(d, p, q)
                out[0, k] = wp.length(f)
                out[1, k] = wp.length(f - by_d)
        else:
            f = force(x[k], V(), real(0.0), p)
            by_x, _v, _t, _p = wp.grad(energy)(x[k], V(), real(0.0), p)
            out[0, k] = wp.length(f)
            out[1, k] = wp.length(f + by_x)

    return check

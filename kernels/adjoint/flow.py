"""Vector-Jacobian products of fields of flow with respect to positions; see `kernels.forces.flow`.

Let g be the gradient by the velocity of a field at x + l v, with the lead l. With its spatial derivative J, the gradient by x is
h = J^T g, and by v it is l h. The midpoint rule has the rate 1 / l in its solve, and the gradient by it is -l^2 h . v.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.core.nodes import NodeStorage, state_type
from ddg_warp.kernels.forces.flow import AMPLITUDE, WAVE, grid_functions, space_functions


@cache
def mode_product(real):
    """Return the device function `product(x, g, modes, phases)`: J^T g of modes."""
    X = wp.types.vector(3, real)

    @wp.func
    def product(x: X, g: X, modes: wp.array2d(dtype=real), phases: wp.array(dtype=real)):
        result = X()
        for n in range(phases.shape[0]):
            phase = phases[n]
            size = real(0.0)
            for d in range(3):
                phase += modes[wp.static(WAVE) + d, n] * x[d]
                size += modes[wp.static(AMPLITUDE) + d, n] * g[d]
            size *= wp.sin(phase)
            for d in range(3):
                result[d] -= modes[wp.static(WAVE) + d, n] * size
        return result

    return product


@cache
def grid_product(real):
    """Return the device function `product(x, g, velocities, box, instant)`: J^T g on a grid, zero along axes beyond the box."""
    X = wp.types.vector(3, real)
    cell, _ = grid_functions(real)

    @wp.func
    def inner(x: real, count: int):
        """Return 1 within the grid, else 0."""
        return wp.where(x > real(0.0) and x < real(count - 1), real(1.0), real(0.0))

    @wp.func
    def product(x: X, g: X, velocities: wp.array4d(dtype=X), box: wp.array(dtype=X), instant: wp.array(dtype=real)):
        index = wp.cw_mul(x - box[0], box[1])
        i, a = cell(index[0], velocities.shape[1])
        j, b = cell(index[1], velocities.shape[2])
        k, c = cell(index[2], velocities.shape[3])
        t, d = cell(instant[0], velocities.shape[0])
        result = X()
        for corner in range(16):
            di = wp.min(corner & 1, velocities.shape[1] - 1)
            dj = wp.min((corner >> 1) & 1, velocities.shape[2] - 1)
            dk = wp.min((corner >> 2) & 1, velocities.shape[3] - 1)
            dt = wp.min((corner >> 3) & 1, velocities.shape[0] - 1)
            wa = wp.where((corner & 1) == 1, a, real(1.0) - a)
            wb = wp.where(((corner >> 1) & 1) == 1, b, real(1.0) - b)
            wc = wp.where(((corner >> 2) & 1) == 1, c, real(1.0) - c)
            wd = wp.where(((corner >> 3) & 1) == 1, d, real(1.0) - d)
            size = wp.dot(velocities[t + dt, i + di, j + dj, k + dk], g) * wd
            result[0] += size * wb * wc * real(2 * (corner & 1) - 1)
            result[1] += size * wa * wc * real(2 * ((corner >> 1) & 1) - 1)
            result[2] += size * wa * wb * real(2 * ((corner >> 2) & 1) - 1)
        inside = X(
            inner(index[0], velocities.shape[1]),
            inner(index[1], velocities.shape[2]),
            inner(index[2], velocities.shape[3]),
        )
        return wp.cw_mul(wp.cw_mul(result, box[1]), inside)

    return product


@cache
def pull_function(nodes: NodeStorage, real):
    """Return the device function `add(k, island, h, before, lead, rate_out, start_out)`: add the gradients of a node."""
    X, State = wp.types.vector(3, real), state_type(nodes, real)
    _, drop = space_functions(nodes.dim, real)

    @wp.func
    def add(
        k: int,
        island: int,
        h: X,
        before: State,
        lead: wp.array(dtype=real),
        rate_out: wp.array2d(dtype=real),
        start_out: State,
    ):
        l = lead[0]
        by_x = drop(h)
        start_out.x[k, island] = start_out.x[k, island] + by_x
        if l > real(0.0):
            start_out.v[k, island] = start_out.v[k, island] + by_x * l
            rate_out[k, island] = rate_out[k, island] - l * l * wp.dot(by_x, before.v[k, island])

    return add


@cache
def mode_kernel(nodes: NodeStorage, real):
    """Build the kernel `pull`: add the gradients of modes."""
    V, State, product = wp.types.vector(nodes.dim, real), state_type(nodes, real), mode_product(real)
    add, (lift, _) = pull_function(nodes, real), space_functions(nodes.dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        before: State,
        count: wp.array(dtype=int),
        lead: wp.array(dtype=real),
        modes: wp.array2d(dtype=real),
        phases: wp.array(dtype=real),
        by_flow: wp.array2d(dtype=V),
        rate_out: wp.array2d(dtype=real),
        start_out: State,
    ):
        k, r = wp.tid()
        if k < count[r]:
            x = lift(before.x[k, r] + before.v[k, r] * lead[0])
            h = product(x, lift(by_flow[k, r]), modes, phases)
            add(k, r, h, before, lead, rate_out, start_out)

    return pull


@cache
def grid_kernel(nodes: NodeStorage, real):
    """Build the kernel `pull`: add the gradients of a grid."""
    V, X, State = wp.types.vector(nodes.dim, real), wp.types.vector(3, real), state_type(nodes, real)
    product, add, (lift, _) = grid_product(real), pull_function(nodes, real), space_functions(nodes.dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        before: State,
        count: wp.array(dtype=int),
        lead: wp.array(dtype=real),
        velocities: wp.array4d(dtype=X),
        box: wp.array(dtype=X),
        instant: wp.array(dtype=real),
        by_flow: wp.array2d(dtype=V),
        rate_out: wp.array2d(dtype=real),
        start_out: State,
    ):
        k, r = wp.tid()
        if k < count[r]:
            x = lift(before.x[k, r] + before.v[k, r] * lead[0])
            h = product(x, lift(by_flow[k, r]), velocities, box, instant)
            add(k, r, h, before, lead, rate_out, start_out)

    return pull

"""Fields of flow at nodes: sums of Fourier modes, and trilinear interpolation on grids; see `ddg_warp.scene.flow`.

A field is evaluated at the start of a solve, at x + l v with the lead l [s]: half a step by the midpoint rule, else 0. Kernels add
fields to a uniform velocity.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS

WAVE, AMPLITUDE = 0, 3  # first rows of wave vectors and amplitudes of modes
ROWS = 6


@cache
def space_functions(dim: int, real):
    """Return the device functions `lift(x)` and `drop(x)`: to a vector in space, and back; y of a planar rod is zero."""
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)

    @wp.func
    def lift(x: V):
        if wp.static(dim == 2):
            return X(x[0], real(0.0), x[1])
        else:
            return x

    @wp.func
    def drop(x: X):
        if wp.static(dim == 2):
            return V(x[0], x[2])
        else:
            return x

    return lift, drop


@cache
def start_kernel(dim: int, real):
    """Build the kernel `start`: write the uniform velocity to all nodes."""
    V = wp.types.vector(dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(uniform: wp.array(dtype=V), flow: wp.array2d(dtype=V)):
        k, r = wp.tid()
        flow[k, r] = uniform[0]

    return start


@cache
def mode_functions(real):
    """Return the device function `velocity(x, modes, phases)` of modes (rows, N) with phases at the time (N,)."""
    X = wp.types.vector(3, real)

    @wp.func
    def velocity(x: X, modes: wp.array2d(dtype=real), phases: wp.array(dtype=real)):
        result = X()
        for n in range(phases.shape[0]):
            phase = phases[n]
            for d in range(3):
                phase += modes[wp.static(WAVE) + d, n] * x[d]
            size = wp.cos(phase)
            for d in range(3):
                result[d] += modes[wp.static(AMPLITUDE) + d, n] * size
        return result

    return velocity


@cache
def grid_functions(real):
    """Return the device functions `cell(index, count)`, and `velocity(x, velocities, box, instant)`.

    `cell` returns the cell of an index with a fraction, and the fraction. Velocities are [time][x][y][z]. `box` has the lower corner
    and the inverse distances of grid points (2,); `instant` is the index of the time with its fraction.
    """
    X = wp.types.vector(3, real)

    @wp.func
    def cell(index: real, count: int):
        inside = wp.clamp(index, real(0.0), real(count - 1))
        first = wp.min(int(inside), wp.max(count - 2, 0))
        return first, inside - real(first)

    @wp.func
    def velocity(x: X, velocities: wp.array4d(dtype=X), box: wp.array(dtype=X), instant: real):
        index = wp.cw_mul(x - box[0], box[1])
        i, a = cell(index[0], velocities.shape[1])
        j, b = cell(index[1], velocities.shape[2])
        k, c = cell(index[2], velocities.shape[3])
        t, d = cell(instant, velocities.shape[0])
        result = X()
        for corner in range(16):
            di = corner & 1
            dj = (corner >> 1) & 1
            dk = (corner >> 2) & 1
            dt = (corner >> 3) & 1
            weight = wp.where(di == 1, a, real(1.0) - a) * wp.where(dj == 1, b, real(1.0) - b)
            weight *= wp.where(dk == 1, c, real(1.0) - c) * wp.where(dt == 1, d, real(1.0) - d)
            if weight > real(0.0):
                result += velocities[t + dt, i + di, j + dj, k + dk] * weight
        return result

    return cell, velocity


@cache
def mode_kernel(dim: int, real):
    """Build the kernel `add`: add the velocity of modes at nodes."""
    V, velocity, (lift, drop) = wp.types.vector(dim, real), mode_functions(real), space_functions(dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(
        x: wp.array2d(dtype=V),
        v: wp.array2d(dtype=V),
        count: wp.array(dtype=int),
        lead: wp.array(dtype=real),
        modes: wp.array2d(dtype=real),
        phases: wp.array(dtype=real),
        flow: wp.array2d(dtype=V),
    ):
        k, r = wp.tid()
        if k < count[r]:
            flow[k, r] = flow[k, r] + drop(velocity(lift(x[k, r] + v[k, r] * lead[0]), modes, phases))

    return add


@cache
def grid_kernel(dim: int, real):
    """Build the kernel `add`: add the velocity on a grid at nodes."""
    V, X = wp.types.vector(dim, real), wp.types.vector(3, real)
    (_, velocity), (lift, drop) = grid_functions(real), space_functions(dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def add(
        x: wp.array2d(dtype=V),
        v: wp.array2d(dtype=V),
        count: wp.array(dtype=int),
        lead: wp.array(dtype=real),
        velocities: wp.array4d(dtype=X),
        box: wp.array(dtype=X),
        instant: wp.array(dtype=real),
        flow: wp.array2d(dtype=V),
    ):
        k, r = wp.tid()
        if k < count[r]:
            flow[k, r] = flow[k, r] + drop(velocity(lift(x[k, r] + v[k, r] * lead[0]), velocities, box, instant[0]))

    return add

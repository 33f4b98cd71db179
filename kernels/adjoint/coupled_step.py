"""Reverse of a step of the coupled system; see `kernels.elements.variation` and `kernels.elements.coupled_element` for the layout.

Every local node of an element writes its own contributions, which `kernels.adjoint.coupled_assembly` gathers.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.coupled_element import FRAME, elements_type, place_function, spread_function
from ddg_warp.kernels.forces.drag import block_inertia
from ddg_warp.kernels.terms import Term


@cache
def lag_kernel(term: Term, real):
    """Build the kernel of gradients by an element's own lagged rows.

    `pull`: reverse `kernels.elements.coupled_frames.lag_kernel`, and add.
    """
    Elements, measure = elements_type(real), term.measure
    V = wp.types.vector(3, real)
    Q, S, _, _ = measure.types(real)
    own_rows = measure.lag_size - FRAME * measure.frames
    L = wp.types.vector(own_rows, real)
    place, advance = place_function(measure, real), measure.advance(real)
    spread = spread_function(measure, real)
    slots, data = measure.slots, measure.lag_size + measure.data_size

    @wp.func
    def advanced(q: Q, s: S, f: L):
        return wp.dot(advance(q, s), f)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def pull(
        inputs: Elements,
        cotangent: wp.array2d(dtype=real),
        slot_out: wp.array2d(dtype=V),
        lag_out: wp.array2d(dtype=real),
    ):
        tid = wp.tid()
        world = tid / inputs.elements
        q, s = place(inputs, inputs.q, world, tid - world * inputs.elements)
        f = L()
        for i in range(wp.static(own_rows)):
            f[i] = cotangent[i, tid]
        dq, ds, _df = wp.grad(advanced)(q, s, f)
        for i in range(wp.static(slots)):
            slot_out[i, tid] = slot_out[i, tid] + spread(dq, i)
        for i in range(wp.static(data)):
            lag_out[i, tid] = lag_out[i, tid] + ds[i]

    return pull


@cache
def step_kernels(real, midpoint: bool, drag: bool):
    """Build the kernels of the reverse of a step of the blocks of the coupled system.

    `solution`, `start`: see `kernels.adjoint.rod_step`, without loads, weight and inertia of a solve. `inert`: add the gradients by
    these. `ended`: write blocks at the end of a step. Joint rotations begin every step at zero.
    """
    V = wp.types.vector(3, real)
    share = real(2.0 if midpoint else 1.0)
    kept = real(1.0 if midpoint else 0.0)

    Inertia, settles = block_inertia(real), drag and midpoint

    @wp.func
    def swing(inertia: wp.array2d(dtype=Inertia), i: int, blocks: int):
        """Return the factor of the solve's rate in the rate at the end; see `settle` of `drag.coupled_kernels`."""
        result = V(share, share, share)
        if wp.static(settles):
            node = inertia[i / blocks, i % blocks]
            for d in range(3):
                if node.mass[d] <= real(0.0) and node.resistance[d, d] > real(0.0):
                    result[d] = real(1.0)
        return result

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def solution(
        q: wp.array(dtype=V),
        v: wp.array(dtype=V),
        more: wp.array(dtype=V),
        inertia: wp.array2d(dtype=Inertia),
        rate: real,
        last: int,
        blocks: int,
        out: wp.array(dtype=V),
    ):
        """Write the gradient by the solution; `last` is the number of blocks without joint rotations."""
        i = wp.tid()
        total = more[i] * share
        if i % blocks < last:
            total += q[i] * share + wp.cw_mul(swing(inertia, i, blocks), v[i]) * rate
        out[i] = total

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def inert(
        solved: wp.array(dtype=V),
        q0: wp.array(dtype=V),
        v0: wp.array(dtype=V),
        w: wp.array(dtype=V),
        mass: wp.array2d(dtype=V),
        gravity: wp.array(dtype=V),
        nodes: int,
        last: int,
        blocks: int,
        rate: real,
        damping: wp.array(dtype=real),
        q_out: wp.array(dtype=V),
        v_out: wp.array(dtype=V),
        load_out: wp.array(dtype=V),
        mass_out: wp.array(dtype=V),
        rate_out: wp.array(dtype=real),
        damping_out: wp.array(dtype=real),
        gravity_out: wp.array(dtype=V),
    ):
        """Add gradients by inertia, weight and loads; `gravity` is by world."""
        i = wp.tid()
        world = i / blocks
        k = i - world * blocks
        residual = w[i]
        load_out[i] = load_out[i] + residual
        if k >= last:
            return
        c = rate * (rate + damping[0])
        m = mass[world, k]
        pushed = wp.cw_mul(m, residual)
        step = solved[i] - q0[i]
        before = v0[i]
        q_out[i] = q_out[i] + pushed * c
        v_out[i] = v_out[i] + pushed * rate
        outer = before * rate - step * c
        if k < nodes:
            outer += gravity[world]
            gravity_out[i] = gravity_out[i] + pushed
        mass_out[i] = mass_out[i] + wp.cw_mul(residual, outer)
        rate_out[i] = rate_out[i] - wp.dot(pushed, step * (real(2.0) * rate + damping[0]) - before)
        damping_out[i] = damping_out[i] - rate * wp.dot(pushed, step)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def start(
        q: wp.array(dtype=V),
        v: wp.array(dtype=V),
        more: wp.array(dtype=V),
        solved: wp.array(dtype=V),
        q0: wp.array(dtype=V),
        fixed_part: wp.array(dtype=V),
        inertia: wp.array2d(dtype=Inertia),
        last: int,
        blocks: int,
        rate: real,
        q_out: wp.array(dtype=V),
        v_out: wp.array(dtype=V),
        rate_out: wp.array(dtype=real),
    ):
        """Add gradients by the start; `fixed_part` is the gradient at fixed dofs without prescribed motion."""
        i = wp.tid()
        if i % blocks >= last:
            return
        ended = wp.cw_mul(swing(inertia, i, blocks), v[i])
        q_out[i] = q_out[i] + fixed_part[i] - (q[i] + more[i]) * kept - ended * rate
        v_out[i] = v_out[i] - (ended - v[i]) * kept
        rate_out[i] = rate_out[i] + wp.dot(ended, solved[i] - q0[i])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def ended(solved: wp.array(dtype=V), q0: wp.array(dtype=V), out: wp.array(dtype=V)):
        i = wp.tid()
        out[i] = solved[i] + (solved[i] - q0[i])

    return solution, inert, start, ended

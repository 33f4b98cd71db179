"""Reverse of time-lagged data and end of a step of the coupled system; layout as in `kernels.elements.coupled_element`.

Every local node of an element writes its own contributions, which `kernels.adjoint.coupled_assembly` gathers.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.coupled_element import FRAME, elements_type, place_function, spread_function
from ddg_warp.kernels.terms import Term


@cache
def lag_kernel(term: Term, real):
    """Build the kernel of gradients by an element's own lagged rows.

    `vjp`: reverse `kernels.elements.coupled_frames.lag_kernel`, and add.
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
    def vjp(
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

    return vjp


@cache
def end_kernel(real):
    """Build the kernel `ended`: write blocks at the end of a step of the midpoint rule."""
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def ended(solved: wp.array(dtype=V), q0: wp.array(dtype=V), out: wp.array(dtype=V)):
        i = wp.tid()
        out[i] = solved[i] + (solved[i] - q0[i])

    return ended

"""Element forces of one term from gathered local dofs, and their reverse, an element a thread; see `kernels.elements.variation`."""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements.variation import variation_functions
from ddg_warp.kernels.terms import Term


@cache
def force_kernels(term: Term, real):
    """Build the kernels of element forces.

    `forces`: write derivatives of the energy by local dofs.
    `vjp`: write the derivatives of v . forces by local dofs, lagged data, rest measure and parameters, for cotangents v.
    """
    measure, density, n = term.measure, term.density, len(term.measure.strains)
    Q, S, E, _ = measure.types(real)
    P = wp.types.vector(density.parameter_size(n), real)
    _, jacobian_of, *_ = measure.functions(real)
    _, slope_of, _ = density.functions(real, n)
    along, _ = variation_functions(term, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def forces(
        q: wp.array(dtype=Q),
        s: wp.array(dtype=S),
        w: wp.array(dtype=real),
        p: wp.array(dtype=P),
        out: wp.array(dtype=Q),
    ):
        i = wp.tid()
        strain, jacobian = jacobian_of(q[i], s[i], w[i])
        out[i] = (slope_of(strain, p[i]) * w[i]) * jacobian

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def vjp(
        q: wp.array(dtype=Q),
        s: wp.array(dtype=S),
        w: wp.array(dtype=real),
        p: wp.array(dtype=P),
        v: wp.array(dtype=Q),
        q_out: wp.array(dtype=Q),
        s_out: wp.array(dtype=S),
        w_out: wp.array(dtype=real),
        p_out: wp.array(dtype=P),
    ):
        i = wp.tid()
        dq, ds, dw, dp, _dv, _de = wp.grad(along)(q[i], s[i], w[i], p[i], v[i], E())
        q_out[i] = dq
        s_out[i] = ds
        w_out[i] = dw
        p_out[i] = dp

    return forces, vjp

"""Gyroscopic couple: the spin of a rod about its tangent resists rotation of the tangent.

An edge with the inertia I about its tangent t that spins at w has the angular momentum I w t. Its rate along t is the equation of the
twist angle. Its rate across, I w dt/dt, is a couple that the nodes exert; they feel -I w dt/dt as a pair of forces

    f_b = -f_a = g t x (v_b - v_a) ,  g = I w / |e|^2 ,

as dt/dt = (v_b - v_a) / |e| across t. They do no work. A solve with them would have a matrix that is not symmetric, and forces taken
from the start of a step make energy. So they act between steps (Strang, SIAM J. Numer. Anal. 5, 1968, 506): half a time step of them
before and after each step of everything else, positions and spins unchanged. Edge by edge that is the midpoint rule,

    d' = d + W p ,  p = g s / 2 t x (d + d') ,  d = v_b - v_a ,  W = W_a + W_b

over s, with the inverse masses W of free components, solved exactly. Kinetic energy stays whatever s is, as p . (d + d') = 0, and
linear momentum too; angular momentum drifts by O(s^2). Edges with a common node act one after another, by colour, in one order before
and in the reverse order after a step. The whole is symmetric in time: of second order by the midpoint rule.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.dof_map import column_of, point_functions
from ddg_warp.kernels.core.islands import STATUS
from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def kick_kernel(real):
    """Build the kernel of the gyroscopic couples.

    `kick`: apply half a time step of the couples of edges without common nodes, in place.
    """
    X = wp.types.vector(3, real)
    get, put = point_functions(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def kick(
        edges: wp.array2d(dtype=int),
        free: wp.array(dtype=X),
        x: wp.array2d(dtype=X),
        omega: wp.array2d(dtype=real),
        mass: wp.array2d(dtype=real),
        rotary: wp.array2d(dtype=real),
        dt: wp.array(dtype=real),
        columns: int,
        after: int,
        flags: wp.array2d(dtype=int),
        v: wp.array2d(dtype=X),
    ):
        """Apply the couples of `edges`, given by both nodes and the angle; `free` masks free components of nodes.

        `after` the step, failed islands revert the change from before.
        """
        i, w = wp.tid()
        a = edges[i, 0]
        b = edges[i, 1]
        k = edges[i, 2] / columns
        r = column_of(edges[i, 2], w, columns)
        momentum = rotary[k, r] * omega[k, r]
        ma = mass[a / columns, r]
        mb = mass[b / columns, r]
        if momentum == real(0.0) or ma <= real(0.0) or mb <= real(0.0):
            return
        e = get(x, b, w, columns) - get(x, a, w, columns)
        t = wp.normalize(e)
        half = real(0.25) * dt[w] * momentum / wp.length_sq(e)
        if after != 0 and flags[wp.static(STATUS), r] == wp.static(outcome.STEP_FAILED):
            half = -half
        inverse_a = free[a] / ma
        inverse_b = free[b] / mb
        va = get(v, a, w, columns)
        vb = get(v, b, w, columns)
        turn = wp.skew(t) * half
        matrix = wp.identity(n=3, dtype=real) - wp.diag(inverse_a + inverse_b) * turn
        push = turn * (wp.inverse(matrix) * ((vb - va) * real(2.0)))
        put(v, a, w, columns, va - wp.cw_mul(inverse_a, push))
        put(v, b, w, columns, vb + wp.cw_mul(inverse_b, push))

    return kick

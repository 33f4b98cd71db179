"""Integrated mean curvature vector of a hinge, sum_j K_j x_j [m]: linear in the positions (Bergou et al. 2006).

Four nodes, 0 and 1 on the edge, 2 and 3 opposite (Bergou, Wardetzky, Harmon, Zorin, Grinspun, A quadratic bending model for
inextensible surfaces, 2006; Wardetzky et al. 2007). With cotangents of the flat rest shape, c02 of the angle between the edge and
the side 0-2 and so on,

    K0 = c12 + c13,   K1 = c02 + c03,   K2 = -c02 - c12,   K3 = -c03 - c13,   sum K_j = 0.

Its length is |e| theta for small angles if lengths do not change. With w = 1 / A_e [1/m^2] and stiffness k in all three components,
the energy is that of `hinge_angle` with the same k [J]. A_e is a third of the two triangles' rest area. Continuum moduli (D = 3 k
and nu = -1/3 on equilateral triangles) and mesh dependence are the same, at a constant Hessian. It holds for isometric deformations
of flat rest shapes; stretch raises the energy as well. Data: K1, K2, K3.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.measures import Measure


@cache
def _functions(real):
    Q, S, E, M = isometric_bending.types(real)

    @wp.func
    def strains(q: Q, s: S, w: real):
        return E(
            s[0] * q[0] + s[1] * q[3] + s[2] * q[6],
            s[0] * q[1] + s[1] * q[4] + s[2] * q[7],
            s[0] * q[2] + s[1] * q[5] + s[2] * q[8],
        )

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        zero = real(0.0)
        return strains(q, s, w), wp.matrix_from_rows(
            Q(s[0], zero, zero, s[1], zero, zero, s[2], zero, zero),
            Q(zero, s[0], zero, zero, s[1], zero, zero, s[2], zero),
            Q(zero, zero, s[0], zero, zero, s[1], zero, zero, s[2]),
        )

    return strains, jacobian, None, None


isometric_bending = Measure(
    "isometric_bending", 3, ((0, 1), (0, 2), (0, 3)), ("Kx_x [m]", "Kx_y [m]", "Kx_z [m]"), _functions, data_size=3
)

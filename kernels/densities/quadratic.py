"""The quadratic law psi = sum_i k_i (e_i - e0_i)^2 / 2."""

from functools import cache

import warp as wp

from ddg_warp.kernels.densities import FINITE, NOT_NEGATIVE, Density, each


@cache
def _laws(real, n):
    E, P = wp.types.vector(n, real), wp.types.vector(2 * n, real)

    @wp.func
    def energy(e: E, p: P):
        total = real(0.0)
        for i in range(wp.static(n)):
            strain = e[i] - p[wp.static(n) + i]
            total += real(0.5) * p[i] * strain * strain
        return total

    @wp.func
    def slope(e: E, p: P):
        f = E()
        for i in range(wp.static(n)):
            f[i] = p[i] * (e[i] - p[wp.static(n) + i])
        return f

    @wp.func
    def curvature(e: E, p: P):
        c = E()
        for i in range(wp.static(n)):
            c[i] = p[i]
        return c

    return energy, slope, curvature


def _parameters(n):
    stiffness = each(n, "stiffness", "J per rest measure and strain squared", NOT_NEGATIVE)
    return (*stiffness, *each(n, "rest", "that of the strain", FINITE, rest=True, default=0.0))


quadratic = Density("quadratic", _parameters, _laws, quadratic=True)

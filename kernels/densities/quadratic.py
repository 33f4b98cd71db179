"""The quadratic law psi = sum_i k_i (e_i - e0_i)^2 / 2, and the same with strain-rate damping (Kelvin and Voigt).

The damped law adds the dissipation potential of a step, sum_i eta_i (e_i - e_i^n)^2 / 2h, with e^n the strains at the start of
the step: the viscous analogy of Bergou et al. 2010 applied over one step of length h.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.densities import Density


@cache
def _quadratic(real, n):
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
    def root(e: E, p: P, shift: E):
        r = E()
        for i in range(wp.static(n)):
            r[i] = wp.sqrt(wp.max(p[i] + shift[i], real(0.0)))
        return r

    return energy, slope, root


@cache
def _kelvin_voigt(real, n):
    E, P = wp.types.vector(n, real), wp.types.vector(4 * n + 1, real)

    @wp.func
    def energy(e: E, p: P):
        total = real(0.0)
        for i in range(wp.static(n)):
            strain = e[i] - p[wp.static(n) + i]
            change = e[i] - p[wp.static(3 * n) + i]
            total += real(0.5) * (
                p[i] * strain * strain + p[wp.static(2 * n) + i] * p[wp.static(4 * n)] * change * change
            )
        return total

    @wp.func
    def slope(e: E, p: P):
        f = E()
        for i in range(wp.static(n)):
            rate = (e[i] - p[wp.static(3 * n) + i]) * p[wp.static(4 * n)]
            f[i] = p[i] * (e[i] - p[wp.static(n) + i]) + p[wp.static(2 * n) + i] * rate
        return f

    @wp.func
    def root(e: E, p: P, shift: E):
        r = E()
        for i in range(wp.static(n)):
            stiffness = p[i] + p[wp.static(2 * n) + i] * p[wp.static(4 * n)]
            r[i] = wp.sqrt(wp.max(stiffness + shift[i], real(0.0)))
        return r

    return energy, slope, root


def _names(*kinds):
    return lambda n: tuple(f"{kind}_{i + 1}" if n > 1 else kind for kind in kinds for i in range(n))


quadratic = Density("quadratic", _names("stiffness", "rest"), _quadratic)
kelvin_voigt = Density("kelvin_voigt", _names("stiffness", "rest", "viscosity"), _kelvin_voigt, lagged=True)

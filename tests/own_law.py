"""A law of one's own, as a user writes it: bending that saturates, psi = k c^2 (sqrt(1 + |e|^2 / c^2) - 1) of all three strains.

Its stress k e / sqrt(1 + |e|^2 / c^2) goes like k e at first and never exceeds k c; the strains are coupled.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.densities import NOT_NEGATIVE, POSITIVE, Density, Parameter


@cache
def laws(real, n):
    E, P, M = wp.types.vector(n, real), wp.types.vector(2, real), wp.types.matrix((n, n), real)

    @wp.func
    def ratio(e: E, p: P):
        return wp.sqrt(real(1.0) + wp.dot(e, e) / (p[1] * p[1]))

    @wp.func
    def energy(e: E, p: P):
        return p[0] * p[1] * p[1] * (ratio(e, p) - real(1.0))

    @wp.func
    def slope(e: E, p: P):
        return e * (p[0] / ratio(e, p))

    @wp.func
    def curvature(e: E, p: P):
        a = ratio(e, p)
        one = M()
        for i in range(wp.static(n)):
            one[i, i] = real(1.0)
        return (one - wp.outer(e, e) / (a * a * p[1] * p[1])) * (p[0] / a)

    return energy, slope, curvature


def parameters(n):
    return Parameter("modulus", "N m^2", NOT_NEGATIVE), Parameter("limit", "1/m", POSITIVE)


saturating = Density("saturating", parameters, laws, coupled=True)

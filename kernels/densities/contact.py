"""Laws of contact: energy of two surfaces by the gap g, the distance of their middles minus the thickness.

Smooth penalty (the implicit contact model: Tong, Choi, Joo and Jawed, Extreme Mech. Lett. 58, 2023, 101924), with K = 15 / delta
and the range delta:

    psi = k (ln(1 + exp(-K g)) / K)^2   for g < delta,   0 beyond.

The published law is k g^2 for g < -delta, where it jumps by 4.1e-8 of its value and its slope by 2.9e-7. Here one form holds for all
gaps, without jumps, and differs from the published law by no more. At delta it ends with 4.2e-16 k delta^2 and a slope of
1.2e-14 k delta.

Log barrier (incremental potential contact: Li et al., ACM Trans. Graph. 39, 2020, 49), with the range g^:

    psi = -k (g - g^)^2 ln(g / g^)   for 0 < g < g^,   0 beyond;   infinite for g <= 0.

It ends with two continuous derivatives. In the source g is a squared distance; here it is the distance. Then the Gauss-Newton matrix
J^T psi'' J is exactly the positive part of the Hessian where two points are closest.

Measured: for other random pairs about as long as their distance, its error is 0.14 to 0.18 of the Hessian at half the range. In squared
distances it is 0.6, even for points, as 4 g^2 b'' of the curvature 4 g^2 b'' + 2 b' along the normal is kept.

Both laws are convex in g, psi'' >= 0, and repulsive, psi' <= 0, as `kernels.collision.contact.potential` requires.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.densities import NOT_NEGATIVE, POSITIVE, Density, Parameter

SHARPNESS = 15.0  # K times the range of the smooth penalty
THICKNESS = Parameter("thickness", "m", NOT_NEGATIVE, default=0.0)
RANGE = Parameter("range", "m", POSITIVE)
STIFFNESS = Parameter("stiffness", "N/m", NOT_NEGATIVE)


@cache
def _penalty_laws(real, n):
    E, P = wp.types.vector(1, real), wp.types.vector(3, real)
    sharpness = wp.constant(real(SHARPNESS))

    @wp.func
    def scaled(e: E, p: P):
        """Return K and K g."""
        K = sharpness / p[1]
        return K, (e[0] - p[2]) * K

    @wp.func
    def softplus(x: real):
        """Return log(1 + exp(-x)) and the derivative by -x."""
        one = real(1.0)
        if x > real(0.0):
            small = wp.exp(-x)
            share = small / (one + small)
            if small < real(1.0e-3):  # where one + small loses digits
                tail = real(1.0 / 3.0) - small * (real(0.25) - small * real(0.2))
                return small * (one - small * (real(0.5) - small * tail)), share
            return wp.log(one + small), share
        large = wp.exp(x)
        return wp.log(one + large) - x, one / (one + large)

    @wp.func
    def energy(e: E, p: P):
        K, x = scaled(e, p)
        if x >= sharpness:
            return real(0.0)
        s, _share = softplus(x)
        return p[0] * s * s / (K * K)

    @wp.func
    def slope(e: E, p: P):
        K, x = scaled(e, p)
        if x >= sharpness:
            return E()
        s, share = softplus(x)
        return E(real(-2.0) * p[0] * s * share / K)

    @wp.func
    def curvature(e: E, p: P):
        _K, x = scaled(e, p)
        if x >= sharpness:
            return E()
        s, share = softplus(x)
        return E(real(2.0) * p[0] * share * (share + s * (real(1.0) - share)))

    return energy, slope, curvature


@cache
def _barrier_laws(real, n):
    E, P = wp.types.vector(1, real), wp.types.vector(3, real)

    @wp.func
    def gap(e: E, p: P):
        """Return g / g^, at least zero, where the logarithm makes energy and derivatives infinite."""
        return wp.max(e[0] - p[2], real(0.0)) / p[1]

    @wp.func
    def energy(e: E, p: P):
        y = gap(e, p)
        one = real(1.0)
        if y >= one:
            return real(0.0)
        return -p[0] * p[1] * p[1] * (y - one) * (y - one) * wp.log(y)

    @wp.func
    def slope(e: E, p: P):
        y = gap(e, p)
        one = real(1.0)
        if y >= one:
            return E()
        return E(p[0] * p[1] * (one - y) * (real(2.0) * wp.log(y) - (one - y) / y))

    @wp.func
    def curvature(e: E, p: P):
        y = gap(e, p)
        one = real(1.0)
        if y >= one:
            return E()
        left = (one - y) / y
        return E(p[0] * (left * (left + real(4.0)) - real(2.0) * wp.log(y)))

    return energy, slope, curvature


@cache
def gap_law(density: Density, constants: tuple[float, ...]) -> Density:
    """Return a law of the gap as a law of the distance, the form of contact potentials.

    Args:
        density: law of one strain, the gap [m], used below the range only.
        constants: values of the parameters in order. Contact parameters replace "stiffness" and "range", which are never read.
    """

    @cache
    def laws(real, n):
        return _gap_laws(density, constants, real)

    return Density(density.name, lambda n: (STIFFNESS, RANGE, THICKNESS), laws, strains=1)


def _gap_laws(density: Density, constants: tuple[float, ...], real):
    energy_of, slope_of, curvature_of = density.laws(real, 1)
    names = [parameter.name for parameter in density.parameters(1)]
    stiffness, reach = (names.index(name) if name in names else -1 for name in ("stiffness", "range"))
    E, P, Q = wp.types.vector(1, real), wp.types.vector(3, real), wp.types.vector(len(names), real)
    fixed, is_coupled = Q(*constants), density.coupled

    @wp.func
    def law_parameters(p: P):
        q = fixed * real(1.0)
        if wp.static(stiffness >= 0):
            q[wp.static(stiffness)] = p[0]
        if wp.static(reach >= 0):
            q[wp.static(reach)] = p[1]
        return q

    @wp.func
    def energy(e: E, p: P):
        gap = e[0] - p[2]
        if gap >= p[1]:
            return real(0.0)
        return energy_of(E(gap), law_parameters(p))

    @wp.func
    def slope(e: E, p: P):
        gap = e[0] - p[2]
        if gap >= p[1]:
            return E()
        return slope_of(E(gap), law_parameters(p))

    @wp.func
    def curvature(e: E, p: P):
        gap = e[0] - p[2]
        if gap >= p[1]:
            return E()
        c = curvature_of(E(gap), law_parameters(p))
        if wp.static(is_coupled):
            return E(c[0, 0])
        else:
            return c

    return energy, slope, curvature


smooth_penalty = Density("smooth_penalty", lambda n: (STIFFNESS, RANGE, THICKNESS), _penalty_laws, strains=1)
log_barrier = Density("log_barrier", lambda n: (STIFFNESS, RANGE, THICKNESS), _barrier_laws, strains=1)

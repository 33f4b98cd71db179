"""Laws of contact: the energy of two surfaces by their gap g, the distance of their middles less the thickness between.

Smooth penalty (the implicit contact model: Tong, Choi, Joo and Jawed, Extreme Mech. Lett. 58, 2023, 101924), with K = 15 / delta
and the range delta:

    psi = k (ln(1 + exp(-K g)) / K)^2   for g < delta,   0 beyond.

As published it is k g^2 from -delta inwards, where it jumps by 4.1e-8 of its value there, and its slope by 2.9e-7; here it has the
same form all the way in, so that nothing jumps and it differs from the published one by no more than these. At delta it ends with
4.2e-16 k delta^2 and a slope of 1.2e-14 k delta.

Log barrier (incremental potential contact: Li et al., ACM Trans. Graph. 39, 2020, 49), with the range g^:

    psi = -k (g - g^)^2 ln(g / g^)   for 0 < g < g^,   0 beyond;   infinite for g <= 0.

It ends with two continuous derivatives. There g is a squared distance; here it is the distance. Then J^T psi'' J, what a Gauss-Newton
matrix keeps, is just what is positive of the Hessian where two points are closest; of random pairs about as long as far it is else off
by 0.14 to 0.18 of that at half the range. In squared distances it is off by 0.6 of it, even of points, as it keeps 4 g^2 b'' of the
curvature 4 g^2 b'' + 2 b' along the normal.

Both are convex in g, psi'' >= 0, and fall, psi' <= 0, as `contact.pair_energy` takes them to.
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
        """K and K g."""
        K = sharpness / p[1]
        return K, (e[0] - p[2]) * K

    @wp.func
    def softplus(x: real):
        """ln(1 + exp(-x)) and its derivative by -x."""
        one = real(1.0)
        if x > real(0.0):
            small = wp.exp(-x)
            share = small / (one + small)
            if small < real(1.0e-3):  # where one + small has lost its digits
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
        """g over g^, not below zero: there the logarithm makes all infinite."""
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
    """Return a law of the gap as a law of the distance, as the contact potential takes it.

    Args:
        density: of one strain, the gap [m]. It counts below the range alone.
        constants: values of its parameters in their order; those of "stiffness" and "range" are never read, contact has them.
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
    fixed, coupled = Q(*constants), density.coupled

    @wp.func
    def own(p: P):
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
        return energy_of(E(gap), own(p))

    @wp.func
    def slope(e: E, p: P):
        gap = e[0] - p[2]
        if gap >= p[1]:
            return E()
        return slope_of(E(gap), own(p))

    @wp.func
    def curvature(e: E, p: P):
        gap = e[0] - p[2]
        if gap >= p[1]:
            return E()
        c = curvature_of(E(gap), own(p))
        if wp.static(coupled):
            return E(c[0, 0])
        else:
            return c

    return energy, slope, curvature


smooth_penalty = Density("smooth_penalty", lambda n: (STIFFNESS, RANGE, THICKNESS), _penalty_laws, strains=1)
log_barrier = Density("log_barrier", lambda n: (STIFFNESS, RANGE, THICKNESS), _barrier_laws, strains=1)

"""Regularised Coulomb friction: dissipation potential of a step of length h, by the slip u since the start,

    psi = mu N nu h G(|u| / (nu h)),   force -mu N G'(x) u / |u|,   x = |u| / (nu h) the speed over the velocity nu [m/s],

with the coefficient mu and the lagged normal force N, so that it is a potential in the step. It is zero without slip, convex and
dissipative, at most mu N |u|, the dissipation of Coulomb's law.

    logistic     G' = 2 / (1 + exp(-15 x)) - 1 = tanh(7.5 x)     (Tong, Choi, Joo and Jawed, Extreme Mech. Lett. 58, 2023, 101924)
    polynomial   G' = x (2 - x) for x < 1, 1 beyond              (Li et al., ACM Trans. Graph. 39, 2020, 49: f_1)

Sticking contacts creep: under a fraction f of mu N the speed is nu atanh(f) / 7.5, or nu (1 - sqrt(1 - f)). In statics, with the rate
1/h = 0, there is no friction.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.densities import NOT_NEGATIVE, POSITIVE, Density, Parameter

STEEPNESS = 7.5
BOUND = Parameter("bound", "N", NOT_NEGATIVE)  # mu N
VELOCITY = Parameter("velocity", "m/s", POSITIVE)
RATE = Parameter("rate", "1/s", NOT_NEGATIVE)  # 1/h


@cache
def _logistic(real):
    """Return the device functions G / x^2, G' / x and G'' of x of the logistic profile."""
    a = wp.constant(real(STEEPNESS))

    @wp.func
    def potential(x: real):
        """Return a ln cosh z / z^2, near zero by series, since the difference cancels."""
        z = a * x
        y = z * z
        if z < real(0.1):
            tail = real(31.0 / 14175.0) - y * real(691.0 / 935550.0)
            tail = real(1.0 / 45.0) - y * (real(17.0 / 2520.0) - y * tail)
            return a * (real(0.5) - y * (real(1.0 / 12.0) - y * tail))
        return a * (z - wp.log(real(2.0)) + wp.log(real(1.0) + wp.exp(real(-2.0) * z))) / y

    @wp.func
    def force(x: real):
        z = a * x
        if z < real(1.0e-4):
            return a * (real(1.0) - z * z / real(3.0))
        return a * wp.tanh(z) / z

    @wp.func
    def slope(x: real):
        t = wp.tanh(a * x)
        return a * (real(1.0) - t * t)

    return potential, force, slope


@cache
def _polynomial(real):
    """Return the device functions of the polynomial profile; see `_logistic`."""

    @wp.func
    def potential(x: real):
        if x < real(1.0):
            return real(1.0) - x / real(3.0)
        return (x - real(1.0) / real(3.0)) / (x * x)

    @wp.func
    def force(x: real):
        if x < real(1.0):
            return real(2.0) - x
        return real(1.0) / x

    @wp.func
    def slope(x: real):
        return real(2.0) * wp.max(real(1.0) - x, real(0.0))

    return potential, force, slope


def _laws(profile, real):
    """Return (energy, slope, curvature) of a profile G."""
    potential, force, slope_of = profile(real)
    E, P = wp.types.vector(2, real), wp.types.vector(3, real)

    @wp.func
    def scaled(u: E, p: P):
        """Return the length of the slip over nu h, and mu N / (nu h)."""
        inverse = p[2] / p[1]
        return wp.length(u) * inverse, p[0] * inverse

    @wp.func
    def energy(u: E, p: P):
        x, scale = scaled(u, p)
        return scale * potential(x) * wp.dot(u, u)

    @wp.func
    def slope(u: E, p: P):
        x, scale = scaled(u, p)
        return u * (scale * force(x))

    @wp.func
    def curvature(u: E, p: P):
        """Return the matrix with G'' along the slip and G' / x across."""
        x, scale = scaled(u, p)
        across, along, unit = scale * force(x), scale * slope_of(x), wp.normalize(u)
        return wp.diag(E(across, across)) + wp.outer(unit, unit) * (along - across)

    return energy, slope, curvature


def _friction(name: str, profile) -> Density:
    @cache
    def laws(real, n):
        return _laws(profile, real)

    return Density(name, lambda n: (BOUND, VELOCITY, RATE), laws, strains=2, coupled=True)


logistic_friction = _friction("logistic_friction", _logistic)
polynomial_friction = _friction("polynomial_friction", _polynomial)

"""Strain-rate damping of any law (Kelvin and Voigt): the dissipation potential of a step of length h is added to it,

    psi(e) + (tau / 2h) (e - e^n) . psi''(e0) (e - e^n) ,

with e^n the strains at the start of the step, e0 those at rest, and the retardation time tau [s]: the viscous analogy of Bergou et al.
(2010) over one step. At rest psi'' is positive, so that damping takes energy whatever the law does elsewhere.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.densities import NOT_NEGATIVE, Density, Parameter

VISCOSITY = Parameter("viscosity", "s", NOT_NEGATIVE, default=0.0)


@cache
def damped(density: Density) -> Density:
    """The law with damping; its parameter `viscosity` is the time tau."""

    @cache
    def laws(real, n):
        return _laws(density, real, n)

    @cache
    def root(real, n):
        return _root(density, real, n)

    return Density(
        f"{density.name} with damping",
        lambda n: (*density.parameters(n), VISCOSITY),
        laws,
        strains=density.strains,
        lagged=True,
        coupled=density.coupled,
        quadratic=density.quadratic,
        own_root=root if density.quadratic and density.own_root else None,
        undamped=density,
    )


def _split(density: Density, real, n: int):
    """own(p) -> parameters of the law itself; ratio(p) -> tau / h; before(p), rest(p) -> strains of the last step, and at rest."""
    size = len(density.parameters(n))
    at = [i for i, known in enumerate(density.parameters(n)) if known.family == "rest"]
    first = at[0] if at else -1
    E, P, O = (wp.types.vector(s, real) for s in (n, size + n + 2, size))

    @wp.func
    def own(p: P):
        o = O()
        for i in range(wp.static(size)):
            o[i] = p[i]
        return o

    @wp.func
    def ratio(p: P):
        return p[wp.static(size)] * p[wp.static(size + n + 1)]

    @wp.func
    def before(p: P):
        e = E()
        for i in range(wp.static(n)):
            e[i] = p[wp.static(size + 1) + i]
        return e

    @wp.func
    def rest(p: P):
        e = E()
        if wp.static(first >= 0):
            for i in range(wp.static(n)):
                e[i] = p[wp.static(first) + i]
        return e

    return own, ratio, before, rest, E, P


def _laws(density: Density, real, n: int):
    energy_of, slope_of, curvature_of = density.laws(real, n)
    own, ratio, before, rest, E, P = _split(density, real, n)
    coupled = density.coupled

    @wp.func
    def viscous(p: P):
        """psi'' of the dissipation, but for tau / h."""
        return curvature_of(rest(p), own(p))

    @wp.func
    def drag(e: E, p: P):
        if wp.static(coupled):
            return viscous(p) * (e - before(p)) * ratio(p)
        else:
            return wp.cw_mul(viscous(p), e - before(p)) * ratio(p)

    @wp.func
    def energy(e: E, p: P):
        return energy_of(e, own(p)) + real(0.5) * wp.dot(drag(e, p), e - before(p))

    @wp.func
    def slope(e: E, p: P):
        return slope_of(e, own(p)) + drag(e, p)

    @wp.func
    def curvature(e: E, p: P):
        return curvature_of(e, own(p)) + viscous(p) * ratio(p)

    return energy, slope, curvature


def _root(density: Density, real, n: int):
    """Of a quadratic law with a root of its own: that, larger by the root of 1 + tau / h."""
    own, ratio, _, _, E, P = _split(density, real, n)
    root_of = density.own_root(real, n)

    @wp.func
    def root(e: E, p: P, shift: E):
        return root_of(e, own(p), shift) * wp.sqrt(real(1.0) + ratio(p))

    return root

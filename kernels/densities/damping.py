"""Strain-rate damping of any law (Kelvin and Voigt): the dissipation potential of a step of length h is added to it,

    psi(e) + (tau / 2h) (e - e^n) . psi''(e^n) (e - e^n) ,

with e^n the strains at the start of the step and the retardation time tau [s]: the viscous analogy of Bergou et al. (2010) over one
step. psi'' is that of the law where it depends on no strain, else its positive semi-definite part at e^n.
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
        lagged=True,
        coupled=density.coupled,
        quadratic=density.quadratic,
        own_root=root if density.quadratic and density.own_root else None,
    )


def _split(density: Density, real, n: int):
    """own(p) -> parameters of the law itself; ratio(p) -> tau / h; before(p) -> strains of the last step."""
    size = len(density.parameters(n))
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

    return own, ratio, before, E, P


def _laws(density: Density, real, n: int):
    energy_of, slope_of, curvature_of = density.laws(real, n)
    *_, root_of = density.functions(real, n)
    own, ratio, before, E, P = _split(density, real, n)
    coupled, quadratic = density.coupled, density.quadratic

    @wp.func
    def viscous(p: P):
        """psi'' of the dissipation, but for tau / h."""
        if wp.static(quadratic):
            return curvature_of(before(p), own(p))
        else:
            r = root_of(before(p), own(p), E())
            if wp.static(coupled):
                return wp.transpose(r) * r
            else:
                return wp.cw_mul(r, r)

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
    own, ratio, _, E, P = _split(density, real, n)
    root_of = density.own_root(real, n)

    @wp.func
    def root(e: E, p: P, shift: E):
        return root_of(e, own(p), shift) * wp.sqrt(real(1.0) + ratio(p))

    return root

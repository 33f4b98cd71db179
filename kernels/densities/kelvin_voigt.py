"""Kelvin-Voigt damping of any law: the dissipation potential of a step of length h is added,

    psi(e) + (tau / 2h) (e - e^n) . psi''(e0) (e - e^n) ,

with e^n the strains at the start of the step, e0 the rest strains, and the retardation time tau [s]: the viscous analogy of Bergou et
al. (2010) over one step. psi'' is positive at rest, so that damping dissipates energy for every law.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.densities import NOT_NEGATIVE, Density, Parameter

VISCOSITY = Parameter("viscosity", "s", NOT_NEGATIVE, default=0.0)


@cache
def damped(density: Density) -> Density:
    """Return the law with damping, which adds the parameter `viscosity`, the time tau [s]."""

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
    """Return the device functions that split p.

    `law_parameters(p)`: parameters of the undamped law.
    `ratio(p)`: tau / h.
    `before(p)`: strains of the last step.
    `rest(p)`: rest strains.
    """
    size = len(density.parameters(n))
    rest_indices = [i for i, parameter in enumerate(density.parameters(n)) if parameter.family == "rest"]
    first = rest_indices[0] if rest_indices else -1
    E, P, O = (wp.types.vector(s, real) for s in (n, size + n + 2, size))

    @wp.func
    def law_parameters(p: P):
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

    return law_parameters, ratio, before, rest, E, P


def _laws(density: Density, real, n: int):
    energy_of, slope_of, curvature_of = density.laws(real, n)
    law_parameters, ratio, before, rest, E, P = _split(density, real, n)
    is_coupled = density.coupled

    @wp.func
    def viscous(p: P):
        """Return psi'' of the dissipation potential without the factor tau / h."""
        return curvature_of(rest(p), law_parameters(p))

    @wp.func
    def viscous_stress(e: E, p: P):
        if wp.static(is_coupled):
            return viscous(p) * (e - before(p)) * ratio(p)
        else:
            return wp.cw_mul(viscous(p), e - before(p)) * ratio(p)

    @wp.func
    def energy(e: E, p: P):
        return energy_of(e, law_parameters(p)) + real(0.5) * wp.dot(viscous_stress(e, p), e - before(p))

    @wp.func
    def slope(e: E, p: P):
        return slope_of(e, law_parameters(p)) + viscous_stress(e, p)

    @wp.func
    def curvature(e: E, p: P):
        return curvature_of(e, law_parameters(p)) + viscous(p) * ratio(p)

    return energy, slope, curvature


def _root(density: Density, real, n: int):
    """Return the root of a quadratic law with a closed form, scaled by sqrt(1 + tau / h)."""
    law_parameters, ratio, _, _, E, P = _split(density, real, n)
    root_of = density.own_root(real, n)

    @wp.func
    def root(e: E, p: P, shift: E):
        return root_of(e, law_parameters(p), shift) * wp.sqrt(real(1.0) + ratio(p))

    return root

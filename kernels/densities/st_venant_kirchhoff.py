"""St. Venant and Kirchhoff's law of a plane tensor, per rest area.

With the covariant components e = (e11, e12, e22), the rest metric abar and M = abar^-1 (e - e0), a mixed 2 x 2 tensor,

    psi = K/2 [(1 - nu) tr(M^2) + nu (tr M)^2].

Membrane: e half the metric, K = E h / (1 - nu^2) [N/m]. Bending: e the second fundamental form, K = E h^3 / (12 (1 - nu^2)) [J]
(Weischedel 2012; Chen et al. 2018). In a basis orthonormal under abar, from its Cholesky factor, M has the symmetric components x,
y, z (11, 12, 22), linear in e - e0, and

    psi = K/2 [(x + nu z)^2 + (1 - nu^2) z^2 + 2 (1 - nu) y^2],

which gives the root of psi'': positive definite for -1 < nu < 1.
"""

from dataclasses import replace
from functools import cache

import warp as wp

from ddg_warp.kernels.densities import FINITE, NOT_NEGATIVE, POSITIVE, Density, Parameter


@cache
def _tensor(real):
    """Return the device functions `energy`, `slope` and `root` of the quadratic form, for a change of strain d."""
    E, M, B = wp.types.vector(3, real), wp.types.matrix((3, 3), real), wp.types.vector(5, real)

    @wp.func
    def components(b: B):
        """Return the matrix that maps (d11, d12, d22) to (x, y, z)."""
        zero = real(0.0)
        u = real(1.0) / wp.sqrt(b[2])  # abar^-1 = V V^T with the columns (u, 0) and (v, t)
        t = real(1.0) / wp.sqrt(b[4] - b[3] * b[3] / b[2])
        v = -b[3] / b[2] * t
        return M(u * u, zero, zero, u * v, u * t, zero, v * v, real(2.0) * v * t, t * t)

    @wp.func
    def energy(d: E, b: B):
        m = components(b) * d
        nu = b[1]
        x = m[0] + nu * m[2]
        one = real(1.0)
        two = real(2.0)
        return real(0.5) * b[0] * (x * x + (one - nu * nu) * m[2] * m[2] + two * (one - nu) * m[1] * m[1])

    @wp.func
    def slope(d: E, b: B):
        T = components(b)
        m = T * d
        nu = b[1]
        two = real(2.0)
        return wp.transpose(T) * (E(m[0] + nu * m[2], two * (real(1.0) - nu) * m[1], nu * m[0] + m[2]) * b[0])

    @wp.func
    def root(b: B):
        zero = real(0.0)
        one = real(1.0)
        nu = b[1]
        a = wp.sqrt(b[0])
        y = a * wp.sqrt(real(2.0) * (one - nu))
        return M(a, zero, a * nu, zero, y, zero, zero, zero, a * wp.sqrt(one - nu * nu)) * components(b)

    return energy, slope, root


@cache
def _laws(real, n):
    E, P, B = (wp.types.vector(size, real) for size in (n, 8, 5))
    energy_of, slope_of, root_of = _tensor(real)

    @wp.func
    def law(p: P):
        return B(p[0], p[1], p[2], p[3], p[4])

    @wp.func
    def strain(e: E, p: P):
        return E(e[0] - p[5], e[1] - p[6], e[2] - p[7])

    @wp.func
    def energy(e: E, p: P):
        return energy_of(strain(e, p), law(p))

    @wp.func
    def slope(e: E, p: P):
        return slope_of(strain(e, p), law(p))

    @wp.func
    def curvature(e: E, p: P):
        r = root_of(law(p))
        return wp.transpose(r) * r

    return energy, slope, curvature


@cache
def _root(real, n):
    E, P, B = (wp.types.vector(size, real) for size in (n, 8, 5))
    _, _, root_of = _tensor(real)

    @wp.func
    def root(e: E, p: P, shift: E):
        return root_of(B(p[0], p[1], p[2], p[3], p[4]))

    return root


def _parameters(n):
    metric, rest = (
        [Parameter(family, "that of the tensor", FINITE, number, rest=True) for number in ("11", "12", "22")]
        for family in ("metric", "rest")
    )
    metric[0], metric[2] = replace(metric[0], valid=POSITIVE), replace(metric[2], valid=POSITIVE)
    poisson = Parameter("poisson", "1", ("between -1 and 1", lambda v: abs(v) < 1.0))
    return Parameter("stiffness", "J per rest measure", NOT_NEGATIVE), poisson, *metric, *rest


st_venant_kirchhoff = Density(
    "st_venant_kirchhoff", _parameters, _laws, strains=3, coupled=True, quadratic=True, own_root=_root
)

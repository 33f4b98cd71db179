"""Laws of ribbons: rods of width W and thickness h << W whose cross-section bends along with them.

Of the strains (kappa_1, k, t), kappa_1 bends the ribbon in its plane, about the stiff axis, k bends it softly and t twists it. With
natural strains kappa_10, k0 and t0, B = EI_2 / (1 - nu^2) = D W the stiffness of a plate, and the crossover curvature
1 / zeta = sqrt(60 / (1 - nu^2)) h / W^2, all three laws are

    psi = EI_1 (kappa_1 - kappa_10)^2 / 2 + EI_2 (k - k0)^2 / 2 + GJ (t - t0)^2 / 2 + B/2 N(k, t) g(k) ,

the energy of a rod plus the energy of a constrained cross-section. The ribbon with k, t and the curvature c = f - nu (k - k0) across
its width has the Gauss curvature k c - t^2; at rest it is -t0^2. Where they differ the ribbon stretches: the longitudinal strain e(y)
has e'' = q - k f with the defect q = t^2 - t0^2 + nu k (k - k0). Minimising D f^2 / 2 + E h e^2 / 2 over e gives
D e'''' / k^2 + E h e = 0 with e'' = q and e''' = 0 at both edges. This is a beam on an elastic foundation (Ashwell, J. R. Aeronaut.
Soc. 54, 1950, for t = 0). It leaves B/2 q^2 g per length:

    audoly_neukirch   N = q^2 ,  g = 360 zeta^2 phi(v) ,  v = sqrt(720) zeta k ,  x = sqrt(|v| / 2) ,
                      phi = (1/2 - (cosh x - cos x) / (x (sinh x + sin x))) / x^4 :
                      Audoly and Neukirch, J. Mech. Phys. Solids 153, 104457 (2021). There, and here for k0 = t0 = 0, the term
                      is (E h W^5 / 4) (nu k^2 + t^2)^2 phi(v), v = sqrt(12 (1 - nu^2)) W^2 k / h.
    sano_wada         N = (t^2 - t0^2)^2 ,  g = 1 / (1 / zeta^2 + k^2) : Sano and Wada, Phys. Rev. Lett. 122, 114301 (2019), who leave
                      out the effect of bending alone on the section. The factor B is that for which g(0) is the stretching of a
                      twisted ribbon, E h W^5 t^4 / 1440 (Green, Proc. R. Soc. A 154, 1936).
    sadowsky          N = q^2 + nu e^2 (nu (k - k0)^2 + 2 (t - t0)^2) ,  g = 1 / (k^2 + e^2) , which for k0 = t0 = 0, EI_2 and GJ of a
                      plate is the energy of Sadowsky (1930) with a regularised fraction, B/2 (k^2 + 2 t^2 + t^4 / (k^2 + e^2)):
                      inextensible. The cutoff e, which is its parameter `crossover`, keeps it finite where the ribbon twists
                      without bending; a `Ribbon` takes 1 / zeta, the curvature below which it would stretch instead.

Where W is small the first two are Kirchhoff's rod; where k >> 1 / zeta the first and third are B/2 (k^2 + t^2)^2 / k^2, and the second
is that for nu = 0. The third is not convex in (k, t) where |t| > |k|, so that a ribbon that twists more than it bends may wrinkle at
the scale of its edges. The first is exact for uniform strains of thin sections. Natural strains enter all three as in this
derivation: a strip naturally curved along its length is developable however it is bent back.
"""

from functools import cache
from math import factorial

import warp as wp

from ddg_warp.kernels.densities import FINITE, NOT_NEGATIVE, POSITIVE, Density, Parameter, each

SWITCH = 256.0  # y up to which phi is a quotient of series: nine terms of each are exact to rounding


def _series() -> list[float]:
    """Return coefficients (6, 9) of P, P', P'', Q, Q', Q'' in powers of z = y / SWITCH, where phi = P / 2 Q."""
    n, rows = range(9), []
    for terms in ([(4 * i + 4) / factorial(4 * i + 6) for i in n], [1 / factorial(4 * i + 1) for i in n]):
        for _ in range(3):
            rows += [c * SWITCH**i for i, c in zip(n, terms, strict=True)]
            terms = [(i + 1) * terms[i + 1] for i in range(8)] + [0.0]
    return rows


@cache
def _phi(real):
    """Return the device function `phi(y) -> (phi, phi', phi'')` of y = x^4 = v^2 / 4, in which phi is smooth.

    Small y: 2 phi = sum (4 n + 4) y^n / (4 n + 6)! / sum y^n / (4 n + 1)!, where all terms are positive and nothing cancels.
    """
    V, Z = wp.types.vector(3, real), wp.types.vector(9, real)
    coefficients = wp.constant(wp.types.matrix((6, 9), real)(*_series()))

    @wp.func
    def near(y: real):
        z = y / real(SWITCH)
        z2 = z * z
        z4 = z2 * z2
        s = coefficients * Z(real(1.0), z, z2, z2 * z, z4, z4 * z, z4 * z2, z4 * z2 * z, z4 * z4)
        h = real(0.5) / s[3]
        first = (s[1] - s[0] * s[4] / s[3]) * h
        second = (s[2] - s[0] * s[5] / s[3]) * h - real(2.0) * first * s[4] / s[3]
        return V(s[0] * h, first, second)

    @wp.func
    def far(y: real):
        """Return phi for large y, with r, t, u = (cosh x - cos x, cosh x + cos x, sinh x - sin x) / (sinh x + sin x)."""
        one = real(1.0)
        two = real(2.0)
        x = wp.sqrt(wp.sqrt(y))
        e = wp.exp(-x)
        c = two * e * wp.cos(x)
        s = two * e * wp.sin(x)
        over = one / (one - e * e + s)
        r = (one + e * e - c) * over
        t = (one + e * e + c) * over
        u = (one - e * e - s) * over
        slope = one - r * t
        bend = r * t * t - slope * t - r * u
        h = real(0.5) - r / x
        h1 = (r / x - slope) / x
        h2 = (two * (slope - r / x) / x - bend) / x
        first = h1 - real(4.0) * h / x  # phi' x^4
        second = h2 - real(8.0) * h1 / x + real(20.0) * h / (x * x)
        return V(h, real(0.25) * first * x, real(0.0625) * (second * x * x - real(3.0) * first * x)) * (one / y)

    @wp.func
    def phi(y: real):
        close = near(wp.min(y, real(SWITCH)))
        y_far = wp.max(y, real(SWITCH))
        wide = far(y_far)
        wide = V(wide[0], wide[1] / y_far, wide[2] / (y_far * y_far))
        return wp.where(y < real(SWITCH), close, wide)

    return phi


@cache
def _compliance(name: str, real):
    """Return the device function `(k, crossover) -> (g, dg/dk, d2g/dk2)` of a law."""
    V, phi = wp.types.vector(3, real), _phi(real)

    @wp.func
    def rational(k: real, crossover: real):
        g = real(1.0) / (crossover * crossover + k * k)
        return V(g, real(-2.0) * k * g * g, (real(8.0) * k * k * g - real(2.0)) * g * g)

    @wp.func
    def elastic(k: real, crossover: real):
        a = real(180.0) / (crossover * crossover)
        f = phi(a * k * k)
        return V(f[0], real(2.0) * a * k * f[1], real(2.0) * a * (f[1] + real(2.0) * a * k * k * f[2])) * (
            real(2.0) * a
        )

    return elastic if name == "audoly_neukirch" else rational


@cache
def _defect(name: str, real):
    """Return the device function `(k, t, k0, t0, nu, crossover) -> (N, dN/dk, dN/dt, d2N/dk2, d2N/dk dt, d2N/dt2)`."""
    D = wp.types.vector(6, real)
    bends, kept = float(name != "sano_wada"), float(name == "sadowsky")

    @wp.func
    def defect(k: real, t: real, k0: real, t0: real, nu: real, crossover: real):
        two = real(2.0)
        mu = real(bends) * nu
        m = real(kept) * nu * crossover * crossover
        a = k - k0
        s = t - t0
        q = t * t - t0 * t0 + mu * k * a
        qk = mu * (k + a)
        qt = two * t
        return D(
            q * q + m * (nu * a * a + two * s * s),
            two * (q * qk + m * nu * a),
            two * (q * qt + two * m * s),
            two * (qk * qk + two * q * mu + m * nu),
            two * qk * qt,
            two * (qt * qt + two * q + two * m),
        )

    return defect


@cache
def _law(name: str):
    @cache
    def laws(real, n):
        E, P, M = wp.types.vector(3, real), wp.types.vector(8, real), wp.types.matrix((3, 3), real)
        compliance, defect = _compliance(name, real), _defect(name, real)

        @wp.func
        def half(p: P):
            """Return B / 2."""
            return real(0.5) * p[1] / (real(1.0) - p[3] * p[3])

        @wp.func
        def energy(e: E, p: P):
            d = E(e[0] - p[5], e[1] - p[6], e[2] - p[7])
            rod = real(0.5) * (p[0] * d[0] * d[0] + p[1] * d[1] * d[1] + p[2] * d[2] * d[2])
            g = compliance(e[1], p[4])
            N = defect(e[1], e[2], p[6], p[7], p[3], p[4])
            return rod + half(p) * N[0] * g[0]

        @wp.func
        def slope(e: E, p: P):
            g = compliance(e[1], p[4])
            N = defect(e[1], e[2], p[6], p[7], p[3], p[4])
            b = half(p)
            return E(
                p[0] * (e[0] - p[5]),
                p[1] * (e[1] - p[6]) + b * (N[1] * g[0] + N[0] * g[1]),
                p[2] * (e[2] - p[7]) + b * N[2] * g[0],
            )

        @wp.func
        def curvature(e: E, p: P):
            g = compliance(e[1], p[4])
            N = defect(e[1], e[2], p[6], p[7], p[3], p[4])
            b = half(p)
            zero = real(0.0)
            kk = p[1] + b * (N[3] * g[0] + real(2.0) * N[1] * g[1] + N[0] * g[2])
            kt = b * (N[4] * g[0] + N[2] * g[1])
            return M(p[0], zero, zero, zero, kk, kt, zero, kt, p[2] + b * N[5] * g[0])

        return energy, slope, curvature

    return laws


def _parameters(n):
    return (
        *each(n, "stiffness", "N m^2", NOT_NEGATIVE),
        Parameter("poisson", "1", ("between -1 and 1", lambda v: abs(v) < 1.0)),
        Parameter("crossover", "1/m", POSITIVE),
        *each(n, "rest", "1/m", FINITE, rest=True, default=0.0),
    )


LAWS = {
    name: Density(name, _parameters, _law(name), strains=3, coupled=True)
    for name in ("audoly_neukirch", "sano_wada", "sadowsky")
}

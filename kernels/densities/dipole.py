"""Magnetic dipoles of magnetisation M [A/m] per volume, in a field and in pairs.

In a field: psi = -M n . B with n the unit direction of the dipole, of the strains (n, B). For rotations of n, psi has the curvature M
n . B along the unit sphere, positive in an aligned field; the square root of that is the root of n. The coupling of n and B, and
negative curvature, are left to the exact Hessian.

In pairs: psi = mu0 / (4 pi) M M' f / r^3 per product of volumes. Strains are the orientation f = n . n' - 3 (n . u) (n' . u) and
the distance r (Jackson, Classical Electrodynamics, 1999, section 5.7: a dipole in the field of a point dipole).
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.densities import FINITE, Density, Parameter, each

VACUUM = 1.0e-7  # mu0 / (4 pi) [T m/A], to 1e-9


@cache
def _field_laws(real, n):
    E, P, V = wp.types.vector(6, real), wp.types.vector(1, real), wp.types.vector(3, real)

    @wp.func
    def energy(e: E, p: P):
        return -p[0] * wp.dot(V(e[0], e[1], e[2]), V(e[3], e[4], e[5]))

    @wp.func
    def slope(e: E, p: P):
        return E(e[3], e[4], e[5], e[0], e[1], e[2]) * -p[0]

    @wp.func
    def curvature(e: E, p: P):
        """Return the diagonal of psi''."""
        return E()

    return energy, slope, curvature


@cache
def _field_root(real, n):
    E, P, V = wp.types.vector(6, real), wp.types.vector(1, real), wp.types.vector(3, real)

    @wp.func
    def root(e: E, p: P, shift: E):
        aligned = p[0] * wp.dot(V(e[0], e[1], e[2]), V(e[3], e[4], e[5]))
        k = wp.sqrt(wp.max(aligned, real(0.0)))
        zero = real(0.0)
        return E(k, k, k, zero, zero, zero)

    return root


@cache
def _pair_laws(real, n):
    E, P, M = wp.types.vector(2, real), wp.types.vector(2, real), wp.types.matrix((2, 2), real)
    vacuum = wp.constant(real(VACUUM))

    @wp.func
    def strength(e: E, p: P):
        return vacuum * p[0] * p[1] / (e[1] * e[1] * e[1])

    @wp.func
    def energy(e: E, p: P):
        return strength(e, p) * e[0]

    @wp.func
    def slope(e: E, p: P):
        k = strength(e, p)
        return E(k, real(-3.0) * k * e[0] / e[1])

    @wp.func
    def curvature(e: E, p: P):
        k = strength(e, p) / e[1]
        mixed = real(-3.0) * k
        return M(real(0.0), mixed, mixed, real(12.0) * k * e[0] / e[1])

    return energy, slope, curvature


def _magnetisation(n):
    return (Parameter("magnetisation", "A/m", FINITE),)


dipole_in_field = Density("dipole_in_field", _magnetisation, _field_laws, strains=6, own_root=_field_root)
dipole_dipole = Density(
    "dipole_dipole", lambda n: each(2, "magnetisation", "A/m", FINITE), _pair_laws, strains=2, coupled=True
)

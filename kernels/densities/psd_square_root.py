"""Square root of psi'', made positive semidefinite, for the Gauss-Newton factor."""

from functools import cache

import warp as wp


@cache
def root_function(density, real, n: int):
    """Return the device function `root(e, p, shift)` of a law, without negative curvatures; see `Density.functions`."""
    _, _, curvature = density.laws(real, n)
    E, M3 = wp.types.vector(n, real), wp.types.matrix((3, 3), real)
    M = wp.types.matrix((n, n), real)
    P = wp.types.vector(density.parameter_size(n), real)

    @wp.func
    def diagonal(e: E, p: P, shift: E):
        r = E()
        c = curvature(e, p)
        for i in range(wp.static(n)):
            r[i] = wp.sqrt(wp.max(c[i] + shift[i], real(0.0)))
        return r

    @wp.func
    def full(e: E, p: P, shift: E):
        c = curvature(e, p)
        wide = M3()
        for i in range(wp.static(n)):
            for j in range(wp.static(n)):
                wide[i, j] = c[i, j] + wp.where(i == j, shift[i], real(0.0))
        vectors, values = wp.eig3(wide)
        r = M()
        for i in range(wp.static(n)):
            for j in range(wp.static(n)):
                total = real(0.0)
                for k in range(3):
                    total += vectors[i, k] * wp.sqrt(wp.max(values[k], real(0.0))) * vectors[j, k]
                r[i, j] = total
        return r

    return full if density.coupled else diagonal

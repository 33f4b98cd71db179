"""Elimination of one node: L D L^T of its symmetric block, and updates of the blocks that couple to it.

A block of a slender rod mixes stretching and bending stiffness, a factor of (l/r)^2 apart. An explicit inverse by cofactors loses
twice the digits of that factor, L D L^T with scalar pivots once. Sizes 2, 3 and 4 are written out, so that everything stays in
registers.
"""

from functools import cache

import warp as wp


@cache
def functions(size: int, real, sides: int | None = None):
    """Return the device functions `factor`, `lower`, `upper`, `lower_vector`, `upper_vector` and `congruence`.

    `factor(A) -> (L, inverse pivots, lost pivots)`: L D L^T.
    `lower(L, B)`: L^-1 B.
    `upper(L, inverse, Z)`: L^-T D^-1 Z.
    `lower_vector`, `upper_vector`: solve for vectors.
    `congruence(A, inverse, B)`: A^T D^-1 B.

    B and Z have as many columns as a block, or `sides`.
    """
    H, M = wp.types.vector(size, real), wp.types.matrix((size, size), real)
    W = wp.types.matrix((size, sides or size), real)
    tiny = wp.constant(real(2.3e-16 if real == wp.float64 else 1.2e-7))

    @wp.func
    def inverse_pivot(d: real, diagonal: real):
        """Return (1/d, 0); for a negative pivot or one lost in rounding that of a small positive pivot, and 1."""
        floor = tiny * wp.abs(diagonal)
        if d > floor:
            return real(1.0) / d, int(0)
        return real(1.0) / wp.max(wp.abs(d), wp.max(floor, tiny)), int(1)

    @wp.func
    def factor(A: M):
        L = M()
        inverse = H()
        i0, lost = inverse_pivot(A[0, 0], A[0, 0])
        inverse[0] = i0
        L[1, 0] = A[1, 0] * i0
        i1, l1 = inverse_pivot(A[1, 1] - L[1, 0] * A[1, 0], A[1, 1])
        inverse[1] = i1
        lost += l1
        if wp.static(size > 2):
            L[2, 0] = A[2, 0] * i0
            a21 = A[2, 1] - L[2, 0] * A[1, 0]
            L[2, 1] = a21 * i1
            i2, l2 = inverse_pivot(A[2, 2] - L[2, 0] * A[2, 0] - L[2, 1] * a21, A[2, 2])
            inverse[2] = i2
            lost += l2
        if wp.static(size > 3):
            L[3, 0] = A[3, 0] * i0
            a31 = A[3, 1] - L[3, 0] * A[1, 0]
            L[3, 1] = a31 * i1
            a32 = A[3, 2] - L[3, 0] * A[2, 0] - L[3, 1] * a21
            L[3, 2] = a32 * i2
            i3, l3 = inverse_pivot(A[3, 3] - L[3, 0] * A[3, 0] - L[3, 1] * a31 - L[3, 2] * a32, A[3, 3])
            inverse[3] = i3
            lost += l3
        return L, inverse, lost

    @wp.func
    def lower(L: M, B: W):
        Z = W()
        Z[0] = B[0]
        z1 = B[1] - L[1, 0] * B[0]
        Z[1] = z1
        if wp.static(size > 2):
            z2 = B[2] - L[2, 0] * B[0] - L[2, 1] * z1
            Z[2] = z2
        if wp.static(size > 3):
            Z[3] = B[3] - L[3, 0] * B[0] - L[3, 1] * z1 - L[3, 2] * z2
        return Z

    @wp.func
    def upper(L: M, inverse: H, Z: W):
        U = W()
        if wp.static(size == 4):
            u3 = Z[3] * inverse[3]
            u2 = Z[2] * inverse[2] - L[3, 2] * u3
            u1 = Z[1] * inverse[1] - L[2, 1] * u2 - L[3, 1] * u3
            U[3] = u3
            U[2] = u2
            U[1] = u1
            U[0] = Z[0] * inverse[0] - L[1, 0] * u1 - L[2, 0] * u2 - L[3, 0] * u3
        if wp.static(size == 3):
            v2 = Z[2] * inverse[2]
            v1 = Z[1] * inverse[1] - L[2, 1] * v2
            U[2] = v2
            U[1] = v1
            U[0] = Z[0] * inverse[0] - L[1, 0] * v1 - L[2, 0] * v2
        if wp.static(size == 2):
            t1 = Z[1] * inverse[1]
            U[1] = t1
            U[0] = Z[0] * inverse[0] - L[1, 0] * t1
        return U

    @wp.func
    def lower_vector(L: M, b: H):
        z = H()
        z[0] = b[0]
        y1 = b[1] - L[1, 0] * b[0]
        z[1] = y1
        if wp.static(size > 2):
            y2 = b[2] - L[2, 0] * b[0] - L[2, 1] * y1
            z[2] = y2
        if wp.static(size > 3):
            z[3] = b[3] - L[3, 0] * b[0] - L[3, 1] * y1 - L[3, 2] * y2
        return z

    @wp.func
    def upper_vector(L: M, inverse: H, z: H):
        u = wp.cw_mul(inverse, z)
        if wp.static(size > 3):
            u[2] = u[2] - L[3, 2] * u[3]
            u[1] = u[1] - L[3, 1] * u[3]
            u[0] = u[0] - L[3, 0] * u[3]
        if wp.static(size > 2):
            u[1] = u[1] - L[2, 1] * u[2]
            u[0] = u[0] - L[2, 0] * u[2]
        u[0] = u[0] - L[1, 0] * u[1]
        return u

    @wp.func
    def congruence(A: M, inverse: H, B: M):
        """Return A^T D^-1 B."""
        out = M()
        for i in range(wp.static(size)):
            out += wp.outer(A[i] * inverse[i], B[i])
        return out

    return factor, lower, upper, lower_vector, upper_vector, congruence


@cache
def signed_functions(size: int, negative: int, real):
    """Return the functions of `functions` for a quasi-definite block, with the last `negative` pivots negative."""
    if not negative:
        return functions(size, real)
    H, M = wp.types.vector(size, real), wp.types.matrix((size, size), real)
    tiny, positive = wp.constant(real(2.3e-16 if real == wp.float64 else 1.2e-7)), size - negative
    *_, congruence = functions(size, real)

    @wp.func
    def inverse_pivot(d: real, diagonal: real, sign: real):
        """Return (1/d, 0); for a pivot of the wrong sign or lost in rounding that of a small one of `sign`, and 1."""
        floor = tiny * wp.abs(diagonal)
        if sign * d > floor:
            return real(1.0) / d, int(0)
        return sign / wp.max(wp.abs(d), wp.max(floor, tiny)), int(1)

    @wp.func
    def factor(A: M):
        L = M()
        W = M()  # L D
        inverse = H()
        lost = int(0)
        for i in range(wp.static(size)):
            d = A[i, i]
            for j in range(i):
                w = A[i, j]
                for k in range(j):
                    w -= L[j, k] * W[i, k]
                W[i, j] = w
                L[i, j] = w * inverse[j]
                d -= L[i, j] * w
            inverse_d, lost_here = inverse_pivot(d, A[i, i], wp.where(i < wp.static(positive), real(1.0), real(-1.0)))
            inverse[i] = inverse_d
            lost += lost_here
        return L, inverse, lost

    @wp.func
    def lower(L: M, B: M):
        Z = M()
        for i in range(wp.static(size)):
            z = B[i]
            for j in range(i):
                z -= L[i, j] * Z[j]
            Z[i] = z
        return Z

    @wp.func
    def upper(L: M, inverse: H, Z: M):
        U = M()
        for i in range(wp.static(size)):
            row = wp.static(size - 1) - i
            u = Z[row] * inverse[row]
            for j in range(row + 1, wp.static(size)):
                u -= L[j, row] * U[j]
            U[row] = u
        return U

    @wp.func
    def lower_vector(L: M, b: H):
        z = H()
        for i in range(wp.static(size)):
            v = b[i]
            for j in range(i):
                v -= L[i, j] * z[j]
            z[i] = v
        return z

    @wp.func
    def upper_vector(L: M, inverse: H, z: H):
        u = H()
        for i in range(wp.static(size)):
            row = wp.static(size - 1) - i
            v = z[row] * inverse[row]
            for j in range(row + 1, wp.static(size)):
                v -= L[j, row] * u[j]
            u[row] = v
        return u

    return factor, lower, upper, lower_vector, upper_vector, congruence

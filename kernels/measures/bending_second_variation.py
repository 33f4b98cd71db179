"""Second variation of a bending strain under rotations of both edges, for the measures of rods.

Along a straight line in the edge vectors e, f the tangents move by v = de across te / |e|, and u likewise. Let b = te x tf / (1 + te
. tf), half of the curvature binormal, and K = b . g with constant g. Then K' = A . v + B . u where A = (tf x g) i - tt K, B = -(te x
g) i - tt K, i = 1 / (1 + te . tf), tt = (te + tf) i. A second differentiation gives

    K'' = 2 i g . (v x u) - 2 (tt . (v + u)) K' - i K |v + u|^2 - 2 (te . de) A . v / |e| - 2 (tf . df) B . u / |f|.
"""

from functools import cache

import warp as wp


def packed_index(size: int, i: int, j: int) -> int:
    """Return the index of entry (i, j), i <= j, of a symmetric matrix stored as upper triangle row by row."""
    return i * size - i * (i - 1) // 2 + j - i


@cache
def functions(real):
    """Return the device functions `turning`, `across` and `lengthening`.

    `turning(a, b, tt, g, i, k)`: S_vv, S_uu, S_vu of K'' without its last two terms.
    `across`, `lengthening`: transform them to edges.
    """
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)

    @wp.func
    def turning(a: V, b: V, tt: V, g: V, i: real, k: real):
        """Return S_vv, S_uu, S_vu; a = A, b = B, k = K. K'' = v . S_vv v + u . S_uu u + 2 v . S_vu u."""
        one = real(1.0)
        same = wp.diag(V(one, one, one)) * (i * k)
        return (
            -wp.outer(tt, a) - wp.outer(a, tt) - same,
            -wp.outer(tt, b) - wp.outer(b, tt) - same,
            -wp.outer(tt, b) - wp.outer(a, tt) - same - wp.skew(g) * i,
        )

    @wp.func
    def across(s: M, t: V, u: V, scale: real):
        """Return (I - t t^T) s (I - u u^T) scale."""
        left = s - wp.outer(t, t * s)
        return (left - wp.outer(left * u, u)) * scale

    @wp.func
    def lengthening(t: V, a: V, inverse: real):
        """Return -(t a^T + a t^T) / |e|^2, the loss of a tangent's rotation as its edge lengthens."""
        m = wp.outer(t, a)
        return -(m + wp.transpose(m)) * (inverse * inverse)

    return turning, across, lengthening

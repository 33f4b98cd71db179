"""Second variation of a bending strain as its edges turn, shared by the measures of rods.

Along a straight line in the edge vectors e, f their tangents move by v = de across te / |e| and u likewise. With half of the
curvature binormal b = te x tf / (1 + te . tf), and K = b . g with g held, K' = A . v + B . u where
A = (tf x g) i - tt K, B = -(te x g) i - tt K, i = 1 / (1 + te . tf), tt = (te + tf) i. A second differentiation gives

    K'' = 2 i g . (v x u) - 2 (tt . (v + u)) K' - i K |v + u|^2 - 2 (te . de) A . v / |e| - 2 (tf . df) B . u / |f|.
"""

from functools import cache

import warp as wp


def packed_index(size: int, i: int, j: int) -> int:
    """Place of entry (i, j), i <= j, of a symmetric matrix whose upper triangle is stored row by row."""
    return i * size - i * (i - 1) // 2 + j - i


@cache
def functions(real):
    """turning(...) -> S_vv, S_uu, S_vu of K'' without its last two terms; across(...) and lengthening(...) take it to edges."""
    V, M = wp.types.vector(3, real), wp.types.matrix((3, 3), real)

    @wp.func
    def turning(a: V, b: V, tt: V, g: V, i: real, k: real):
        """a, b, tt, i as in the module's text; k = K. K'' = v . S_vv v + u . S_uu u + 2 v . S_vu u."""
        one = real(1.0)
        same = wp.diag(V(one, one, one)) * (i * k)
        return (
            -wp.outer(tt, a) - wp.outer(a, tt) - same,
            -wp.outer(tt, b) - wp.outer(b, tt) - same,
            -wp.outer(tt, b) - wp.outer(a, tt) - same - wp.skew(g) * i,
        )

    @wp.func
    def across(s: M, t: V, u: V, scale: real):
        """(I - t t^T) s (I - u u^T) scale."""
        left = s - wp.outer(t, t * s)
        return (left - wp.outer(left * u, u)) * scale

    @wp.func
    def lengthening(t: V, a: V, inverse: real):
        """-(t a^T + a t^T) / |e|^2: what a tangent's turn loses as its edge grows."""
        m = wp.outer(t, a)
        return -(m + wp.transpose(m)) * (inverse * inverse)

    return turning, across, lengthening

"""Distance of two edges [m], and how far they are from parallel, |e0 x e2|^2 [m^4], by which contact of edges is mollified.

Nodes: two of either edge. For the distance and its derivatives see `closest_points`. Where edges are parallel the closest points are
not unique, and jump along them as they turn past each other: laws of two strains fade out there (`densities.mollified`).
With N = e0 x e2 and the rows K of its Jacobian, the second strain has the derivative 2 N . K and the second one 2 K^T K and
2 N . (de0 x de2) twice. Singular where the edges meet.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures.closest_points import distance_functions, edge_edge


@cache
def _functions(real):
    Q, S, E, M = edge_edge_distance.types(real)
    V, H = wp.types.vector(3, real), wp.types.vector(45, real)
    _, _, slope_of, bend = distance_functions(edge_edge, 9, real)

    @wp.func
    def edges(q: Q):
        return V(q[0], q[1], q[2]), V(q[6], q[7], q[8])

    @wp.func
    def strains(q: Q, s: S, w: real):
        d, _row = slope_of(q)
        a, c = edges(q)
        normal = wp.cross(a, c)
        return E(d, wp.dot(normal, normal))

    @wp.func
    def along(a: V, c: V, v: V):
        """Derivative of v . (a x c)."""
        da = wp.cross(c, v)
        dc = wp.cross(v, a)
        zero = real(0.0)
        return Q(da[0], da[1], da[2], zero, zero, zero, dc[0], dc[1], dc[2])

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        d, row = slope_of(q)
        a, c = edges(q)
        normal = wp.cross(a, c)
        return E(d, wp.dot(normal, normal)), wp.matrix_from_rows(row, along(a, c, normal * real(2.0)))

    @wp.func
    def curvature(q: Q, s: S, w: real, slope: E):
        g, first, second, rho, inverse = bend(q)
        a, c = edges(q)
        zero, one = real(0.0), real(1.0)
        near = w * slope[0] * inverse
        turn = real(2.0) * w * slope[1]
        x = along(a, c, V(one, zero, zero))
        y = along(a, c, V(zero, one, zero))
        z = along(a, c, V(zero, zero, one))
        mixed = wp.skew(wp.cross(a, c))
        h = H()
        for i in range(9):
            for j in range(i, 9):
                value = -near * (g[i] * g[j] + first[i] * first[j] + second[i] * second[j])
                value += turn * (x[i] * x[j] + y[i] * y[j] + z[i] * z[j])
                if i % 3 == j % 3:
                    value += near * rho[i // 3] * rho[j // 3]
                if i < 3 and j > 5:
                    value -= turn * mixed[i % 3, j % 3]
                h[i * 9 - i * (i - 1) // 2 + j - i] = value  # `packed_index`
        return h

    return strains, jacobian, None, curvature


edge_edge_distance = Measure(
    "edge_edge_distance",
    3,
    ((0, 1), (1, 2), (2, 3)),
    ("distance [m]", "crossing [m^4]"),
    _functions,
    apart=True,
    sample=lambda random, count: {"nodes": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, -0.5, 0.3], [0.7, 0.5, 0.4]]},
)

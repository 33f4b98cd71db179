"""Slip: where the closest points are to each other in the plane that they touch in [m], of which the change over a step is what slides.

With the coefficients rho of the closest points (see `closest_points`) and an orthonormal basis (t1, t2) at right angles to the normal,
all lagged, the strains are

    (t1 . r, t2 . r),   r = sum_k rho_k e_k of pairs,   r = x - c - A^T y of a point and an obstacle,

linear in the dofs. Laws of friction take the strains at the start of the step, with the same lagged data, from them. The point y of
the obstacle stays where it is in the obstacle's frame (c, A), so that what moves or turns drags along what lies on it.

Lagged data: of pairs rho, t1, t2; of obstacles t1, t2, y, which `advance` takes where the points are then. Nodes and data are those
of the measure of the distance.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures.closest_points import distance_functions, edge_edge, point_edge, point_triangle
from ddg_warp.kernels.measures.obstacle_distance import obstacle, obstacle_distance


@cache
def basis(real):
    """basis(n) -> (t1, t2), at right angles to each other and the unit vector n (Duff et al., J. Comput. Graph. Tech. 6, 2017)."""
    V = wp.types.vector(3, real)

    @wp.func
    def tangents(n: V):
        one = real(1.0)
        sign = wp.where(n[2] < real(0.0), -one, one)
        a = -one / (sign + n[2])
        b = n[0] * n[1] * a
        return V(one + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), V(b, sign + n[1] * n[1] * a, -n[1])

    return tangents


def _pair(measure_of, closest_of):
    @cache
    def functions(real):
        measure = measure_of()
        Q, S, E, M = measure.types(real)
        edges, packed = len(measure.edges), measure.size * (measure.size + 1) // 2
        K, V, H = wp.types.vector(edges, real), wp.types.vector(3, real), wp.types.vector(packed, real)
        between, spread, *_ = distance_functions(closest_of, measure.size, real)

        @wp.func
        def lagged(s: S):
            rho = K()
            t1 = V()
            t2 = V()
            for k in range(wp.static(edges)):
                rho[k] = s[k]
            for d in range(3):
                t1[d] = s[wp.static(edges) + d]
                t2[d] = s[wp.static(edges + 3) + d]
            return rho, t1, t2

        @wp.func
        def strains(q: Q, s: S, w: real):
            rho, t1, t2 = lagged(s)
            r = between(q, rho)
            return E(wp.dot(t1, r), wp.dot(t2, r))

        @wp.func
        def jacobian(q: Q, s: S, w: real):
            rho, t1, t2 = lagged(s)
            return strains(q, s, w), wp.matrix_from_rows(spread(rho, t1), spread(rho, t2))

        @wp.func
        def curvature(q: Q, s: S, w: real, slope: E):
            return H()

        return strains, jacobian, None, curvature

    return functions


def _pair_advance(measure_of, closest_of):
    @cache
    def make(real):
        measure = measure_of()
        Q, S, _, _ = measure.types(real)
        edges, L = len(measure.edges), wp.types.vector(measure.lag_size, real)
        between, *_ = distance_functions(closest_of, measure.size, real)
        closest, tangents = closest_of(real), basis(real)

        @wp.func
        def advance(q: Q, s: S):
            rho, _m, _o = closest(q)
            t1, t2 = tangents(wp.normalize(between(q, rho)))
            out = L()
            for k in range(wp.static(edges)):
                out[k] = rho[k]
            for d in range(3):
                out[wp.static(edges) + d] = t1[d]
                out[wp.static(edges + 3) + d] = t2[d]
            return out

        return advance

    return make


def _tangents(random, count: int) -> np.ndarray:
    """Orthonormal pairs (6, count)."""
    return np.linalg.qr(random.normal(size=(count, 3, 2)))[0].transpose(2, 1, 0).reshape(6, count)


def _pair_slip(name: str, edges: int, closest_of) -> Measure:
    def sample(random, count: int) -> dict:
        return {"lag": np.vstack([random.uniform(0.2, 0.9, (edges, count)), _tangents(random, count)])}

    measure = Measure(
        name,
        3,
        tuple((k, k + 1) for k in range(edges)),
        ("slip_1 [m]", "slip_2 [m]"),
        _pair(lambda: measure, closest_of),
        lag_size=edges + 6,
        vectors=(edges, edges + 3),
        apart=True,
        advance=_pair_advance(lambda: measure, closest_of),
        sample=sample,
    )
    return measure


@cache
def _obstacle_functions(real):
    Q, S, E, M = obstacle_slip.types(real)
    V, H, A3 = wp.types.vector(3, real), wp.types.vector(6, real), wp.types.matrix((3, 3), real)

    @wp.func
    def tangents(s: S):
        return V(s[0], s[1], s[2]), V(s[3], s[4], s[5])

    @wp.func
    def strains(q: Q, s: S, w: real):
        t1, t2 = tangents(s)
        axes = A3(s[13], s[14], s[15], s[16], s[17], s[18], s[19], s[20], s[21])
        r = q - V(s[10], s[11], s[12]) - V(s[6], s[7], s[8]) * axes
        return E(wp.dot(t1, r), wp.dot(t2, r))

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        t1, t2 = tangents(s)
        return strains(q, s, w), wp.matrix_from_rows(t1, t2)

    @wp.func
    def curvature(q: Q, s: S, w: real, slope: E):
        return H()

    return strains, jacobian, None, curvature


@cache
def _obstacle_advance(real):
    Q, S, _, _ = obstacle_slip.types(real)
    P, L = wp.types.vector(16, real), wp.types.vector(9, real)
    local, slope_of = obstacle(real)
    tangents = basis(real)

    @wp.func
    def advance(q: Q, s: S):
        p = P()
        for i in range(16):
            p[i] = s[9 + i]
        y, axes = local(q, p)
        d, n, _outside = slope_of(y, p)
        t1, t2 = tangents(n * axes)
        y -= n * d
        return L(t1[0], t1[1], t1[2], t2[0], t2[1], t2[2], y[0], y[1], y[2])

    return advance


def _obstacle_sample(random, count: int) -> dict:
    """Of the obstacles of the distance."""
    given = obstacle_distance.sample(random, count)
    return {**given, "lag": np.vstack([_tangents(random, count), random.uniform(0.2, 0.9, (3, count))])}


edge_edge_slip = _pair_slip("edge_edge_slip", 3, edge_edge)
point_edge_slip = _pair_slip("point_edge_slip", 2, point_edge)
point_triangle_slip = _pair_slip("point_triangle_slip", 3, point_triangle)
obstacle_slip = Measure(
    "obstacle_slip",
    3,
    (),
    ("slip_1 [m]", "slip_2 [m]"),
    _obstacle_functions,
    lag_size=9,
    data_size=16,
    points=1,
    vectors=(0, 3, 10, 13, 16, 19),
    advance=_obstacle_advance,
    sample=_obstacle_sample,
)

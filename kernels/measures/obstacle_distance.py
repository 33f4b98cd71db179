"""Signed distance of a point from an obstacle [m]: a half-space or a box, with a thickness a sphere, a capsule or a rounded box.

In the obstacle's frame, y = A (x - c) with the axes as rows of A:

    kind 0: the half-space y_3 < 0, y_3;
    kind 1: the box |y_i| <= h_i, with u_i = |y_i| - h_i the length of what is positive of u, inside the largest of u.

A box without lengths h is a point, one with one a line, one with two a rectangle: with the radius in the law's `thickness` these are
the sphere, the capsule and the rounded plate, of which distance - thickness is signed, too. Outside of a box the distance
has a continuous gradient n and the second derivative (P - n n^T) / distance, P the projection onto axes where u is positive; inside
it is linear, with kinks where the nearest face changes.

Data: kind; c (3), a point of the half-space's surface or the middle of the box; A (9, row by row); h (3).
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.measures import Measure


@cache
def obstacle(real):
    """Device functions local(x, s) -> (y, A); slope(y, s) -> (distance, its derivative by y, 1 where u is positive outside)."""
    V, S, A3 = wp.types.vector(3, real), wp.types.vector(16, real), wp.types.matrix((3, 3), real)

    @wp.func
    def local(x: V, s: S):
        axes = A3(s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11], s[12])
        return axes * (x - V(s[1], s[2], s[3])), axes

    @wp.func
    def slope(y: V, s: S):
        zero, one = real(0.0), real(1.0)
        u = V(wp.abs(y[0]) - s[13], wp.abs(y[1]) - s[14], wp.abs(y[2]) - s[15])
        side = V(wp.where(y[0] < zero, -one, one), wp.where(y[1] < zero, -one, one), wp.where(y[2] < zero, -one, one))
        outside = V(
            wp.where(u[0] > zero, one, zero), wp.where(u[1] > zero, one, zero), wp.where(u[2] > zero, one, zero)
        )
        if s[0] < real(0.5):
            return y[2], V(zero, zero, one), V()
        if u[0] > zero or u[1] > zero or u[2] > zero:
            v = wp.cw_mul(u, outside)
            d = wp.length(v)
            return d, wp.cw_mul(v, side) / d, outside
        if u[0] >= u[1] and u[0] >= u[2]:
            return u[0], V(side[0], zero, zero), V()
        if u[1] >= u[2]:
            return u[1], V(zero, side[1], zero), V()
        return u[2], V(zero, zero, side[2]), V()

    return local, slope


@cache
def _functions(real):
    Q, S, E, M = obstacle_distance.types(real)
    H = wp.types.vector(6, real)
    local, slope_of = obstacle(real)

    @wp.func
    def strains(q: Q, s: S, w: real):
        y, _axes = local(q, s)
        d, _n, _outside = slope_of(y, s)
        return E(d)

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        y, axes = local(q, s)
        d, n, _outside = slope_of(y, s)
        return E(d), wp.matrix_from_rows(n * axes)

    @wp.func
    def curvature(q: Q, s: S, w: real, slope: E):
        y, axes = local(q, s)
        d, n, outside = slope_of(y, s)
        scale = real(0.0)
        if outside[0] + outside[1] + outside[2] > real(1.5):
            scale = w * slope[0] / d
        h = wp.transpose(axes) * ((wp.diag(outside) - wp.outer(n, n)) * axes) * scale
        return H(h[0, 0], h[0, 1], h[0, 2], h[1, 1], h[1, 2], h[2, 2])

    return strains, jacobian, None, curvature


def _sample(random, count: int) -> dict:
    """Half-spaces and boxes, points, lines and rectangles, in turns, askew, some 0.5 away from the point."""
    axes = np.linalg.qr(random.normal(size=(count, 3, 3)))[0]
    lengths = np.where(np.arange(count)[:, None] % 4 > np.arange(3), 0.3, 0.0)
    out = np.array([0.2, 0.25, 0.35]) + lengths
    kind = 1.0 * (np.arange(count) % 5 < 4)
    place = np.array([2.0, 0.0, 0.0]) - np.einsum("ni,nij->nj", out, axes)
    return {"nodes": [[2.0, 0.0, 0.0]], "data": np.vstack([kind, place.T, axes.reshape(count, 9).T, lengths.T])}


obstacle_distance = Measure(
    "obstacle_distance",
    3,
    (),
    ("distance [m]",),
    _functions,
    data_size=16,
    points=1,
    vectors=(1, 4, 7, 10),
    sample=_sample,
)

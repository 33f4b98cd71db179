"""Contact potential: energy of a collision by its distance, gradient, and rows of the Gauss-Newton factor.

For a point and a triangle or plane, an edge and a ball, or two balls, the energy is psi(d) (`closest_points`, `densities.contact`). The
closest points of two edges jump where the edges are parallel. So with the mollifier m, 0 for parallel edges a, b and 1 beyond about two
degrees, the energy of two edges is

    m psi(d_ab) + (1 - m) / 2 (G(a0, b) + G(a1, b) + G(b0, a) + G(b1, a)) ,   G(p, b) = psi(d_p,b) - (psi(d_p,b0) + psi(d_p,b1)) / 2 ,

where the last sum covers only ends of b in the interior of its rod. Both terms have continuous slopes: m removes the jump from the
first, and a point has one closest point on an edge. Along straight rows of edges all is counted once. A node in the interior of a rod
ends two edges, each of which contributes half. The G of a point add up to psi of its distance from the row, also at nodes shared by two
edges. Along an edge the halves are the trapezoidal rule. G >= 0, as psi decreases. Ends of edges that cross at an angle do not count.
Up to four pairs of edges count near nodes. Points against edges of shells are omitted, since point-triangle distances cover them.

A distance is |r| with r = sum_i w_i x_i over the four nodes, sum_i w_i = 0, and has the derivative w_i r / |r|. So forces have no
resultant and, being along r, no moment. psi'' >= 0 adds a factor row sqrt(c psi'') w_i r / |r| for each distance, with its weight c in
the energy. The product of these rows is positive semi-definite. The row of G is that of d_p,b. Its size follows from the second
derivative of G, if positive, for equal changes of all three distances, which is accurate where they are nearly equal.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.collision.contact.closest_points import (
    distance_function,
    end_function,
    mollifier_function,
    node_function,
    node_types,
)
from ddg_warp.kernels.collision.primitives import EDGES, Kind
from ddg_warp.kernels.densities import Density

ENDS = 4  # ends of two edges


def rows_of(kind: Kind) -> int:
    """Return the number of distances in the energy of a pair."""
    return 1 + ENDS * (kind == EDGES)


@cache
def end_functions(density: Density, real):
    """Return the device functions of half of G of end k of two edges, zero if not counted: `of_end` and `row_of_end`.

    - `of_end(x, p, inner, k) -> (energy, gradient)`.
    - `row_of_end(x, p, inner, k) -> (w, v)`.
    """
    X, W, V = node_types(real)
    E, I = wp.types.vector(1, real), wp.types.vector(4, int)
    end, to_node = end_function(real), node_function(real)
    energy_of, slope_of, curvature_of = density.laws(real, 1)
    opposite, half = I(2, 2, 0, 0), real(0.5)

    @wp.func
    def of_end(x: X, p: V, inner: W, k: int):
        e = real(0.0)
        g = X()
        if inner[opposite[k]] >= real(0.0):
            w, d, n = end(x, k)
            f = slope_of(E(d), p)
            e = half * energy_of(E(d), p)
            g = wp.outer(w, n * (half * f[0]))
            if not wp.isinf(e):
                for i in range(2):
                    j = opposite[k] + i
                    wj, dj, nj = to_node(x, k, j)
                    fj = slope_of(E(dj), p)
                    e -= half * inner[j] * energy_of(E(dj), p)
                    g -= wp.outer(wj, nj * (half * inner[j] * fj[0]))
        return e, g

    @wp.func
    def row_of_end(x: X, p: V, inner: W, k: int):
        w = W()
        v = V()
        if inner[opposite[k]] >= real(0.0):
            w, d, n = end(x, k)
            stiffness = curvature_of(E(d), p)
            c = stiffness[0]
            for i in range(2):
                j = opposite[k] + i
                _w, dj, _n = to_node(x, k, j)
                less = curvature_of(E(dj), p)
                c -= inner[j] * less[0]
            v = n * wp.sqrt(half * wp.max(c, real(0.0)))
        return w, v

    return of_end, row_of_end


@cache
def bend_function(kind: Kind, density: Density, real):
    """Return the device function `bends(x, p, threshold, d)`: psi' / d for an energy of the distance d alone, else 0.

    See `geometric_stiffness`.
    """
    X, W, V = node_types(real)
    E = wp.types.vector(1, real)
    slope_of = density.laws(real, 1)[1]

    @wp.func
    def bends(x: X, p: V, threshold: real, d: real):
        if wp.static(kind == EDGES):
            normal = wp.cross(x[1] - x[0], x[3] - x[2])
            if wp.dot(normal, normal) < threshold:
                return real(0.0)
        f = slope_of(E(d), p)
        return f[0] / d

    return bends


@cache
def pair_energy_functions(kind: Kind, density: Density, real):
    """Return the device functions of the contact energy: `about`, `row`, `evaluate` and `along`.

    Arguments are nodes x, parameters p and, for edges, the threshold [m^4] of the mollifier and `inner` of the four nodes. It is 1/2 in
    the interior of a rod, 0 at its ends, and -1 at edges of shells, for which no ends count.

    - `about(x, w, d, n, p, threshold, inner) -> (energy [J], gradient (4, 3) [N], m)`: for closest points (w, d, n) of
      `distance_function`, with the mollifier m.
    - `row(x, w, d, n, m, p, inner, k) -> (w, v)`: the k-th row w_i v of the factor.
    - `evaluate(x, p, threshold, inner) -> (energy, gradient)`.
    - `along(x, v, p, threshold, inner)`: derivative along v; its reverse is a row of the exact Hessian.
    """
    X, W, V = node_types(real)
    E = wp.types.vector(1, real)
    near = distance_function(kind, real)
    of_end, row_of_end = end_functions(density, real) if kind == EDGES else (None, None)
    mollify = mollifier_function(real)
    energy_of, slope_of, curvature_of = density.laws(real, 1)

    @wp.func
    def crossing(x: X):
        """Return |a x b|^2 of two edges and the derivative."""
        a = x[1] - x[0]
        b = x[3] - x[2]
        normal = wp.cross(a, b)
        da = wp.cross(b, normal) * real(2.0)
        db = wp.cross(normal, a) * real(2.0)
        return wp.dot(normal, normal), wp.matrix_from_rows(-da, da, -db, db)

    @wp.func
    def single(x: X, w: W, d: real, n: V, p: V, threshold: real, inner: W):
        f = slope_of(E(d), p)
        return energy_of(E(d), p), wp.outer(w, n * f[0]), real(1.0)

    @wp.func
    def edges(x: X, w: W, d: real, n: V, p: V, threshold: real, inner: W):
        square, turn = crossing(x)
        m, first = mollify(square, threshold)
        e = energy_of(E(d), p)
        f = slope_of(E(d), p)
        total = e
        g = wp.outer(w, n * (m * f[0]))
        if m < real(1.0):
            ends = real(0.0)
            for k in range(wp.static(ENDS)):
                ek, gk = of_end(x, p, inner, k)
                ends += ek
                g += gk * (real(1.0) - m)
            g += turn * (first * (e - ends))
            total = (real(1.0) - m) * ends
            if m > real(0.0):
                total += m * e
        return total, g, m

    about = edges if kind == EDGES else single

    @wp.func
    def row(x: X, w: W, d: real, n: V, m: real, p: V, inner: W, k: int):
        stiffness = curvature_of(E(d), p)
        v = n * wp.sqrt(stiffness[0] * m)
        if wp.static(kind == EDGES):
            if k > 0:
                v = V()
                if m < real(1.0):
                    w, u = row_of_end(x, p, inner, wp.max(k - 1, 0))
                    v = u * wp.sqrt(real(1.0) - m)
        return w, v

    @wp.func
    def evaluate(x: X, p: V, threshold: real, inner: W):
        w, d, n = near(x)
        e, g, _m = about(x, w, d, n, p, threshold, inner)
        return e, g

    @wp.func
    def along(x: X, v: X, p: V, threshold: real, inner: W):
        _e, g = evaluate(x, p, threshold, inner)
        return wp.ddot(g, v)

    return about, row, evaluate, along

"""Energy of a pair of surfaces by their distance, its gradient, and the factor of its Gauss-Newton matrix.

Of a point and a triangle, or an edge and a ball, it is psi(d) of their distance (`densities.contact`). The closest points of two edges
jump where these are parallel. So with m the mollifier of `densities.contact`, 0 where edges a, b are parallel and 1 from some two
degrees on, theirs is

    m psi(d_ab) + (1 - m) / 2 (G(a0, b) + G(a1, b) + G(b0, a) + G(b1, a)) ,   G(p, b) = psi(d_p,b) - (psi(d_p,b0) + psi(d_p,b1)) / 2 ,

where the last sum has those ends of b only that are inside of its rod. Both parts have continuous slopes, the first as m ends the jump,
the second as a point has one closest point on an edge. Along straight rows of edges all is counted once: a node inside a rod ends two
edges, each of which brings half of it; and the G of a point add up to psi of its distance from the row, even where that is from a node,
which two edges have in common. Along an edge the halves are the trapezoidal rule. G >= 0, as psi falls. Where edges cross at an angle
their ends do not count; each two edges do that are near, which close to nodes are up to four. Points against edges of shells are left
out: their distances from triangles have them.

A distance is |r| with r = sum_i w_i x_i over the four nodes, sum_i w_i = 0, and has the derivative w_i r / |r|: forces have no
resultant and, r being along them, no moment. What psi'' >= 0 brings to the Hessian is a row sqrt(c psi'') w_i r / |r| for each
distance, c its share in the energy; the product of these rows is positive semi-definite by form. Of G the row is that of d_p,b, with
what is positive of the second derivative of G if all three changed alike, as they do where they are all but equal.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.contact.surfaces import EDGE_POINT, EDGES, Kind
from ddg_warp.kernels.densities import Density
from ddg_warp.kernels.densities.contact import mollifier_function
from ddg_warp.kernels.measures import closest_points

ENDS = 4  # ends of two edges


def rows_of(kind: Kind) -> int:
    """Distances that the energy of a pair depends on."""
    return 1 + ENDS * (kind == EDGES)


@cache
def shape_types(real):
    """Nodes of a pair (4, 3), weights of nodes or of what is counted of them, and parameters of the law."""
    return wp.types.matrix((4, 3), real), wp.types.vector(4, real), wp.types.vector(3, real)


@cache
def distance_function(kind: Kind, real):
    """near(x) -> (w, d, n): weights, length and direction of what is between the closest points."""
    if kind == EDGE_POINT:
        return _edge_point(real)
    if kind.endless:
        return _point_plane(real)
    X, W, V = shape_types(real)
    Q = wp.types.vector(9, real)
    closest_of = closest_points.edge_edge if kind == EDGES else closest_points.point_triangle
    closest = closest_of(real)

    @wp.func
    def near(x: X):
        a = x[1] - x[0]
        b = x[2] - x[1]
        c = x[3] - x[2]
        rho, _m, _o = closest(Q(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]))
        r = a * rho[0] + b * rho[1] + c * rho[2]
        d = wp.length(r)
        return W(-rho[0], rho[0] - rho[1], rho[1] - rho[2], rho[2]), d, r / wp.where(d > real(0.0), d, real(1.0))

    return near


def _point_plane(real):
    """The same of a half-space, with a distance that is below zero inside of it."""
    X, W, _ = shape_types(real)

    @wp.func
    def near(x: X):
        u = x[2] - x[1]
        v = x[3] - x[1]
        r = x[0] - x[1]
        normal = wp.cross(u, v)
        size = wp.length(normal)
        n = normal / size
        b = wp.dot(wp.cross(r, v), n) / size
        c = wp.dot(wp.cross(u, r), n) / size
        return W(real(1.0), b + c - real(1.0), -b, -c), wp.dot(r, n), n

    return near


@cache
def point_edge_function(real):
    """apart(p, a, b) -> (t, d, n): where on edge a b the closest point is, how far from p, and in which direction."""
    _, _, V = shape_types(real)
    Q = wp.types.vector(6, real)
    closest = closest_points.point_edge(real)

    @wp.func
    def apart(p: V, a: V, b: V):
        u = a - p
        e = b - a
        rho, _m, _o = closest(Q(u[0], u[1], u[2], e[0], e[1], e[2]))
        r = u + e * rho[1]
        d = wp.length(r)
        return rho[1], d, r / wp.where(d > real(0.0), d, real(1.0))

    return apart


@cache
def _edge_point(real):
    """`near` of an edge and a point, node 2."""
    X, W, V = shape_types(real)
    apart = point_edge_function(real)

    @wp.func
    def near(x: X):
        t, d, n = apart(x[2], x[0], x[1])
        return W(real(1.0) - t, t, real(-1.0), real(0.0)), d, n

    return near


@cache
def end_function(real):
    """end(x, k) -> (w, d, n) of end k of two edges, node k, and the other edge."""
    X, W, _ = shape_types(real)
    apart = point_edge_function(real)

    @wp.func
    def end(x: X, k: int):
        one, zero = real(1.0), real(0.0)
        first = wp.where(k < 2, 2, 0)
        t, d, n = apart(x[k], x[first], x[first + 1])
        is_first = wp.where(k == 0 or k == 2, one, zero)
        w = W(-is_first, is_first - one, one - t, t)
        if k >= 2:
            w = W(one - t, t, -is_first, is_first - one)
        return w, d, n

    return end


@cache
def end_functions(density: Density, real):
    """Half of G of end k of two edges: of_end(x, p, inner, k) -> (energy, gradient), row_of_end(x, p, inner, k) -> (w, v).

    Zero where it is not counted.
    """
    X, W, V = shape_types(real)
    E, I = wp.types.vector(1, real), wp.types.vector(4, int)
    end = end_function(real)
    energy_of, slope_of, curvature_of = density.laws(real, 1)
    others, half = I(2, 2, 0, 0), real(0.5)

    @wp.func
    def to_node(x: X, k: int, j: int):
        """(w, d, n) of nodes k and j."""
        w = W()
        for i in range(4):
            w[i] = wp.where(i == j, real(1.0), real(0.0)) - wp.where(i == k, real(1.0), real(0.0))
        r = x[j] - x[k]
        d = wp.length(r)
        return w, d, r / wp.where(d > real(0.0), d, real(1.0))

    @wp.func
    def of_end(x: X, p: V, inner: W, k: int):
        e = real(0.0)
        g = X()
        if inner[others[k]] >= real(0.0):
            w, d, n = end(x, k)
            f = slope_of(E(d), p)
            e = half * energy_of(E(d), p)
            g = wp.outer(w, n * (half * f[0]))
            if not wp.isinf(e):
                for i in range(2):
                    j = others[k] + i
                    wj, dj, nj = to_node(x, k, j)
                    fj = slope_of(E(dj), p)
                    e -= half * inner[j] * energy_of(E(dj), p)
                    g -= wp.outer(wj, nj * (half * inner[j] * fj[0]))
        return e, g

    @wp.func
    def row_of_end(x: X, p: V, inner: W, k: int):
        w = W()
        v = V()
        if inner[others[k]] >= real(0.0):
            w, d, n = end(x, k)
            stiffness = curvature_of(E(d), p)
            c = stiffness[0]
            for i in range(2):
                j = others[k] + i
                _w, dj, _n = to_node(x, k, j)
                less = curvature_of(E(dj), p)
                c -= inner[j] * less[0]
            v = n * wp.sqrt(half * wp.max(c, real(0.0)))
        return w, v

    return of_end, row_of_end


@cache
def bend_function(kind: Kind, density: Density, real):
    """bends(x, p, threshold, d) -> psi' / d where the energy is that of the distance d alone, else 0; see `pair_bend`."""
    X, W, V = shape_types(real)
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
    """Functions of nodes x, parameters p and, of edges, the threshold [m^4] of the mollifier and `inner`.

    `inner`, of the four nodes: 1/2 inside of a rod, 0 at its ends, -1 at edges of shells, against which no ends are counted.

    about(x, w, d, n, p, threshold, inner) -> (energy [J], gradient (4, 3) [N], m), of closest points (w, d, n) as `distance_function`
    has them, with the mollifier m; row(x, w, d, n, m, p, inner, k) -> (w, v), the k-th row w_i v of the factor; evaluate(x, p,
    threshold, inner) -> (energy, gradient); along(x, v, p, threshold, inner): derivative along v, whose reverse is a row of the exact
    Hessian.
    """
    X, W, V = shape_types(real)
    E = wp.types.vector(1, real)
    near = distance_function(kind, real)
    of_end, row_of_end = end_functions(density, real) if kind == EDGES else (None, None)
    mollify = mollifier_function(real)
    energy_of, slope_of, curvature_of = density.laws(real, 1)

    @wp.func
    def crossing(x: X):
        """|a x b|^2 of two edges and its derivative."""
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
        m, first, _second = mollify(square, threshold)
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

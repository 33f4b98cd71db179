"""Second fundamental form of a triangle, (b11, b12, b22) [m], from normals at the middles of its edges.

In the basis a1 = x1 - x0, a2 = x2 - x0, with edge i opposite to corner i and h_i the height over it,

    b11 = c0 + c1,   b12 = c0,   b22 = c0 + c2,   c_i = -2 h_i phi_i ,

phi_i the angle about edge i from the triangle's normal to the normal at the middle of the edge. For small angles this is b_ij =
-dn(a_i) . a_j with n linear between the mid-edge normals. Then c_i = -2 h_i sin(phi_i) (Grinspun, Gingold, Reisman and Zorin
2006, Weischedel 2012, Chen, Sastry, van Rees and Vouga 2018). The angle itself has the same limit on fine meshes, and two thirds of
the error of sin(phi) on a clamped strip that rolls up. It grows with the fold, so that an edge resists any fold below 180 degrees
and a normal cannot flip. By the kind of the edge:

    0 free:        phi = 0, the normal of the triangle
    1 neighbour:   phi = theta / 2, the mean of the two triangles' unit normals, theta the dihedral angle
    2 clamped:     phi = alpha, the angle to the prescribed unit normal N, as in `edge_tilt`
    3 symmetry:    as 1, with the mirrored triangle as neighbour; that is the normal projected into the plane and normalised

`midedge_curvature_dof` adds to phi of kinds 0 and 1 the sign of the edge times an angle xi of the edge, a dof. The normal rotates
about the edge as stored in the mesh, and is the same for both triangles. (Chen et al. 2018 call it a mid-edge director; Morley's
plate has this rotation.) At kinds 2 and 3 xi has no effect and must be fixed. Between flat triangles of equal heights the energy of
an edge is that of phi^2 = (theta / 2 + xi)^2 and (theta / 2 - xi)^2, least at xi = 0 for every theta. The angle theta jumps by 2 pi
where the surface folds onto itself.

Nodes: corners 0, 1, 2 and the corners 3, 4, 5 behind edges 0, 1, 2; a missing one may be any node. Data: the three kinds, the three
vectors (prescribed normal or unit normal of the plane), and, with angles, the three signs. w is the rest area [m^2].

Measured: (tests/kernels/test_shell_orders.py) averaged normals are consistent on uniform meshes (right or equilateral triangles), of
order 2 in the energy of exact shapes. Elsewhere their energy does not converge: with alternating diagonals it is 65 % too high for a
cylinder across them and 186 % for twist, on irregular meshes 5 to 35 %. With angles, relaxed, the order is 2 on every mesh. A free
edge without angle takes no moment of its triangle's normal, an error of order 1; an angle there removes it.
"""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import warp as wp

from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures.boundary_hinge_angle import mirror, tilt
from ddg_warp.kernels.measures.hinge_angle import dihedral


@cache
def _edge(real):
    """Return the device functions `value` and `derivatives` of one edge.

    `value(e, a, b, kind, N, xi) -> c`. `derivatives(...) -> (c, dc/de, dc/da, dc/db, dc/dxi)`. e runs along the edge as in the
    triangle, a to the triangle's corner, b to the corner behind the edge, all from the edge's first node.
    """
    V = wp.types.vector(3, real)
    angle, derivative = dihedral(real)
    mirrored = mirror(real)
    tilted = tilt(real)

    @wp.func
    def value(e: V, a: V, b: V, kind: real, N: V, xi: real):
        phi = xi
        if kind > real(2.5):
            phi = real(0.5) * angle(e, a, mirrored(a, N))
        elif kind > real(1.5):
            alpha, _e, _a = tilted(e, a, N)
            phi = alpha
        elif kind > real(0.5):
            phi = xi + real(0.5) * angle(e, a, b)
        return real(-2.0) * phi * wp.length(wp.cross(e, a)) / wp.length(e)

    @wp.func
    def turned(e: V, a: V, phi: real):
        """Return c = -2 h phi at constant phi, with derivatives: (c, dc/de, dc/da, dc/dphi)."""
        length = wp.length(e)
        n = wp.cross(e, a)
        unit = wp.normalize(n)
        h = wp.length(n) / length
        s = real(-2.0) * phi
        along = s / length
        return (
            s * h,
            (wp.cross(a, unit) - e * (h / length)) * along,
            wp.cross(unit, e) * along,
            real(-2.0) * h,
        )

    @wp.func
    def derivatives(e: V, a: V, b: V, kind: real, N: V, xi: real):
        half = real(0.5)
        if kind < real(0.5):
            c, de, da, dphi = turned(e, a, xi)
            return c, de, da, V(), dphi
        elif kind < real(1.5):
            theta, theta_e, theta_a, theta_b = derivative(e, a, b)
            c, de, da, dphi = turned(e, a, xi + half * theta)
            g = half * dphi
            return c, de + g * theta_e, da + g * theta_a, g * theta_b, dphi
        elif kind < real(2.5):
            alpha, alpha_e, alpha_a = tilted(e, a, N)
            c, de, da, dphi = turned(e, a, alpha)
            return c, de + dphi * alpha_e, da + dphi * alpha_a, V(), real(0.0)
        else:
            theta, theta_e, theta_a, theta_b = derivative(e, a, mirrored(a, N))
            c, de, da, dphi = turned(e, a, half * theta)
            g = half * dphi
            return c, de + g * theta_e, da + g * (theta_a + mirrored(theta_b, N)), V(), real(0.0)

    return value, derivatives


def _functions(measure_of):
    @cache
    def functions(real):
        Q, S, E, M = measure_of().types(real)
        V = wp.types.vector(3, real)
        value, derivatives = _edge(real)
        rotated = measure_of().angles > 0

        @wp.func
        def local(q: Q, i: int):
            return V(q[3 * i], q[3 * i + 1], q[3 * i + 2])

        @wp.func
        def target(s: S, i: int):
            return V(s[3 + 3 * i], s[4 + 3 * i], s[5 + 3 * i])

        @wp.func
        def sign(s: S, i: int):
            if wp.static(rotated):
                return s[12 + i]
            else:
                return real(0.0)

        @wp.func
        def rotation(q: Q, s: S, i: int):
            if wp.static(rotated):
                return sign(s, i) * q[15 + i]
            else:
                return real(0.0)

        @wp.func
        def strains(q: Q, s: S, w: real):
            a1 = local(q, 0)
            a2 = local(q, 1)
            c0 = value(a2 - a1, -a1, local(q, 2), s[0], target(s, 0), rotation(q, s, 0))
            c1 = value(-a2, a1 - a2, local(q, 3), s[1], target(s, 1), rotation(q, s, 1))
            c2 = value(a1, a2, local(q, 4), s[2], target(s, 2), rotation(q, s, 2))
            return E(c0 + c1, c0, c0 + c2)

        @wp.func
        def row(a1: V, a2: V, b0: V, b1: V, b2: V, xi: V):
            if wp.static(rotated):
                # fmt: off
                return Q(a1[0], a1[1], a1[2], a2[0], a2[1], a2[2], b0[0], b0[1], b0[2],
                         b1[0], b1[1], b1[2], b2[0], b2[1], b2[2], xi[0], xi[1], xi[2])
            else:
                return Q(
                    a1[0],
                    a1[1],
                    a1[2],
                    a2[0],
                    a2[1],
                    a2[2],
                    b0[0],
                    b0[1],
                    b0[2],
                    b1[0],
                    b1[1],
                    b1[2],
                    b2[0],
                    b2[1],
                    b2[2],
                )
                # fmt: on

        @wp.func
        def jacobian(q: Q, s: S, w: real):
            a1 = local(q, 0)
            a2 = local(q, 1)
            c0, e0, d0, b0, x0 = derivatives(a2 - a1, -a1, local(q, 2), s[0], target(s, 0), rotation(q, s, 0))
            c1, e1, d1, b1, x1 = derivatives(-a2, a1 - a2, local(q, 3), s[1], target(s, 1), rotation(q, s, 1))
            c2, e2, d2, b2, x2 = derivatives(a1, a2, local(q, 4), s[2], target(s, 2), rotation(q, s, 2))
            zero = real(0.0)
            none = V()
            row0 = row(-e0 - d0, e0, b0, none, none, V(x0 * sign(s, 0), zero, zero))
            row1 = row(d1, -e1 - d1, none, b1, none, V(zero, x1 * sign(s, 1), zero))
            row2 = row(e2, d2, none, none, b2, V(zero, zero, x2 * sign(s, 2)))
            return E(c0 + c1, c0, c0 + c2), wp.matrix_from_rows(row0 + row1, row0, row0 + row2)

        return strains, jacobian, None, None

    return functions


_EDGES = ((0, 1), (0, 2), (1, 3), (2, 4), (0, 5))
_STRAINS = ("b11 [m]", "b12 [m]", "b22 [m]")


def _sample(angles: int, random, count: int) -> dict:
    """Return edges of every kind; symmetry planes roughly contain the normal, clamps prescribe it."""
    some = [[0, 1, 2], [1, 2, 3], [2, 3, 0], [3, 0, 1], [1, 1, 1], [0, 1, 1], [1, 3, 1], [1, 2, 0]]
    kinds = np.resize(some, (count, 3)).T
    vectors = np.where((kinds == 3)[..., None], [1.0, 0.2, -0.1], [0.2, -0.1, 1.0])
    vectors = vectors + 0.2 * random.normal(size=vectors.shape)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    signs = np.sign(random.normal(size=(angles, count)))
    return {
        "nodes": 0.1 * np.array([[0, 0, 0], [10, 0, 0], [4, 9, 0], [13, 11, 3], [-7, 6, 3], [5, -8, 3]]),
        "data": np.concatenate([kinds, vectors.transpose(0, 2, 1).reshape(9, count), signs]),
        "felt": np.concatenate(
            [kinds >= 0, kinds == 1, (kinds <= 1)[:angles]]
        ),  # corners behind edges belong to neighbours
    }


midedge_curvature = Measure(
    "midedge_curvature",
    3,
    _EDGES,
    _STRAINS,
    _functions(lambda: midedge_curvature),
    data_size=12,
    vectors=(3, 6, 9),
    sample=partial(_sample, 0),
)
midedge_curvature_dof = replace(
    midedge_curvature,
    name="midedge_curvature_dof",
    functions=_functions(lambda: midedge_curvature_dof),
    angles=3,
    data_size=15,
    sample=partial(_sample, 3),
)

"""Angle about a mesh edge from the surface to the directors of a rod on that edge [rad]: rod-shell coupling.

The two triangles of the edge are at the angles beta_a and beta_b in its reference frame (u, v = t x u). That is the lagged frame
transported to the current tangent t. With a from the edge to the opposite corner, beta = atan2(a . v, a . u), continued past pi
from its lagged value. Normals rotate with the triangles. The mean rotation of the surface counts, with weight m. If the normal at
the middle of the edge has its own angle xi (`midedge_curvature_dof`), that is added:

    psi = theta - (1 - m) beta_a - m beta_b - r xi .

A symmetric fold about the edge does not change psi, so that the coupling adds no bending stiffness across. With m = h_a / (h_a +
h_b), h the heights of the triangles at rest, neither does a uniform curvature across. With xi, m = 1/2 as in the definition of that
normal.

Let h be the distance of a from the edge's line and n = (e x a) / |e x a| the direction in which beta grows. The frame, transported
in time, spins by z = (t0 x t) / (1 + t0 . t) (see `rod_curvature_twist`). Then

    d beta / da = n / h,   d beta / de = -n (a . t) / (h |e|) + z / |e| .

Singular where a triangle has no area, or the edge rotates by 180 degrees from its lagged tangent.

Nodes: 0, 1 on the edge in rod order, 2 and 3 opposite; of an edge with one triangle 3 is 2, and m = 0. Angles: theta, xi. Lagged
data: frame (u, t) of the edge; beta_a, beta_b. Data: m; r, +1 where the rod runs along the edge as stored in the mesh, -1 against it,
0 without xi, which may then be any angle.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.measures import Measure


@cache
def _functions(real):
    Q, S, E, M = rod_surface_angle.types(real)
    V = wp.types.vector(3, real)
    transport, angle_between, _ = parallel_transport.functions(real)
    nonzero = nonzero_function(real)

    @wp.func
    def angle(q: Q, s: S):
        t = wp.normalize(V(q[0], q[1], q[2]))
        u = transport(V(s[0], s[1], s[2]), V(s[3], s[4], s[5]), t)
        first = angle_between(u, V(q[3], q[4], q[5]), t, t, s[6])
        second = angle_between(u, V(q[6], q[7], q[8]), t, t, s[7])
        return q[9] - (real(1.0) - s[8]) * first - s[8] * second - s[9] * q[10]

    @wp.func
    def by_height(e: V, a: V):
        """Return n / h of a triangle with the sides e and a."""
        h = wp.cross(wp.normalize(e), a)
        return h / nonzero(wp.dot(h, h))

    @wp.func
    def strains(q: Q, s: S, w: real):
        return E(angle(q, s))

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        e = V(q[0], q[1], q[2])
        a = V(q[3], q[4], q[5])
        b = V(q[6], q[7], q[8])
        t0 = V(s[3], s[4], s[5])
        inverse = real(1.0) / wp.length(e)
        t = e * inverse
        z = wp.cross(t0, t) / (real(1.0) + wp.dot(t0, t))
        da = by_height(e, a) * (s[8] - real(1.0))
        db = by_height(e, b) * -s[8]
        de = (da * wp.dot(a, t) + db * wp.dot(b, t) + z) * -inverse
        return E(angle(q, s)), wp.matrix_from_rows(
            Q(de[0], de[1], de[2], da[0], da[1], da[2], db[0], db[1], db[2], real(1.0), -s[9])
        )

    return strains, jacobian, None, None


@cache
def _advance(real):
    Q, S, _, _ = rod_surface_angle.types(real)
    V, L = wp.types.vector(3, real), wp.types.vector(2, real)
    _, angle_between, _ = parallel_transport.functions(real)

    @wp.func
    def advance(q: Q, s: S):
        """Return the angles of both triangles in the frame of the edge."""
        u = V(s[0], s[1], s[2])
        t = V(s[3], s[4], s[5])
        return L(angle_between(u, V(q[3], q[4], q[5]), t, t, s[6]), angle_between(u, V(q[6], q[7], q[8]), t, t, s[7]))

    return advance


def _sample(random, count: int) -> dict:
    """Return edges with two triangles or one, and xi of either sign or none."""
    weight, sign = random.uniform(0.2, 0.8, count), np.arange(count) % 3 - 1.0
    weight[count // 2] = 0.0
    dependent = np.ones((6, count), bool)
    dependent[3], dependent[5] = weight > 0.0, sign != 0.0
    return {"data": np.stack([weight, sign]), "felt": dependent}


rod_surface_angle = Measure(
    "rod_surface_angle",
    3,
    ((0, 1), (0, 2), (0, 3)),
    ("angle [rad]",),
    _functions,
    angles=2,
    frames=1,
    lag_size=8,
    data_size=2,
    advance=_advance,
    sample=_sample,
)

"""Angle between a triangle's normal and a target normal about an edge [rad]: half a hinge, at a clamp or a symmetry plane.

Nodes 0, 1 on the edge (the way the triangle runs it), 2 opposite. With e = x1 - x0, a = x2 - x0, n = e x a:

    clamped:  alpha = atan2((n x N) . e / |e|, n . N), N the prescribed unit normal;
    symmetry: alpha = theta / 2, theta the angle of the hinge with the mirrored triangle, whose corner is a - 2 (a . N) N with N the
              unit normal of the plane, in which the edge lies: the normal on the edge stays in the plane.

Data: kind (2 clamped, 3 symmetry), N (3). Signs as in `hinge_angle`. Half of the mirrored hinge, whose angle is 2 alpha, has the
energy k w alpha^2 / 2 with w = |e|^2 / A_e, A_e a third of the one triangle's rest area.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.measures import Measure
from ddg_warp.kernels.measures.hinge_angle import dihedral


@cache
def mirror(real):
    """Return the device function `mirrored(a, N)`: a vector mirrored at the plane with the unit normal N."""
    V = wp.types.vector(3, real)

    @wp.func
    def mirrored(a: V, N: V):
        return a - N * (real(2.0) * wp.dot(a, N))

    return mirrored


@cache
def tilt(real):
    """Return the device function `tilted(e, a, N) -> (alpha, dalpha/de, dalpha/da)` of a triangle clamped with the normal N."""
    V, nonzero = wp.types.vector(3, real), nonzero_function(real)

    @wp.func
    def tilted(e: V, a: V, N: V):
        # y = (n x N) . t / |e| and x = n . N / |e| with t = e / |e|; n x N . e = (a . e) (N . e) - (N . a) |e|^2
        length = wp.length(e)
        t = e / length
        N_t = wp.dot(N, t)
        a_t = wp.dot(a, t)
        N_a = wp.dot(N, a)
        y = a_t * N_t - N_a
        x = wp.dot(wp.cross(t, a), N)
        y_e = N * a_t + a * N_t - t * (a_t * N_t + N_a)
        y_a = (t * N_t - N) * length
        scale = real(1.0) / (length * nonzero(x * x + y * y))
        return (
            wp.atan2(y, x),
            (y_e * x - wp.cross(a, N) * y) * scale,
            (y_a * x - wp.cross(N, e) * y) * scale,
        )

    return tilted


@cache
def _functions(real):
    Q, S, E, M = edge_tilt.types(real)
    V = wp.types.vector(3, real)
    angle, derivative = dihedral(real)
    mirrored = mirror(real)
    tilted = tilt(real)

    @wp.func
    def derivatives(q: Q, s: S):
        e = V(q[0], q[1], q[2])
        a = V(q[3], q[4], q[5])
        N = V(s[1], s[2], s[3])
        half = real(0.5)
        if s[0] > real(2.5):
            theta, de, da, db = derivative(e, a, mirrored(a, N))
            return half * theta, half * de, half * (da + mirrored(db, N))
        else:
            alpha, alpha_e, alpha_a = tilted(e, a, N)
            return alpha, alpha_e, alpha_a

    @wp.func
    def strains(q: Q, s: S, w: real):
        alpha, _e, _a = derivatives(q, s)
        return E(alpha)

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        alpha, e, a = derivatives(q, s)
        return E(alpha), wp.matrix_from_rows(Q(e[0], e[1], e[2], a[0], a[1], a[2]))

    return strains, jacobian, None, None


def _sample(random, count: int) -> dict:
    """Return alternating clamps and symmetry planes, with normals some 25 degrees away."""
    kind = 2.0 + np.arange(count) % 2
    normal = np.where(kind[:, None] > 2.5, [0.1, 0.2, 1.0], [0.2, -1.0, 0.1]) + 0.2 * random.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return {"data": np.vstack([kind, normal.T])}


edge_tilt = Measure(
    "edge_tilt", 3, ((0, 1), (0, 2)), ("angle [rad]",), _functions, data_size=4, vectors=(1,), sample=_sample
)

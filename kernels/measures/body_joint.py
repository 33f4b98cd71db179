"""Strains of joints between two rigid bodies: separation of a common point, and rotation of one body relative to the other.

`separation`: x_2 - x_1 of the point as carried by each body [m], of ball joints and of the joints below.

`hinge`: the separation, then the rotation of the second body relative to the first about an axis. Both bodies carry a ghost edge along
the axis, with a director. Bending and twist between the ghosts are the strains of a rod vertex (`rod_curvature_twist`) without a
length. These are 2 tan(phi/2) about both directors [1], zero where the axes agree, and the angle theta about the axis [rad], which
counts revolutions.

Ghosts rotate with their bodies, as at rigid joints; see `joint_curvature_twist` for the rows of their rotation vectors. Dofs:
x_2 - x_1 (3), rotation vectors of both bodies (3 each). Lagged data: (u, t) of both ghosts, reference twist.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.measures import Measure, lagged_frames
from ddg_warp.kernels.measures.joint_curvature_twist import ghost_function, rotations
from ddg_warp.kernels.measures.rod_curvature_twist import rod_curvature_twist

SEPARATION = ("separation_x [m]", "separation_y [m]", "separation_z [m]")


@cache
def _separation_functions(real):
    Q, S, E, _ = separation.types(real)

    @wp.func
    def strains(q: Q, s: S, w: real):
        return E(q[0], q[1], q[2])

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        return E(q[0], q[1], q[2]), wp.identity(n=3, dtype=real)

    return strains, jacobian, None, None


@cache
def _hinge_functions(real):
    Q, S, E, J = hinge.types(real)
    R, T, _, _ = rod_curvature_twist.types(real)
    V = wp.types.vector(3, real)
    rod_strains, rod_jacobian, *_ = rod_curvature_twist.functions(real)
    turned, transposed, *_ = rotations(real)

    @wp.func
    def vertex(q: Q, s: S):
        """Return dofs and lagged data of the rod vertex between both ghosts, and their tangents."""
        first, second = V(q[3], q[4], q[5]), V(q[6], q[7], q[8])
        u1 = turned(first, V(s[0], s[1], s[2]))
        t1 = turned(first, V(s[3], s[4], s[5]))
        u2 = turned(second, V(s[6], s[7], s[8]))
        t2 = turned(second, V(s[9], s[10], s[11]))
        r = R(t1[0], t1[1], t1[2], t2[0], t2[1], t2[2], real(0.0), real(0.0))
        lag = T(u1[0], u1[1], u1[2], t1[0], t1[1], t1[2], u2[0], u2[1], u2[2], t2[0], t2[1], t2[2], s[12])
        return r, lag, t1, t2

    @wp.func
    def strains(q: Q, s: S, w: real):
        r, lag, _t1, _t2 = vertex(q, s)
        e = rod_strains(r, lag, real(1.0))
        return E(q[0], q[1], q[2], e[0], e[1], e[2])

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        r, lag, t1, t2 = vertex(q, s)
        e, j = rod_jacobian(r, lag, real(1.0))
        rows = J()
        for i in range(3):
            rows[i, i] = real(1.0)
            k = j[i]
            a = transposed(V(q[3], q[4], q[5]), wp.cross(t1, V(k[0], k[1], k[2])) + t1 * k[6])
            b = transposed(V(q[6], q[7], q[8]), wp.cross(t2, V(k[3], k[4], k[5])) + t2 * k[7])
            for d in range(3):
                rows[3 + i, 3 + d] = a[d]
                rows[3 + i, 6 + d] = b[d]
        return E(q[0], q[1], q[2], e[0], e[1], e[2]), rows

    return strains, jacobian, None, None


@cache
def _advance(real):
    Q, S, _, _ = hinge.types(real)
    V, L = wp.types.vector(3, real), wp.types.vector(13, real)
    _, reference_twist, _ = parallel_transport.functions(real)
    ghost = ghost_function(real)

    @wp.func
    def advance(q: Q, s: S):
        """Return the ghosts, rotated by their bodies, and the angle between them."""
        first, second = V(q[3], q[4], q[5]), V(q[6], q[7], q[8])
        u1, t1 = ghost(first, V(s[0], s[1], s[2]), V(s[3], s[4], s[5]))
        u2, t2 = ghost(second, V(s[6], s[7], s[8]), V(s[9], s[10], s[11]))
        m = reference_twist(u1, u2, t1, t2, s[12])
        return L(u1[0], u1[1], u1[2], t1[0], t1[1], t1[2], u2[0], u2[1], u2[2], t2[0], t2[1], t2[2], m)

    return advance


def _sample(random, count: int) -> dict:
    """Return ghosts about a common axis, twisted by about half a revolution."""
    along = np.repeat(np.eye(3)[:1], count, axis=0)
    ghosts = [lagged_frames(random, along) for _ in range(2)]
    return {"lag": np.concatenate([*ghosts, 3.0 * random.normal(size=(1, count))])}


separation = Measure("separation", 3, ((0, 1),), SEPARATION, _separation_functions)
hinge = Measure(
    "hinge",
    3,
    ((0, 1),),
    (*SEPARATION, "bend_1 [1]", "bend_2 [1]", "angle [rad]"),
    _hinge_functions,
    spins=2,
    lag_size=13,
    advance=_advance,
    vectors=(0, 3, 6, 9),
    sample=_sample,
)

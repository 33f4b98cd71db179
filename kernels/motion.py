"""Motion of supports over a time step on the device, as `ddg_warp.scene.motion.Motion.pose` describes it.

A pose is a row of an array: the rotation vector of the step (3), the rotation at its start (9), the pivot (3), the translations
at its start and end (3 each). s is the fraction of the step; the turn runs at a constant rate, so that no part of it is a chord.

Supports are at the end of the part of the step that is taken; for the midpoint rule positions are the mean of those at both of its
ends, so that the extrapolated ones are exact, and angles and normals those in the middle.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames
from ddg_warp.kernels.gather import column_of, point_functions
from ddg_warp.kernels.islands import PORTION, PROGRESS

POSE = 21  # reals of a motion over a step


@cache
def functions(real):
    """turned(pose, m, s, v): a vector of the rest state; placed(pose, m, s, rest): a point of it; branch(...): see there."""
    X = wp.types.vector(3, real)
    turn = wp.constant(real(6.283185307179586476925286766559))

    @wp.func
    def row(pose: wp.array2d(dtype=real), m: int, at: int):
        return X(pose[m, at], pose[m, at + 1], pose[m, at + 2])

    @wp.func
    def turned(pose: wp.array2d(dtype=real), m: int, s: real, v: X):
        """v of the rest state, rotated to the fraction s of the step (Rodrigues)."""
        w = X(wp.dot(row(pose, m, 3), v), wp.dot(row(pose, m, 6), v), wp.dot(row(pose, m, 9), v))
        rotation = row(pose, m, 0) * s
        angle = wp.length(rotation)
        if angle > real(0.0):
            axis = rotation / angle
            w = (
                w * wp.cos(angle)
                + wp.cross(axis, w) * wp.sin(angle)
                + axis * (wp.dot(axis, w) * (real(1.0) - wp.cos(angle)))
            )
        return w

    @wp.func
    def placed(pose: wp.array2d(dtype=real), m: int, s: real, rest: X):
        pivot = row(pose, m, 12)
        shift = row(pose, m, 15) * (real(1.0) - s) + row(pose, m, 18) * s
        return turned(pose, m, s, rest - pivot) + pivot + shift

    @wp.func
    def branch(pose: wp.array2d(dtype=real), m: int, s0: real, s1: real, rest: X, u: X, t: X, angle0: real):
        """Angle from u about t to the director `rest` at s1, on the branch that the rotation since s0 leads to from angle0."""
        d = turned(pose, m, s1, rest)
        angle = wp.atan2(wp.dot(wp.cross(u, d), t), wp.dot(u, d))
        expected = angle0 + wp.dot(row(pose, m, 0), t) * (s1 - s0)
        return angle - turn * wp.round((angle - expected) / turn)

    return turned, placed, branch


@cache
def reached_function(real, midpoint: bool):
    """reached(scalars, i): fraction of the step that a solve of island i is about."""

    @wp.func
    def reached(scalars: wp.array2d(dtype=real), i: int):
        if wp.static(midpoint):
            return scalars[PROGRESS, i] + real(0.5) * scalars[PORTION, i]
        else:
            return scalars[PROGRESS, i] + scalars[PORTION, i]

    return reached


@cache
def support_kernels(dim: int, real, midpoint: bool):
    """nodes(...) and angles(...) of an iterate, put where their motions have them."""
    X, V = wp.types.vector(3, real), wp.types.vector(dim, real)
    get, put = point_functions(dim, real)
    transport, *_ = frames.functions(real)
    _, placed, branch = functions(real)
    reached = reached_function(real, midpoint)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def nodes(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=X),
        pose: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        columns: int,
        x: wp.array2d(dtype=V),
    ):
        """`where` is the place, then the pose of each component, -1 for none; `rest` the position at rest."""
        i, w = wp.tid()
        place = where[i, 0]
        r = column_of(place, w, columns)
        start = scalars[PROGRESS, r]
        if start >= real(1.0):
            return
        here = get(x, place, w, columns)
        for d in range(3):
            m = where[i, 1 + d]
            if m >= 0:
                p = placed(pose, m, start + scalars[PORTION, r], rest[i])
                if wp.static(midpoint):
                    p = real(0.5) * (p + placed(pose, m, start, rest[i]))
                here[d] = p[d]
        put(x, place, w, columns, here)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def angles(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=X),
        pose: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        columns: int,
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
        theta: wp.array2d(dtype=real),
    ):
        """`where` is the angle, its edge, the nodes of that and the pose, `rest` the edge's first material director at rest."""
        i, w = wp.tid()
        r = column_of(where[i, 0], w, columns)
        start = scalars[PROGRESS, r]
        if start >= real(1.0):
            return
        t = wp.normalize(get(x, where[i, 3], w, columns) - get(x, where[i, 2], w, columns))
        e = where[i, 1] / columns
        u = transport(
            X(frame[0, e, r], frame[1, e, r], frame[2, e, r]), X(frame[3, e, r], frame[4, e, r], frame[5, e, r]), t
        )
        k = where[i, 0] / columns
        theta[k, r] = branch(pose, where[i, 4], start, reached(scalars, r), rest[i], u, t, theta[k, r])

    return nodes, angles

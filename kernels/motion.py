"""Motion of supports over a time step on the device, as `ddg_warp.scene.motion.Motion.pose` describes it.

A pose is a row of an array: the rotation vector of the step (3), the rotation at its start (9), the pivot (3), the translations
at its start and end (3 each). s is the fraction of the step; the turn runs at a constant rate, so that no part of it is a chord.
Where worlds are moved each for itself, by `Grip`, the rows of one world follow those of another, `stride` apart, which else is zero.

Supports are at the end of the part of the step that is taken; for the midpoint rule positions are the mean of those at both of its
ends, so that the extrapolated ones are exact, and angles and normals those in the middle.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames
from ddg_warp.kernels.gather import column_of, point_functions
from ddg_warp.kernels.islands import PORTION, PROGRESS
from ddg_warp.kernels.threads import CPU_OPTIONS

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

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def nodes(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=X),
        pose: wp.array2d(dtype=real),
        stride: int,
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
                m += w * stride
                p = placed(pose, m, start + scalars[PORTION, r], rest[i])
                if wp.static(midpoint):
                    p = real(0.5) * (p + placed(pose, m, start, rest[i]))
                here[d] = p[d]
        put(x, place, w, columns, here)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def angles(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=X),
        pose: wp.array2d(dtype=real),
        stride: int,
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
        theta[k, r] = branch(pose, where[i, 4] + w * stride, start, reached(scalars, r), rest[i], u, t, theta[k, r])

    return nodes, angles


@cache
def grip_kernel(real):
    """Poses of all motions over a step, world by world: those of grips between two states, of functions of time as they are given."""
    X, Q = wp.types.vector(3, real), wp.types.quaternion(real)

    @wp.func
    def row(values: wp.array2d(dtype=real), first: int, i: int):
        return X(values[first, i], values[first + 1, i], values[first + 2, i])

    @wp.func
    def quaternion(rotation: X):
        angle = wp.length(rotation)
        q = Q(real(0.0), real(0.0), real(0.0), real(1.0))
        if angle > real(0.0):
            v = rotation * (wp.sin(real(0.5) * angle) / angle)
            q = Q(v[0], v[1], v[2], wp.cos(real(0.5) * angle))
        return q

    @wp.func
    def turn_between(r0: X, r1: X):
        """The rotation vector of the shortest turn from one orientation to another, exactly none where they are the same."""
        q = quaternion(r1) * wp.quat_inverse(quaternion(r0))
        v = X(q[0], q[1], q[2])
        if q[3] < real(0.0):
            v = -v
        size = wp.length(v)
        if size == real(0.0) or r0 == r1:
            return X()
        return v * (real(2.0) * wp.atan2(size, wp.abs(q[3])) / size)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def grip(
        grips: wp.array(dtype=int),
        count: int,
        shared: wp.array2d(dtype=real),
        before: wp.array2d(dtype=real),
        after: wp.array2d(dtype=real),
        pose_out: wp.array2d(dtype=real),
    ):
        """`grips` is the number of the grip of each row, among `count`, -1 where it is a function of time."""
        m, w = wp.tid()
        at = m + w * grips.shape[0]
        for c in range(wp.static(POSE)):
            pose_out[at, c] = shared[m, c]
        if grips[m] < 0:
            return
        i = grips[m] + w * count
        r0 = row(before, 3, i)
        turn = turn_between(r0, row(after, 3, i))
        rotation = wp.quat_to_matrix(quaternion(r0))
        for d in range(3):
            pose_out[at, d] = turn[d]
            for e in range(3):
                pose_out[at, 3 + 3 * d + e] = rotation[d, e]
            pose_out[at, 15 + d] = before[d, i]
            pose_out[at, 18 + d] = after[d, i]

    return grip

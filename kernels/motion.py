"""Rigid motions over a time step on the device, as `ddg_warp.scene.motion.Motion.pose` describes them.

A pose is a row of an array: the rotation vector of the step (3), the rotation at its start (9), the pivot (3), the translations
at its start and end (3 each). s is the fraction of the step; the turn runs at a constant rate, so that no part of it is a chord.
"""

from functools import cache

import warp as wp

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

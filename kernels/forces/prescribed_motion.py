"""Prescribed motion of supports over a time step on the device, as in `ddg_warp.scene.prescribed_motion.Motion.pose`.

A pose is a row of an array: rotation vector of the step (3), rotation at its start (9), pivot (3), translations at start and end (3
    each). The fraction of the step is s. The rotation has a constant rate, so that substeps follow arcs, not chords. For grips,
    which differ by world, rows of worlds follow each other with `stride`, which is zero otherwise. For a step in K = 2^k intervals
    (`solve.collision.support_arcs`), K sets of `rows` follow the sets of all coarser intervals. A set is the motion of an interval,
    extended to the whole step, so that s means the same.

Supports are at the end of the current substep. With the midpoint rule positions are the mean of both ends, so that extrapolated
positions are exact; angles and normals are at the middle.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.core.dof_map import column_of, point_functions
from ddg_warp.kernels.core.islands import FAILURE_STATUS, INTERVAL, STATUS, STEP_PROGRESS, SUBSTEP, SUBSTEP_FRACTION
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements import parallel_transport

POSE = 21  # Reals of a motion over a step.
MAX_SUBSTEPS = 1024  # Maximum substeps of a step.
HALF = 1e-6  # Tolerance of half a revolution, as half the angle [rad].
COUNTED = 3.1415926535897932 + HALF  # Length of a rotation vector above which it counts revolutions [rad].
SLACK = 1.0 - 1e-6  # Factor on rotations that substeps have to resolve, for rounding.


@cache
def functions(real):
    """Return the device functions `turned`, `placed` and `branch` of a pose.

    `turned(pose, m, s, v)`: a rotated vector.
    `placed(pose, m, s, rest)`: a moved point.
    `branch(...)`: the twist angle of a rotated director.
    """
    X = wp.types.vector(3, real)
    full_turn = wp.constant(real(6.283185307179586476925286766559))

    @wp.func
    def row(pose: wp.array2d(dtype=real), m: int, entry: int):
        return X(pose[m, entry], pose[m, entry + 1], pose[m, entry + 2])

    @wp.func
    def turned(pose: wp.array2d(dtype=real), m: int, s: real, v: X):
        """Return v of the rest state, rotated to the fraction s of the step (Rodrigues)."""
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
        """Return the angle from u about t to the director `rest` at s1, on the branch that follows from angle0 at s0."""
        d = turned(pose, m, s1, rest)
        angle = wp.atan2(wp.dot(wp.cross(u, d), t), wp.dot(u, d))
        expected = angle0 + wp.dot(row(pose, m, 0), t) * (s1 - s0)
        return angle - full_turn * wp.round((angle - expected) / full_turn)

    return turned, placed, branch


@cache
def row_function(real):
    """Return the device function `row(scalars, i, rows)`: the first row of the interval of a solve of island i."""

    @wp.func
    def row(scalars: wp.array2d(dtype=real), i: int, rows: int):
        parts = real(1.0) / scalars[INTERVAL, i]
        return (int(parts) - 1 + int(wp.floor(scalars[STEP_PROGRESS, i] * parts))) * rows

    return row


@cache
def reached_function(real, midpoint: bool):
    """Return the device function `reached(scalars, i)`: the fraction of the step at the solve of island i."""

    @wp.func
    def reached(scalars: wp.array2d(dtype=real), i: int):
        if wp.static(midpoint):
            return scalars[STEP_PROGRESS, i] + real(0.5) * scalars[SUBSTEP_FRACTION, i]
        else:
            return scalars[STEP_PROGRESS, i] + scalars[SUBSTEP_FRACTION, i]

    return reached


@cache
def support_kernels(dim: int, real, midpoint: bool):
    """Build the kernels of prescribed motion.

    `nodes`: write positions of supports.
    `angles`: write twist angles of supports.
    """
    X, V = wp.types.vector(3, real), wp.types.vector(dim, real)
    get, put_point = point_functions(dim, real)
    transport, *_ = parallel_transport.functions(real)
    _, placed, branch = functions(real)
    reached, row = reached_function(real, midpoint), row_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def nodes(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=X),
        pose: wp.array2d(dtype=real),
        stride: int,
        rows: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        columns: int,
        x: wp.array2d(dtype=V),
    ):
        """Write positions; `where` is the dof index, then the pose of each component, -1 for none, `rest` the rest position."""
        i, w = wp.tid()
        dof_index = where[i, 0]
        r = column_of(dof_index, w, columns)
        start = scalars[STEP_PROGRESS, r]
        if start >= real(1.0):
            return
        position = get(x, dof_index, w, columns)
        first = w * stride + row(scalars, r, rows)
        for d in range(3):
            m = where[i, 1 + d]
            if m >= 0:
                m += first
                p = placed(pose, m, start + scalars[SUBSTEP_FRACTION, r], rest[i])
                if wp.static(midpoint):
                    p = real(0.5) * (p + placed(pose, m, start, rest[i]))
                position[d] = p[d]
        put_point(x, dof_index, w, columns, position)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def angles(
        where: wp.array2d(dtype=int),
        rest: wp.array(dtype=X),
        pose: wp.array2d(dtype=real),
        stride: int,
        rows: int,
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        columns: int,
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
        theta: wp.array2d(dtype=real),
    ):
        """Write twist angles; `where` is the angle, its edge, both nodes and the pose, `rest` the first material director at rest."""
        i, w = wp.tid()
        r = column_of(where[i, 0], w, columns)
        start = scalars[STEP_PROGRESS, r]
        if start >= real(1.0):
            return
        t = wp.normalize(get(x, where[i, 3], w, columns) - get(x, where[i, 2], w, columns))
        e = where[i, 1] / columns
        u = transport(
            X(frame[0, e, r], frame[1, e, r], frame[2, e, r]), X(frame[3, e, r], frame[4, e, r], frame[5, e, r]), t
        )
        k = where[i, 0] / columns
        m = where[i, 4] + w * stride + row(scalars, r, rows)
        theta[k, r] = branch(pose, m, start, reached(scalars, r), rest[i], u, t, theta[k, r])

    return nodes, angles


@cache
def grip_kernel(real, arcs: bool):
    """Build the kernel of poses.

    `grip`: write poses of all motions over a step, world by world, of grips between two states and of functions of time as given.

    With `arcs` it also writes the substeps that resolve the arcs of grips.
    """
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
        """Return the rotation vector of the shortest rotation between two orientations, exactly zero if equal.

        A rotation by 180 degrees has the direction of r1 - r0. Rotation vectors that count revolutions give nan: see
        `rotations_between`.
        """
        if wp.length(r1) > real(wp.static(COUNTED)) and wp.length(r1 - r0) > real(wp.static(COUNTED)):
            return X(real(wp.nan), real(wp.nan), real(wp.nan))
        q = quaternion(r1) * wp.quat_inverse(quaternion(r0))
        v = X(q[0], q[1], q[2])
        flip = q[3] < real(0.0)
        if wp.abs(q[3]) < real(wp.static(HALF)):
            flip = wp.dot(v, r1 - r0) < real(0.0)
        if flip:
            v = -v
        size = wp.length(v)
        if size == real(0.0) or r0 == r1:
            return X()
        return v * (real(2.0) * wp.atan2(size, wp.abs(q[3])) / size)

    @wp.func
    def largest_turn(arms: wp.array2d(dtype=X), g: int, axis: X, allowed: real):
        """Return the largest rotation about `axis` [rad] with chords within `allowed` of the arcs of `arms` (grips, points)."""
        far = real(0.0)
        for p in range(arms.shape[1]):
            far = wp.max(far, wp.length(wp.cross(axis, arms[g, p])))
        if real(2.0) * far <= allowed:
            return real(wp.inf)
        return real(4.0) * wp.asin(wp.sqrt(real(0.5) * wp.min(real(1.0), allowed / far)))

    @wp.func
    def parts_of(
        w: int,
        count: int,
        before: wp.array2d(dtype=real),
        after: wp.array2d(dtype=real),
        arms: wp.array2d(dtype=X),
        allowed: wp.array2d(dtype=real),
        most: wp.array2d(dtype=real),
        parts: real,
    ):
        """Return the number of substeps that resolve all grips: a power of two >= `parts`, above `MAX_SUBSTEPS` if too many."""
        for g in range(count):
            r0 = row(before, 3, g + w * count)
            rotation = turn_between(r0, row(after, 3, g + w * count))
            angle = wp.length(rotation)
            if angle > real(0.0):
                axis = wp.quat_rotate_inv(quaternion(r0), rotation / angle)
                largest = wp.min(most[w, g], largest_turn(arms, g, axis, allowed[w, g]))
                while parts * largest < real(wp.static(SLACK)) * angle and parts <= real(
                    wp.static(float(MAX_SUBSTEPS))
                ):
                    parts *= real(2.0)
        return parts

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def grip(
        grips: wp.array(dtype=int),
        count: int,
        shared: wp.array2d(dtype=real),
        before: wp.array2d(dtype=real),
        after: wp.array2d(dtype=real),
        arms: wp.array2d(dtype=X),
        allowed: wp.array2d(dtype=real),
        most: wp.array2d(dtype=real),
        pose_out: wp.array2d(dtype=real),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        tally: wp.array(dtype=wp.int64),
    ):
        """Write poses; `grips` is the grip of each row, among `count`, -1 for a function of time.

        Worlds whose arcs are not resolved fail; see `kernels.stepping.time_step.advance_kernel` for `tally`.
        """
        n, w = wp.tid()
        if wp.static(arcs):
            if n == 0:
                parts = parts_of(w, count, before, after, arms, allowed, most, real(1.0) / scalars[INTERVAL, w])
                if parts > real(wp.static(float(MAX_SUBSTEPS))) and flags[STATUS, w] != wp.static(outcome.STEP_FAILED):
                    flags[STATUS, w] = wp.static(outcome.STEP_FAILED)
                    flags[FAILURE_STATUS, w] = wp.static(outcome.ROTATED_TOO_FAR)
                    wp.atomic_add(tally, wp.static(outcome.ROTATED_TOO_FAR), wp.int64(1))
                scalars[SUBSTEP, w] = real(1.0) / parts
        m, pose_row = n % grips.shape[0], n + w * shared.shape[0]
        for c in range(wp.static(POSE)):
            pose_out[pose_row, c] = shared[n, c]
        if grips[m] < 0:
            return
        i = grips[m] + w * count
        r0 = row(before, 3, i)
        rotation_vector = turn_between(r0, row(after, 3, i))
        rotation = wp.quat_to_matrix(quaternion(r0))
        for d in range(3):
            pose_out[pose_row, d] = rotation_vector[d]
            for e in range(3):
                pose_out[pose_row, 3 + 3 * d + e] = rotation[d, e]
            pose_out[pose_row, 15 + d] = before[d, i]
            pose_out[pose_row, 18 + d] = after[d, i]

    return grip

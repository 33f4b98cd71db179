"""Lagged data of a net: frames of rod edges, reference twist of vertices, ghosts of rigid joints, angles of glued triangles.

Worlds whose flag `moved` is zero take over what is `kept`, untouched.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels import frames
from ddg_warp.kernels.measures.joint_curvature_twist import rotations


@cache
def functions(real):
    """row(a, i, k) -> vector from three rows of an array; put(a, i, k, v)."""
    V = wp.types.vector(3, real)

    @wp.func
    def row(a: wp.array2d(dtype=real), i: int, k: int):
        return V(a[i, k], a[i + 1, k], a[i + 2, k])

    @wp.func
    def put(a: wp.array2d(dtype=real), i: int, k: int, v: V):
        for d in range(3):
            a[i + d, k] = v[d]

    return row, put


@cache
def edge_kernel(real):
    """Frames of rod edges, transported to the tangents of positions q and orthonormalised."""
    V = wp.types.vector(3, real)
    row, put = functions(real)
    transport, *_ = frames.functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def edges(
        q: wp.array(dtype=V),
        ends: wp.array2d(dtype=int),
        blocks: int,
        moved: wp.array(dtype=int),
        kept: wp.array2d(dtype=real),
        frame: wp.array2d(dtype=real),
        frame_out: wp.array2d(dtype=real),
    ):
        f = wp.tid()
        count = ends.shape[0]
        world = f / count
        if moved[world] == 0:
            for c in range(6):
                frame_out[c, f] = kept[c, f]
            return
        i = f - world * count
        t = wp.normalize(q[ends[i, 1] + world * blocks] - q[ends[i, 0] + world * blocks])
        u = transport(row(frame, 0, f), row(frame, 3, f), t)
        put(frame_out, 0, f, wp.normalize(u - t * wp.dot(u, t)))
        put(frame_out, 3, f, t)

    return edges


@cache
def lag_kernel(measure, real):
    """Own lagged rows of elements of a measure with frames, which are up to date, as the positions are."""
    return {
        "rod_curvature_twist": vertex_kernel,
        "rod_curvature_twist_angle": vertex_kernel,
        "joint_curvature_twist": joint_kernel,
        "joint_curvature_twist_angle": joint_kernel,
        "rod_surface_angle": surface_kernel,
    }[measure.name](real)


@cache
def vertex_kernel(real):
    """Reference twist of rod vertices, whose slots are three nodes and the angles of both edges."""
    V = wp.types.vector(3, real)
    row, _ = functions(real)
    _, reference_twist, _ = frames.functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def vertices(
        q: wp.array(dtype=V),
        frame: wp.array2d(dtype=real),
        slots: wp.array2d(dtype=int),
        data: wp.array2d(dtype=real),
        blocks: int,
        angle_start: int,
        edges: int,
        moved: wp.array(dtype=int),
        kept: wp.array2d(dtype=real),
        lag: wp.array2d(dtype=real),
        lag_out: wp.array2d(dtype=real),
    ):
        tid = wp.tid()
        count = slots.shape[1]
        world = tid / count
        if moved[world] == 0:
            lag_out[0, tid] = kept[0, tid]
            return
        e = tid - world * count
        a = slots[3, e] - angle_start + world * edges
        b = slots[4, e] - angle_start + world * edges
        lag_out[0, tid] = reference_twist(
            row(frame, 0, a), row(frame, 0, b), row(frame, 3, a), row(frame, 3, b), lag[0, tid]
        )

    return vertices


@cache
def joint_kernel(real):
    """Ghost edges of rigid joints, turned by the joint's rotation, and the reference twist to the edges that meet it."""
    V = wp.types.vector(3, real)
    row, put = functions(real)
    _, reference_twist, _ = frames.functions(real)
    turned, _ = rotations(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def joints(
        q: wp.array(dtype=V),
        frame: wp.array2d(dtype=real),
        slots: wp.array2d(dtype=int),
        data: wp.array2d(dtype=real),
        blocks: int,
        angle_start: int,
        edges: int,
        moved: wp.array(dtype=int),
        kept: wp.array2d(dtype=real),
        lag: wp.array2d(dtype=real),
        lag_out: wp.array2d(dtype=real),
    ):
        tid = wp.tid()
        count = slots.shape[1]
        world = tid / count
        if moved[world] == 0:
            for c in range(7):
                lag_out[c, tid] = kept[c, tid]
            return
        e = tid - world * count
        omega = q[slots[3, e] + world * blocks]
        t = wp.normalize(turned(omega, row(lag, 3, tid)))
        u = turned(omega, row(lag, 0, tid))
        u = wp.normalize(u - t * wp.dot(u, t))
        f = slots[2, e] - angle_start + world * edges
        put(lag_out, 0, tid, u)
        put(lag_out, 3, tid, t)
        lag_out[6, tid] = reference_twist(u, row(frame, 0, f), t, row(frame, 3, f) * data[0, e], lag[6, tid])

    return joints


@cache
def surface_kernel(real):
    """Angles of the two triangles beside a glued rod edge in the edge's frame."""
    V = wp.types.vector(3, real)
    row, _ = functions(real)
    _, angle_between, _ = frames.functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def surfaces(
        q: wp.array(dtype=V),
        frame: wp.array2d(dtype=real),
        slots: wp.array2d(dtype=int),
        data: wp.array2d(dtype=real),
        blocks: int,
        angle_start: int,
        edges: int,
        moved: wp.array(dtype=int),
        kept: wp.array2d(dtype=real),
        lag: wp.array2d(dtype=real),
        lag_out: wp.array2d(dtype=real),
    ):
        tid = wp.tid()
        count = slots.shape[1]
        world = tid / count
        if moved[world] == 0:
            for side in range(2):
                lag_out[side, tid] = kept[side, tid]
            return
        e = tid - world * count
        f = slots[4, e] - angle_start + world * edges
        u = row(frame, 0, f)
        t = row(frame, 3, f)
        for side in range(2):
            a = q[slots[2 + side, e] + world * blocks] - q[slots[0, e] + world * blocks]
            lag_out[side, tid] = angle_between(u, a, t, t, lag[side, tid])

    return surfaces


@cache
def reset_kernel(real):
    """Rotations of joints start from zero once their frames have taken them over."""
    V = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def reset(first: int, spins: int, blocks: int, q: wp.array(dtype=V)):
        tid = wp.tid()
        q[first + tid % spins + tid / spins * blocks] = V()

    return reset

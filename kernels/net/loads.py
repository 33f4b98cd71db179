"""Loads of a net that follow what they act on, as forces on the predicted configuration; it is kept within a step.

Each kernel writes the forces on all `places` of its elements, one after the other, from `first` on among the `total` of a world;
spread(...) sums them block by block in one order, without atomics.
"""

from functools import cache

import numpy as np
import warp as wp


@cache
def follower_kernels(real):
    """press(...) of triangles, squeeze(...) of meridian edges, couples: twist(...) of rod, bend(...) of mesh edges; spread(...)."""
    V = wp.types.vector(3, real)
    third = wp.constant(real(np.pi / 3.0))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def press(
        q: wp.array(dtype=V),
        places: wp.array2d(dtype=int),
        pressure: wp.array(dtype=real),
        blocks: int,
        first: int,
        total: int,
        force_out: wp.array(dtype=V),
    ):
        """On all corners alike, p A n / 3."""
        k, w = wp.tid()
        x0 = q[places[k, 0] + w * blocks]
        x1 = q[places[k, 1] + w * blocks]
        x2 = q[places[k, 2] + w * blocks]
        force = wp.cross(x1 - x0, x2 - x0) * (pressure[k] / real(6.0))
        at = first + 3 * k + w * total
        for corner in range(3):
            force_out[at + corner] = force

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def squeeze(
        q: wp.array(dtype=V),
        places: wp.array2d(dtype=int),
        pressure: wp.array(dtype=real),
        blocks: int,
        first: int,
        total: int,
        force_out: wp.array(dtype=V),
    ):
        """Forces on both ends; see `ddg_warp.compile.axisymmetric.NetBand`."""
        k, w = wp.tid()
        a = q[places[k, 0] + w * blocks]
        b = q[places[k, 1] + w * blocks]
        across = V(a[2] - b[2], real(0.0), b[0] - a[0]) * (pressure[k] * third)
        at = first + 2 * k + w * total
        force_out[at] = across * (real(2.0) * a[0] + b[0])
        force_out[at + 1] = across * (a[0] + real(2.0) * b[0])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def twist(
        q: wp.array(dtype=V),
        places: wp.array2d(dtype=int),
        couple: wp.array(dtype=V),
        blocks: int,
        first: int,
        total: int,
        force_out: wp.array(dtype=V),
    ):
        """Of a couple M on an edge e: -M x e / |e|^2, M x e / |e|^2 on its nodes, and M . t on its angle, if it has one."""
        k, w = wp.tid()
        e = q[places[k, 1] + w * blocks] - q[places[k, 0] + w * blocks]
        pair = wp.cross(couple[k], e) / wp.length_sq(e)
        count = places.shape[1]
        at = first + count * k + w * total
        force_out[at] = -pair
        force_out[at + 1] = pair
        if count > 2:
            force_out[at + 2] = V(wp.dot(couple[k], e) / wp.length(e), real(0.0), real(0.0))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def bend(
        q: wp.array(dtype=V),
        places: wp.array2d(dtype=int),
        moment: wp.array(dtype=V),
        blocks: int,
        first: int,
        total: int,
        force_out: wp.array(dtype=V),
    ):
        """Forces on the ends and the corner opposite, moment on the angle; see `ddg_warp.compile.net.loads.NetEdgeCouple`."""
        k, w = wp.tid()
        x = q[places[k, 0] + w * blocks]
        e = q[places[k, 1] + w * blocks] - x
        a = q[places[k, 2] + w * blocks] - x
        n = wp.cross(e, a)
        lift = n * (moment[k][0] * wp.length(e) / wp.length_sq(n))
        s = wp.dot(a, e) / wp.length_sq(e)
        at = first + 4 * k + w * total
        force_out[at] = lift * (s - real(1.0))
        force_out[at + 1] = -lift * s
        force_out[at + 2] = lift
        force_out[at + 3] = V(moment[k][1], real(0.0), real(0.0))

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def spread(
        constant: wp.array(dtype=V),
        force: wp.array(dtype=V),
        starts: wp.array(dtype=int),
        items: wp.array(dtype=int),
        blocks: int,
        total: int,
        load_out: wp.array(dtype=V),
    ):
        """Constant loads and the forces that belong to a block."""
        i = wp.tid()
        w = i / blocks
        k = i - w * blocks
        f = constant[i]
        for at in range(starts[k], starts[k + 1]):
            f += force[items[at] + w * total]
        load_out[i] = f

    return press, squeeze, twist, bend, spread

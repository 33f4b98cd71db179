"""Conservative float32 AABBs of collision primitives: rounded outwards, so that they contain the exact bounds."""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.collision.primitives import surface_struct
from ddg_warp.kernels.core.launch import CPU_OPTIONS

ROUNDING = 3e-7  # relative bound of two float32 roundings, of a sum and of the conversion
FAR = 1e15  # beyond any scene [m]; its square is finite
LEAST = float(np.finfo(np.float32).tiny)  # so that zero is rounded outwards, too


@wp.struct
class BvhPair:
    """AABBs of two sides in all worlds, and the BVH of the second side.

    `lower`, `upper`: AABBs of first primitives; `second_lower`, `second_upper`: AABBs of second primitives.
    `bundle_lower`, `bundle_upper`: AABBs of bundles of consecutive first primitives, which traverse the BVH together.
    `bundles`: offsets of the bundles of one world among its first primitives.
    `leaves`: offsets of the leaves of the BVH among second primitives.
    `order`: sequence of bundles in traversals; empty for their own order.
    """

    lower: wp.array(dtype=wp.vec3)
    upper: wp.array(dtype=wp.vec3)
    second_lower: wp.array(dtype=wp.vec3)
    second_upper: wp.array(dtype=wp.vec3)
    bundle_lower: wp.array(dtype=wp.vec3)
    bundle_upper: wp.array(dtype=wp.vec3)
    bvh_leaves: wp.array(dtype=int)
    leaves: wp.array(dtype=int)
    order: wp.array(dtype=int)
    tree: wp.uint64


@wp.func
def overlap(lower: wp.vec3, upper: wp.vec3, other_lower: wp.vec3, other_upper: wp.vec3):
    """Return True if two AABBs overlap, by the rule of the BVH."""
    x = lower[0] <= other_upper[0] and upper[0] >= other_lower[0]
    y = lower[1] <= other_upper[1] and upper[1] >= other_lower[1]
    return x and y and lower[2] <= other_upper[2] and upper[2] >= other_lower[2]


@wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
def bundle(
    starts: wp.array(dtype=int),
    count: int,
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    lower_out: wp.array(dtype=wp.vec3),
    upper_out: wp.array(dtype=wp.vec3),
):
    """Write AABBs of bundles with offsets `starts` among the `count` primitives of a world."""
    tid = wp.tid()
    bundles = starts.shape[0] - 1
    w = tid / bundles
    start = starts[tid - w * bundles] + w * count
    low = lower[start]
    high = upper[start]
    for i in range(start + 1, starts[tid - w * bundles + 1] + w * count):
        low = wp.min(low, lower[i])
        high = wp.max(high, upper[i])
    lower_out[tid] = low
    upper_out[tid] = high


@wp.func
def spread(v: int):
    """Return the ten bits of a number, spread to every third bit."""
    v = (v | (v << 16)) & 0x030000FF
    v = (v | (v << 8)) & 0x0300F00F
    v = (v | (v << 4)) & 0x030C30C3
    return (v | (v << 2)) & 0x09249249


@wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
def encode(
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    count: int,
    corner: wp.vec3,
    scale: float,
    dropped: int,
    keys_out: wp.array(dtype=int),
    numbers_out: wp.array(dtype=int),
):
    """Write indices of AABBs, `count` in a world, and keys that sort them by world and Morton code.

    Args:
        corner, scale: of the grid of 1024 cells along each axis; AABBs beyond it are in its outermost cells.
        dropped: low bits of the Morton code that keys leave out.
    """
    i = wp.tid()
    cell = (wp.float32(0.5) * (lower[i] + upper[i]) - corner) * scale
    key = int(0)
    for d in range(3):
        key |= spread(int(wp.clamp(cell[d], wp.float32(0.0), wp.float32(1023.0)))) << d
    keys_out[i] = (i / count << (30 - dropped)) | (key >> dropped)
    numbers_out[i] = i


@cache
def outward_function(real):
    """Return the device function `outward(value, sign)`: the value in float32, rounded down or up by the sign."""

    @wp.func
    def outward(value: real, sign: float):
        v = wp.float32(value)
        return v + sign * (wp.abs(v) * wp.static(wp.float32(ROUNDING)) + wp.static(wp.float32(LEAST)))

    return outward


@cache
def box_kernel(size: int, endless: bool, real):
    """Build the kernel of AABBs.

    `boxes`: write swept AABBs of primitives with `size` nodes, or unbounded ones if `endless`.

    An AABB contains x and x + move - shift, inflated by `share` times the radius plus `more` [m]; `shift` is the common motion of the
    world. A node that is not finite is noted in `lost` as node + 1; its AABB is empty, at the origin.
    """
    Surface, X, outward = surface_struct(real), wp.types.vector(3, real), outward_function(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def boxes(
        surface: Surface,
        count: int,
        x: wp.array(dtype=X),
        move: wp.array(dtype=X),
        shift: wp.array(dtype=X),
        share: real,
        more: real,
        lower: wp.array(dtype=wp.vec3),
        upper: wp.array(dtype=wp.vec3),
        lost: wp.array(dtype=int),
    ):
        """Write the AABB of one primitive of a world per thread."""
        i = wp.tid()
        w = i / count
        k = i - w * count
        low, high, sound = X(), X(), int(1)
        for l in range(wp.static(size)):
            node = surface.nodes[k, l] + w * surface.nodes_a_world
            a = x[node]
            b = a + (move[node] - shift[w])
            if not (wp.isfinite(a) and wp.isfinite(b)):
                sound = 0
                wp.atomic_max(lost, 0, node + 1)
            if l == 0:
                low, high = wp.min(a, b), wp.max(a, b)
            else:
                low, high = wp.min(low, wp.min(a, b)), wp.max(high, wp.max(a, b))
        if sound == 0:
            lower[i] = wp.vec3()
            upper[i] = wp.vec3()
            return
        reach = surface.radius[w, surface.object[k]] * share + more
        down, up = wp.vec3(), wp.vec3()
        for d in range(3):
            down[d] = outward(low[d] - reach, wp.float32(-1.0))
            up[d] = outward(high[d] + reach, wp.float32(1.0))
        if wp.static(endless):
            for d in range(3):
                down[d] = wp.static(wp.float32(-FAR))
                up[d] = wp.static(wp.float32(FAR))
        lower[i] = down
        upper[i] = up

    return boxes

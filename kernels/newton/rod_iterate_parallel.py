"""Moves of few, long rods, one thread a node; `rod_iterate.adjust_kernel` and `rod_step.predict_kernel` use one thread a rod.

A prefix sum maps rotated edges to positions. It runs within ranges of about the square root of a rod's nodes, one thread a range,
then over the ranges, one thread a rod.

Why not shared with `kernels.newton.coupled_edge_rotation`: four launches here rotate edges, move straight, or update frames and twist
angles, in the plane and in space. The coupled form takes at least two launches more an iteration, and reads indices of path nodes.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.islands import (
    ANGLE_STEP_LEFT,
    COLD_START,
    INVERSE_STEP,
    ITERATE_ACTION,
    ROTATE_PREDICTOR,
    STEP_LENGTH,
    STEP_PROGRESS,
)
from ddg_warp.kernels.core.launch import CPU_OPTIONS
from ddg_warp.kernels.elements import parallel_transport
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.newton.edge_rotation import repeat_rotation_function
from ddg_warp.kernels.newton.rod_iterate import ROTATE_EDGES, UPDATE_FRAMES, move_functions
from ddg_warp.kernels.stepping.rod_step import predicted_function


@cache
def move_kernels(kind: RodKind, real, linear, mixed_axial: bool = False):
    """Build the kernels of an edge-rotation update or a frame update.

    `turn`: compute the excess of rotated edges, or their frames, into a second array as neighbours read the old frames.
    `scan`, `offset`: take the prefix sum of edges.
    `move`: write nodes or frames; see `rod_iterate.search_functions`.
    """
    dim, twist = kind.dim, kind.twist
    V = wp.types.vector(dim, real)
    step_of, excess, put_node, carry = move_functions(kind, real, linear, mixed_axial)
    onward_of = repeat_rotation_function(real)
    _, reference_twist, _ = parallel_transport.functions(real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        count: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        direction: wp.array3d(dtype=linear),
        step_length: wp.array(dtype=real),
        straight: wp.array(dtype=real),
        extrapolation: int,
        base: wp.array2d(dtype=V),
        positions: wp.array2d(dtype=V),
        x: wp.array2d(dtype=V),
        frame: wp.array3d(dtype=real),
        excess_out: wp.array2d(dtype=V),
        frame_out: wp.array3d(dtype=real),
    ):
        """Write for every edge the excess of rotation over shear, or its frame in the iterate."""
        k, r = wp.tid()
        n = count[r]
        if k >= n - 1:
            return
        if todo[r] == wp.static(ROTATE_EDGES):
            excess_out[k, r] = excess(
                base, positions, direction, step_length[r], onward_of(straight[r], extrapolation), k, n, r
            )
        if wp.static(twist):
            if todo[r] == wp.static(UPDATE_FRAMES):
                u, t = carry(x, frame, k, n, r)
                for c in range(3):
                    frame_out[c, k, r] = u[c]
                    frame_out[3 + c, k, r] = t[c]
                twisted = frame[6, k, r]
                if k < n - 2:
                    u1, t1 = carry(x, frame, k + 1, n, r)
                    twisted = reference_twist(u, u1, t, t1, twisted)
                frame_out[6, k, r] = twisted

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def scan(
        count: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        width: int,
        excess_to_sum: wp.array2d(dtype=V),
        sum_out: wp.array3d(dtype=V),
    ):
        """Write the exclusive sum of edges within a range of `width` nodes; of the range its sum and the sum of these sums."""
        i, r = wp.tid()
        if todo[r] != wp.static(ROTATE_EDGES):
            return
        n = count[r]
        running = V()
        area = V()
        for k in range(i * width, wp.min(n, (i + 1) * width)):
            edge_excess = V()
            if k < n - 1:
                edge_excess = excess_to_sum[k, r]
            excess_to_sum[k, r] = running
            area += running
            running += edge_excess
        sum_out[0, i, r] = running
        sum_out[1, i, r] = area

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def offset(
        count: wp.array(dtype=int),
        todo: wp.array(dtype=int),
        width: int,
        ranges: int,
        sums: wp.array3d(dtype=V),
        mean_out: wp.array(dtype=V),
    ):
        """Replace the sum of a range by that of all ranges before; write the mean over nodes of the exclusive sums."""
        r = wp.tid()
        if todo[r] != wp.static(ROTATE_EDGES):
            return
        n = count[r]
        running = V()
        mean = V()
        for i in range(ranges):
            range_sum = sums[0, i, r]
            sums[0, i, r] = running
            nodes = wp.min(n, (i + 1) * width) - i * width
            if nodes > 0:
                mean += sums[1, i, r] + running * real(nodes)
                running += range_sum
        mean_out[r] = mean / real(n)

    @wp.func
    def before(prefix: wp.array2d(dtype=V), sums: wp.array3d(dtype=V), width: int, k: int, r: int):
        """Return the sum over all edges before node k."""
        return prefix[k, r] + sums[0, k // width, r]

    @wp.func
    def added(
        x: wp.array2d(dtype=V),
        base: wp.array2d(dtype=V),
        direction: wp.array3d(dtype=linear),
        amount: real,
        k: int,
        r: int,
    ):
        """Return the difference between a fixed node and the end of the straight update."""
        return x[k, r] - base[k, r] - step_of(direction, k, r) * amount

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def move(
        count: wp.array(dtype=int),
        fixed: wp.array2d(dtype=wp.uint8),
        anchors: wp.array3d(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        direction: wp.array3d(dtype=linear),
        prefix: wp.array2d(dtype=V),
        sums: wp.array3d(dtype=V),
        mean: wp.array(dtype=V),
        width: int,
        new_frame: wp.array3d(dtype=real),
        x: wp.array2d(dtype=V),
        theta: wp.array2d(dtype=real),
        frame: wp.array3d(dtype=real),
        base: wp.array2d(dtype=V),
    ):
        """Write a node's end position: for rotated edges the sum from the anchor before, corrected to close at the next anchor."""
        k, r = wp.tid()
        action = flags[ITERATE_ACTION, r]
        if action == 0 or k >= count[r]:
            return
        if action == wp.static(UPDATE_FRAMES):
            base[k, r] = x[k, r]
            if wp.static(twist):
                if k < count[r] - 1:
                    for c in range(7):
                        frame[c, k, r] = new_frame[c, k, r]
            return
        shift = V()
        if action == wp.static(ROTATE_EDGES):
            p = anchors[0, k, r]
            q = anchors[1, k, r]
            shift = before(prefix, sums, width, k, r)
            amount = scalars[STEP_LENGTH, r]
            if p < 0 and q < 0:
                shift -= mean[r]
            elif p < 0:
                shift += added(x, base, direction, amount, q, r) - before(prefix, sums, width, q, r)
            else:
                start = added(x, base, direction, amount, p, r) - before(prefix, sums, width, p, r)
                shift += start
                if q > p:
                    end = added(x, base, direction, amount, q, r) - before(prefix, sums, width, q, r)
                    shift += (end - start) * (real(k - p) / real(q - p))
        if anchors[0, k, r] != k:
            put_node(x, base, direction, fixed, scalars[STEP_LENGTH, r], shift, k, r)
        if wp.static(twist):
            theta[k, r] = theta[k, r] + scalars[ANGLE_STEP_LEFT, r] * real(direction[wp.static(dim), k, r])

    return turn, scan, offset, move


@cache
def predict_kernels(kind: RodKind, real, linear):
    """Build the kernels of the predictor.

    `aim`: set the velocity step of rods with rotated edges as direction.
    `renew`: request a frame update of every moving rod.
    `again`: request the step of rods with rotated edges again.
    """
    dim, nb = kind.dim, kind.block
    V = wp.types.vector(dim, real)
    predicted = predicted_function(dim, real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def aim(
        x0: wp.array2d(dtype=V),
        v0: wp.array2d(dtype=V),
        fixed: wp.array2d(dtype=wp.uint8),
        count: wp.array(dtype=int),
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        x: wp.array2d(dtype=V),
        base_out: wp.array2d(dtype=V),
        direction_out: wp.array3d(dtype=linear),
    ):
        k, r = wp.tid()
        if k >= count[r]:
            return
        moving = scalars[STEP_PROGRESS, r] < real(1.0) and flags[ROTATE_PREDICTOR, r] != 0
        if k == 0:
            scalars[STEP_LENGTH, r] = real(1.0)
            scalars[ANGLE_STEP_LEFT, r] = real(0.0)
            flags[ITERATE_ACTION, r] = wp.where(moving, wp.static(ROTATE_EDGES), 0)
        if moving:
            base_out[k, r] = x0[k, r]
            step = predicted(
                x[k, r], x0[k, r], v0[k, r], int(fixed[k, r]), flags[COLD_START, r], scalars[INVERSE_STEP, r]
            )
            for d in range(wp.static(nb)):
                direction_out[d, k, r] = linear(0.0)
            for d in range(wp.static(dim)):
                direction_out[d, k, r] = linear(step[d])

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def renew(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real)):
        r = wp.tid()
        flags[ITERATE_ACTION, r] = wp.where(scalars[STEP_PROGRESS, r] < real(1.0), wp.static(UPDATE_FRAMES), 0)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def again(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real)):
        r = wp.tid()
        bent = scalars[STEP_PROGRESS, r] < real(1.0) and flags[ROTATE_PREDICTOR, r] != 0
        flags[ITERATE_ACTION, r] = wp.where(bent, wp.static(ROTATE_EDGES), 0)

    return aim, renew, again

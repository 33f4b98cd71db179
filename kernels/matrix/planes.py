"""Blocks on planes that are not across an axis of space: their dofs in a frame, the plane's normal first, for the linear algebra.

With the frame's rows Q (orthonormal), forces become Q f, rows and columns of H Q_i H_ij Q_j^T, and a direction d is Q^T d in space. The
iterate itself stays in space.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.threads import CPU_OPTIONS


@cache
def turn_kernel(real, back: bool):
    """turn(...): vectors of the blocks `where` into their frames, or back, in the worlds that want it."""
    V, F = wp.types.vector(3, real), wp.types.matrix((3, 3), real)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        where: wp.array(dtype=int),
        frames: wp.array(dtype=F),
        wanted: wp.array(dtype=int),
        blocks: int,
        vectors: wp.array(dtype=V),
    ):
        i, w = wp.tid()
        if wanted[w] == 0:
            return
        at = where[i] + w * blocks
        if wp.static(back):
            vectors[at] = wp.transpose(frames[i]) * vectors[at]
        else:
            vectors[at] = frames[i] * vectors[at]

    return turn


@cache
def matrix_kernel(linear):
    """turn(...): entries of H whose row or column is in a frame, in the worlds that want H."""
    F = wp.types.matrix((3, 3), linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        entries: wp.array2d(dtype=int),
        frames: wp.array(dtype=F),
        wanted: wp.array(dtype=int),
        positions: int,
        matrix: wp.array2d(dtype=linear),
    ):
        """`entries` are position, frame of the row and frame of the column, -1 for none."""
        i, w = wp.tid()
        if wanted[w] == 0:
            return
        at = entries[i, 0] + w * positions
        h = F()
        for a in range(3):
            for b in range(3):
                h[a, b] = matrix[3 * a + b, at]
        if entries[i, 1] >= 0:
            h = frames[entries[i, 1]] * h
        if entries[i, 2] >= 0:
            h = h * wp.transpose(frames[entries[i, 2]])
        for a in range(3):
            for b in range(3):
                matrix[3 * a + b, at] = h[a, b]

    return turn

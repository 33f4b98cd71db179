"""Skew supports: dof blocks whose constraint axis is no coordinate axis, rotated into nodal frames for linear algebra.

The first row of a frame Q (orthonormal) is the normal of the plane. Forces become Q f, blocks of H Q_i H_ij Q_j^T, and a direction d
is Q^T d in space. The iterate itself stays in space.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.launch import CPU_OPTIONS


@cache
def rotate_kernel(real, back: bool):
    """Build the kernel that rotates vectors.

    `turn`: rotate the vectors of dof blocks `where` into their nodal frames, or back, in wanted worlds.
    """
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
        block = where[i] + w * blocks
        if wp.static(back):
            vectors[block] = wp.transpose(frames[i]) * vectors[block]
        else:
            vectors[block] = frames[i] * vectors[block]

    return turn


@cache
def matrix_kernel(linear):
    """Build the kernel that rotates H.

    `turn`: rotate entries of H into the nodal frames of row and column, in wanted worlds.
    """
    F = wp.types.matrix((3, 3), linear)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options=CPU_OPTIONS)
    def turn(
        entries: wp.array2d(dtype=int),
        frames: wp.array(dtype=F),
        wanted: wp.array(dtype=int),
        positions: int,
        matrix: wp.array2d(dtype=linear),
    ):
        """Rotate `entries`: position, frame of the row and frame of the column, -1 for none."""
        i, w = wp.tid()
        if wanted[w] == 0:
            return
        position = entries[i, 0] + w * positions
        h = F()
        for a in range(3):
            for b in range(3):
                h[a, b] = matrix[3 * a + b, position]
        if entries[i, 1] >= 0:
            h = frames[entries[i, 1]] * h
        if entries[i, 2] >= 0:
            h = h * wp.transpose(frames[entries[i, 2]])
        for a in range(3):
            for b in range(3):
                matrix[3 * a + b, position] = h[a, b]

    return turn

"""Skew supports: dofs, forces and tangents in the nodal frames of `ddg_warp.compile.coupled.skew_supports`."""

import numpy as np
import warp as wp

from ddg_warp.kernels.linear import skew_supports


class HostPlanes:
    """Nodal frames of the coupled system as one orthogonal matrix, for all worlds."""

    def __init__(self, coupled, worlds: int):
        from scipy import sparse

        index, blocks = np.array(list(coupled.frames)), coupled.blocks
        frames = np.tile(np.eye(3), (blocks, 1, 1))
        frames[index] = list(coupled.frames.values())
        of_world = sparse.bsr_matrix((frames, np.arange(blocks), np.arange(blocks + 1)))
        self._turn = sparse.block_diag([of_world] * worlds, format="csr")

    def into(self, values: np.ndarray) -> np.ndarray:
        """Return dofs, forces or steps in components of the frames."""
        return self._turn @ values

    def back(self, values: np.ndarray) -> np.ndarray:
        """Return vectors in space, given components in the frames."""
        return self._turn.T @ values

    def matrix(self, values):
        """Return a matrix of spatial dofs in components of the frames."""
        return (self._turn @ values @ self._turn.T).tocsc()


class SkewSupports:
    """Nodal frames on the device, for the linear algebra of `CoupledNewton`."""

    def __init__(self, coupled, table, real, linear):
        host, device = coupled.host, coupled.device
        self.coupled, self.positions = coupled, table.positions
        index = np.array(list(host.frames))
        frames = np.array(list(host.frames.values()))
        rows, columns = table.rows.numpy(), table.columns.numpy()
        frame = np.full(host.blocks + 1, -1)  # the last entry is for padding
        frame[index] = np.arange(len(index))
        entries = np.column_stack([np.arange(len(rows)), frame[rows], frame[columns]])
        entries = entries[(entries[:, 1:] >= 0).any(1)]

        def put(values, dtype):
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        self.where, self.entries = put(index.astype(np.int32), int), put(entries.astype(np.int32), int)
        self.of_blocks = put(frame[:-1].astype(np.int32), int)
        self.frames = {kind: put(frames, wp.types.matrix((3, 3), kind)) for kind in {real, linear}}
        self._matrix = skew_supports.matrix_kernel(linear)
        self._into, self._back = (skew_supports.rotate_kernel(linear, back) for back in (False, True))
        self.real, self.linear = real, linear

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._matrix, self._into, self._back]

    def into(self, direction: wp.array, wanted: wp.array) -> None:
        """Rotate the directions of worlds that need one into the frames."""
        self._turn(self._into, self.linear, wanted, direction)

    def back(self, direction: wp.array, wanted: wp.array) -> None:
        """Rotate directions back into space."""
        self._turn(self._back, self.linear, wanted, direction)

    def matrix(self, matrix: wp.array, wanted: wp.array) -> None:
        """Rotate H into the frames, in worlds that need it."""
        inputs = [self.entries, self.frames[self.linear], wanted, self.positions]
        dim = (len(self.entries), self.coupled.worlds)
        wp.launch(self._matrix, dim, inputs, [matrix], device=self.coupled.device)

    def _turn(self, kernel, kind, wanted: wp.array, vectors: wp.array) -> None:
        inputs = [self.where, self.frames[kind], wanted, self.coupled.blocks]
        wp.launch(kernel, (len(self.where), self.coupled.worlds), inputs, [vectors], device=self.coupled.device)

"""Nodes of a net on planes that are not across an axis of space: the frames their dofs are held and solved in.

A symmetry plane holds the displacement along its normal. Where that is no axis of space, the node gets an orthonormal frame with the
held directions first; `Net.fixed` then speaks of components in this frame. Positions stay in space everywhere: host and device turn
forces and tangents into the frames, and directions back.
"""

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels.net import planes

ALIGNED = 1e-12  # how far a held direction may be off an axis that it is taken for


def frames_of_planes(net, normals: dict[int, list], moves: np.ndarray) -> None:
    """Hold nodes along the normals of their planes, whatever else holds them; `moves` (blocks,) are those with a motion.

    Raises:
        SceneError: a node on such a plane is also moved.
    """
    for block, given in normals.items():
        if moves[block]:
            raise SceneError(
                "the point at ({:g}, {:g}, {:g}) m is on a symmetry plane across {} and moved by a support; give the support other "
                "vertices".format(*net.rest[block], tuple(np.round(given[0], 6).tolist()))
            )
        held = np.concatenate([np.eye(3)[net.fixed[block]], given])
        _, size, directions = np.linalg.svd(held)
        rank = int((size > 1e-9).sum())
        along = directions[:rank].T @ directions[:rank]  # projector on what is held
        axes = np.diag(along) > 0.5
        if np.abs(along - np.diag(axes)).max() <= ALIGNED:
            net.fixed[block] = axes
        else:
            net.fixed[block] = np.arange(3) < rank
            net.frames[block] = directions


class HostPlanes:
    """The frames of a net's nodes as one orthogonal matrix, for all worlds."""

    def __init__(self, net, worlds: int):
        from scipy import sparse

        place, blocks = np.array(list(net.frames)), net.blocks
        turn = np.tile(np.eye(3), (blocks, 1, 1))
        turn[place] = list(net.frames.values())
        one = sparse.bsr_matrix((turn, np.arange(blocks), np.arange(blocks + 1)))
        self._turn = sparse.block_diag([one] * worlds, format="csr")

    def into(self, values: np.ndarray) -> np.ndarray:
        """Dofs, forces or steps in space as components in the frames."""
        return self._turn @ values

    def back(self, values: np.ndarray) -> np.ndarray:
        """Components in the frames as vectors in space."""
        return self._turn.T @ values

    def matrix(self, values):
        """A matrix of dofs in space as one of components in the frames."""
        return (self._turn @ values @ self._turn.T).tocsc()


class DevicePlanes:
    """The same on the device, for the linear algebra of `NetNewton`."""

    def __init__(self, net, table, real, linear):
        host, device = net.host, net.device
        self.net, self.positions = net, table.positions
        place = np.array(list(host.frames))
        frames = np.array(list(host.frames.values()))
        rows, columns = table.rows.numpy(), table.columns.numpy()
        frame = np.full(host.blocks + 1, -1)  # the last for padding
        frame[place] = np.arange(len(place))
        entries = np.column_stack([np.arange(len(rows)), frame[rows], frame[columns]])
        entries = entries[(entries[:, 1:] >= 0).any(1)]

        def put(values, dtype):
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        self.where, self.entries = put(place.astype(np.int32), int), put(entries.astype(np.int32), int)
        self.frames = {kind: put(frames, wp.types.matrix((3, 3), kind)) for kind in {real, linear}}
        self._force, self._matrix = planes.turn_kernel(real, False), planes.matrix_kernel(linear)
        self._into, self._back = (planes.turn_kernel(linear, back) for back in (False, True))
        self.real, self.linear = real, linear

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._force, self._matrix, self._into, self._back]

    def forces(self, force: wp.array) -> None:
        """Turn forces into the frames."""
        self._turn(self._force, self.real, self.net.every, force)

    def into(self, direction: wp.array, wanted: wp.array) -> None:
        """Turn the directions of the worlds that want one into the frames."""
        self._turn(self._into, self.linear, wanted, direction)

    def back(self, direction: wp.array, wanted: wp.array) -> None:
        """Turn them back into space."""
        self._turn(self._back, self.linear, wanted, direction)

    def matrix(self, matrix: wp.array, wanted: wp.array) -> None:
        """Turn H of the worlds that want it."""
        inputs = [self.entries, self.frames[self.linear], wanted, self.positions]
        dim = (len(self.entries), self.net.worlds)
        wp.launch(self._matrix, dim, inputs, [matrix], device=self.net.device)

    def _turn(self, kernel, kind, wanted: wp.array, vectors: wp.array) -> None:
        inputs = [self.where, self.frames[kind], wanted, self.net.blocks]
        wp.launch(kernel, (len(self.where), self.net.worlds), inputs, [vectors], device=self.net.device)

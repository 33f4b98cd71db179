"""Velocity of the fluid at the nodes of a rod group or of the coupled system; see `scene.flow`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.scene.flow import depends_on_position, flow_at


class FlowVelocity:
    """Velocity of the fluid at the nodes of a `RodGroup` or `CoupledModel`, of a uniform flow or of a field of position.

    Fields are evaluated on the host, once a step, at the nodes of the start of the step. For the midpoint rule these are moved on by
    half a step at their velocities.

    Args:
        midpoint: True if the scheme evaluates forces at the middle of a step.

    Attributes:
        array: velocities [node][column]; all entries of a uniform flow are one in memory.
        is_local: True if the flow depends on position.
    """

    def __init__(self, model, part, midpoint: bool):
        self._scene, self._part, self.midpoint = model.scene, part, midpoint
        self.is_local, self._is_coupled = depends_on_position(model.scene.flow), part is model.coupled
        vector, device = wp.types.vector(part.dim, model.types.real), model.wp_device
        shape = (part.blocks if self._is_coupled else part.nodes), part.columns
        if self.is_local:
            self.array = device_arrays.allocate(shape, vector, device)
            self._mask = _real_nodes(part, self._is_coupled)
        else:
            self._uniform = wp.array(self._at(0.0)[None], dtype=vector, device=device)
            self.array = wp.array(ptr=self._uniform.ptr, dtype=vector, shape=shape, strides=(0, 0), device=device)

    def upload(self, t0: float, t1: float) -> None:
        """Upload a uniform flow at the evaluation time of the scheme."""
        if not self.is_local and callable(self._scene.flow):
            self._uniform.assign(self._at(self._time(t0, t1))[None])

    def sample(self, state, t0: float, t1: float) -> None:
        """Upload a field at the nodes of a state, for a step between t0 and t1."""
        if not self.is_local:
            return
        x, v = (self._download(array) for array in ((state.q, state.v) if self._is_coupled else (state.x, state.v)))
        x = x + 0.5 * (t1 - t0) * v if self.midpoint else x
        worlds, dim, mask = self._part.worlds, self._part.dim, self._mask
        points = np.zeros((worlds, mask.sum(), 3))
        points[..., self._axes] = x.reshape(len(x), worlds, -1, dim).transpose(1, 0, 2, 3)[:, mask]
        values = np.zeros((worlds, *mask.shape, dim))
        values[:, mask] = self._at(self._time(t0, t1), points if worlds > 1 else points[0])
        device_arrays.assign(self.array, values.transpose(1, 0, 2, 3).reshape(*self.array.shape, dim))

    @property
    def _axes(self) -> list[int]:
        return list(self._part.host.axes)

    def _time(self, t0: float, t1: float) -> float:
        return 0.5 * (t0 + t1) if self.midpoint else t1

    def _at(self, t: float, points: np.ndarray | None = None) -> np.ndarray:
        return flow_at(self._scene.flow, t, self._scene.dimension, points)[..., self._axes]

    def _download(self, array: wp.array) -> np.ndarray:
        """Return nodes [node][column] on the host."""
        return device_arrays.download(self._part.points(array) if self._is_coupled else array).astype(float)


def _real_nodes(part, is_coupled: bool) -> np.ndarray:
    """Return the mask of nodes in a world [node][column]."""
    if is_coupled:
        return np.arange(part.blocks)[:, None] < part.host.nodes
    return np.arange(part.nodes)[:, None] < part.host.count

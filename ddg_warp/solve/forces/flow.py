"""Velocity of the fluid at the nodes of a rod group or of the coupled system; see `scene.flow`."""

from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint import flow as adjoint_kernels
from ddg_warp.kernels.forces import flow as kernels
from ddg_warp.scene.flow import FlowGrid, Turbulence, depends_on_position, flow_at, is_on_host, terms_of

# velocities of each `FlowGrid` by device and type, as they may be large
_grids: WeakKeyDictionary = WeakKeyDictionary()


class FlowVelocity:
    """Velocity of the fluid at the nodes of a `RodGroup` or `CoupledModel`, of a uniform flow or of a field of position.

    Fields are evaluated at the nodes of the start of a step. For the midpoint rule these are moved on by half a step at their
    velocities. `Turbulence` and `FlowGrid` are evaluated on the device, functions of users on the host, once a step.

    Args:
        midpoint: True if the scheme evaluates forces at the middle of a step.

    Attributes:
        array: velocities [node][column]; all entries of a uniform flow are one in memory.
    """

    def __init__(self, model, part, midpoint: bool):
        self._scene, self._part, self.midpoint = model.scene, part, midpoint
        flow, real, device = model.scene.flow, model.types.real, model.wp_device
        vector, self._on_host = wp.types.vector(part.dim, real), is_on_host(flow)
        shape, terms = part.node_shape, terms_of(flow)
        local = [] if self._on_host else filter(depends_on_position, terms)
        self._fields = [_field(each, real, device) for each in local]
        self._constant = [each for each in terms if not depends_on_position(each)]
        self._uniform = wp.zeros(1, dtype=vector, device=device)
        if self._on_host or self._fields:
            self.array = device_arrays.allocate(shape, vector, device)
            self._count = part.node_count
            self._mask = np.arange(shape[0])[:, None] < self._count.numpy().reshape(part.worlds, -1)[0]
            self._lead, self._start = wp.zeros(1, dtype=real, device=device), kernels.start_kernel(part.dim, real)
            self._adders = [field.kernel(part.dim, real) for field in self._fields]
        else:
            self.array = wp.array(ptr=self._uniform.ptr, dtype=vector, shape=shape, strides=(0, 0), device=device)
            self._uniform.assign(self._at(0.0)[None])

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._start, *self._adders] if self._fields else []

    def upload(self, t0: float, t1: float) -> None:
        """Upload a uniform flow, and data of fields, at the evaluation time of the scheme."""
        if self._on_host:
            return
        t = self._time(t0, t1)
        if self._fields or any(map(callable, self._constant)):
            uniform = sum((self._at(t, flow=each) for each in self._constant), np.zeros(self._part.dim))
            self._uniform.assign(uniform[None])
        for field in self._fields:
            field.upload(t)
            self._lead.fill_(0.5 * (t1 - t0) if self.midpoint else 0.0)

    def evaluate(self, state) -> None:
        """Launch the fields at the nodes of a state."""
        if not self._fields:
            return
        x, v = self._nodes(state)
        wp.launch(self._start, self.array.shape, [self._uniform], [self.array], device=x.device)
        for field, add in zip(self._fields, self._adders, strict=True):
            inputs = [x, v, self._count, self._lead, *field.arrays]
            wp.launch(add, self.array.shape, inputs, [self.array], device=x.device)

    @property
    def is_field(self) -> bool:
        """True if the flow depends on position, and is evaluated on the device."""
        return bool(self._fields)

    def pull_kernels(self, nodes, real) -> list:
        """Return the kernels of `pull` for nodes of a `NodeStorage`."""
        return [field.pull_kernel(nodes, real) for field in self._fields]

    def pull(self, kernels, before, by_flow: wp.array, by_rate: wp.array, start) -> None:
        """Add the gradients by the nodes before and by the rate, given the gradient by velocities of the fluid.

        States are of nodes; arrays are [node][column].
        """
        for field, kernel in zip(self._fields, kernels, strict=True):
            inputs = [before, self._count, self._lead, *field.arrays, by_flow]
            wp.launch(kernel, self.array.shape, inputs, [by_rate, start], device=by_flow.device)

    def sample(self, state, t0: float, t1: float) -> None:
        """Upload a function of a user at the nodes of a state, for a step between t0 and t1."""
        if not self._on_host:
            return
        x, v = (device_arrays.download(array).astype(float) for array in self._nodes(state))
        x = x + 0.5 * (t1 - t0) * v if self.midpoint else x
        worlds, dim, mask = self._part.worlds, self._part.dim, self._mask
        points = np.zeros((worlds, mask.sum(), 3))
        points[..., self._axes] = x.reshape(len(x), worlds, -1, dim).transpose(1, 0, 2, 3)[:, mask]
        values = np.zeros((worlds, *mask.shape, dim))
        values[:, mask] = self._at(self._time(t0, t1), points if worlds > 1 else points[0])
        device_arrays.assign(self.array, values.transpose(1, 0, 2, 3).reshape(*self.array.shape, dim))

    def _nodes(self, state) -> tuple[wp.array, wp.array]:
        """Return positions and velocities [node][column]."""
        nodes = self._part.node_state(state)
        return nodes.x, nodes.v

    @property
    def _axes(self) -> list[int]:
        return list(self._part.host.axes)

    def _time(self, t0: float, t1: float) -> float:
        return 0.5 * (t0 + t1) if self.midpoint else t1

    def _at(self, t: float, points: np.ndarray | None = None, flow=None) -> np.ndarray:
        flow = self._scene.flow if flow is None else flow
        return flow_at(flow, t, self._scene.dimension, points)[..., self._axes]


def _field(flow, real, device):
    """Return the device data of a field."""
    return (_Modes if isinstance(flow, Turbulence) else _Grid)(flow, real, device)


class _Modes:
    """Modes of a `Turbulence` on a device, its mean in the first, of wave number zero.

    Attributes:
        kernel, pull_kernel: factories of its kernels; arrays: inputs of the kernels.
    """

    kernel, pull_kernel = staticmethod(kernels.mode_kernel), staticmethod(adjoint_kernels.mode_kernel)

    def __init__(self, flow: Turbulence, real, device):
        self._flow = flow
        rows = np.concatenate([flow.waves, flow.amplitudes], axis=1).T
        mean = np.concatenate([np.zeros(3), flow.mean])[:, None]
        modes = wp.array(np.concatenate([mean, rows], axis=1), dtype=real, device=device)
        self.arrays = [modes, wp.zeros(modes.shape[1], dtype=real, device=device)]

    def upload(self, t: float) -> None:
        """Upload the phases at t."""
        self.arrays[1].assign(np.concatenate([[0.0], self._flow.phases(t)]))


class _Grid:
    """Velocities of a `FlowGrid` on a device; see `_Modes`."""

    kernel, pull_kernel = staticmethod(kernels.grid_kernel), staticmethod(adjoint_kernels.grid_kernel)

    def __init__(self, flow: FlowGrid, real, device):
        self._flow, vector = flow, wp.types.vector(3, real)
        kept, key = _grids.setdefault(flow, {}), (str(device), real)
        if key not in kept:
            velocities = flow.velocities if flow.times is not None else flow.velocities[None]
            kept[key] = wp.array(velocities, dtype=vector, device=device)
        box = wp.array(np.stack([flow.lower, flow.cells_per_length]), dtype=vector, device=device)
        self.arrays = [kept[key], box, wp.zeros(1, dtype=real, device=device)]

    def upload(self, t: float) -> None:
        """Upload the index of t among the times."""
        self.arrays[2].fill_(self._flow.instant(t))

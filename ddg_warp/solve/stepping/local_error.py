"""Velocity changes of steps, summed on the device for the local error estimate; see `kernels.stepping.local_error`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.stepping.local_error import differ_kernel
from ddg_warp.model.state import State
from ddg_warp.solve.linear.sparse_system import Sums


class VelocityChange:
    """Velocity changes of all masses of a model: rod groups, and nodes of the coupled system."""

    def __init__(self, model):
        self._parts = [_Part(model, group) for group in model.groups]
        self._parts += [] if model.coupled is None else [_Part(model, None)]
        shape = len(self._parts), model.worlds
        totals = wp.zeros(shape, dtype=model.types.real, device=model.wp_device)
        self._totals, self._reading = [totals[i] for i in range(len(self._parts))], device_arrays.Reading(totals)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [kernel for part in self._parts for kernel in part.kernels]

    def __call__(self, before: State, after: State) -> None:
        """Launch the sums of velocity changes between two states; capturable."""
        for part, states, total in zip(self._parts, _velocities(before, after), self._totals, strict=True):
            part(*states, total)

    def squares(self) -> np.ndarray:
        """Return sums of m |v1 - v0|^2 over the last step (worlds,) [J]. Reads from the device."""
        return self._reading().astype(float).sum(0)

    def masses(self) -> np.ndarray:
        """Return the masses of the worlds (worlds,) [kg]. Reads from the device."""
        return sum(part.masses() for part in self._parts)


def _velocities(before: State, after: State):
    """Yield velocities at both ends of a step, of every rod group and of the coupled system."""
    yield from ((one.v, following.v) for one, following in zip(before.groups, after.groups, strict=True))
    if before.coupled is not None:
        coupled = before.model.coupled
        yield coupled.points(before.coupled.v), coupled.points(after.coupled.v)


class _Part:
    """Sums per world over a rod group, or over the nodes of the coupled system if that is None."""

    def __init__(self, model, group):
        self._of, coupled, device, real = group or model.coupled, model.coupled, model.wp_device, model.types.real
        self._rows, self._columns = (
            (coupled.host.nodes, coupled.worlds) if group is None else (group.nodes, group.columns)
        )
        self._width = self._columns // model.worlds
        self._threads = device_arrays.takers(self._rows, device) if group is None else 1
        self._kernel = differ_kernel(3 if group is None else group.dim, real)
        self._sums = wp.zeros((model.worlds, self._width * self._threads), dtype=real, device=device)
        self._sum = Sums(*self._sums.shape, real, device)
        self.kernels = [self._kernel, *self._sum.kernels]
        self._device = device

    def masses(self) -> np.ndarray:
        """Return the masses of the worlds (worlds,) [kg]."""
        mass = device_arrays.download(self._of.node_mass).astype(float)[: self._rows]
        return mass.sum(0).reshape(-1, self._width).sum(1)

    def __call__(self, before: wp.array, after: wp.array, total: wp.array) -> None:
        inputs = [before, after, self._of.node_mass, self._rows, self._width, self._threads]
        wp.launch(self._kernel, (self._threads, self._columns), inputs, [self._sums], device=self._device)
        self._sum(self._sums, total)

"""Drag on rods on their own."""

from types import SimpleNamespace

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels import drag, element
from ddg_warp.kernels.islands import Islands
from ddg_warp.scene.drag import flow_at


class ChainDrag:
    """Drag on a group of rods, against a fluid that flows."""

    def __init__(self, model, group, midpoint: bool = False):
        self.model, self.group, self.midpoint = model, group, midpoint
        self._resist, self._settle = drag.chain_kernels(group.kind, model.types.real)
        vector = wp.types.vector(group.kind.dim, model.types.real)
        self.flow = wp.array(self._flow(0.0), dtype=vector, device=model.wp_device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._resist, *([self._settle] if self.midpoint else [])]

    def upload(self, t0: float, t1: float) -> None:
        """The flow at the time that the scheme balances forces at."""
        if callable(self.model.scene.flow):
            self.flow.assign(self._flow(0.5 * (t0 + t1) if self.midpoint else t1))

    def _flow(self, t: float) -> np.ndarray:
        return flow_at(self.model.scene, t)[None, [0, 2] if self.group.kind.dim == 2 else [0, 1, 2]]

    def resist(self, before, newton, islands) -> None:
        """Write inertia and drag of a solve from the state `before`, once its iterate is predicted."""
        group = self.group
        self._launch(
            self._resist,
            [before.x, before.v, before.theta, newton.x if self.midpoint else before.x, newton.x, group.drag, self.flow]
            + [group.mass, group.rotary, group.count, *islands.arrays],
            [newton.mass, newton.rotary, newton.target_angle],
        )

    def at(self, data, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Inertia and drag (node, column) of a group's state at t, with the resistance over a second, and the flow (dim,)."""
        group, real, device = self.group, self.model.types.real, self.model.wp_device
        islands = Islands(group.columns, real, device)
        islands.coefficient.fill_(1.0)
        islands.rate.fill_(1.0)
        solve = SimpleNamespace(x=data.x)
        solve.mass = arrays.allocate((group.nodes, group.columns), element.inertia_type(group.kind, real), device)
        solve.rotary, solve.target_angle = wp.zeros_like(data.theta), wp.clone(data.theta)
        self.upload(t, t)
        self.resist(data, solve, islands)
        return arrays.download(solve.mass), self.flow.numpy()[0].astype(float)

    def settle(self, after, newton, islands) -> None:
        """Rates of what has no inertia in the state `after`."""
        group = self.group
        if self.midpoint:
            self._launch(
                self._settle,
                [newton.x, newton.theta, group.mass, group.rotary, group.count, *islands.arrays]
                + [after.x, after.theta],
                [after.v, after.omega],
            )

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.group.node_threads, inputs, outputs, device=self.model.wp_device)

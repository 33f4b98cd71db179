"""Residual tolerances of the coupled system on the device; see `ddg_warp.compile.residual_tolerance`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.residual import residual_sums


class ResidualTolerances:
    """Tolerances of block residuals and of cluster sums, at rtol and load scale 1.

    Attributes:
        `blocks`: tolerance of every block of all worlds [N, N m].
        `least`: rounding floor of blocks, which `settle` writes.
        `limits`: tolerance of the cluster sums of every level (worlds, clusters) [N].
        `total`: loads of all bodies (worlds,) [N].
        `ratio`: residuals over tolerances, of blocks, then of cluster sums.
    """

    def __init__(self, coupled, real, linear):
        self.coupled, self.bodies, self._real = coupled, coupled.host.bodies, real
        worlds, device = coupled.worlds, coupled.device

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        def make(shape, dtype=real):
            return wp.zeros(shape, dtype=dtype, device=device)

        self.blocks, self.least = make(worlds * coupled.blocks), make(worlds * coupled.blocks)
        self.ratio = make((worlds, coupled.blocks + sum(len(level.weight) for level in self.bodies.levels)))
        self.kernels = [
            residual_sums.cluster_kernel(real, linear, leaf, device_arrays.serial(device)) for leaf in (True, False)
        ]
        self._levels = []
        for level in self.bodies.levels:
            n = len(level.weight)
            buffers = (
                put(level.starts),
                put(level.items),
                make((worlds, n)),
                make(worlds * n, coupled.vector),
                make(worlds * n),
            )
            self._levels.append(buffers)
        self.total = make(worlds)
        self.limits = [limit for _, _, limit, _, _ in self._levels]

    def assign(self, loads: np.ndarray) -> wp.array:
        """Set the loads of bodies (worlds or 1, bodies) [N]; return load scales of worlds: 1, or 0 without loads."""
        loads = np.broadcast_to(loads, (self.coupled.worlds, self.bodies.count))
        loaded = (loads > 0.0).any(1)
        loads = np.where(loaded[:, None], loads, 1.0)
        self.total.assign(loads.sum(1))
        self.blocks.assign(np.concatenate([self.bodies.limits(of_world) for of_world in loads]))
        for level, limit in zip(self.bodies.levels, self.limits, strict=True):
            limit.assign(loads[:, level.body] * level.weight)
        return wp.array(loaded.astype(float), dtype=self._real, device=self.coupled.device)

    def sum_up(self, rhs, rtol: float, islands, unbalanced, drowned, exact: bool = False) -> None:
        """Raise the flags of worlds with a cluster sum above the tolerance; `exact`: directions are exact."""
        value, rounding, below, kernel = rhs, self.least, self.coupled.blocks, self.kernels[0]
        first_ratio = below
        for starts, items, limit, sums, squares in self._levels:
            wp.launch(
                kernel,
                (device_arrays.takers(limit.shape[1], self.coupled.device), self.coupled.worlds),
                [value, rounding, starts, items, below, limit, first_ratio, rtol, int(exact), *islands.arrays],
                [sums, squares, self.ratio, unbalanced, drowned],
                device=self.coupled.device,
            )
            first_ratio += limit.shape[1]
            value, rounding, below, kernel = sums, squares, limit.shape[1], self.kernels[1]

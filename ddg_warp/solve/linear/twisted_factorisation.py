"""Twisted factorisation of rod paths on a device: solves from both ends; see `kernels.linear.twisted_factorisation`."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import twisted_factorisation


class TwistedFactorisation:
    """Factors of rod paths of a plan without joints or mixed axial-force formulation, and solves.

    Args:
        columns: columns of all worlds; threads: threads a block.
    """

    def __init__(self, plan, columns: int, linear, device, threads: int):
        self._columns, self._threads, self._device = columns, threads, device
        self._sides, self._middle = twisted_factorisation.factor_kernels(plan.twist, plan.span, linear)
        self._inward, self._outward = twisted_factorisation.solve_kernels(plan.twist, plan.span, linear)
        self._taken = device_arrays.allocate((3 * plan.block**2, 2, columns), linear, device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [(kernel, self._threads) for kernel in (self._sides, self._middle, self._inward, self._outward)]

    def factorise(self, blocks: wp.array, count, idle, wanted: wp.array, factors: wp.array, lost: wp.array) -> None:
        """Factorise the paths of worlds with `wanted` not 0; raise `lost` of worlds with a lost pivot."""
        inputs = [blocks, count, idle, wanted]
        self._launch(self._sides, 2 * self._columns, inputs, [factors, self._taken, lost])
        self._launch(self._middle, self._columns, [*inputs, self._taken], [factors, lost])

    def solve(self, factors: wp.array, inputs: tuple, values: wp.array, z: wp.array, dots: wp.array) -> None:
        """Write the solution z of the blocks at path nodes, and r . z; `values` are scratch.

        Args:
            inputs: residual of blocks, arrays `places`, `held`, `count`, `idle` of `RodPaths`, `wanted` (1) of worlds,
                blocks of a world.
        """
        self._launch(self._inward, 2 * self._columns, [factors, *inputs], [values, self._taken])
        self._launch(self._outward, 2 * self._columns, [factors, *inputs, self._taken], [values, z, dots])

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self._device, block_dim=self._threads)

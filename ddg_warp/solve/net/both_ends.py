"""Solves along chains from both of their ends, on a device; see `kernels.solve.both_ends`."""

import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.solve import both_ends


class BothEnds:
    """Factors of chains of a plan, without joints or edges that are split, and solves with them.

    Args:
        columns: chains of all worlds; threads: of a block.
    """

    def __init__(self, plan, columns: int, linear, device, threads: int):
        self._columns, self._threads, self._device = columns, threads, device
        self._sides, self._middle = both_ends.factor_kernels(plan.twist, plan.span, linear)
        self._inward, self._outward = both_ends.solve_kernels(plan.twist, plan.span, linear)
        self._taken = arrays.allocate((3 * plan.block**2, 2, columns), linear, device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [(kernel, self._threads) for kernel in (self._sides, self._middle, self._inward, self._outward)]

    def factorise(self, blocks: wp.array, count, idle, wanted: wp.array, factors: wp.array, lost: wp.array) -> None:
        """Of the chains of worlds that are wanted (not 0); raises `lost` of those where a pivot is."""
        inputs = [blocks, count, idle, wanted]
        self._launch(self._sides, 2 * self._columns, inputs, [factors, self._taken, lost])
        self._launch(self._middle, self._columns, [*inputs, self._taken], [factors, lost])

    def solve(self, factors: wp.array, at: tuple, values: wp.array, z: wp.array, dots: wp.array) -> None:
        """z of blocks at places, and r . z; `values` are scratch.

        Args:
            at: residual of blocks; places, held, count and idle of `Chains`; worlds that are wanted (1); blocks of a world.
        """
        self._launch(self._inward, 2 * self._columns, [factors, *at], [values, self._taken])
        self._launch(self._outward, 2 * self._columns, [factors, *at, self._taken], [values, z, dots])

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self._device, block_dim=self._threads)

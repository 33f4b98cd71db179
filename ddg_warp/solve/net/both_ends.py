"""Solves along chains from both of their ends, on a device; see `kernels.solve.both_ends`."""

import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.solve import both_ends


class BothEnds:
    """Factors of chains of a plan, without joints or edges that are split, and solves with them.

    Args:
        given: places, held, count and idle of `Chains`; blocks: of a world.
        columns: chains of all worlds; block: threads of a block.
    """

    def __init__(self, plan, linear, device, given: tuple, blocks: int, columns: int, block: int):
        places, held, count, idle = given
        self._about, self._at = [count, idle], [places, held, count, idle]
        self._blocks, self._columns, self._block, self._device = blocks, columns, block, device
        self._sides, self._middle = both_ends.factor_kernels(plan.twist, plan.span, linear)
        self._inward, self._outward = both_ends.solve_kernels(plan.twist, plan.span, linear)
        self._taken = arrays.allocate((3 * plan.block**2, 2, columns), linear, device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [(kernel, self._block) for kernel in (self._sides, self._middle, self._inward, self._outward)]

    def factorise(self, blocks: wp.array, wanted: wp.array, factors: wp.array, lost: wp.array) -> None:
        """Of the chains of worlds that are wanted (not 0); raises `lost` of those where a pivot is."""
        self._launch(self._sides, 2 * self._columns, [blocks, *self._about, wanted], [factors, self._taken, lost])
        self._launch(self._middle, self._columns, [blocks, *self._about, wanted, self._taken], [factors, lost])

    def solve(self, factors, residual, wanted, values: wp.array, z: wp.array, dots: wp.array) -> None:
        """z of blocks at places from their residual, of worlds that are wanted (1), and r . z; `values` are scratch."""
        given = [factors, residual, *self._at, wanted, self._blocks]
        self._launch(self._inward, 2 * self._columns, given, [values, self._taken])
        self._launch(self._outward, 2 * self._columns, [*given, self._taken], [values, z, dots])

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self._device, block_dim=self._block)

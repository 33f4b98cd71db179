"""Sleeping islands: recompute contact islands for every direction, and fix the dofs of converged ones.

An island has all rods and shells that contact or friction connects; obstacles do not connect. Directions are computed for islands
with a residual above the tolerance. All others sleep: their dofs stay unchanged, bit for bit, until a moving body contacts one of
them. An island falls asleep at `SLEEP` of the tolerance: Newton residuals are mostly far smaller, and so it stays converged while
others iterate.

Alternative: more bodies may sleep, such as converged rods in contact with unconverged ones.

Measured: with only unconverged rods and their neighbours awake, 10,000 strands took as long on a GPU. A pile of 300 rods took up to
twice the iterations, since barely converged rods wake repeatedly.
"""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.newton.sleeping_islands import resting_kernels
from ddg_warp.timers import timer

SLEEP = 0.1


class SleepingIslands:
    """Sleeping islands of a `CoupledModel` in contact: masks of inactive dofs and rod paths, and excluded pairs.

    Args:
        linear: scalar type of products with pairs.
        tolerances: `ResidualTolerances`; `substructuring`: `RodSubstructuring`, or None.
        body: body (rod, shell, or several joined) of each block (blocks,), -1 for none; bodies: largest possible number of bodies.

    Attributes:
        owner: body of every ratio of the tolerances, -1 for none.
    """

    def __init__(self, coupled, linear, tolerances, substructuring, body: np.ndarray, bodies: int):
        self._device, self._worlds, self.bodies = coupled.device, coupled.worlds, bodies
        owner = [body]
        for level in tolerances.bodies.levels:  # sums over clusters belong to the body of their blocks
            owner.append(owner[-1][level.items[level.starts[:-1]]])

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=coupled.device)

        self.owner, self._body = put(np.concatenate(owner)), put(body)
        self._link, self._awake = (put(np.arange(coupled.worlds * bodies)) for _ in range(2))
        self._any = put(np.zeros(coupled.worlds))
        self._where, self._width = (
            (substructuring.paths.where, substructuring.paths.width) if substructuring else (put([]), 1)
        )
        made = resting_kernels(coupled.real, linear, device_arrays.serial(coupled.device))
        self._begin, self._look, self._join, self._wake, self._settle, self._leave = self.kernels = made

    @timer("sleeping islands")
    def __call__(self, products, ratio: wp.array, rtol: float, search, system, islands) -> None:
        """Find sleeping islands by ratios of residuals to tolerances, and the pairs of a `PairProduct`."""
        device = self._device
        device_arrays.sweep(self._begin, len(self._link), [], [self._link, self._awake, self._any], device)
        inputs = [ratio, self.owner, self.bodies, SLEEP * rtol, *islands.arrays]
        device_arrays.sweep(self._look, len(self.owner), inputs, [self._awake, self._any], device, worlds=self._worlds)
        inputs = [products.sets, self._body, self.bodies, self._awake]
        device_arrays.take_turns(self._join, products.most, inputs, [self._link], device)
        device_arrays.sweep(self._wake, len(self._link), [], [self._link, self._awake], device)
        self._mask(search, system, islands)
        self.leave(products, system)

    def leave(self, products, system) -> None:
        """Exclude pairs between sleeping bodies from products, among the present pairs."""
        inputs = [products.sets, system.masks.inactive]
        device_arrays.take_turns(self._leave, products.most, inputs, [], self._device)

    def wake(self, search, system, islands) -> None:
        """Wake all islands; see `leave` for the pairs."""
        self._any.zero_()
        self._mask(search, system, islands)

    def _mask(self, search, system, islands) -> None:
        masks = system.masks
        masks.idle_paths.fill_(1)
        inputs = [self._link, self._awake, self._any, self.bodies, search.stalled, islands.arrays[0]]
        inputs += [self._body, masks.fixed, self._where, self._width]
        outputs = [masks.inactive, masks.idle_paths]
        device_arrays.sweep(self._settle, len(self._body), inputs, outputs, self._device, worlds=self._worlds)

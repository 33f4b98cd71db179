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
    """Sleeping islands of a `CoupledNewton` in contact; writes `CoupledNewton.inactive_mask` and `RodSubstructuring.idle`.

    Args:
        newton: with its contact and residual tolerances made.
        body: body (rod, shell, or several joined) of each block (blocks,), -1 for none; bodies: largest possible number of bodies.

    Attributes:
        owner: body of every ratio of `CoupledNewton.allowed`, -1 for none.
    """

    def __init__(self, newton, body: np.ndarray, bodies: int):
        self.newton, coupled, device = newton, newton.coupled, newton.device
        self._worlds, self.bodies = coupled.worlds, bodies
        owner = [body]
        for level in newton.allowed.bodies.levels:  # sums over clusters belong to the body of their blocks
            owner.append(owner[-1][level.items[level.starts[:-1]]])

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        self.owner, self._body = put(np.concatenate(owner)), put(body)
        self._link, self._awake = (put(np.arange(coupled.worlds * bodies)) for _ in range(2))
        self._any = put(np.zeros(coupled.worlds))
        chains = newton.chains
        self._where, self._idle, self._width = (
            (chains.where, chains.idle, chains.width) if chains else (put([]), put([]), 1)
        )
        made = resting_kernels(newton.real, newton.linear, device_arrays.serial(device))
        self._begin, self._look, self._join, self._wake, self._settle, self._leave = self.kernels = made

    @timer("sleeping islands")
    def __call__(self, products) -> None:
        """Find sleeping islands by the residuals of the iterate and the pairs of a `PairProduct`."""
        newton, device = self.newton, self.newton.device
        device_arrays.sweep(self._begin, len(self._link), [], [self._link, self._awake, self._any], device)
        inputs = [newton.allowed.ratio, self.owner, self.bodies, SLEEP * newton.options.rtol, *newton.islands.arrays]
        device_arrays.sweep(self._look, len(self.owner), inputs, [self._awake, self._any], device, worlds=self._worlds)
        inputs = [products.sets, self._body, self.bodies, self._awake]
        device_arrays.take_turns(self._join, products.most, inputs, [self._link], device)
        device_arrays.sweep(self._wake, len(self._link), [], [self._link, self._awake], device)
        self._bar()
        self.leave(products)

    def leave(self, products) -> None:
        """Exclude pairs between sleeping bodies from products, among the present pairs."""
        device_arrays.take_turns(
            self._leave, products.most, [products.sets, self.newton.inactive_mask], [], self.newton.device
        )

    def wake(self) -> None:
        """Wake all islands; see `leave` for the pairs."""
        self._any.zero_()
        self._bar()

    def _bar(self) -> None:
        newton = self.newton
        self._idle.fill_(1)
        inputs = [self._link, self._awake, self._any, self.bodies, newton.stalled, newton.islands.arrays[0]]
        inputs += [self._body, newton.fixed, self._where, self._width]
        outputs = [newton.inactive_mask, self._idle]
        device_arrays.sweep(self._settle, len(self._body), inputs, outputs, newton.device, worlds=self._worlds)

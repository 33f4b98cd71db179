"""Islands of a world in contact, found anew for each direction: those in balance rest while Newton's method goes on elsewhere.

Rods and shells that push each other, by contact or friction, are in one island with all that these push. What obstacles are pushed by
is not joined by them. A direction is one of the islands with a residual that is still too large; all others stay where they are, as if
they were held, to the bit. What comes to push one of them wakes it. An island rests at `REST` of the tolerance: what Newton's method
leaves of a residual is mostly far below it, and so it stays where others take longer.

(More may rest: rods in balance that touch others which are not. With the neighbours of those awake, 10,000 strands took as long on a
GPU, whose memory has the rods of a group side by side, and 300 rods of a pile up to twice the iterations: what is barely balanced wakes
again and again.)
"""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.net.resting import resting_kernels

REST = 0.1


class Resting:
    """What rests of a `NetNewton` in contact: it writes `NetNewton.barred` and `Chains.idle`.

    Args:
        newton: once its contact and what residuals may be are there.
        body: which rod, shell, or what is joined of them, each block belongs to (blocks,), -1 for none; bodies: how many there may be.

    Attributes:
        owner: the body of every ratio of `NetNewton.allowed`, -1 for none.
    """

    def __init__(self, newton, body: np.ndarray, bodies: int):
        self.newton, net, device = newton, newton.net, newton.device
        self._worlds, self.bodies = net.worlds, bodies
        owner = [body]
        for level in newton.allowed.bodies.levels:  # sums over parts belong to what their blocks do
            owner.append(owner[-1][level.items[level.starts[:-1]]])

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        self.owner, self._body = put(np.concatenate(owner)), put(body)
        self._link, self._awake = (put(np.arange(net.worlds * bodies)) for _ in range(2))
        self._any = put(np.zeros(net.worlds))
        chains = newton.chains
        self._where, self._idle, self._width = (
            (chains.where, chains.idle, chains.width) if chains else (put([]), put([]), 1)
        )
        made = resting_kernels(newton.real, newton.linear, arrays.serial(device))
        self._begin, self._look, self._join, self._wake, self._settle, self._leave = self.kernels = made

    def __call__(self, products) -> None:
        """Find what rests, by the residuals of the iterate and the pairs of a `PairProduct`."""
        newton, device = self.newton, self.newton.device
        arrays.sweep(self._begin, len(self._link), [], [self._link, self._awake, self._any], device)
        inputs = [newton.allowed.ratio, self.owner, self.bodies, REST * newton.options.rtol, *newton.islands.arrays]
        arrays.sweep(self._look, len(self.owner), inputs, [self._awake, self._any], device, worlds=self._worlds)
        inputs = [products.sets, self._body, self.bodies, self._awake]
        arrays.take_turns(self._join, products.most, inputs, [self._link], device)
        arrays.sweep(self._wake, len(self._link), [], [self._link, self._awake], device)
        self._bar()
        self.leave(products)

    def leave(self, products) -> None:
        """Have products leave out pairs between what rests, of those that there are by now."""
        arrays.take_turns(self._leave, products.most, [products.sets, self.newton.barred], [], self.newton.device)

    def wake(self) -> None:
        """Nothing rests; see `leave` for the pairs."""
        self._any.zero_()
        self._bar()

    def _bar(self) -> None:
        newton = self.newton
        self._idle.fill_(1)
        inputs = [self._link, self._awake, self._any, self.bodies, newton.stalled, newton.islands.arrays[0]]
        inputs += [self._body, newton.fixed, self._where, self._width]
        outputs = [newton.barred, self._idle]
        arrays.sweep(self._settle, len(self._body), inputs, outputs, newton.device, worlds=self._worlds)

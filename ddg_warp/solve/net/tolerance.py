"""What residuals of a net may be, on the device; see `ddg_warp.compile.tolerance`."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.net import parts


class Allowed:
    """What residuals of blocks and their sums over parts may be, over rtol and the load scale; see `ddg_warp.compile.tolerance`.

    Attributes:
        blocks: of every block of all worlds [N, N m]; least: what rounding leaves there, which `settle` writes.
        limits: of the parts of every level (worlds, parts) [N]; total: loads of all bodies (worlds,) [N].
        ratio: of residuals of blocks, then of sums over parts, to what they may be.
    """

    def __init__(self, net, real, linear):
        self.net, self.bodies, self._real = net, net.host.bodies, real
        worlds, device = net.worlds, net.device

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        def make(shape, dtype=real):
            return wp.zeros(shape, dtype=dtype, device=device)

        self.blocks, self.least = make(worlds * net.blocks), make(worlds * net.blocks)
        self.ratio = make((worlds, net.blocks + sum(len(level.weight) for level in self.bodies.levels)))
        self.kernels = [parts.part_kernel(real, linear, leaf, arrays.serial(device)) for leaf in (True, False)]
        self._levels = []
        for level in self.bodies.levels:
            n = len(level.weight)
            own = (
                put(level.starts),
                put(level.items),
                make((worlds, n)),
                make(worlds * n, net.vector),
                make(worlds * n),
            )
            self._levels.append(own)
        self.total = make(worlds)
        self.limits = [limit for _, _, limit, _, _ in self._levels]

    def assign(self, loads: np.ndarray) -> wp.array:
        """Take the loads of bodies (worlds or 1, bodies) [N]; load scales of the worlds: 1, or 0 where there are none."""
        loads = np.broadcast_to(loads, (self.net.worlds, self.bodies.count))
        given = (loads > 0.0).any(1)
        loads = np.where(given[:, None], loads, 1.0)
        self.total.assign(loads.sum(1))
        self.blocks.assign(np.concatenate([self.bodies.limits(own) for own in loads]))
        for level, limit in zip(self.bodies.levels, self.limits, strict=True):
            limit.assign(loads[:, level.body] * level.weight)
        return wp.array(given.astype(float), dtype=self._real, device=self.net.device)

    def sum_up(self, right, rtol: float, islands, unbalanced, drowned, exact: bool = False) -> None:
        """Raise the flags of worlds with a part whose residuals sum up to too much; `exact` says that directions are."""
        value, rounding, below, kernel = right, self.least, self.net.blocks, self.kernels[0]
        place = below
        for starts, items, limit, sums, squares in self._levels:
            wp.launch(
                kernel,
                (arrays.takers(limit.shape[1], self.net.device), self.net.worlds),
                [value, rounding, starts, items, below, limit, place, rtol, int(exact), *islands.arrays],
                [sums, squares, self.ratio, unbalanced, drowned],
                device=self.net.device,
            )
            place += limit.shape[1]
            value, rounding, below, kernel = sums, squares, limit.shape[1], self.kernels[1]

"""A crowd in balance but for a few: what slips off an edge at the time takes Newton's method as many iterations as all else together.

A rod that stands on another by its end slides off it, from one step to the next, along a direction in which the energy bends down.
There the matrix is the projected one and the steps that it makes are short, while ten thousand others wait. What such a rod has left
of its residual acts on it as a force would for the length of the step; see `NewtonOptions.outliers`.
"""

import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.net.outliers import outlier_kernels


class Outliers:
    """Excuses the few of a `NetNewton` in contact that are out of balance; launches alone.

    Args:
        newton: with its `Resting`, by whose numbers bodies go.
        most: bodies of a world that may be out of balance.

    Attributes:
        most; number: (worlds,) of bodies that are out of balance, as of the last `count`.
    """

    def __init__(self, newton, most: int):
        self.newton, self.most = newton, most
        self._owner, self._bodies = newton.resting.owner, newton.resting.bodies
        worlds, device = newton.worlds, newton.device
        self._out_of_balance = wp.zeros(worlds * self._bodies, dtype=int, device=device)
        self.number = wp.zeros(worlds, dtype=int, device=device)
        self._count, self._excuse = self.kernels = outlier_kernels(newton.real, arrays.serial(device))

    def excuse(self) -> None:
        """Lower the flags of worlds in which so few are out of balance, as was counted, by what was found of residuals."""
        newton = self.newton
        inputs = [self.number, self.most, newton.worst, newton._weight[2], newton.options.rtol, *newton.islands.arrays]
        wp.launch(self._excuse, newton.worlds, inputs, device=newton.device)

    def count(self, rtol: float) -> None:
        """Those with a ratio of residuals that is above a tolerance, of active worlds."""
        newton = self.newton
        self._out_of_balance.zero_()
        self.number.zero_()
        inputs = [newton.allowed.ratio, self._owner, self._bodies, rtol, *newton.islands.arrays]
        outputs = [self._out_of_balance, self.number]
        arrays.sweep(self._count, len(self._owner), inputs, outputs, newton.device, worlds=newton.worlds)

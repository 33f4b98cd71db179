"""Relaxed convergence: a few bodies in contact may exceed the tolerance by a bounded factor.

A rod that stands on another by its end slides off along a direction in which the energy is concave. There the Hessian is projected
and its steps are short, while ten thousand other rods wait. The residual left on such a rod acts like an external force for the
length of the step; see `NewtonOptions.unconverged_fraction`.

Measured: such slips take Newton's method as many iterations as all other rods together.
"""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.newton.relaxed_convergence import outlier_kernels


class RelaxedConvergence:
    """Relaxed convergence of a `CoupledNewton` in contact; launches alone.

    Args:
        newton: with its `SleepingIslands`, which numbers the bodies.
        most: unconverged bodies that a world may have.

    Attributes:
        most; number: (worlds,) unconverged bodies of the last `count`.
    """

    def __init__(self, newton, most: int):
        self.newton, self.most = newton, most
        self._owner, self._bodies = newton.resting.owner, newton.resting.bodies
        worlds, device = newton.worlds, newton.device
        self._out_of_balance = wp.zeros(worlds * self._bodies, dtype=int, device=device)
        self.number = wp.zeros(worlds, dtype=int, device=device)
        self._count, self._excuse = self.kernels = outlier_kernels(newton.real, device_arrays.serial(device))

    def excuse(self) -> None:
        """Mark worlds with so few unconverged bodies as converged, by the counts and the largest residuals."""
        newton = self.newton
        inputs = [self.number, self.most, newton.worst, newton._weight[2], newton.options.rtol, *newton.islands.arrays]
        wp.launch(self._excuse, newton.worlds, inputs, device=newton.device)

    def count(self, rtol: float) -> None:
        """Count the bodies of active worlds with a residual ratio above a tolerance."""
        newton = self.newton
        self._out_of_balance.zero_()
        self.number.zero_()
        inputs = [newton.allowed.ratio, self._owner, self._bodies, rtol, *newton.islands.arrays]
        outputs = [self._out_of_balance, self.number]
        device_arrays.sweep(self._count, len(self._owner), inputs, outputs, newton.device, worlds=newton.worlds)

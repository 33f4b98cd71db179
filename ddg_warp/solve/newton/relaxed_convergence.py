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
    """Relaxed convergence of a `CoupledModel` in contact; launches alone.

    Args:
        sleeping: `SleepingIslands`, which number the bodies.
        most: unconverged bodies that a world may have.

    Attributes:
        most; number: (worlds,) unconverged bodies of the last `count`.
    """

    def __init__(self, coupled, sleeping, most: int):
        self.coupled, self.most = coupled, most
        self._owner, self._bodies = sleeping.owner, sleeping.bodies
        worlds, device = coupled.worlds, coupled.device
        self._out_of_balance = wp.zeros(worlds * self._bodies, dtype=int, device=device)
        self.number = wp.zeros(worlds, dtype=int, device=device)
        self._count, self._excuse = self.kernels = outlier_kernels(coupled.real, device_arrays.serial(device))

    def excuse(self, rtol: float, norms, islands) -> None:
        """Mark worlds with so few unconverged bodies as converged, by the counts and the largest residuals."""
        inputs = [self.number, self.most, norms.worst, norms.of_worlds[2], rtol, *islands.arrays]
        wp.launch(self._excuse, self.coupled.worlds, inputs, device=self.coupled.device)

    def count(self, rtol: float, ratio: wp.array, islands) -> None:
        """Count the bodies of active worlds with a residual ratio above a tolerance."""
        self._out_of_balance.zero_()
        self.number.zero_()
        inputs, outputs = [ratio, self._owner, self._bodies, rtol, *islands.arrays], [self._out_of_balance, self.number]
        self.coupled.sweep(self._count, inputs, outputs, len(self._owner))

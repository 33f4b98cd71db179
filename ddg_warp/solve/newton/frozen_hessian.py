"""Frozen Hessian: one factorisation a step, in the worlds of the coupled system that need a direction."""

import warp as wp

from ddg_warp.kernels.core.islands import NEEDS_DIRECTION, Islands
from ddg_warp.kernels.newton.coupled_newton import freeze_kernel


class FrozenHessian:
    """Frozen Hessian of modified Newton: new for the first direction of a solve, reused afterwards.

    Compression is dropped, since the matrix has to be definite for all iterates.

    Attributes:
        arrays, needs_direction: see `Islands`, but worlds need a direction only while the matrix is new.
    """

    def __init__(self, islands: Islands):
        self._flags, scalars = wp.zeros_like(islands.arrays[0]), islands.arrays[1]
        self.arrays, self.needs_direction = [self._flags, scalars], self._flags[NEEDS_DIRECTION]
        self._done = wp.zeros_like(islands.needs_direction)
        self.kernels = [freeze_kernel()]

    def begin(self, islands: Islands) -> None:
        """Discard the matrix of the last solve."""
        self._done.zero_()
        islands.drop_compression.fill_(1)

    def update(self, islands: Islands) -> None:
        """Find the worlds that need a direction and have no matrix yet; mark the matrix as made."""
        wp.copy(self._flags, islands.arrays[0])
        wp.launch(self.kernels[0], len(islands), [self._flags, self._done], device=self._flags.device)

"""A matrix that serves a whole step: which worlds of a net still want one."""

import warp as wp

from ddg_warp.kernels.islands import WANTED, Islands
from ddg_warp.kernels.net.newton import freeze_kernel


class Frozen:
    """Of the first direction of a solve the matrix is new, of those after it the same.

    Compression is left out of it, since it has to be definite wherever the step leads.

    Attributes:
        arrays, wanted: as of the islands, but that worlds want a direction only where their matrix is new.
    """

    def __init__(self, islands: Islands):
        self._islands = islands
        self._flags, scalars = wp.zeros_like(islands.arrays[0]), islands.arrays[1]
        self.arrays, self.wanted = [self._flags, scalars], self._flags[WANTED]
        self._done = wp.zeros_like(islands.wanted)
        self.kernels = [freeze_kernel()]

    def begin(self) -> None:
        """Forget the matrix of the last solve."""
        self._done.zero_()
        self._islands.clamped.fill_(1)

    def update(self) -> None:
        """Find the worlds that want a direction now and have no matrix yet; they are given one."""
        wp.copy(self._flags, self._islands.arrays[0])
        wp.launch(self.kernels[0], len(self._islands), [self._flags, self._done], device=self._flags.device)

"""A matrix that serves a whole step: which worlds of a net still want one."""

import warp as wp

from ddg_warp.kernels.islands import Islands
from ddg_warp.kernels.net.newton import freeze_kernel


class Frozen:
    """Of the first direction of a solve the matrix is new, of those after it the same.

    Compression is left out of it, since it has to be definite wherever the step leads.

    Attributes:
        islands: as those of the solver, but that worlds want a direction only where their matrix is new.
    """

    def __init__(self, islands: Islands):
        self._given = islands
        self.islands = Islands(len(islands), islands.arrays[1].dtype, islands.active.device)
        self.islands.arrays[1] = islands.arrays[1]
        self._done = wp.zeros(len(islands), dtype=int, device=islands.active.device)
        self._freeze = freeze_kernel()

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._freeze]

    def begin(self) -> None:
        """Forget the matrix of the last solve."""
        self._done.zero_()
        self._given.clamped.fill_(1)

    def first(self) -> Islands:
        """Those that want a direction now and have no matrix yet; they are given one."""
        flags = self.islands.arrays[0]
        wp.copy(flags, self._given.arrays[0])
        wp.launch(self._freeze, len(self._given), [flags, self._done], device=flags.device)
        return self.islands

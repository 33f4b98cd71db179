"""Flag that kernels raise and the host reads without synchronisation."""

import warp as wp


class Notice:
    """Integer in host memory that kernels of a device can write.

    On CUDA it is pinned, and the device writes to the host's address (unified addressing), so that the host sees writes of finished
    kernels without waiting.

    Attributes:
        array: the integer (1,), as kernels take it; initially zero.
    """

    def __init__(self, device):
        self._host = wp.zeros(1, dtype=int, device="cpu", pinned=device.is_cuda)
        self._values, self.array = self._host.numpy(), self._host
        if device.is_cuda:
            self.array = wp.array(ptr=self._host.ptr, dtype=int, shape=1, device=device)

    @property
    def given(self) -> bool:
        """True if a kernel has raised the flag."""
        return bool(self._values[0])

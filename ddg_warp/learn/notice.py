"""A flag that kernels raise and the host reads without a wait."""

import warp as wp


class Notice:
    """An integer in memory of the host that kernels of a device can write to.

    On CUDA it is pinned, and the device writes there by the address that the host has for it (unified addressing), so that the host
    sees what kernels have done so far and waits for none.

    Attributes:
        array: the integer (1,), as kernels take it; zero at first.
    """

    def __init__(self, device):
        self._host = wp.zeros(1, dtype=int, device="cpu", pinned=device.is_cuda)
        self._values, self.array = self._host.numpy(), self._host
        if device.is_cuda:
            self.array = wp.array(ptr=self._host.ptr, dtype=int, shape=1, device=device)

    @property
    def given(self) -> bool:
        """Whether a kernel has raised the flag."""
        return bool(self._values[0])

"""Pressures on the shells of a net, on a device."""

import numpy as np
import warp as wp

from ddg_warp.kernels.net import newton
from ddg_warp.net_system import lists


class Pressures:
    """All pressures of a net that follow its surface.

    Attributes:
        count: triangles under pressure.
        meets: (starts, items) of the triangles around each block.
        force: force on each corner of a triangle (worlds * count,) [N].
        kernel: to load before a capture.
    """

    def __init__(self, net):
        self.net, device = net, net.device
        triangles = np.concatenate([p.triangles for p in net.host.pressures])
        starts, items = lists(triangles.ravel(), net.blocks)
        self._triangles, *self.meets = (
            wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=device)
            for v in (triangles, starts, items // 3)
        )
        self.count = len(triangles)
        self._pressure = wp.zeros(self.count, dtype=net.real, device=device)
        self.force = self.make()
        self.kernel = newton.pressure_kernel(net.real)

    def make(self) -> wp.array:
        """Forces, not yet filled."""
        return wp.zeros(self.net.worlds * self.count, dtype=self.net.vector, device=self.net.device)

    def assign(self, at: float, otherwise: float) -> None:
        """Set pressures to time or load parameter `at`; those without an amplitude are multiplied by `otherwise`."""
        self._pressure.assign(np.concatenate([p.at(at, otherwise) * p.pressure for p in self.net.host.pressures]))

    def on(self, q: wp.array, force_out: wp.array) -> None:
        """Forces on the surface q."""
        wp.launch(
            self.kernel,
            self.net.worlds * self.count,
            [q, self._triangles, self._pressure, self.net.blocks],
            [force_out],
            device=self.net.device,
        )

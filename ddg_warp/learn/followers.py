"""Reverse of loads that follow the predicted configuration of a step."""

import numpy as np
import warp as wp

from ddg_warp.kernels.adjoint.loads import POINTS, follower_kernel, gather_kernel
from ddg_warp.solve.loads import Loads
from ddg_warp.solve.net.system import lists


class Followers:
    """Of a group of rods or of a net.

    Args:
        part: `Group` or `DeviceNet`.
    """

    def __init__(self, model, part, midpoint: bool):
        real, host = model.types.real, part.host
        self.part, self._loads = part, Loads(model, part, midpoint)
        self._kernels, points = [], []
        for _, load, places, values, first in self._loads._followers:
            kernel = follower_kernel(load.kernel, load.places.shape[1], part.dim, real)
            self._kernels.append((kernel, load, places, values, first))
            wanted = np.arange(load.places.shape[1]) < POINTS[load.kernel]
            points.append(np.where(wanted, load.places, -1).ravel())
        points = np.concatenate(points)
        items = np.flatnonzero(points >= 0)
        places, index = np.unique(points[items], return_inverse=True)
        starts, order = lists(index.ravel(), len(places))
        self._places, *self._lists = (
            wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=model.wp_device)
            for v in (host.index(places), starts, items[order])
        )
        self._points = wp.zeros(part.worlds * len(points), dtype=wp.types.vector(3, real), device=model.wp_device)
        self._no_angles = wp.zeros((1, 1), dtype=real, device=model.wp_device)
        self._gather = gather_kernel(part.dim, real)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*{kernel for kernel, *_ in self._kernels}, self._gather]

    def upload(self, t0: float, t1: float) -> None:
        """Values at the time that the scheme balances forces at."""
        self._loads.upload(t0, t1)

    def pull(self, x: wp.array, w: wp.array, w_angle: wp.array | None, by_x: wp.array) -> None:
        """Add derivatives by predicted nodes.

        Args:
            x: predicted nodes [node][column].
            w, w_angle: derivatives by the forces on nodes [component][node][column] and by moments [angle][column], None without
                angles; by_x: to what is added, as w.
        """
        part, total = self.part, self._loads.total
        turns = self._no_angles if w_angle is None else w_angle
        for kernel, load, places, values, first in self._kernels:
            inputs = [x, places, values, part.world_columns, first, total, w, turns]
            wp.launch(kernel, (len(load.places), part.worlds), inputs, [self._points], device=part.device)
        inputs = [self._places, *self._lists, self._points, part.world_columns, total]
        wp.launch(self._gather, (len(self._places), part.worlds), inputs, [by_x], device=part.device)

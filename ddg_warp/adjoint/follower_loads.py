"""VJP of follower loads, which a step evaluates on the predicted configuration."""

import numpy as np
import warp as wp

from ddg_warp.kernels.adjoint.follower_loads import POINTS, follower_kernel, gather_kernel
from ddg_warp.solve.forces.loads import Loads
from ddg_warp.solve.linear.sparse_system import lists


class Followers:
    """VJP of the follower loads of a rod group or of the coupled system.

    Args:
        part: `RodGroup` or `CoupledModel`.
    """

    def __init__(self, model, part, midpoint: bool):
        real, host = model.types.real, part.host
        self.part, self._loads = part, Loads(model, part, midpoint)
        self._kernels, points = [], []
        for _, load, nodes, values, first in self._loads._followers:
            kernel = follower_kernel(load.kernel, load.places.shape[1], part.dim, real)
            self._kernels.append((kernel, load, nodes, values, first))
            is_point = np.arange(load.places.shape[1]) < POINTS[load.kernel]
            points.append(np.where(is_point, load.places, -1).ravel())
        points = np.concatenate(points)
        items = np.flatnonzero(points >= 0)
        nodes, index = np.unique(points[items], return_inverse=True)
        starts, order = lists(index.ravel(), len(nodes))
        self._places, *self._lists = (
            wp.array(np.ascontiguousarray(v, np.int32), dtype=int, device=model.wp_device)
            for v in (host.index(nodes), starts, items[order])
        )
        self._points = wp.zeros(part.worlds * len(points), dtype=wp.types.vector(3, real), device=model.wp_device)
        self._no_angles = wp.zeros((1, 1), dtype=real, device=model.wp_device)
        self._gather = gather_kernel(part.dim, real)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*{kernel for kernel, *_ in self._kernels}, self._gather]

    def upload(self, t0: float, t1: float) -> None:
        """Evaluate time functions of loads at the time of the residual."""
        self._loads.upload(t0, t1)

    def vjp(self, x: wp.array, w: wp.array, w_angle: wp.array | None, by_x: wp.array) -> None:
        """Add the gradient with respect to predicted nodes.

        Args:
            x: predicted nodes [node][column].
            w, w_angle: gradients with respect to nodal forces [component][node][column] and to moments [angle][column], None
                without angles.
            by_x: output, added to, in the layout of w.
        """
        part, total = self.part, self._loads.total
        w_moments = self._no_angles if w_angle is None else w_angle
        for kernel, load, places, values, first in self._kernels:
            inputs = [x, places, values, part.world_columns, first, total, w, w_moments]
            wp.launch(kernel, (len(load.places), part.worlds), inputs, [self._points], device=part.device)
        inputs = [self._places, *self._lists, self._points, part.world_columns, total]
        wp.launch(self._gather, (len(self._places), part.worlds), inputs, [by_x], device=part.device)

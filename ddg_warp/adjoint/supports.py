"""VJP of prescribed motion of supports during a step."""

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels.adjoint.time_step import angle_kernel
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.solve.forces.prescribed_element_data import CoupledMotion
from ddg_warp.solve.forces.prescribed_motion import Motion


class Supports:
    """VJP of the supports of a rod group or of the coupled system, with motions by time functions or grips.

    Args:
        part: `RodGroup` or `CoupledModel`.

    Attributes:
        islands: islands at the start of a whole step.

    Raises:
        SceneError: a motion rotates an edge with a free end.
    """

    def __init__(self, model, part, midpoint: bool):
        self.model, self.part, real = model, part, model.types.real
        host = part.host
        self.motion = CoupledMotion(model, midpoint) if part is model.coupled else Motion(model, part, midpoint)
        self.islands = Islands(part.columns, real, model.wp_device)
        self.islands.substep_fraction.fill_(1.0)
        self._angles = angle_kernel(part.dim, real, midpoint)
        turning, ends = host.turning[:, 0], host.edge_ends(host.turning[:, 0])
        loose = np.flatnonzero(~host.holding(ends).all((1, 2)))
        if loose.size:
            raise SceneError(
                f"no gradient goes through a motion that rotates {host.name(int(turning[loose[0]]))} and does not support both of its "
                "nodes; clamp the edge"
            )
        self.by_director = wp.zeros(
            (len(turning), model.worlds), dtype=wp.types.vector(3, real), device=model.wp_device
        )

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._angles, *self.motion.kernels]

    def upload(self, t0: float, t1: float) -> None:
        """Upload poses of motions that are functions of time."""
        self.motion.upload(t0, t1)

    def follow(self, before, after) -> None:
        """Compute grip poses between the states of the model at both ends of the step; launches only."""
        self.motion.follow(before, after)

    def vjp(self, x: wp.array, frame: wp.array, by_node: wp.array, angle: wp.array, by_frame: wp.array) -> None:
        """Convert gradients by prescribed angles to gradients by directors (`by_director`), edge nodes and lagged frames.

        Args:
            x, frame: nodes at the solution [node][column], and the lagged frames [component][edge][column].
            by_node, angle: gradients by nodes [component][node][column], added to, and by angles [edge][column].
            by_frame: gradient by the lagged frames, added to.
        """
        motion = self.motion
        if len(motion.angles):
            read = [motion.angles, motion.directors, motion.pose, motion.stride, *self.islands.arrays]
            wp.launch(
                self._angles,
                (len(motion.angles), self.model.worlds),
                [*read, self.part.world_columns, x, frame, angle],
                [by_node, by_frame, self.by_director],
                device=self.model.wp_device,
            )

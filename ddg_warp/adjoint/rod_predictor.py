"""Predictor of rod groups in the backward pass: recomputed for terms lagged at the predicted configuration, with a VJP.

Follower loads are evaluated on the predicted configuration; in the midpoint rule frames and quadratic potentials are, too.
"""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint import rod_elements, rod_predictor
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.stepping import rod_step, time_step


class RodPredictor:
    """Predictor of a rod group with a VJP, for whole steps solved at the first attempt.

    Args:
        motion: prescribed motion of the supports, None if fixed.

    Attributes:
        x: predicted nodes.
        frame: lagged frames, transported to `x` in the midpoint rule.
        by_x: gradient by predicted nodes (block, n, R), scratch.
        by_frame: gradient by transported frames.
    """

    def __init__(self, model, group, motion, midpoint: bool):
        kind, real, device = group.kind, model.types.real, model.wp_device
        self.model, self.group, self.motion, self._midpoint = model, group, motion, midpoint
        self.carries = kind.twist and midpoint
        nodes, vector = (group.nodes, group.columns), wp.types.vector(kind.dim, real)

        def make(*rows, dtype=real, needed=True):
            return device_arrays.allocate((*rows, *(nodes if needed else (1, 1))), dtype, device)

        self.x, self._base, self._target = (make(dtype=vector) for _ in range(3))
        self._theta, self._target_angle = (make(needed=kind.twist) for _ in range(2))
        self.frame, self.by_frame = make(7, needed=kind.twist), make(7, needed=self.carries)
        self._direction = self._predict = self._for = None
        self.by_x, self._excess, self._added = (make(kind.block) for _ in range(3))
        self._islands = Islands(group.columns, real, device)
        self._islands.substep_fraction.fill_(1.0)
        self._dt = wp.zeros(model.worlds, dtype=real, device=device)
        self._none = wp.zeros(group.columns, dtype=real, device=device)
        self._begin = time_step.begin_kernel(kind.nodes, real, midpoint)
        self._carry = rod_elements.transport_kernel(kind, real) if self.carries else None
        self._vjp = rod_predictor.predict_kernel(kind, real, midpoint)

    @classmethod
    def of(cls, model, group, motion, scheme: str | None) -> "RodPredictor | None":
        """Return the predictor of a scheme; None if solves lag nothing at the predicted configuration."""
        kind, midpoint = group.kind, scheme == "implicit_midpoint"
        needed = scheme and (group.host.followers or (midpoint and (kind.twist or kind.quadratic)))
        return cls(model, group, motion, midpoint) if needed else None

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture, after `suit`."""
        return [self._begin, self._predict, self._vjp, *([self._carry] if self._carry else [])]

    def suit(self, solved, s: float) -> bool:
        """Prepare for solves of a `RodStep` over s [s]; return True if kernels or arrays have changed."""
        linear = solved.newton.linear
        if self._for != (s, self.model.version):
            self._for = s, self.model.version
            self._dt.fill_(2.0 * s if self._midpoint else s)
            self._islands.straight_rotation_limit.assign(solved.limits(s)["straight_rotation_limit"])
        if self._direction is not None and self._direction.dtype is linear:
            return False
        kind, real = self.group.kind, self.model.types.real
        self._direction = device_arrays.allocate((kind.block, *self.x.shape), linear, self.model.wp_device)
        self._predict = rod_step.predict_kernel(kind, real, linear, self._midpoint)
        return True

    def find(self, before) -> None:
        """Compute the predictor of a step from the state `before` of the group; launches only."""
        group, islands = self.group, self._islands
        islands.rotate_predictor.zero_()
        wp.launch(
            self._begin,
            group.node_threads,
            [group.node_state(before), before.frame, group.fixed, group.count, group.world]
            + [self._dt, self._none, self._none, *islands.arrays],
            [self.x, self._theta, self.frame, None, self._target, self._target_angle],
            device=self.model.wp_device,
        )
        if self.motion:
            self.motion.place(islands, self.x)
        wp.launch(
            self._predict,
            group.columns,
            [before.x, before.v, group.fixed, group.anchor, group.count, *islands.arrays],
            [self._base, self._direction, self.x, self.frame],
            device=self.model.wp_device,
        )

    def vjp(self, before, gather, window: wp.array, by_fixed: wp.array, start, grad_inverse_step: wp.array) -> None:
        """Add the gradients `by_x` and `by_frame` to `start`, the gradient by the state before the step.

        Args:
            before: as of the last `find`.
            gather: kernel that assembles element windows to nodes.
            window: scratch.
            by_fixed: gradient by fixed dofs, added to.
            grad_inverse_step: gradient by the inverse step, added to.
        """
        group = self.group
        if self.carries:
            self._launch(self._carry, [self.x, before.frame, group.count, self.by_frame], [window, start.frame])
            self._launch(gather, [window, group.count], [self.by_x])
        wp.launch(
            self._vjp,
            group.columns,
            [self.x, before.x, before.v, group.fixed, group.anchor, group.count, *self._islands.arrays, self.by_x],
            [self._excess, self._added, by_fixed, start.x, start.v, grad_inverse_step],
            device=self.model.wp_device,
        )

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, (self.group.nodes, self.group.columns), inputs, outputs, device=self.model.wp_device)

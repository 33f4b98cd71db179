"""VJP of user-defined forces in the steps and equilibria of the coupled system; see `kernels.forces.user_force`."""

import warp as wp

from ddg_warp.solve.forces.user_force import UserForces


class UserForceAdjoint:
    """VJP of user-defined forces at the solution of a step or an equilibrium.

    Args:
        quadratic: True if blocks have a quadratic potential; see `kernels.core.inertia`.

    Attributes:
        force: `UserForces` at the solution, in float64 linear algebra.
        by_parameters: gradient by all components of the parameters of each force (worlds, nodes), written by `vjp`.
        by_rate: gradient by the inverse step, in contributions of blocks (W N,), added to by `vjp`.
    """

    quadratic = False

    def __init__(self, model, quadratic: bool):
        self.coupled, self.force = model.coupled, UserForces(model, wp.float64, quadratic)
        self.by_parameters = [
            wp.zeros(
                part.parameters.shape,
                dtype=wp.types.vector(sum(size for _, size in part.layout), self.coupled.real),
                device=self.coupled.device,
            )
            for part in self.force.parts
        ]
        coupled = model.coupled
        self.by_rate = wp.zeros(coupled.worlds * coupled.blocks, dtype=coupled.real, device=coupled.device)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*self.force.kernels, *self.force.pulls]

    def begin(self, before, load_factor: float | None) -> None:
        """Take the start of a solve; its time from `upload`, or the load parameter of an equilibrium."""
        if load_factor is not None:
            self.force.upload(load_factor, load_factor)
        self.force.start_at(before.q)

    def vjp(self, pull) -> None:
        """Add the gradients by positions and rate, and write gradients by parameters."""
        force, coupled = self.force, self.coupled
        for part, kernel, by_parameters in zip(force.parts, force.pulls, self.by_parameters, strict=True):
            read = [
                part.nodes,
                part.parameters,
                pull.solved.q,
                force.start,
                force.time,
                pull.rate,
                pull.w,
                coupled.blocks,
            ]
            outputs = [pull.by_fixed, pull.start.q, self.by_rate, by_parameters]
            wp.launch(kernel, part.parameters.shape, read, outputs, device=coupled.device)

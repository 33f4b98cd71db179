"""Pending motion in contact: the remainder of limited motions of supports and predictors; see `contact_newton`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.newton.contact_newton import pending_kernels

ROUNDING = 16.0  # ulps within which supports count as arrived


class PendingMotion:
    """Motion of supports and predictors that the next direction begins with, in worlds where CCD has limited it.

    Args:
        linear: scalar type of directions.

    Attributes:
        going: (1,), nonzero if a world has pending motion; `StepLimit.begin` resets it, `end` sets it.
    """

    def __init__(self, model, linear):
        self.coupled, host, device = model.coupled, model.coupled.host, model.coupled.device
        self._eps, worlds = ROUNDING * model.types.eps, self.coupled.worlds
        support_blocks = np.concatenate([host.moving[:, 0], host.turning[:, 0]])
        self._nodes = wp.array(support_blocks.astype(np.int32), dtype=int, device=device)
        self._aims = wp.zeros((max(1, len(support_blocks)), worlds), dtype=self.coupled.vector, device=device)
        blocks, vector = worlds * self.coupled.blocks, wp.types.vector(3, linear)
        self._rest, self._product = (wp.zeros(blocks, dtype=vector, device=device) for _ in range(2))
        self.going = wp.zeros(1, dtype=int, device=device)
        self.kernels = pending_kernels(self.coupled.real, linear, device_arrays.serial(device))
        self._aim, self._land, self._arrive, self._end = self.kernels[:4]
        self._find_rest, self._push, self._lessen, self._add = self.kernels[4:]

    def clear(self, iterates, islands) -> None:
        """End all pending motion: the target is the iterate itself."""
        wp.copy(iterates.proposed, iterates.q)
        islands.support_motion_pending.zero_()
        self.going.zero_()

    def aim(self, iterates) -> None:
        """Store the prescribed positions of supports, where a predictor has them."""
        self._launch(self._aim, [self.coupled.blocks, iterates.q], [self._aims])

    def land(self, iterates, system, islands, modes: wp.array) -> None:
        """Complete the motion of supports after full updates, in worlds with `modes` of an update."""
        inputs = [self._aims, system.masks.fixed, modes, *islands.arrays, self.coupled.blocks]
        self._launch(self._land, inputs, [iterates.q])

    def arrive(self, iterates, system, islands, modes: wp.array) -> None:
        """Mark worlds with moving supports after a limited motion."""
        inputs = [self._aims, system.masks.fixed, modes, self._eps, self.coupled.blocks, iterates.q]
        self._launch(self._arrive, inputs, [islands.arrays[0]])

    def end(self, iterates, islands) -> None:
        """Reset the target to the iterate in worlds without pending motion."""
        inputs = [iterates.q, islands.arrays[0], self.coupled.blocks]
        self.coupled.sweep(self._end, inputs, [iterates.proposed, self.going])

    def approach(self, iterates, system, terms, rigid_bodies) -> None:
        """Subtract the resistance of a `ContactPotential` against pending motion from the residual.

        Args:
            rigid_bodies: `RigidBodies` or None.
        """
        blocks, fixed, wanted = self.coupled.blocks, system.masks.fixed, system.wanted

        def approach() -> None:
            self.coupled.sweep(self._find_rest, [iterates.q, iterates.proposed, wanted, blocks], [self._rest])
            self._launch(self._push, [self._aims, iterates.q, fixed, wanted, blocks], [self._rest])
            self._product.zero_()
            if rigid_bodies:
                rigid_bodies.spread(self._rest)
            terms.product(self._rest, self._product)
            if rigid_bodies:
                rigid_bodies.condense_product(self._product)
            self.coupled.sweep(self._lessen, [self._product, fixed, wanted, blocks], [system.rhs])

        wp.capture_if(self.going, approach)

    def follow(self, system) -> None:
        """Add pending motion to the directions."""
        inputs, outputs = [self._rest, system.wanted, self.coupled.blocks], [system.direction]
        wp.capture_if(self.going, lambda: self.coupled.sweep(self._add, inputs, outputs))

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        """Launch over the supports of every world, if any."""
        if len(self._nodes):
            dim, inputs = (len(self._nodes), self.coupled.worlds), [self._nodes, *inputs]
            wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device)

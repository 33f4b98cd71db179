"""Rigid bodies of the coupled system on a device: constant arrays, and their initial state."""

import numpy as np
import warp as wp

from ddg_warp.kernels.rigid_bodies import motion

REST, TORQUE = "rest_6", "torque"  # driven parameters of the term "hinge": angle and torque


class RigidBodyTables:
    """Constant arrays of the rigid bodies of a `CoupledModel`.

    Attributes:
        `host`: `RigidBodyArrays`.
        `origins`, `spins`, `carried`, `owner`, `starts`, `arms`: see there.
        moments: principal moments of inertia (W B,).
    """

    def __init__(self, host, coupled):
        self.host, self.coupled, device = host, coupled, coupled.device

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        for name in ("origins", "spins", "carried", "owner", "starts"):
            setattr(self, name, put(getattr(host, name)))
        self.matrix = wp.types.matrix((3, 3), coupled.real)
        self.arms = wp.array(host.arms.reshape(-1, 3), dtype=coupled.vector, device=device)
        self.moments = wp.array(np.tile(host.moments, (coupled.worlds, 1)), dtype=coupled.vector, device=device)
        for part in coupled.sets:
            for name in (REST, TORQUE) if part.term.name == "hinge" else ():
                part.parameters.prescribe(name, (coupled.worlds, part.elements))
        self._carry = motion.carry_kernel(coupled.real)

    def __len__(self) -> int:
        return len(self.host)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._carry]

    def start(self, state) -> None:
        """Set the initial poses and rates in a state at rest."""
        host, worlds = self.host, self.coupled.worlds
        spins = np.einsum("bji,bj->bi", host.axes, host.angular_velocity)
        momentum = np.einsum("bij,bj->bi", host.axes, host.moments * spins)
        state.rotation.assign(np.tile(host.axes, (worlds, 1, 1)))
        state.momentum.assign(np.tile(momentum, (worlds, 1)))
        v = state.v.numpy().reshape(worlds, -1, 3)
        v[:, host.origins] = host.velocity
        state.v.assign(v.reshape(-1, 3))
        self.carry(state)

    def carry(self, state) -> None:
        """Place carried nodes of a state by the poses of their bodies, with their velocities; capturable."""
        inputs = [state.rotation, state.momentum, self.moments, self.arms, self.owner, self.carried, self.origins]
        wp.launch(
            self._carry,
            (self.coupled.worlds, len(self.host.carried)),
            [*inputs, self.coupled.blocks],
            [state.q, state.v],
            device=self.coupled.device,
        )

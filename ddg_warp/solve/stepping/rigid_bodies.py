"""Rigid bodies in time steps of the coupled system: flight before a solve, poses and momenta after it."""

import numpy as np
import warp as wp

from ddg_warp.kernels.rigid_bodies import motion


class RigidBodyStep:
    """Flight and end of a step of the rigid bodies of a `CoupledStep`; see `kernels.rigid_bodies.motion`.

    Args:
        newton: `CoupledNewton`, with its `RigidBodies`.

    Attributes:
        acceleration: mean accelerations of the centres of mass over the last substep (W B,) [m/s^2].
        has_wrenches: True with wrenches of controls.
    """

    def __init__(self, newton, midpoint: bool):
        self.newton, self.bodies, self.tables = newton, newton.rigid_bodies, newton.rigid_bodies.tables
        self.has_wrenches = False
        self.coupled, real = newton.coupled, newton.coupled.real
        self.acceleration = wp.zeros(
            self.coupled.worlds * len(self.tables), dtype=self.coupled.vector, device=self.coupled.device
        )
        self._accelerate = motion.accelerate_kernel(real, midpoint)
        self._predict, self._turn = motion.predict_kernel(real, midpoint), motion.turn_kernel(real)
        self._finish, self._depart = motion.finish_kernel(real, midpoint), motion.depart_kernel(real)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        departs = [self._depart] if self.newton.contact else []
        return [self._accelerate, self._predict, self._turn, self._finish, *departs, *self.tables.kernels]

    def push(self, wrenches: np.ndarray | None) -> None:
        """Set forces at the centres and moments on all bodies (1 or worlds, bodies, 6), none without."""
        if wrenches is None and not self.has_wrenches:
            return
        self.has_wrenches = wrenches is not None
        shape = self.coupled.worlds, len(self.tables), 6
        values = np.broadcast_to(0.0 if wrenches is None else wrenches, shape).reshape(-1, 6)
        struct = self.bodies.bodies
        struct.force.assign(np.ascontiguousarray(values[:, :3]))
        struct.moment.assign(np.ascontiguousarray(values[:, 3:]))

    def predict(self, before) -> None:
        """Find the orientations after the flight, and move carried nodes there."""
        tables, islands = self.tables, self.newton.islands
        inputs = [before.rotation, before.momentum, tables.moments, len(tables), islands.arrays[1]]
        self._launch(self._predict, inputs, [self.bodies.predicted, self.bodies.bodies.inertia])
        self.bodies.place(self.newton.iterates, islands)

    def turn(self, before) -> None:
        """Write the rotation vectors of the flight from a state `before` into the iterate."""
        inputs = [before.rotation, self.bodies.predicted, self.tables.spins, self.coupled.blocks]
        self._launch(self._turn, inputs, [self.newton.iterates.q])

    def turn_ghosts(self, before, start) -> None:
        """Rotate the ghosts of clamped rods from the state `before` with the flight, into the lagged data of `start`."""
        q = self.newton.iterates.q
        self.turn(before)
        self.coupled.turn_ghosts(before, start, q, self.newton.islands.substep_accepted)

    def depart(self, before) -> None:
        """Let the motion of the predictor begin at the orientations of a state `before`, in contact."""
        iterates, islands = self.newton.iterates, self.newton.islands
        inputs = [before.rotation, self.bodies.predicted, self.tables.spins, self.bodies.longest, self.coupled.blocks]
        self._launch(self._depart, [*inputs, islands.substep_accepted], [iterates.base, iterates.q])

    def finish(self, before, after) -> None:
        """Write poses and momenta at the end of accepted substeps, with carried nodes."""
        newton, tables = self.newton, self.tables
        inputs = [
            newton.iterates.q,
            self.bodies.predicted,
            self.bodies.bodies.inertia,
            before.rotation,
            before.momentum,
        ]
        inputs += [tables.spins, self.coupled.blocks, *newton.islands.arrays]
        self._launch(self._finish, inputs, [after.rotation, after.momentum, after.q])
        tables.carry(after)
        inputs = [before.v, after.v, tables.centers, self.coupled.blocks, *newton.islands.arrays]
        self._launch(self._accelerate, inputs, [self.acceleration])

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, (self.coupled.worlds, len(self.tables)), inputs, outputs, device=self.coupled.device)

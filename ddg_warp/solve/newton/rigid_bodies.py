"""Rigid bodies in the solves of the coupled system; see `kernels.rigid_bodies`."""

import warp as wp

from ddg_warp.kernels.rigid_bodies import condensation, motion
from ddg_warp.timers import timer


class RigidBodies:
    """Rigid bodies of a `CoupledNewton`: flight, carried nodes, residuals and the matrix.

    Args:
        tables: `RigidBodyTables`; sparsity: `SparseSystem`; `residual`: `ResidualAssembler`.
        linear: scalar type of directions.
        quadratic: True if blocks have a quadratic potential; `outer`: True if there are contact forces or user-defined ones.

    Attributes:
        predicted: orientations after the torque-free flight (W B,).
        bodies: struct of kernels, with y and D of carried nodes and the inertia of rotations.
    """

    def __init__(self, tables, sparsity, linear, quadratic: bool, inertia_structs: bool, outer: bool):
        self.tables, self.sparsity, self.coupled = tables, sparsity, tables.coupled
        coupled, real, device = tables.coupled, tables.coupled.real, tables.coupled.device
        worlds, bodies, carried = coupled.worlds, len(tables), len(tables.host.carried)
        self.predicted = wp.zeros(worlds * bodies, dtype=tables.matrix, device=device)
        self.bodies = struct = condensation.bodies_type(real)()
        for name in ("origins", "spins", "carried", "starts"):
            setattr(struct, name, getattr(tables, name))
        struct.y = wp.zeros(worlds * carried, dtype=coupled.vector, device=device)
        struct.derivative = wp.zeros(worlds * carried, dtype=tables.matrix, device=device)
        struct.inertia = wp.zeros_like(self.predicted)
        self._place, self._spread = motion.place_kernel(real), motion.spread_kernel(real, linear)
        self._balance = condensation.balance_kernel(real, linear, quadratic, outer)
        self._condense = condensation.condense_kernel(real, linear, inertia_structs, not coupled.sets)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._place, self._spread, self._balance, self._condense]

    def place(self, iterates, islands) -> None:
        """Place carried nodes at the iterate."""
        tables, struct = self.tables, self.bodies
        inputs = [self.predicted, tables.arms, tables.owner, tables.carried, tables.origins, tables.spins]
        inputs += [self.coupled.blocks, islands.status]
        self._launch(self._place, self._carried, inputs, [iterates.q, struct.y, struct.derivative])

    def spread(self, system) -> None:
        """Write the displacements of carried nodes along directions."""
        tables = self.tables
        inputs = [self.bodies.derivative, tables.owner, tables.carried, tables.origins, tables.spins]
        self._launch(self._spread, self._carried, [*inputs, self.coupled.blocks, system.wanted], [system.direction])

    @timer("residual")
    def balance(self, inputs, sets: wp.array, islands, outputs) -> None:
        """Write residuals and energy changes of all blocks of bodies; see `ResidualAssembler`."""
        self._launch(self._balance, len(self.tables), [inputs, self.bodies, sets, *islands.arrays], [outputs])

    def condense(self, mass: wp.array, islands, matrix: wp.array) -> None:
        """Add the entries of carried nodes to those of the bodies, after the assembly of element sets."""
        lists = self.sparsity.condensed
        inputs = [
            mass,
            self.bodies,
            *(lists[n] for n in ("targets", "rows", "turning", "starts", "sources", "left", "right")),
        ]
        inputs += [self.sparsity.positions, *islands.arrays]
        self._launch(self._condense, len(lists["targets"]), inputs, [matrix])

    @property
    def _carried(self) -> int:
        return len(self.tables.host.carried)

    def _launch(self, kernel, count: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, (self.coupled.worlds, count), inputs, outputs, device=self.coupled.device)

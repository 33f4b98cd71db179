"""Rigid bodies in the solves of the coupled system; see `kernels.rigid_bodies`."""

import numpy as np
import warp as wp

from ddg_warp.kernels.rigid_bodies import condensation, motion
from ddg_warp.solve.collision.support_arcs import PART
from ddg_warp.timers import timer


class RigidBodies:
    """Rigid bodies of a `CoupledNewton`: flight, carried nodes, residuals and the matrix.

    Args:
        tables: `RigidBodyTables`; sparsity: `SparseSystem`; `residual`: `ResidualAssembler`.
        linear: scalar type of directions.
        quadratic: True if blocks have a quadratic potential; `outer`: True if there are contact forces or user-defined ones.

    Attributes:
        predicted: orientations after the torque-free flight (W B,).
        longest: largest rotation of each body in one motion that contact limits (B,) [rad].
        bodies: struct of kernels, with y and D of carried nodes and the inertia of rotations.
    """

    def __init__(self, tables, sparsity, linear, quadratic: bool, inertia_structs: bool, outer: bool):
        self.tables, self.sparsity, self.coupled = tables, sparsity, tables.coupled
        self._touches = tables.coupled.host.contact_parameters is not None
        coupled, real, device = tables.coupled, tables.coupled.real, tables.coupled.device
        worlds, bodies, carried = coupled.worlds, len(tables), len(tables.host.carried)
        self.predicted = wp.zeros(worlds * bodies, dtype=tables.matrix, device=device)
        self.bodies = struct = condensation.bodies_type(real)()
        for name in ("origins", "spins", "carried", "starts"):
            setattr(struct, name, getattr(tables, name))
        struct.y = wp.zeros(worlds * carried, dtype=coupled.vector, device=device)
        struct.derivative = wp.zeros(worlds * carried, dtype=tables.matrix, device=device)
        struct.inertia = wp.zeros_like(self.predicted)
        struct.force, struct.moment = (wp.zeros(worlds * bodies, dtype=coupled.vector, device=device) for _ in range(2))
        struct.center = tables.center
        longest = _longest_arcs(coupled.host) if self._touches else np.full(bodies, np.inf)
        self.longest = wp.array(longest, dtype=real, device=device)
        self._shorten = motion.shorten_kernel(real, linear)
        self._place, self._spread = motion.place_kernel(real), motion.spread_kernel(real, linear)
        self._balance = condensation.balance_kernel(real, linear, quadratic, outer)
        self._gather, self._condense_diagonal, self._condense_product = condensation.contact_kernels(real, linear)
        self._condense = condensation.condense_kernel(real, linear, inertia_structs, not coupled.sets)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        contact = [self._gather, self._condense_diagonal, self._condense_product, self._shorten]
        return [self._place, self._spread, self._balance, self._condense, *(contact if self._touches else [])]

    def place(self, iterates, islands) -> None:
        """Place carried nodes at the iterate."""
        tables, struct = self.tables, self.bodies
        inputs = [self.predicted, tables.arms, tables.owner, tables.carried, tables.origins, tables.spins]
        inputs += [self.coupled.blocks, islands.status]
        self._launch(self._place, self._carried, inputs, [iterates.q, struct.y, struct.derivative])

    def spread(self, direction: wp.array) -> None:
        """Write the displacements of carried nodes along directions of the linear solver."""
        tables = self.tables
        inputs = [self.bodies.derivative, tables.owner, tables.carried, tables.origins, tables.spins]
        self._launch(self._spread, self._carried, [*inputs, self.coupled.blocks], [direction])

    def shorten(self, direction: wp.array, cap: float, wanted: wp.array, rotation: wp.array) -> None:
        """Raise the squared rotations of worlds (worlds,) so that updates in contact turn no body by more than its `longest`.

        Args:
            cap: largest rotation of updates [rad].
        """
        if self._touches:
            inputs = [direction, self.tables.spins, self.longest, cap, self.coupled.blocks, wanted]
            self._launch(self._shorten, len(self.tables), inputs, [rotation])

    def gather(self, products, p: wp.array, product: wp.array, system) -> None:
        """Add the products of contact pairs at carried nodes, see `PairProduct.settle`, to those of the bodies."""
        inputs = [self.bodies, products.sets, products.in_pairs, p, system.masks.inactive, system.wanted]
        self._launch(self._gather, len(self.tables), inputs, [product, system.dots])

    def condense_contact(self, diagonal: wp.array) -> None:
        """Add the diagonal blocks of contact at carried nodes to those of the bodies."""
        self._launch(self._condense_diagonal, len(self.tables), [self.bodies, self.coupled.blocks], [diagonal])

    def condense_product(self, product: wp.array) -> None:
        """Add a product at carried nodes to that of the bodies."""
        self._launch(self._condense_product, len(self.tables), [self.bodies, self.coupled.blocks], [product])

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


def _longest_arcs(host) -> np.ndarray:
    """Return the largest rotation of every body in one motion (B,) [rad], infinite without a surface.

    CCD moves points straight. The sagitta R a^2 / 8 of an arc stays below `PART` of the activation distance and of the thickness; see
    `ddg_warp.solve.collision.support_arcs`.
    """
    rigid, contact = host.rigid_bodies, host.contact_parameters
    result = np.full(len(rigid), np.inf)
    least = min(body.radius for body in contact.bodies)
    for number, body in enumerate(contact.bodies):
        if body.rigid >= 0:
            arms = rigid.arms[np.isin(rigid.carried, body.nodes)]
            longest = np.linalg.norm(arms, axis=1).max() + body.radius
            group = contact.group[number]
            allowed = PART * min(contact.range[group].min(), body.radius + least)
            result[body.rigid] = min(result[body.rigid], np.sqrt(8.0 * allowed / longest))
    return result

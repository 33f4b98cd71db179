"""Rigid bodies in the solves of the coupled system; see `kernels.rigid_bodies`."""

import numpy as np
import warp as wp

from ddg_warp.kernels.rigid_bodies import condensation, contact_energy, motion
from ddg_warp.solve.collision.support_arcs import PART
from ddg_warp.timers import timer

FREE = 1e-9  # stiffness of free motions in equilibria with contact, over the least contact stiffness


class RigidBodies:
    """Rigid bodies of a `CoupledNewton`: flight, carried nodes, residuals and the matrix.

    Args:
        tables: `RigidBodyTables`.
        sparsity: `SparseSystem`.
        linear: scalar type of directions.
        quadratic: True if blocks have a quadratic potential; `outer`: True if there are contact forces or user-defined ones.

    Attributes:
        predicted: orientations after the torque-free flight (W B,).
        longest: largest rotation of each body in one motion that contact limits (B,) [rad].
        cross: blocks of contact between origin and rotation of bodies, at blocks of rotations (W N,); empty without contact.
        least: least fraction of the motion of each world after `bound_rotations` (worlds,).
        shift: added to the diagonal of the matrix (N,); empty in time steps.
        bodies: struct of kernels, with y and D of carried nodes and the inertia of rotations.
    """

    def __init__(self, tables, sparsity, linear, quadratic: bool, inertia_structs: bool, outer: bool):
        self.tables, self.sparsity, self.coupled, self.linear = tables, sparsity, tables.coupled, linear
        self._touches = tables.coupled.host.contact_parameters is not None
        coupled, real, device = tables.coupled, tables.coupled.real, tables.coupled.device
        worlds, bodies, carried = coupled.worlds, len(tables), len(tables.host.carried)
        self.predicted = wp.zeros(worlds * bodies, dtype=tables.matrix, device=device)
        self.bodies = struct = condensation.bodies_type(real)()
        for name in ("origins", "spins", "carried", "starts"):
            setattr(struct, name, getattr(tables, name))
        struct.y = wp.zeros(worlds * carried, dtype=coupled.vector, device=device)
        struct.derivative = wp.zeros(worlds * carried, dtype=tables.matrix, device=device)
        struct.inertia, struct.virial = (wp.zeros_like(self.predicted) for _ in range(2))
        for name in ("force", "moment", "sum_force", "sum_moment"):
            setattr(struct, name, wp.zeros(worlds * bodies, dtype=coupled.vector, device=device))
        struct.center = tables.center
        longest = _longest_arcs(coupled.host) if self._touches else np.full(bodies, np.inf)
        self.longest = wp.array(longest, dtype=real, device=device)
        self._fractions, self.least = (
            wp.zeros(n, dtype=real, device=device) for n in (worlds * coupled.blocks, worlds)
        )
        self._measure, self._shorten, self._note = motion.arc_kernels(real)
        self._turn, self._refuse = motion.turn_kernel(real), contact_energy.refuse_kernel(real)
        self._place, self._spread = motion.place_kernel(real), motion.spread_kernel(real, linear)
        self._balance = condensation.balance_kernel(real, linear, quadratic, outer)
        M = wp.types.matrix((3, 3), linear)
        self.cross = wp.zeros(worlds * coupled.blocks if self._touches else 0, dtype=M, device=device)
        self._factors = wp.zeros((3, worlds * bodies), dtype=M, device=device)
        self._factorise, self._apply = condensation.preconditioner_kernels(linear)
        self._gather, self._condense_diagonal, self._condense_product = condensation.contact_kernels(real, linear)
        self.shift = wp.zeros(0, dtype=linear, device=device)
        self._condense = condensation.condense_kernel(real, linear, inertia_structs, not coupled.sets)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._balance, *self.matrix_kernels]

    @property
    def matrix_kernels(self) -> list:
        """Kernels of carried nodes and of linear systems."""
        contact = [self._gather, self._condense_diagonal, self._condense_product, self._turn, self._refuse]
        contact += [self._measure, self._shorten, self._note]
        return [
            self._place,
            self._spread,
            self._condense,
            self._factorise,
            self._apply,
            *(contact if self._touches else []),
        ]

    def resist(self) -> None:
        """Add a small stiffness to the matrix, against motions that contact leaves free and rounding would drive."""
        host, shift = self.coupled.host, np.zeros(self.coupled.blocks)
        rigid, stiffness = self.tables.host, host.contact_parameters.stiffness
        shift[rigid.origins] = FREE * stiffness[stiffness > 0.0].min()
        shift[rigid.spins] = shift[rigid.origins] * rigid.lengths(host.mass) ** 2
        self.shift = wp.array(shift, dtype=self.shift.dtype, device=self.coupled.device)

    def begin_statics(self, rotation: wp.array, loads: np.ndarray) -> None:
        """Count rotations from orientations (W B,), without inertia, and take moments on bodies out of loads (worlds, N, 3)."""
        wp.copy(self.predicted, rotation)
        spins = self.tables.host.spins
        self.bodies.moment.assign(np.ascontiguousarray(loads[:, spins].reshape(-1, 3)))
        loads[:, spins] = 0.0

    def place(self, iterates, islands) -> None:
        """Move carried nodes to the iterate."""
        tables, struct = self.tables, self.bodies
        inputs = [self.predicted, tables.arms, tables.owner, tables.carried, tables.origins, tables.spins]
        inputs += [self.coupled.blocks, islands.status]
        self._launch(self._place, self._carried, inputs, [iterates.q, struct.y, struct.derivative])

    def spread(self, direction: wp.array) -> None:
        """Write the displacements of carried nodes along directions of the linear solver."""
        tables = self.tables
        inputs = [self.bodies.derivative, tables.owner, tables.carried, tables.origins, tables.spins]
        self._launch(self._spread, self._carried, [*inputs, self.coupled.blocks], [direction])

    def begin_slip(self, rotation: wp.array, start: wp.array) -> None:
        """Write rotation vectors from the predicted orientations to orientations (W B,) into dof blocks at the start of slip."""
        inputs = [self.predicted, rotation, self.tables.spins, self.coupled.blocks]
        self._launch(self._turn, len(self.tables), inputs, [start])

    def bound_rotations(self, start: wp.array, q: wp.array, ccd_body: wp.array, num_ccd_bodies: int, together) -> None:
        """Shorten the motions from `start` to q that rotate a body by more than `longest`.

        Args:
            ccd_body: CCD body of every block; together: (worlds,), nonzero where all move by one fraction.
        """
        worlds, fractions = self.coupled.worlds, self._fractions[: self.coupled.worlds * num_ccd_bodies]
        fractions.fill_(1.0)
        self.least.fill_(1.0)
        bodies = [ccd_body, num_ccd_bodies]
        inputs = [start, q, self.tables.spins, self.longest, *bodies]
        self._launch(self._measure, len(self.tables), inputs, [fractions, self.least])
        inputs = [start, *bodies, together, fractions, self.least]
        wp.launch(self._shorten, (worlds, self.coupled.blocks), inputs, [q], device=self.coupled.device)

    def refuse(self, before, iterates, push: wp.array, islands, smallest: float) -> None:
        """Reject substeps from a coupled state where contact forces `push` (W N,) on rotating bodies create energy.

        `smallest`: fraction of a step that retries reach.
        """
        tables, shortest = self.tables, max(contact_energy.SHORTEST, smallest)
        inputs = [before.rotation, before.momentum, tables.moments, self.predicted, tables.arms, self.bodies]
        inputs += [iterates.q, iterates.target, self.coupled.mass, push, shortest]
        self._launch(self._refuse, len(tables), inputs, [*islands.arrays])

    def note_fractions(self, time: wp.array) -> None:
        """Limit step fractions (worlds,) to the fractions of `bound_rotations`."""
        wp.launch(self._note, self.coupled.worlds, [self.least], [time], device=self.coupled.device)

    def gather(self, products, p: wp.array, product: wp.array, system) -> None:
        """Add the products of contact pairs at carried nodes, see `PairProduct.settle`, to the products of the bodies."""
        inputs = [self.bodies, products.sets, products.in_pairs, p, system.masks.inactive, system.wanted]
        self._launch(self._gather, len(self.tables), inputs, [product, system.dots])

    def condense_contact(self, sets: wp.array, diagonal: wp.array) -> None:
        """Write the diagonal blocks of contact of bodies, and `cross`, from the blocks of carried nodes and sets of pairs."""
        inputs = [self.bodies, sets, self.coupled.blocks]
        self._launch(self._condense_diagonal, len(self.tables), inputs, [diagonal, self.cross])

    def factorise(self, system, more: wp.array) -> None:
        """Factorise the blocks of bodies for `precondition`; `more`: diagonal blocks of contact (W N,), empty without."""
        tables, table = self.tables, self.sparsity
        inputs = [tables.origins, tables.spins, table.condensed["crossing"], table.diagonal, system.matrix]
        inputs += [table.positions, more, self.cross, system.masks.inactive, system.outdated, self.coupled.blocks]
        self._launch(self._factorise, len(tables), inputs, [self._factors])

    def precondition(self, system, residual: wp.array, z: wp.array) -> None:
        """Write z of bodies from the residual, and r . z block by block."""
        tables = self.tables
        inputs = [tables.origins, tables.spins, self._factors, residual, system.wanted, self.coupled.blocks]
        self._launch(self._apply, len(tables), inputs, [z, system.dots])

    def condense_product(self, product: wp.array) -> None:
        """Add a product at carried nodes to that of the bodies."""
        self._launch(self._condense_product, len(self.tables), [self.bodies, self.coupled.blocks], [product])

    @timer("residual")
    def balance(self, inputs, sets: wp.array, islands, outputs) -> None:
        """Write residuals and energy changes of all blocks of bodies; see `ResidualAssembler`."""
        self._launch(self._balance, len(self.tables), [inputs, self.bodies, sets, *islands.arrays], [outputs])

    def condense(self, mass: wp.array, islands, matrix: wp.array) -> None:
        """Add the entries of carried nodes to the entries of bodies, after the assembly of element sets."""
        lists = self.sparsity.condensed
        inputs = [
            mass,
            self.bodies,
            *(lists[n] for n in ("targets", "rows", "turning", "starts", "sources", "left", "right")),
        ]
        inputs += [self.sparsity.positions, self.shift, *islands.arrays]
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

"""Friction of the coupled system as a function of positions, normal forces and directions included; see `kernels.adjoint.contact`."""

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint.contact import NUMBERS, ROLLED, SPUN, friction_jacobian_kernel
from ddg_warp.kernels.collision.contact.assembly import ITEMS, PAIR_NODES
from ddg_warp.kernels.terms import FRICTION_LAWS
from ddg_warp.solve.collision.rolling_rotation import rotated_by


class FrictionJacobian:
    """Derivatives of friction on the pairs of an `ExactContact`.

    Attributes:
        spun, radii, by_direction: further outputs of `friction_jacobian_kernel` per pair.
    """

    def __init__(self, coupled, system):
        self.coupled, self.system, terms, contact_parameters = (
            coupled,
            system,
            system.terms,
            coupled.host.contact_parameters,
        )
        self._velocity = contact_parameters.law.velocity
        law, friction = contact_parameters.density, FRICTION_LAWS[contact_parameters.law.friction_law]
        self._spins = bool(terms.frictions) and terms.spins.any
        self._rolls = any(friction_terms.rolls for friction_terms in terms.frictions)
        self._rotates = any(friction_terms.rotates for friction_terms in terms.frictions)
        self._leads = any(friction_terms.directions[0] is not None for friction_terms in terms.frictions)
        self.kernels = [
            friction_jacobian_kernel(
                friction_terms.found.kind,
                law,
                friction,
                coupled.real,
                friction_terms.directions[1] is not None,
                self._spins,
                friction_terms.rolls,
                friction_terms.rotates,
            )
            for friction_terms in terms.frictions
        ]
        self.reserve()

    def reserve(self) -> None:
        """Allocate outputs for the capacity of the pair lists."""
        most = max(pairs.capacity for pairs in self.system.search.lists)
        items = ITEMS if self._rolls or self._rotates else PAIR_NODES
        shape, vector, device = (items, most), self.coupled.vector, self.coupled.device

        def zeros(rows, some):
            return wp.zeros((rows, most if some else 1), dtype=self.coupled.real, device=device)

        self.spun, self.radii, self._numbers = (
            zeros(SPUN, self._spins),
            zeros(ROLLED, self._rolls or self._rotates),
            zeros(NUMBERS, True),
        )
        self._start_parts, self._lagged_parts = (device_arrays.allocate(shape, vector, device) for _ in range(2))
        self.by_direction = wp.zeros(most if self._leads else 1, dtype=vector, device=device)

    def vjp(
        self, index: int, ends: tuple, positions: tuple, w: wp.array, rate: wp.array, numbers: wp.array
    ) -> list[wp.array]:
        """Return friction's derivatives by local node of the solution, of the start and of the lagged positions, on one list of
        pairs.

        Args:
            index: number of the list.
            ends: nodes, angles and rotations of the pairs.
            positions: blocks at the friction lag, at the start and at the solution (W N,) each.
            w: solution of the linear system (W N,).
            numbers: output, derivatives by the parameters of pairs.
        """
        terms = self.system.terms
        friction = terms.frictions[index]
        inputs = [friction.pairs, friction.count, friction.found.sides, terms.lag_law, *ends]
        inputs += [
            friction.lagged.radii,
            friction.factor.used,
            *positions,
            w,
            self._velocity,
            rate,
            *friction.directions,
            terms.spins.places,
            terms.spins.turned.flatten(),
        ]
        written = [friction.gradient, self._start_parts, self._lagged_parts]
        more = [numbers, self.by_direction, self.spun, self.radii]
        device_arrays.take_turns(
            self.kernels[index], friction.found.capacity, inputs, [*written, *more], self.coupled.device
        )
        return written

    def matrix(self, q: wp.array, before: wp.array, rate: wp.array) -> sparse.csc_matrix:
        """Return friction's term in the matrix of an equilibrium at blocks q, reached from `before` (3 W N, 3 W N) [N/m].

        Normal forces and directions are evaluated at q, too: the matrix is unsymmetric. Enlarges pair lists; reads from the device.
        """
        while True:
            self.system.find(q, before, q, rate)
            if not self.system.has_overflow(q):
                break
            self.reserve()
        total = sparse.csc_matrix((3 * len(q),) * 2)
        for index in range(len(self.kernels)):
            total -= self._of_list(index, q, before, rate)
        return (
            total + total @ rotated_by(self.coupled, q.numpy(), before.numpy())[0] if self.system.terms.rolls else total
        )

    def _of_list(self, index: int, q: wp.array, before: wp.array, rate: wp.array) -> sparse.csc_matrix:
        """Return the derivative by q of the friction on one list of pairs, without rigid bodies.

        Each pair has private blocks, behind the blocks of the coupled system; w is a unit vector there, one component at a time.
        """
        friction = self.system.terms.frictions[index]
        count, device, size = int(friction.count.numpy()[0]), self.coupled.device, 3 * len(q)
        blocks, angles, ends = friction.factor.nodes.numpy()[:count], friction.factor.angles, None
        if friction.rolls:
            blocks = np.column_stack([blocks, angles.numpy()[:count]])
        involved = (friction.factor.used.numpy()[:count, None] != 0) & (blocks >= 0)
        involved[:, friction.found.kind.first + friction.found.kind.second : PAIR_NODES] = False
        private = np.where(involved, len(q) + np.arange(blocks.size).reshape(blocks.shape), blocks).astype(np.int32)
        nodes = device_arrays.upload(private[:, :PAIR_NODES], wp.vec4i, device)
        if friction.rolls:
            angles = device_arrays.upload(private[:, PAIR_NODES:], wp.vec2i, device)
        if friction.directions[0]:
            world, first = np.divmod(friction.pairs.numpy()[:count, 0], friction.found.first.count)
            ends = friction.directions[0].numpy()[first] + world[:, None] * self.coupled.blocks
        start, x = (
            wp.array(np.concatenate([positions, positions[blocks.ravel()]]), dtype=q.dtype, device=device)
            for positions in (before.numpy(), q.numpy())
        )
        w, entries = wp.zeros_like(x), [(np.zeros(0, int), np.zeros(0, int), np.zeros(0))]

        def add(row, block, gradients):
            """Add derivatives `gradients` (n, 3) of components (n,) by the positions of blocks (n,)."""
            columns = 3 * block[:, None] + np.arange(3)
            entries.append((np.repeat(row, 3), columns.ravel(), gradients.astype(float).ravel()))

        for slot in range(blocks.shape[1]):
            on = np.flatnonzero(involved[:, slot])
            for d in range(3 if slot < PAIR_NODES else 1):
                unit = np.zeros((len(x), 3))
                unit[private[on, slot], d] = 1.0
                w.assign(unit)
                written = self.vjp(
                    index, (nodes, angles, friction.factor.rotations), (x, start, x), w, rate, self._numbers
                )
                by_x, _, by_lagged = (array.numpy()[:, :count] for array in written)
                by_x[:PAIR_NODES] += by_lagged[:PAIR_NODES]
                row = 3 * blocks[:, slot] + d
                for column in range(blocks.shape[1]):
                    both = on[involved[on, column]]
                    add(row[both], blocks[both, column], by_x[column, both])
                if ends is not None:
                    led = self.by_direction.numpy()[on]
                    add(row[on], ends[on, 1], led)
                    add(row[on], ends[on, 0], -led)
        rows, columns, values = map(np.concatenate, zip(*entries, strict=True))
        return sparse.csc_matrix((values, (rows, columns)), shape=(size, size))

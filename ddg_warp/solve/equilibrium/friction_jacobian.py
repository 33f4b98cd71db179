"""Friction of a net as a function of where everything is, normal forces and directions included; see `kernels.adjoint.contact`."""

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint.contact import NUMBERS, ROLLED, SPUN, rub_kernel
from ddg_warp.kernels.collision.contact.assembly import ITEMS, PAIR_NODES
from ddg_warp.kernels.terms import FRICTION_LAWS
from ddg_warp.solve.collision.rolling_rotation import rotated_by


class FrictionJacobian:
    """Derivatives of friction, whose pairs are those of an `ExactContact`.

    Attributes:
        spun, radii, by_direction: what `rub_kernel` writes of pairs beside its parts.
    """

    def __init__(self, coupled, system):
        self.coupled, self.system, terms, touching = coupled, system, system.terms, coupled.host.touching
        self._velocity = touching.law.velocity
        law, friction = touching.density, FRICTION_LAWS[touching.law.friction_law]
        self._spins = bool(terms.frictions) and terms.spins.any
        self._rolls = any(of.rolls for of in terms.frictions)
        self._leads = any(of.directions[0] is not None for of in terms.frictions)
        self.kernels = [
            rub_kernel(of.found.kind, law, friction, coupled.real, of.directions[1] is not None, self._spins, of.rolls)
            for of in terms.frictions
        ]
        self.reserve()

    def reserve(self) -> None:
        """Make room for as many pairs as the search has."""
        most = max(pairs.capacity for pairs in self.system.search.lists)
        shape, vector, device = (ITEMS if self._rolls else PAIR_NODES, most), self.coupled.vector, self.coupled.device

        def zeros(rows, some):
            return wp.zeros((rows, most if some else 1), dtype=self.coupled.real, device=device)

        self.spun, self.radii, self._numbers = (
            zeros(SPUN, self._spins),
            zeros(ROLLED, self._rolls),
            zeros(NUMBERS, True),
        )
        self._start_parts, self._lagged_parts = (device_arrays.allocate(shape, vector, device) for _ in range(2))
        self.by_direction = wp.zeros(most if self._leads else 1, dtype=vector, device=device)

    def vjp(self, index: int, of: tuple, at: tuple, w: wp.array, rate: wp.array, numbers: wp.array) -> list[wp.array]:
        """What friction on a list of pairs, with nodes and angles `of` these, brings by slot of the solution, of the start and of what
        was lagged.

        Args:
            at: blocks where friction was lagged, at the start and at the solution (W N,) each.
            w: solution of the linear system (W N,).
            numbers: what it brings by the numbers of pairs, to be written.
        """
        terms = self.system.terms
        rub = terms.frictions[index]
        inputs = [rub.pairs, rub.count, rub.found.sides, terms.lag_law, *of, rub.factor.used]
        inputs += [*at, w, self._velocity, rate, *rub.directions, terms.spins.places, terms.spins.turned.flatten()]
        written = [rub.gradient, self._start_parts, self._lagged_parts]
        more = [numbers, self.by_direction, self.spun, self.radii]
        device_arrays.take_turns(
            self.kernels[index], rub.found.capacity, inputs, [*written, *more], self.coupled.device
        )
        return written

    def matrix(self, q: wp.array, before: wp.array, rate: wp.array) -> sparse.csc_matrix:
        """What friction adds to the matrix of an equilibrium at blocks q that came there from others (3 W N, 3 W N) [N/m].

        Normal forces and directions are those at q, too, so that it is not symmetric. Makes room for pairs; reads from the device.
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
        """Derivative of the friction of elements by q.

        Each pair has blocks of its own, behind those of the net, at which w is one component after another.
        """
        rub = self.system.terms.frictions[index]
        count, device, size = int(rub.count.numpy()[0]), self.coupled.device, 3 * len(q)
        blocks, angles, ends = rub.factor.nodes.numpy()[:count], rub.factor.angles, None
        if rub.rolls:
            blocks = np.column_stack([blocks, angles.numpy()[:count]])
        felt = (rub.factor.used.numpy()[:count, None] != 0) & (blocks >= 0)
        felt[:, rub.found.kind.first + rub.found.kind.second : PAIR_NODES] = False
        apart = np.where(felt, len(q) + np.arange(blocks.size).reshape(blocks.shape), blocks).astype(np.int32)
        nodes = device_arrays.upload(apart[:, :PAIR_NODES], wp.vec4i, device)
        if rub.rolls:
            angles = device_arrays.upload(apart[:, PAIR_NODES:], wp.vec2i, device)
        if rub.directions[0]:
            world, first = np.divmod(rub.pairs.numpy()[:count, 0], rub.found.first.count)
            ends = rub.directions[0].numpy()[first] + world[:, None] * self.coupled.blocks
        start, x = (
            wp.array(np.concatenate([own, own[blocks.ravel()]]), dtype=q.dtype, device=device)
            for own in (before.numpy(), q.numpy())
        )
        w, entries = wp.zeros_like(x), [(np.zeros(0, int), np.zeros(0, int), np.zeros(0))]

        def add(row, block, found):
            """Derivatives `found` (n, 3) of components (n,) by those of blocks (n,)."""
            columns = 3 * block[:, None] + np.arange(3)
            entries.append((np.repeat(row, 3), columns.ravel(), found.astype(float).ravel()))

        for slot in range(blocks.shape[1]):
            on = np.flatnonzero(felt[:, slot])
            for d in range(3 if slot < PAIR_NODES else 1):
                unit = np.zeros((len(x), 3))
                unit[apart[on, slot], d] = 1.0
                w.assign(unit)
                written = self.vjp(index, (nodes, angles), (x, start, x), w, rate, self._numbers)
                by_x, _, by_lagged = (array.numpy()[:, :count] for array in written)
                by_x[:PAIR_NODES] += by_lagged[:PAIR_NODES]
                row = 3 * blocks[:, slot] + d
                for other in range(blocks.shape[1]):
                    both = on[felt[on, other]]
                    add(row[both], blocks[both, other], by_x[other, both])
                if ends is not None:
                    led = self.by_direction.numpy()[on]
                    add(row[on], ends[on, 1], led)
                    add(row[on], ends[on, 0], -led)
        rows, columns, values = map(np.concatenate, zip(*entries, strict=True))
        return sparse.csc_matrix((values, (rows, columns)), shape=(size, size))

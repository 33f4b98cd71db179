"""VJP of contact in the steps and equilibria of the coupled system; see `ddg_warp.kernels.adjoint.contact`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.adjoint import contact_parameters
from ddg_warp.kernels.adjoint.contact import NUMBERS, RATE, SPUN, THICKNESS, pull_kernel
from ddg_warp.kernels.collision.contact.assembly import sum_kernel
from ddg_warp.solve.collision.incidence import Incidence
from ddg_warp.solve.collision.rolling_rotation import rotated_by
from ddg_warp.solve.equilibrium.friction_jacobian import FrictionJacobian
from ddg_warp.solve.linear.exact_contact import ExactContact
from ddg_warp.solve.linear.sparse_system import lists

PIECES, LEAST = 256, 64  # largest number of summation chunks of a world, and fewest primitives of one


class ContactAdjoint:
    """VJP of the contact of a `CoupledModel`, friction included; gradients by obstacles are returned by obstacle nodes.

    A step or equilibrium is differentiated as solved exactly. The inputs are:

    - positions at the end and, with friction, at the start, from which slip is measured;
    - positions of the friction lag: the start, the solution of the iteration before, or an equilibrium itself;
    - contact parameters of pairs, and the step length.

    Measured: the relative error against differences is 1e-9 to 1e-7.

    At kinks the gradient is one-sided:

    - a closest point passes an end of an edge or a side of a triangle: second derivatives jump;
    - a pair enters the activation distance: beyond the second derivative of a barrier, and with 1e-14 of the force of a penalty;
    - the polynomial friction law starts to slide, or anisotropic friction changes sense along the rod.

    Sticking contacts creep, which is smooth. CCD step fractions are not differentiated. Rest lengths of edges, which define
    near-parallel pairs, and collision exclusion distances keep their values of the build.

    Args:
        on_obstacles: see `ExactContact`.

    Attributes:
        friction_iterations: number of friction updates in a step.
        by_groups: gradient by stiffness, range, thickness, friction and rate, of groups of first and second primitives (`NUMBERS`,
            worlds, groups, groups), added to.
        by_radius: gradient by radii (worlds, bodies), added to.
    """

    def __init__(self, coupled, on_obstacles: bool = False):
        contact, real, device = coupled.host.contact_parameters, coupled.real, coupled.device
        self.coupled, self.system = coupled, ExactContact(coupled, on_obstacles)
        terms, search = self.system.terms, self.system.search
        serial, nodes = device_arrays.serial(device), len(terms.forces)
        every = wp.zeros(coupled.blocks, dtype=wp.uint8, device=device)
        self.friction_iterations = contact.law.friction_iterations if terms.frictions else 1
        self._friction_sets = terms.frictions or [None] * len(terms.lists)
        kinds = [pairs.kind for pairs in search.lists]
        self._vjp = [pull_kernel(kind, contact.density, real) for kind in kinds]
        leads = [friction.directions[0] is not None for friction in terms.frictions]
        turning = [(friction.rolls, friction.rotates) for friction in terms.frictions] or [(False, False)] * len(kinds)
        self._spins = terms.spins if terms.frictions and terms.spins.any else None
        self.friction_jacobian, spins = FrictionJacobian(coupled, self.system), bool(self._spins)
        self._direct = contact_parameters.direction_kernels(real) if any(leads) else ()
        direction_nodes = search.shapes.beside
        self._leads = [
            self._led(direction_nodes(pairs.first.size)) if has_directions else None
            for pairs, has_directions in zip(search.lists, leads, strict=False)
        ]
        self._sides = [contact_parameters.side_kernels(kind, real) for kind in kinds]
        self._group, self._bodies = contact_parameters.group_kernels(real), contact_parameters.body_kernel(real)
        self._items, self._add = [Incidence(kind, nodes, every) for kind in kinds], sum_kernel(real, serial)
        self._friction_items = [
            Incidence(kind, nodes, every, *turns) if any(turns) else items
            for kind, items, turns in zip(kinds, self._items, turning, strict=True)
        ]
        self.by_groups = self._zeros(NUMBERS, *terms.law.stiffness.shape)
        self.by_radius = self._zeros(*coupled.contact_parameters["radius"].shape)
        self._primitives, self._starts, self._rotating_primitives = {}, {}, {}
        self._by_spun = self._zeros(SPUN, *self.by_radius.shape)
        for size in search.shapes.sizes:
            owner = search.shapes.primitives(size)[2]
            self._primitives[size] = self._zeros(coupled.worlds * len(owner))
            self._rotating_primitives[size] = self._zeros(SPUN if spins else 0, coupled.worlds * len(owner))
            starts = np.searchsorted(owner, np.arange(len(contact.bodies) + 1)).astype(np.int32)
            self._starts[size] = wp.array(starts, dtype=int, device=device)
        most = max(self._pieces(pairs)[0] for pairs in search.lists)
        self._partial = self._zeros(NUMBERS, coupled.worlds * most, *terms.law.stiffness.shape[1:])
        self._reserve()

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        first = [*self._vjp, *self.friction_jacobian.kernels, self._add, *self._group, self._bodies, *self._direct]
        return [
            *first,
            *(k for pair in self._sides for k in pair),
            *(k for items in {*self._items, *self._friction_items} for k in items.kernels),
        ]

    @property
    def grad_inverse_step(self) -> wp.array:
        """Row of `by_groups`: gradient by the inverse step."""
        return self.by_groups[RATE].flatten()

    def has_overflow(self, q: wp.array) -> bool:
        """Regrow lists after a capacity overflow as `ExactContact`; return True if the last `vjp` is to be repeated."""
        grown = self.system.has_overflow(q)
        if grown:
            self._reserve()
        return grown

    def _reserve(self) -> None:
        """Allocate memory for the capacity of the candidate lists."""
        lists = self.system.search.lists
        self._numbers = self._zeros(NUMBERS, max(pairs.capacity for pairs in lists))
        self.friction_jacobian.reserve()
        for items, pairs in {*zip(self._items, lists, strict=True), *zip(self._friction_items, lists, strict=True)}:
            items.reserve(pairs.capacity)

    def vjp(self, positions: tuple, w: wp.array, rate: wp.array, gradients: tuple) -> None:
        """Add the gradients by dof blocks and by contact parameters, after `find` of `system` with the same arguments.

        Args:
            positions: dof blocks at the friction lag, at the start and at the solution (W N,) each.
            w: solution of the adjoint system (W N,).
            rate: inverse step of each world [1/s].
            gradients: gradients by these `positions`, added to.
        """
        terms, (_, before, q), (by_lagged, by_before, grad_q) = self.system.terms, positions, gradients
        for array in (*self._primitives.values(), *self._rotating_primitives.values()):
            array.zero_()
        for i, (part, friction_set) in enumerate(zip(terms.lists, self._friction_sets, strict=True)):
            read, pairs = [part.pairs, part.count, part.found.sides, terms.law], part.found.capacity
            self._items[i].list(part.count, part.factor)
            inputs = [*read, part.factor.nodes, q, w]
            self._take_turns(self._vjp[i], pairs, inputs, [part.gradient, self._numbers])
            self._add_up(self._items[i], part, part.gradient, grad_q)
            self._sum(i, self._items[i], part)
            if friction_set:
                items = self._friction_items[i]
                items.list(friction_set.count, friction_set.factor)
                factor = friction_set.factor
                ends = factor.nodes, factor.angles, factor.rotations
                written = self.friction_jacobian.vjp(i, ends, positions, w, rate, self._numbers)
                for values, gradient in zip(written, (grad_q, by_before, by_lagged), strict=True):
                    self._add_up(items, friction_set, values, gradient)
                self._sum(i, items, friction_set)
                self._lead(i, friction_set, by_lagged)
                if friction_set.rolls or friction_set.rotates:
                    self._to_primitives(
                        i,
                        items,
                        friction_set,
                        (self.friction_jacobian.radii[0], self.friction_jacobian.radii[1]),
                        self._primitives,
                    )
                if self._spins:
                    for row in range(SPUN):
                        self._to_primitives(
                            i, items, friction_set, (self.friction_jacobian.spun[row],) * 2, self._spun_row(row)
                        )
        self._to_bodies(self._primitives, self.by_radius)
        if self._spins:
            self._by_spun.zero_()
            for row in range(SPUN):
                self._to_bodies(self._spun_row(row), self._by_spun[row])
            self._spins.vjp(before, q, self._by_spun, [by_before, grad_q, self.by_radius])

    def matrix(self, q: wp.array, before: wp.array, rate: wp.array):
        """Return the friction matrix as `FrictionJacobian`; a following `vjp` has room for all pairs."""
        version, matrix = self.system.search.version, self.friction_jacobian.matrix(q, before, rate)
        if self.system.search.version != version:
            self._reserve()
        return matrix

    def roll(self, q: wp.array, before: wp.array, by_before: wp.array, grad_q: wp.array) -> None:
        """Add the terms of transported frames to gradients by blocks q and `before`, after `vjp` of an equilibrium.

        Reads from the device.
        """
        if self.system.terms.rolls:
            cotangent = by_before.numpy().astype(float).ravel()
            for gradient, derivative in zip(
                (grad_q, by_before), rotated_by(self.coupled, q.numpy(), before.numpy()), strict=True
            ):
                gradient.assign(gradient.numpy() - (derivative.T @ cotangent).reshape(-1, 3))

    def _add_up(self, items: Incidence, part, written: wp.array, out: wp.array) -> None:
        """Assemble contributions of active pairs, by pair node, to nodes."""
        inputs = [written, part.factor.used, items.places, items.numbers, items.items]
        self._sweep(self._add, len(out), inputs, [out])

    def _sum(self, index: int, items: Incidence, part) -> None:
        """Sum contact parameter gradients of pairs by group and by primitive."""
        pairs, law = part.found, self.system.terms.law
        pieces, total = self._group
        number, size = self._pieces(pairs)
        lists = [part.count, part.starts, part.partners]
        inputs = [*lists, part.pairs, pairs.sides, law, self._numbers, number, size]
        self._launch(pieces, self.coupled.worlds * number, inputs, [self._partial])
        self._launch(total, self.by_groups.shape[1:], [self._partial, number], [self.by_groups])
        self._to_primitives(index, items, part, (self._numbers[THICKNESS],) * 2, self._primitives)

    def _to_primitives(self, index: int, items: Incidence, part, values: tuple, out: dict[int, wp.array]) -> None:
        """Sum values of pairs, of both sides (capacity,), by primitive, for each primitive size."""
        pairs, (first, second), (first_values, second_values) = part.found, self._sides[index], values
        inputs = [part.count, part.starts, part.partners, first_values]
        self._launch(first, pairs.first.all, inputs, [out[pairs.first.size]])
        inputs = [part.pairs, pairs.sides, items.places, items.numbers, items.items, second_values]
        self._launch(second, pairs.second.all, inputs, [out[pairs.second.size]])

    def _to_bodies(self, primitives: dict[int, wp.array], out: wp.array) -> None:
        """Sum values of primitives, by primitive size, over bodies (worlds, bodies)."""
        for size, values in primitives.items():
            starts, count = self._starts[size], len(values) // self.coupled.worlds
            self._launch(self._bodies, out.shape, [values, starts, count], [out])

    def _spun_row(self, row: int) -> dict[int, wp.array]:
        """Return a row of the gradient by spins, by primitive size."""
        return {size: values[row] for size, values in self._rotating_primitives.items()}

    def _led(self, ends: np.ndarray) -> tuple:
        """Return for every node the first primitives with an end there (offsets, items), and scratch of the gradient by directions."""
        starts, items = lists(ends.ravel(), self.coupled.blocks)
        by_direction = wp.zeros((self.coupled.worlds, len(ends)), dtype=self.coupled.vector, device=self.coupled.device)
        upload = (device_arrays.upload(np.asarray(v, np.int32), int, self.coupled.device) for v in (starts, items))
        return *upload, by_direction

    def _lead(self, index: int, friction_set, by_lagged: wp.array) -> None:
        """Add the terms of rod directions to the gradient by lagged positions."""
        if self._leads[index]:
            per_primitive, gather = self._direct
            starts, items, by_direction = self._leads[index]
            flat, nodes = by_direction.flatten(), by_lagged.reshape((self.coupled.worlds, self.coupled.blocks))
            self._launch(
                per_primitive,
                len(flat),
                [friction_set.count, friction_set.starts, friction_set.partners, self.friction_jacobian.by_direction],
                [flat],
            )
            self._launch(gather, nodes.shape, [starts, items, by_direction], [nodes])

    def _pieces(self, pairs) -> tuple[int, int]:
        """Return the number of summation chunks of a world's first primitives, and the primitives in each."""
        size = max(LEAST, -(-pairs.first.count // PIECES))
        return -(-pairs.first.count // size), size

    def _zeros(self, *shape: int) -> wp.array:
        return wp.zeros(shape, dtype=self.coupled.real, device=self.coupled.device)

    def _take_turns(self, kernel, count: int, inputs: list, outputs: list) -> None:
        device_arrays.take_turns(kernel, count, inputs, outputs, self.coupled.device)

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        device_arrays.sweep(kernel, count, inputs, outputs, self.coupled.device)

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device)

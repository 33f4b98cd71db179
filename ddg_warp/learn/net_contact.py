"""Reverse of contact in the steps of a net and in its equilibria; see `ddg_warp.kernels.adjoint.contact`."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.adjoint import contact_sums
from ddg_warp.kernels.adjoint.contact import NUMBERS, RATE, SPUN, THICKNESS, pull_kernel
from ddg_warp.kernels.contact.gather import sum_kernel
from ddg_warp.solve.contact.node_items import NodeItems
from ddg_warp.solve.contact.rolling import turned_by
from ddg_warp.solve.contact.touch import LAWS
from ddg_warp.solve.net.exact_contact import ExactContact
from ddg_warp.solve.net.rubbing import Rubbing
from ddg_warp.solve.net.system import lists

PIECES, LEAST = 256, 64  # of the first things of a world, at most, and what one has at least


class ContactAdjoint:
    """Of the contact of a `DeviceNet`, friction included; derivatives by obstacles are those by their nodes.

    What is differentiated is a step, or an equilibrium, solved exactly: by positions at its end and, with friction, at its start, where
    this takes slip from, and where it takes normal forces and directions from: the start, or the solution before, and of equilibria
    themselves; by the numbers of pairs; by the length of the step. Against differences it errs by 1e-9 to 1e-7.

    At kinks gradients are those of one side: where closest points go over an end of an edge or a side of a triangle, whose second
    derivatives jump there; where a pair begins to push, beyond the second derivative of a barrier, and with 1e-14 of the force of a
    penalty; where the polynomial law of friction begins to slide, or friction by direction changes sense along the rod. What sticks
    creeps, which is smooth. The cut of motions, which may keep a step from being taken at once, is no part of it. Lengths of edges at
    rest, which tell what is all but parallel, and arc lengths within which edges are no pair stay as they were built.

    Attributes:
        lags: how often in a step friction is lagged.
        by_groups: by stiffness, range, thickness, friction and rate, of groups of first and second things (`NUMBERS`, worlds, groups,
            groups); by_radius (worlds, bodies). Both are added to.
    """

    def __init__(self, net):
        given, real, device = net.host.touching, net.real, net.device
        self.net, self.system = net, ExactContact(net)
        terms, search = self.system.terms, self.system.search
        serial, nodes = arrays.serial(device), len(terms.forces)
        every = wp.zeros(net.blocks, dtype=wp.uint8, device=device)
        self.lags = given.law.lags if terms.frictions else 1
        self._rubs = terms.frictions or [None] * len(terms.lists)
        law = LAWS[given.law.law]
        kinds = [pairs.kind for pairs in search.lists]
        self._pull = [pull_kernel(kind, law, real) for kind in kinds]
        leads = [of.directions[0] is not None for of in terms.frictions]
        self._rolls = [of.rolls for of in terms.frictions] or [False] * len(kinds)
        self._spins = terms.spins if terms.frictions and terms.spins.any else None
        self.rubbing, spins = Rubbing(net, self.system), bool(self._spins)
        self._direct = contact_sums.direction_kernels(real) if any(leads) else ()
        beside = search.shapes.beside
        self._leads = [
            self._led(beside(kind.first)) if there else None for kind, there in zip(kinds, leads, strict=False)
        ]
        self._sides = [contact_sums.side_kernels(kind, real) for kind in kinds]
        self._group, self._bodies = contact_sums.group_kernels(real), contact_sums.body_kernel(real)
        self._items, self._add = [NodeItems(kind, nodes, every) for kind in kinds], sum_kernel(real, serial)
        rolling = zip(kinds, self._items, self._rolls, strict=True)
        self._rub_items = [NodeItems(kind, nodes, every, True) if rolls else items for kind, items, rolls in rolling]
        self.by_groups = self._zeros(NUMBERS, *terms.law.stiffness.shape)
        self.by_radius = self._zeros(*net.touching["radius"].shape)
        self._things, self._starts, self._spun_things = {}, {}, {}
        self._by_spun = self._zeros(SPUN, *self.by_radius.shape)
        for size in search.shapes.sizes:
            owner = search.shapes.things(size)[2]
            self._things[size] = self._zeros(net.worlds * len(owner))
            self._spun_things[size] = self._zeros(SPUN if spins else 0, net.worlds * len(owner))
            starts = np.searchsorted(owner, np.arange(len(given.bodies) + 1)).astype(np.int32)
            self._starts[size] = wp.array(starts, dtype=int, device=device)
        most = max(self._pieces(pairs)[0] for pairs in search.lists)
        self._partial = self._zeros(NUMBERS, net.worlds * most, *terms.law.stiffness.shape[1:])
        self._reserve()

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        own = [*self._pull, *self.rubbing.kernels, self._add, *self._group, self._bodies, *self._direct]
        return [
            *own,
            *(k for pair in self._sides for k in pair),
            *(k for items in {*self._items, *self._rub_items} for k in items.kernels),
        ]

    @property
    def by_rate(self) -> wp.array:
        """Part of `by_groups`."""
        return self.by_groups[RATE].flatten()

    def outgrown(self, q: wp.array) -> bool:
        """As of `ExactContact`; what was pulled then is to be pulled again."""
        grown = self.system.outgrown(q)
        if grown:
            self._reserve()
        return grown

    def _reserve(self) -> None:
        """Make room for as many pairs as the search has."""
        lists = self.system.search.lists
        self._numbers = self._zeros(NUMBERS, max(pairs.capacity for pairs in lists))
        self.rubbing.reserve()
        for items, pairs in {*zip(self._items, lists, strict=True), *zip(self._rub_items, lists, strict=True)}:
            items.reserve(pairs.capacity)

    def pull(self, at: tuple, w: wp.array, rate: wp.array, by: tuple) -> None:
        """After `find` of `system` with the same, add to derivatives by blocks, and to the others.

        Args:
            at: blocks where friction was lagged, at the start and at the solution (W N,) each.
            w: solution of the linear system (W N,).
            by: derivatives by these three.
        """
        terms, (_, before, q), (by_lagged, by_before, by_q) = self.system.terms, at, by
        for array in (*self._things.values(), *self._spun_things.values()):
            array.zero_()
        for i, (part, rub) in enumerate(zip(terms.lists, self._rubs, strict=True)):
            read, pairs = [part.pairs, part.count, part.found.sides, terms.law], part.found.capacity
            self._items[i].list(part.count, part.factor)
            inputs = [*read, part.factor.nodes, q, w]
            self._take_turns(self._pull[i], pairs, inputs, [part.gradient, self._numbers])
            self._add_up(self._items[i], part, part.gradient, by_q)
            self._sum(i, self._items[i], part)
            if rub:
                items = self._rub_items[i]
                items.list(rub.count, rub.factor)
                written = self.rubbing.pull(i, (rub.factor.nodes, rub.factor.angles), at, w, rate, self._numbers)
                for found, by_found in zip(written, (by_q, by_before, by_lagged), strict=True):
                    self._add_up(items, rub, found, by_found)
                self._sum(i, items, rub)
                self._lead(i, rub, by_lagged)
                if rub.rolls:
                    self._to_things(i, items, rub, (self.rubbing.radii[0], self.rubbing.radii[1]), self._things)
                if self._spins:
                    for row in range(SPUN):
                        self._to_things(i, items, rub, (self.rubbing.spun[row],) * 2, self._spun_row(row))
        self._to_bodies(self._things, self.by_radius)
        if self._spins:
            self._by_spun.zero_()
            for row in range(SPUN):
                self._to_bodies(self._spun_row(row), self._by_spun[row])
            self._spins.pull(before, q, self._by_spun, [by_before, by_q, self.by_radius])

    def matrix(self, q: wp.array, before: wp.array, rate: wp.array):
        """As of `Rubbing`; what is pulled after it has room for all pairs."""
        version, found = self.system.search.version, self.rubbing.matrix(q, before, rate)
        if self.system.search.version != version:
            self._reserve()
        return found

    def roll(self, q: wp.array, before: wp.array, by_before: wp.array, by_q: wp.array) -> None:
        """After `pull` of an equilibrium, add what comes by frames, which are carried along, to derivatives by blocks q and `before`.

        Reads from the device.
        """
        if self.system.terms.rolls:
            found = by_before.numpy().astype(float).ravel()
            for by, derivative in zip((by_q, by_before), turned_by(self.net, q.numpy(), before.numpy()), strict=True):
                by.assign(by.numpy() - (derivative.T @ found).reshape(-1, 3))

    def _add_up(self, items: NodeItems, part, written: wp.array, out: wp.array) -> None:
        """Add what pairs that are used have written by slot to nodes."""
        inputs = [written, part.factor.used, items.places, items.numbers, items.items]
        self._sweep(self._add, len(out), inputs, [out])

    def _sum(self, index: int, items: NodeItems, part) -> None:
        """Add what the pairs of elements have by their numbers to that of groups and things."""
        found, law = part.found, self.system.terms.law
        pieces, total = self._group
        number, things = self._pieces(found)
        lists = [part.count, part.starts, part.partners]
        inputs = [*lists, part.pairs, found.sides, law, self._numbers, number, things]
        self._launch(pieces, self.net.worlds * number, inputs, [self._partial])
        self._launch(total, self.by_groups.shape[1:], [self._partial, number], [self.by_groups])
        self._to_things(index, items, part, (self._numbers[THICKNESS],) * 2, self._things)

    def _to_things(self, index: int, items: NodeItems, part, values: tuple, out: dict[int, wp.array]) -> None:
        """Add what pairs of elements have for both sides (capacity,) to the things there, by their size."""
        found, (first, second), (one, other) = part.found, self._sides[index], values
        inputs = [part.count, part.starts, part.partners, one]
        self._launch(first, found.first.all, inputs, [out[found.first.size]])
        inputs = [part.pairs, found.sides, items.places, items.numbers, items.items, other]
        self._launch(second, found.second.all, inputs, [out[found.second.size]])

    def _to_bodies(self, things: dict[int, wp.array], out: wp.array) -> None:
        """Add what things have, by their size, to bodies (worlds, bodies)."""
        for size, found in things.items():
            starts, count = self._starts[size], len(found) // self.net.worlds
            self._launch(self._bodies, out.shape, [found, starts, count], [out])

    def _spun_row(self, row: int) -> dict[int, wp.array]:
        """What things have of it, by their size."""
        return {size: found[row] for size, found in self._spun_things.items()}

    def _led(self, beside: np.ndarray) -> tuple:
        """Of nodes, which first things lead from and to them: starts and items; and memory of what comes by directions."""
        starts, items = lists(beside.ravel(), self.net.blocks)
        found = wp.zeros((self.net.worlds, len(beside)), dtype=self.net.vector, device=self.net.device)
        upload = (arrays.upload(np.asarray(v, np.int32), int, self.net.device) for v in (starts, items))
        return *upload, found

    def _lead(self, index: int, rub, by_lagged: wp.array) -> None:
        """Add to derivatives by what was lagged what comes by the directions of rods."""
        if self._leads[index]:
            things, gather = self._direct
            starts, items, found = self._leads[index]
            flat, nodes = found.flatten(), by_lagged.reshape((self.net.worlds, self.net.blocks))
            self._launch(things, len(flat), [rub.count, rub.starts, rub.partners, self.rubbing.by_direction], [flat])
            self._launch(gather, nodes.shape, [starts, items, found], [nodes])

    def _pieces(self, pairs) -> tuple[int, int]:
        """How many pieces the first things of a world are summed in, and how many things each has."""
        things = max(LEAST, -(-pairs.first.count // PIECES))
        return -(-pairs.first.count // things), things

    def _zeros(self, *shape: int) -> wp.array:
        return wp.zeros(shape, dtype=self.net.real, device=self.net.device)

    def _take_turns(self, kernel, count: int, inputs: list, outputs: list) -> None:
        arrays.take_turns(kernel, count, inputs, outputs, self.net.device)

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        arrays.sweep(kernel, count, inputs, outputs, self.net.device)

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.net.device)

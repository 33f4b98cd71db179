"""Reverse of contact in the steps of a net and in its equilibria; see `ddg_warp.kernels.adjoint.contact`."""

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp import arrays
from ddg_warp.kernels.adjoint import contact_sums
from ddg_warp.kernels.adjoint.contact import NUMBERS, RATE, ROLLED, SPUN, THICKNESS, pull_kernel, rub_kernel
from ddg_warp.kernels.contact.gather import ITEMS, SLOTS, sum_kernel
from ddg_warp.learn.rolling import turned_by
from ddg_warp.solve.contact.node_items import NodeItems
from ddg_warp.solve.contact.pair_terms import FRICTION
from ddg_warp.solve.contact.touch import LAWS
from ddg_warp.solve.net.exact_contact import ExactContact
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
        self._rubs, self._velocity = terms.frictions or [None] * len(terms.lists), given.law.velocity
        law, friction = LAWS[given.law.law], FRICTION[given.law.friction_law]
        kinds = [pairs.kind for pairs in search.lists]
        self._pull = [pull_kernel(kind, law, real) for kind in kinds]
        leads, directed = ([of.directions[k] is not None for of in terms.frictions] for k in range(2))
        self._rolls = [of.rolls for of in terms.frictions] or [False] * len(kinds)
        self._spins = terms.spins if terms.frictions and terms.spins.any else None
        spins = bool(self._spins)
        what = zip(kinds, directed, self._rolls, strict=bool(terms.frictions))
        self._rub = [rub_kernel(kind, law, friction, real, ways, spins, rolls) for kind, ways, rolls in what]
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
        own = [*self._pull, *self._rub, self._add, *self._group, self._bodies, *self._direct]
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
        lists, vector = self.system.search.lists, self.net.vector
        most = max(pairs.capacity for pairs in lists)
        self._numbers, self._spun = self._zeros(NUMBERS, most), self._zeros(SPUN, most if self._spins else 1)
        shape, device = (ITEMS if any(self._rolls) else SLOTS, most), self.net.device
        self._radii = self._zeros(ROLLED, most if any(self._rolls) else 1)
        self._start_parts, self._lagged_parts = (arrays.allocate(shape, vector, device) for _ in range(2))
        self._by_direction = wp.zeros(most if self._direct else 1, dtype=vector, device=self.net.device)
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
                written = self._pull_rub(i, rub, (rub.factor.nodes, rub.factor.angles), at, w, rate)
                for found, by_found in zip(written, (by_q, by_before, by_lagged), strict=True):
                    self._add_up(items, rub, found, by_found)
                self._sum(i, items, rub)
                self._lead(i, rub, by_lagged)
                if rub.rolls:
                    self._to_things(i, items, rub, (self._radii[0], self._radii[1]), self._things)
                if self._spins:
                    for row in range(SPUN):
                        self._to_things(i, items, rub, (self._spun[row],) * 2, self._spun_row(row))
        self._to_bodies(self._things, self.by_radius)
        if self._spins:
            self._by_spun.zero_()
            for row in range(SPUN):
                self._to_bodies(self._spun_row(row), self._by_spun[row])
            self._spins.pull(before, q, self._by_spun, [by_before, by_q, self.by_radius])

    def _pull_rub(self, index: int, rub, of: tuple, at: tuple, w: wp.array, rate: wp.array) -> list[wp.array]:
        """What friction on the pairs of elements, with nodes and angles `of` these, brings by slot of the solution, of the start and of
        what was lagged; `at`, w and rate as of `pull`. The rest that `rub_kernel` writes is left where it has its place."""
        terms = self.system.terms
        inputs = [rub.pairs, rub.count, rub.found.sides, terms.law, *of, rub.factor.used]
        inputs += [*at, w, self._velocity, rate, *rub.directions, terms.spins.places, terms.spins.turned.flatten()]
        written = [rub.gradient, self._start_parts, self._lagged_parts]
        more = [self._numbers, self._by_direction, self._spun, self._radii]
        self._take_turns(self._rub[index], rub.found.capacity, inputs, [*written, *more])
        return written

    def rubbing(self, q: wp.array, before: wp.array, rate: wp.array) -> sparse.csc_matrix:
        """What friction adds to the matrix of an equilibrium at blocks q that came there from others (3 W N, 3 W N) [N/m].

        Normal forces and directions are those at q, too, so that it is not symmetric. Makes room for pairs; reads from the device.
        """
        while True:
            self.system.find(q, before, q, rate)
            if not self.outgrown(q):
                break
        total = sparse.csc_matrix((3 * len(q),) * 2)
        for i, rub in enumerate(self._rubs):
            if rub:
                total -= self._rub_matrix(i, rub, q, before, rate)
        return total + total @ turned_by(self.net, q.numpy(), before.numpy())[0] if self.system.terms.rolls else total

    def roll(self, q: wp.array, before: wp.array, by_before: wp.array, by_q: wp.array) -> None:
        """After `pull` of an equilibrium, add what comes by frames, which are carried along, to derivatives by blocks q and `before`.

        Reads from the device.
        """
        if self.system.terms.rolls:
            found = by_before.numpy().astype(float).ravel()
            for by, derivative in zip((by_q, by_before), turned_by(self.net, q.numpy(), before.numpy()), strict=True):
                by.assign(by.numpy() - (derivative.T @ found).reshape(-1, 3))

    def _rub_matrix(self, index: int, rub, q: wp.array, before: wp.array, rate: wp.array) -> sparse.csc_matrix:
        """Derivative of the friction of elements by q.

        Each pair has blocks of its own, behind those of the net, at which w is one component after another.
        """
        count, device, size = int(rub.count.numpy()[0]), self.net.device, 3 * len(q)
        blocks, angles, ends = rub.factor.nodes.numpy()[:count], rub.factor.angles, None
        if rub.rolls:
            blocks = np.column_stack([blocks, angles.numpy()[:count]])
        felt = (rub.factor.used.numpy()[:count, None] != 0) & (blocks >= 0)
        felt[:, rub.found.kind.first + rub.found.kind.second : SLOTS] = False
        apart = np.where(felt, len(q) + np.arange(blocks.size).reshape(blocks.shape), blocks).astype(np.int32)
        nodes = arrays.upload(apart[:, :SLOTS], wp.vec4i, device)
        if rub.rolls:
            angles = arrays.upload(apart[:, SLOTS:], wp.vec2i, device)
        if rub.directions[0]:
            world, first = np.divmod(rub.pairs.numpy()[:count, 0], rub.found.first.count)
            ends = rub.directions[0].numpy()[first] + world[:, None] * self.net.blocks
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
            for d in range(3 if slot < SLOTS else 1):
                unit = np.zeros((len(x), 3))
                unit[apart[on, slot], d] = 1.0
                w.assign(unit)
                written = self._pull_rub(index, rub, (nodes, angles), (x, start, x), w, rate)
                by_x, _, by_lagged = (array.numpy()[:, :count] for array in written)
                by_x[:SLOTS] += by_lagged[:SLOTS]
                row = 3 * blocks[:, slot] + d
                for other in range(blocks.shape[1]):
                    both = on[felt[on, other]]
                    add(row[both], blocks[both, other], by_x[other, both])
                if ends is not None:
                    led = self._by_direction.numpy()[on]
                    add(row[on], ends[on, 1], led)
                    add(row[on], ends[on, 0], -led)
        rows, columns, values = map(np.concatenate, zip(*entries, strict=True))
        return sparse.csc_matrix((values, (rows, columns)), shape=(size, size))

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
            self._launch(things, len(flat), [rub.count, rub.starts, rub.partners, self._by_direction], [flat])
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

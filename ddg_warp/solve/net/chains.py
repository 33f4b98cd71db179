"""The chain preconditioner of a net on a device; see `kernels.solve.elimination` and `joints`."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.matrix.bands import band_kernels
from ddg_warp.kernels.matrix.sliced import SETS
from ddg_warp.kernels.net.places import along_type, place_kernel
from ddg_warp.kernels.solve import elimination, joints
from ddg_warp.solve.choice import long_and_few
from ddg_warp.solve.net.system import lists
from ddg_warp.solve.reduction import CyclicReduction

SERIAL = 32  # threads of a block where a thread walks along a chain, so that few chains spread over the multiprocessors


class Chains:
    """The rods of a net as chains between their joints, and the preconditioner they make.

    Args:
        net: its `DeviceNet`.
        banded: whether blocks of H between their places are kept here, in bands, and not among the positions of a `NetSystem`.

    Attributes:
        exact: whether the preconditioner is the inverse of H, so that a direction takes no conjugate gradients; see `bind`.

    Raises:
        SceneError: the net has no rods.
    """

    def __init__(self, net, banded: bool):
        if not net.host.rods:
            raise SceneError("preconditioner 'chain' is of nets with rods; this one has none")
        self.net, self.device = net, net.device
        self.serial = wp.get_device(net.device).is_cpu
        self.plan = ChainPlan(net.host)
        self.along = [i for i, part in enumerate(net.sets) if part.host.along]
        self.banded = banded and len(self.along) <= SETS
        self.kept = self.plan.where >= 0 if self.banded else None

    def bind(self, table, written: list[dict], real, linear, exact_from: tuple, drag: bool) -> None:
        """Take the `NetSystem` of the net, without what bands keep, and what the elements of all sets write; see `Assembly`."""
        self.table, net, plan = table, self.net, self.plan
        plan.bind(net.host, table.rows.numpy(), table.columns.numpy(), self.kept)
        self.exact = self.banded and plan.complete
        worlds, device = net.worlds, net.device
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        self.places = arrays.upload(plan.places.astype(np.int32), int, device)
        self.chain, self.count, self.where = put(plan.chain), put(plan.count), put(plan.where)
        self.held = arrays.upload(plan.held(net.host), wp.uint8, device)
        self.longest, self.width = plan.chain.shape
        self.columns = worlds * self.width
        block = 4 if plan.twist else 3
        self.factors = arrays.allocate((3 * block**2 + block, self.longest, self.columns), linear, device)
        self.reduction = None
        if long_and_few(self.longest, self.columns, wp.get_device(device)):
            self.reduction = CyclicReduction(block, self.longest, self.columns, linear, device)
            self._all = put(np.tile(plan.count, worlds))
            self._wanted, self._bad = (put(np.zeros(self.columns)) for _ in range(2))
            self.bands = self.factors
        elif not self.banded or self.exact:  # nobody asks for the blocks once they are factored
            self.bands = self.factors
        else:
            self.bands = arrays.allocate((3 * block**2, self.longest, self.columns), linear, device)
        self.values = arrays.allocate((block, self.longest, self.columns), linear, device)
        self.responses = arrays.allocate((block, self.longest, plan.solves * self.columns), linear, device)
        self.coupled = len(plan.of_places[1]) > 0
        self.met = (
            None if plan.met is None or not self.coupled else arrays.upload(plan.met.astype(np.int32), int, device)
        )
        self.joints, self.joint_rows = len(plan.pairs), 2 * len(plan.pairs)
        self.joint_row, self.pairs, self.own = put(plan.joint_row), put(plan.pairs), put(plan.own)
        self.colour, self.taken = put(plan.colour), put(plan.taken)
        self.starts, self.items = map(put, plan.of_places)
        self.joint_starts, self.joint_items = map(put, plan.of_joints)
        self.moved = wp.zeros(max(1, worlds * self.joint_rows), dtype=H, device=device)
        self.units = wp.array(np.repeat(plan.units, worlds, axis=1).reshape(-1, 3), dtype=H, device=device)
        self.parts = wp.zeros((3, max(1, worlds * self.joints)), dtype=M, device=device)
        sets = self.along if self.banded else []
        terms = tuple(net.sets[i].term for i in sets)
        late = tuple(exact_from[i] for i in sets)
        self._assemble, self._clear, self._product = band_kernels(
            terms, plan.twist, plan.span, real, linear, late, drag, self.serial
        )
        own = [self._elements(i, written[i], real, linear) for i in sets] or [along_type(real, linear)()]
        self._own = own + own[-1:] * (SETS - len(own))
        if self.banded:
            self._balance = place_kernel(terms, plan.twist, real, linear, drag, self.serial)
            apart = np.zeros(net.blocks, np.uint8)
            apart[self.elsewhere()] = 1
            self._apart = wp.array(apart, dtype=wp.uint8, device=device)
        made = elimination.chain_kernels(plan.twist, plan.span, linear, plan.size, self.serial)
        self._factorise, self._load, self._solve, self._solve_all, self._follow, self._finish, *self._columns = made
        self._measure, self._meet = joints.joint_kernels(linear) if self.joints else (None, None)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        own = [self._assemble, self._load, self._finish]
        if self.reduction:
            own += [*self._columns, *self.reduction.kernels]
        else:
            own += [
                (kernel, SERIAL) for kernel in (self._factorise, self._solve, *([self._solve_all] * bool(self.joints)))
            ]
        own += [self._balance] if self.banded else []
        own += [self._clear] if self.banded and self.taken.size else []
        own += [self._product] if self.banded and not self.exact else []
        own += [self._follow] if self.met is not None else []
        return own + ([self._measure, self._meet] if self.joints else [])

    def elsewhere(self) -> np.ndarray:
        """Blocks that are not at a place, or at which elements meet that do not run along rods."""
        found = self.plan.where < 0
        for part in self.net.sets:
            if not part.host.along:
                found[part.host.slots.ravel()] = True
        return np.flatnonzero(found)

    def balance(self, given, islands, found) -> None:
        """Residuals of all blocks but those `elsewhere`."""
        self._launch(
            self._balance,
            (1 if self.serial else self.longest, self.columns),
            [given, self.places, self.count, self._apart, *islands.arrays, *self._own],
            [found],
        )

    def assemble(self, matrix: wp.array, mass: wp.array, islands) -> None:
        """Blocks of the chains of the worlds that want a direction."""
        table = self.table
        self._launch(
            self._assemble,
            (1 if self.serial else self.longest, self.columns),
            [matrix, mass, *islands.arrays, self.places, self.chain, self.count, self.held]
            + [table.diagonal, table.positions]
            + self._own,
            [self.bands],
        )
        if self.banded and self.taken.size:
            inputs = [self.taken, islands.wanted, table.positions]
            self._launch(self._clear, (self.taken.size, self.net.worlds), inputs, [matrix])

    def product(self, matrix, p: wp.array, fixed, wanted, product: wp.array, dots: wp.array) -> None:
        """H p with what the bands make of p, and p . H p block by block."""
        table, net = self.table, self.net
        self._launch(
            self._product,
            net.worlds * net.blocks,
            [matrix, table.columns, table.slices, fixed, p, wanted, net.blocks, table.positions]
            + [self.bands, self.places, self.where, self.count, net.host.nodes],
            [product, dots],
        )

    def prepare(self, matrix: wp.array, fixed: wp.array, wanted: wp.array, lost: wp.array) -> None:
        """Factors of chains and joints of the worlds that want a direction; raises `lost` where one of them is indefinite."""
        table, plan, net = self.table, self.plan, self.net
        self._lost, self._reduced = lost, False
        if not self.reduction:
            self._launch(self._factorise, self.columns, [self.bands, self.count, wanted], [self.factors, lost], SERIAL)
        if not self.joints:
            return
        if self.coupled:
            self._eliminate(matrix, wanted, self.responses, None, self.units)
        self._launch(
            self._measure,
            net.worlds * self.joints,
            [matrix, *self._joint_inputs(self.responses), self.own, self.colour, plan.size, fixed, wanted]
            + [table.positions],
            [self.parts, lost],
        )

    def apply(self, matrix, residual, wanted, z: wp.array, dots: wp.array) -> None:
        """z of the blocks of rods and joints from the residual, where block Jacobi has left its own, and r . z block by block."""
        net = self.net
        self._eliminate(matrix, wanted, self.values, residual, None)
        if self.joints:
            self._launch(
                self._meet,
                net.worlds * self.joints,
                [
                    matrix,
                    *self._joint_inputs(self.values),
                    self.parts,
                    residual,
                    wanted,
                    net.blocks,
                    self.table.positions,
                ],
                [self.moved],
            )
        if self.met is not None:
            self._launch(
                self._follow,
                (self.longest, self.columns),
                [self.met, self.count, wanted, self.responses, self.moved, self.joint_rows],
                [self.values],
            )
        elif self.coupled:
            self._eliminate(matrix, wanted, self.values, residual, self.moved)
        self._launch(
            self._finish,
            1 if self.serial else net.worlds * net.blocks,
            [residual, self.values, self.where, self.width, self.joint_row, self.joint_rows, self.moved, wanted]
            + [net.blocks, net.host.nodes],
            [z, dots],
        )

    def _joint_inputs(self, values: wp.array) -> list:
        chains = [self.joint_starts, self.joint_items, values, self.where, self.width, self.net.host.nodes]
        return [self.table.columns, *chains, self.pairs]

    def _eliminate(self, matrix, wanted, values: wp.array, residual, moved) -> None:
        """H_II^-1 (r_I - H_IJ z_J), of movements one by one or all at once; without `residual` or `moved` that one is zero."""
        table, net, solves = self.table, self.net, values.shape[2] // self.columns
        self._launch(
            self._load,
            (1 if self.serial else self.longest, solves * self.columns),
            [matrix, table.columns, self.places, self.count, self.held, self.starts, self.items, self.joint_row]
            + [self.joint_rows, wanted, net.blocks, table.positions, int(residual is not None)]
            + [int(moved is not None), self.moved if residual is None else residual]
            + [self.moved if moved is None else moved],
            [values],
        )
        if self.reduction:
            self._reduce(values, wanted)
            return
        kernel, sides = (self._solve, 1) if values is self.values else (self._solve_all, self.plan.size)
        self._launch(kernel, solves // sides * self.columns, [self.factors, self.count, wanted], [values], SERIAL)

    def _reduce(self, values: wp.array, wanted: wp.array) -> None:
        """H_II^-1 of values by cyclic reduction, which eliminates anew once after every `prepare`."""
        spread, note = self._columns
        self._launch(spread, self.columns, [wanted, self.width], [self._wanted])
        for first in range(0, values.shape[2], self.columns):
            part = values[:, :, first : first + self.columns]
            given = self.bands, part, self._all, self._wanted, part, self._bad
            self.reduction.solve(*given, again=self._reduced)
            if not self._reduced:
                self._launch(note, self.columns, [self.width], [self._bad, self._lost])
            self._reduced = True

    def _elements(self, index: int, written: dict, real, linear):
        """What the elements of a set write, and where they are."""
        part, own = self.net.sets[index], along_type(real, linear)()
        for name, array in written.items():
            setattr(own, name, array)
        own.at = arrays.upload(self.plan.elements(self.net.host, part.host).astype(np.int32), int, self.device)
        own.elements = part.elements
        return own

    def _launch(self, kernel, dim, inputs: list, outputs: list, threads: int = arrays.THREADS) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device, block_dim=threads)


class ChainPlan:
    """Chains, joints and their couplings on the host.

    Place k of a rod has its node k and the angle of the edge ahead of it. Joints take out the nodes where rods meet, the rotations
    of rigid joints, and the last places of a closed rod, so that what is left couples over two places at most; what acts from afar,
    as dipoles do, is left out. It falls into chains at rigid joints, not at hinged ones, over which a rod bends. Short chains lie
    behind each other in columns as long as the longest chain, so that little memory is padding. Nodes that are held take no part.

    Attributes:
        twist, span: whether chains have angles, and over how many places they couple.
        chain (longest, columns): number of the chain at a place, -1 in the padding; count (columns,): places of a column.
        where (blocks,): place * columns + column of a block, -1 for none.
        pairs (joints, 2): blocks of a joint, -1 for none; joint_row (blocks,): 2 joint + which of them, or -1.

    Once it is bound to positions of H:
        places (rows, longest, columns): node and angle of a place, -1 for none; then positions in H of its blocks with itself and
            with the next places (node x node, node x angle, angle x node, angle x angle for each; without angles the first), unless
            there are none.
        taken: positions that bands take over.
        complete: whether the elimination is that of all of H: no chain meets two joints, nothing else is free, and nothing acts
            between joints, or between chains.
        own (joints, 3): positions of its blocks in H, with each other at last.
        of_places, of_joints: starts and positions of the couplings of blocks of chains with joints, of rows of joints with chains.
        colour (joints,); units (solves, 1, 2 joints, 3): movements of joints, of a colour and a dof each, that S is measured with.
        met (colours, longest, columns): the joint of each colour that the chain of a place meets, -1 for none; None where there are no
            joints, or one chain meets two of one colour.
    """

    def __init__(self, host):
        self._blocks = host.blocks
        lengths = [len(rod.all_nodes) for rod in host.rods]
        self._first = dict(zip((rod.rod for rod in host.rods), np.cumsum([0, *lengths[:-1]]), strict=True))
        self._length = dict(zip((rod.rod for rod in host.rods), lengths, strict=True))
        rod = np.repeat(np.arange(len(lengths)), lengths)
        node = np.concatenate([rod.all_nodes for rod in host.rods])
        edges = [(r.all_edges, len(r.all_nodes) - len(r.all_edges)) for r in host.rods]
        angle = np.concatenate([np.append(own, np.full(missing, -1)) for own, missing in edges])
        place, reach = self._joints(host, node, angle, rod)
        node, angle = (np.where((block >= 0) & ~self._out[block], block, -1) for block in (node, angle))
        kept = (node >= 0) | (angle >= 0)
        if not kept.any():
            raise SceneError("preconditioner 'chain': no rod of the net has a node between its joints")
        goes_on = np.zeros(len(node), bool)  # a chain from the place before
        for step in (1, 2):
            goes_on[place[reach == 2] - step + 1] = True
        goes_on[place[reach == 1]] = True
        kept |= goes_on  # also places without dofs that a chain passes over
        chain = np.cumsum(~goes_on)[kept]
        self.twist, self.span = bool((angle >= 0).any()), 2 if (reach == 2).any() else 1
        self._arrange(kept, node[kept], angle[kept], np.unique(chain, return_inverse=True)[1])

    def bind(self, host, rows: np.ndarray, columns: np.ndarray, kept: np.ndarray | None) -> None:
        """Find everything among the rows and columns of positions of H; see `Chains.kept`."""
        if any(part.term.measure.apart for part in host.sets):
            slots = [part.slots.astype(np.int64) for part in host.sets if not part.term.measure.apart]
            near = np.concatenate([(s[:, None] * host.blocks + s[None]).ravel() for s in slots])
            near = np.isin(rows.astype(np.int64) * host.blocks + columns, near)
        else:
            near = rows >= 0
        used = np.flatnonzero(near & (rows >= 0))
        self._order = used[np.argsort(rows[used].astype(np.int64) * host.blocks + columns[used])]
        self._keys = rows[self._order].astype(np.int64) * host.blocks + columns[self._order]
        self._positions()
        self._couple(host, np.where(near, rows, -1), columns)
        chains = self._colour(host, columns)
        self._take(host, rows, columns, near, kept)
        self.complete &= not (np.bincount(chains) > 1).any()

    def elements(self, host, part) -> np.ndarray:
        """The element of a set along rods that has its node i at a place (nodes, longest, columns), -1 for none."""
        rod, k = part.owner
        first, n = (np.array([of[r] for r in rod.tolist()], int) for of in (self._first, self._length))
        result = np.full((part.term.measure.nodes, *self.chain.shape), -1)
        for i, at in enumerate(result):
            row, column = self._at[:, first + (k + i) % n]
            there = row >= 0
            at[row[there], column[there]] = np.flatnonzero(there)
        return result

    def held(self, host) -> np.ndarray:
        """Bits of the dofs of places that are held, or that they do not have (longest, columns)."""
        result = np.zeros(self.chain.shape, np.uint8)
        for part, components in zip(self.places[: len(self._dofs)], (3, 1), strict=False):
            missing = (part < 0)[..., None] | host.fixed[part, :components]
            result |= (missing << (3 * (components == 1) + np.arange(components))).sum(-1).astype(np.uint8)
        return result

    def find(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Positions of blocks in H, -1 where it has none or one of the two is -1."""
        if not len(self._keys):
            return np.full(len(row), -1)
        keys = row.astype(np.int64) * self._blocks + column
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return np.where((row >= 0) & (column >= 0) & (self._keys[at] == keys), self._order[at], -1)

    def _joints(self, host, node, angle, rod) -> tuple[np.ndarray, np.ndarray]:
        """What is taken out of the rods: `pairs` and `joint_row`. Returns couplings in what is left: later place, distance."""
        spins = [part.slots[[0, 3]].T for part in host.sets if part.term.measure.spins]
        held = host.fixed.all(1)
        turning = np.unique(np.concatenate(spins), axis=0) if spins else np.zeros((0, 2), int)
        met = np.bincount(node, minlength=host.blocks) > 1
        met[turning[:, 0]] = True
        spin = np.full(host.blocks, -1)
        spin[turning[::-1, 0]] = turning[::-1, 1]
        others = turning[spin[turning[:, 0]] != turning[:, 1], 1]  # of a second rigid joint at a node
        place = np.full(host.blocks, -1)
        at = np.arange(len(node))
        place[node[~met[node]]] = at[~met[node]]
        place[angle[angle >= 0]] = at[angle >= 0]
        a, b = _couplings(host, place, rod)
        cut = np.unique(a[a - b > 2])
        shared = np.flatnonzero(met)
        pairs = [
            np.column_stack([np.where(held[shared], -1, shared), spin[shared]]),
            np.column_stack([np.full(len(others), -1), others]),
            np.column_stack([np.where(met[node[cut]], -1, node[cut]), angle[cut]]),
        ]
        pairs = np.concatenate(pairs)
        self.pairs = pairs[(pairs >= 0).any(1)]
        self.joint_row = np.full(host.blocks, -1)
        taken = self.pairs.ravel()
        self.joint_row[taken[taken >= 0]] = np.flatnonzero(taken >= 0)
        self._out = met | (self.joint_row >= 0)
        left = ~(np.isin(a, cut) | np.isin(b, cut))
        return a[left], (a - b)[left]

    def _arrange(self, kept, node, angle, chain) -> None:
        """Chains in columns: `chain`, `count` and `where`."""
        lengths = np.bincount(chain)
        begin, column = np.zeros(len(lengths), int), np.zeros(len(lengths), int)
        filled, longest = [0], lengths.max()
        for i in np.argsort(-lengths, kind="stable"):
            if filled[-1] + lengths[i] > longest:
                filled.append(0)
            begin[i], column[i] = filled[-1], len(filled) - 1
            filled[-1] += lengths[i]
        self.count = np.array(filled)
        width = len(filled)
        k = np.arange(len(node)) - np.repeat(np.cumsum(lengths) - lengths, lengths) + begin[chain]
        self._at = np.full((2, len(kept)), -1)
        self._at[:, kept] = k, column[chain]
        self._dofs = [node, angle] if self.twist else [node]
        self._chains, self._k, self._c = chain, k, column[chain]
        self.where = np.full(self._blocks, -1)
        for block in self._dofs:
            self.where[block[block >= 0]] = (k * width + self._c)[block >= 0]
        self.chain = np.full((longest, width), -1)
        self.chain[k, self._c] = chain

    def _positions(self) -> None:
        """Blocks of places and positions of their couplings: `places`."""
        rows, found = list(self._dofs), []
        for s in range(self.span + 1):
            together = np.append(self._chains[s:] == self._chains[: len(self._chains) - s], np.zeros(s, bool))
            for p in self._dofs:
                for q in self._dofs:
                    found.append(self.find(p, np.where(together, np.roll(q, -s), -1)))
        rows += found if any((at >= 0).any() for at in found) else []
        self.places = np.full((len(rows), *self.chain.shape), -1)
        self.places[:, self._k, self._c] = rows

    def _take(self, host, rows, columns, near, kept) -> None:
        """What bands take over (`taken`), and whether that is all (`complete`)."""
        self.taken, self.complete = np.zeros(0, int), False
        if kept is None:
            return
        k, c = np.divmod(self.where, self.chain.shape[1])
        a, b = (np.where(rows >= 0, of, 0) for of in (rows, columns))
        both = kept[a] & kept[b] & (rows >= 0)
        same = both & near & (c[a] == c[b]) & (np.abs(k[a] - k[b]) <= self.span)
        same &= self.chain[k[a], c[a]] == self.chain[k[b], c[b]]
        self.taken = np.flatnonzero(same)
        joint = np.where(self.joint_row >= 0, self.joint_row // 2, -1)
        free = ~host.fixed.all(1)
        between = (joint[a] != joint[b]) & (rows >= 0) & free[a] & free[b] & ~(kept[a] | kept[b])
        self.complete = not (both & ~same).any() and not (free & ~kept & (joint < 0)).any() and not between.any()

    def _couple(self, host, rows, columns) -> None:
        """Couplings of chains and joints, of what is not held."""
        held = host.fixed.all(1)
        real = (rows >= 0) & ~(held[rows] | held[columns])
        inside, joint = (np.where(real, of[b], -1) for b, of in ((rows, self.where), (columns, self.joint_row)))
        there = np.flatnonzero((inside >= 0) & (joint >= 0))
        starts, items = lists(rows[there], host.blocks)
        self.of_places = starts, there[items]
        inside, joint = (np.where(real, of[b], -1) for b, of in ((columns, self.where), (rows, self.joint_row)))
        there = np.flatnonzero((inside >= 0) & (joint >= 0))
        starts, items = lists(joint[there], 2 * len(self.pairs))
        self.of_joints = starts, there[items]
        a, b = self.pairs.T
        self.own = np.column_stack([self.find(a, a), self.find(b, b), self.find(a, b)])

    def _colour(self, host, columns) -> np.ndarray:
        """Colours of joints, different where they meet at a chain, and the movements to measure with; the chain of every meeting."""
        joints = len(self.pairs)
        starts, items = self.of_joints
        joint = np.repeat(np.arange(2 * joints), np.diff(starts)) // 2
        k, column = np.divmod(self.where[columns[items]], self.chain.shape[1])
        touch = np.unique(np.column_stack([column, k, joint]), axis=0)
        neighbours = [set() for _ in range(joints)]
        for lag in (1, 2, 3):
            near = (touch[lag:, 0] == touch[:-lag, 0]) & (touch[lag:, 2] != touch[:-lag, 2])
            for one, other in zip(touch[:-lag][near, 2], touch[lag:][near, 2], strict=True):
                neighbours[one].add(other)
                neighbours[other].add(one)
        self.colour = np.full(joints, -1)
        for m in range(joints):
            taken = {self.colour[other] for other in neighbours[m]}
            self.colour[m] = next(c for c in range(joints) if c not in taken)
        chain, joint = np.unique(np.column_stack([self.chain[touch[:, 1], touch[:, 0]], touch[:, 2]]), axis=0).T
        colours = self.colour.max(initial=-1) + 1
        joints_of = np.full((colours, self.chain.max() + 1), -1)
        joints_of[self.colour[joint], chain] = joint
        alone = np.unique(chain * colours + self.colour[joint]).size == chain.size
        self.met = np.where(self.chain >= 0, joints_of[:, self.chain], -1) if joints and alone else None
        self.size = 6 if (self.pairs[:, 1] >= 0).any() else 3
        self.solves = self.size * (self.colour.max(initial=-1) + 1)
        self.units = np.zeros((self.solves, 1, 2 * joints, 3))
        for m, colour in enumerate(self.colour):
            for d in range(self.size):
                block = self.pairs[m, d // 3]
                if block >= 0 and not host.fixed[block, d % 3]:
                    self.units[colour * self.size + d, 0, 2 * m + d // 3, d % 3] = 1.0
        return chain


def _couplings(host, place: np.ndarray, rod: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of one rod that elements couple, the later one first; `place` is that of a block, -1 for none."""
    late, early = [np.zeros(0, int)], [np.zeros(0, int)]
    for part in host.sets:
        if part.term.measure.apart:
            continue
        at = place[part.slots]
        at = at[:, (at >= 0).sum(0) > 1]
        for i, one in enumerate(at):
            for other in at[:i]:
                high, low = np.maximum(one, other), np.minimum(one, other)
                both = (low >= 0) & (high > low)
                both[both] = rod[high[both]] == rod[low[both]]
                late.append(high[both])
                early.append(low[both])
    return np.concatenate(late), np.concatenate(early)

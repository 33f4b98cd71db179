"""Which dofs of a net make chains, which make joints, and how these couple."""

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.kernels.matrix.chain_places import place_dofs
from ddg_warp.solve.net.system import lists


class ChainPlan:
    """Chains, joints and their couplings on the host.

    Place k of a rod has its node k and the angle of the edge ahead of it. Joints take out the nodes where rods meet, the rotations
    of rigid joints, and the last places of a closed rod, so that what is left couples over two places at most; what acts from afar,
    as dipoles do, is left out. It falls into chains at rigid joints, not at hinged ones, over which a rod bends. Short chains lie
    behind each other in columns as long as the longest chain, so that little memory is padding. Nodes that are held take no part.

    Args:
        split: whether places have the tension of the edge behind them; then a chain goes on to the joint where its last edge ends.

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
        colour (joints,); units (solves, 1, 2 joints, 3): movements of joints, of a colour and a dof each, that S is measured with;
            none where no chain meets a joint.
        met (colours, longest, columns): the joint of each colour that the chain of a place meets, -1 for none; None where none meets
            any, or one chain meets two of one colour.
    """

    def __init__(self, host, split: bool = False):
        self.split = split
        self._blocks, self._held = host.blocks, host.fixed.all(1)
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
        if split:
            goes_on[1:] |= (kept | goes_on)[:-1] & (rod[1:] == rod[:-1])
        kept |= goes_on  # also places without dofs that a chain passes over
        chain = np.cumsum(~goes_on)[kept]
        self.twist, self.span = bool((angle >= 0).any()), 2 if (reach == 2).any() else 1
        self._arrange(kept, node[kept], angle[kept], np.unique(chain, return_inverse=True)[1])

    @property
    def block(self) -> int:
        """Dofs of a place."""
        return place_dofs(self.twist, self.split)

    @property
    def alone(self) -> bool:
        """Whether the elimination is that of all of H and no chain meets a joint, so that every tension ends in one chain."""
        return self.complete and not len(self.of_places[1])

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
        self._take(rows, columns, near, kept)
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

    def places_ahead(self, rod: np.ndarray) -> np.ndarray:
        """Place k and column of the next node (2, nodes) of all rods one after the other, given the rod of every node; -1 for none."""
        result = np.full(self._at.shape, -1)
        result[:, :-1] = np.where(rod[1:] == rod[:-1], self._at[:, 1:], -1)
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
            np.column_stack([np.where(self._held[shared], -1, shared), spin[shared]]),
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

    def _take(self, rows, columns, near, kept) -> None:
        """What bands take over (`taken`), and whether that is all (`complete`)."""
        k, c = np.divmod(self.where, self.chain.shape[1])
        a, b = (np.where(rows >= 0, of, 0) for of in (rows, columns))
        inside, free = self.where >= 0, ~self._held
        both = inside[a] & inside[b] & (rows >= 0) & free[a] & free[b]
        same = both & near & (c[a] == c[b]) & (np.abs(k[a] - k[b]) <= self.span)
        same &= self.chain[k[a], c[a]] == self.chain[k[b], c[b]]
        self.taken = np.zeros(0, int) if kept is None else np.flatnonzero(same)
        joint = np.where(self.joint_row >= 0, self.joint_row // 2, -1)
        between = (joint[a] != joint[b]) & (rows >= 0) & free[a] & free[b] & ~(inside[a] | inside[b])
        self.complete = not (both & ~same).any() and not (free & ~inside & (joint < 0)).any() and not between.any()

    def _couple(self, host, rows, columns) -> None:
        """Couplings of chains and joints, of what is not held."""
        real = (rows >= 0) & ~(self._held[rows] | self._held[columns])
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
        self.met = np.where(self.chain >= 0, joints_of[:, self.chain], -1) if len(chain) and alone else None
        self.size = 6 if (self.pairs[:, 1] >= 0).any() else 3
        self.solves = self.size * colours if len(chain) else 0
        self.units = np.zeros((self.solves, 1, 2 * joints, 3))
        for m, colour in enumerate(self.colour) if self.solves else ():
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

"""Plan of the substructuring: rod paths, joints and their couplings."""

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.kernels.linear.rod_dof_map import path_node_dofs
from ddg_warp.solve.linear.sparse_system import lists


class SubstructuringPlan:
    """Rod paths, joints and their couplings on the host.

    Path node k of a rod has node k and the twist angle of the edge after it. Joints take out the nodes where rods meet, the rotations
    of rigid joints, and the last path nodes of a closed rod. The remainder couples over at most two path nodes; long-range elements
    (dipoles) are left out. Rods are cut into paths at rigid joints, not at hinges, over which a rod bends. Short paths follow each
    other in columns as long as the longest path, so that little memory is padding. Fixed nodes are left out.

    Args:
        mixed_axial: True if path nodes have the tension of the edge before them; a path then extends to the joint where its last
            edge ends.

    Attributes:
        `twist`, `span`: whether paths have twist angles; number of path nodes over which they couple.
        `path` (longest, columns): number of the path at a path node, -1 in the padding.
        `count` (columns,): path nodes of a column.
        `where` (blocks,): path node * columns + column of a block, -1 for none.
        `pairs` (joints, 2): blocks of a joint, -1 for none.
        `joint_row` (blocks,): 2 joint + index of the block in the pair, or -1.

    After `bind` to positions of H:
        `places` (rows, longest, columns): node and angle block of a path node, -1 for none. If there are couplings, also positions in
            H of its blocks with itself and the next path nodes. Each has node x node, node x angle, angle x node, angle x angle;
            without angles the first alone.
        `taken`: positions that the bands replace.
        `complete`: True if the elimination solves all of H. No path meets two joints, all free dofs are on paths or joints, and
            nothing acts between joints or between paths.
        `own` (joints, 3): positions of the joint blocks in H, the coupling of the pair last.
        `of_places`, `of_joints`: couplings of path blocks with joints, of joint rows with paths (offsets, items).
        `colour` (joints,), `units` (solves, 1, 2 joints, 3): unit vectors of a colour and dof each, which probe the joint Schur
            complement S. Empty if no path meets a joint.
        `met` (colours, longest, columns): the joint of each colour that the path at a path node meets, -1 for none. None if no path
            meets one, or if one path meets two of one colour.
    """

    def __init__(self, host, mixed_axial: bool = False):
        self.mixed_axial = mixed_axial
        self._blocks, self._held = host.blocks, host.fixed.all(1)
        lengths = [len(rod.all_nodes) for rod in host.rods]
        self._first = dict(zip((rod.rod for rod in host.rods), np.cumsum([0, *lengths[:-1]]), strict=True))
        self._length = dict(zip((rod.rod for rod in host.rods), lengths, strict=True))
        rod = np.repeat(np.arange(len(lengths)), lengths)
        node = np.concatenate([rod.all_nodes for rod in host.rods])
        edges = [(r.all_edges, len(r.all_nodes) - len(r.all_edges)) for r in host.rods]
        angle = np.concatenate([np.append(edges_of_rod, np.full(missing, -1)) for edges_of_rod, missing in edges])
        later_node, distance = self._joints(host, node, angle, rod)
        node, angle = (np.where((block >= 0) & ~self._out[block], block, -1) for block in (node, angle))
        kept = (node >= 0) | (angle >= 0)
        if not kept.any():
            raise SceneError(
                "preconditioner 'substructuring': no rod of the coupled system has a node between its joints"
            )
        continues = np.zeros(len(node), bool)  # continues the path of the previous path node
        for step in (1, 2):
            continues[later_node[distance == 2] - step + 1] = True
        continues[later_node[distance == 1]] = True
        if mixed_axial:
            continues[1:] |= (kept | continues)[:-1] & (rod[1:] == rod[:-1])
        kept |= continues  # also path nodes without dofs within a path
        path = np.cumsum(~continues)[kept]
        self.twist, self.span = bool((angle >= 0).any()), 2 if (distance == 2).any() else 1
        self._arrange(kept, node[kept], angle[kept], np.unique(path, return_inverse=True)[1])

    @property
    def block(self) -> int:
        """Number of dofs of a path node."""
        return path_node_dofs(self.twist, self.mixed_axial)

    @property
    def joins_paths_only(self) -> bool:
        """True if the elimination solves all of H and no path meets a joint, so that each tension belongs to one path."""
        return self.complete and not len(self.of_places[1])

    def bind(self, host, rows: np.ndarray, columns: np.ndarray, kept: np.ndarray | None) -> None:
        """Find all positions in H, given its rows and columns; see `RodSubstructuring.kept`."""
        if any(element_set.term.measure.apart for element_set in host.sets):
            nodes = [
                element_set.slots.astype(np.int64) for element_set in host.sets if not element_set.term.measure.apart
            ]
            near = np.concatenate([(s[:, None] * host.blocks + s[None]).ravel() for s in nodes])
            near = np.isin(rows.astype(np.int64) * host.blocks + columns, near)
        else:
            near = rows >= 0
        used = np.flatnonzero(near & (rows >= 0))
        self._order = used[np.argsort(rows[used].astype(np.int64) * host.blocks + columns[used])]
        self._keys = rows[self._order].astype(np.int64) * host.blocks + columns[self._order]
        self._positions()
        self._couple(host, np.where(near, rows, -1), columns)
        paths = self._colour(host, columns)
        self._take(rows, columns, near, kept)
        self.complete &= not (np.bincount(paths) > 1).any()

    def elements(self, host, element_set) -> np.ndarray:
        """Return the elements with node i at a path node (nodes, longest, columns), -1 for none."""
        rod, k = element_set.owner
        first, n = (np.array([table[r] for r in rod.tolist()], int) for table in (self._first, self._length))
        result = np.full((element_set.term.measure.nodes, *self.path.shape), -1)
        for i, elements in enumerate(result):
            row, column = self._at[:, first + (k + i) % n]
            present = row >= 0
            elements[row[present], column[present]] = np.flatnonzero(present)
        return result

    def places_ahead(self, rod: np.ndarray) -> np.ndarray:
        """Return path node and column of the next node (2, nodes) of all rods in order, given the rod of every node; -1 for none."""
        result = np.full(self._at.shape, -1)
        result[:, :-1] = np.where(rod[1:] == rod[:-1], self._at[:, 1:], -1)
        return result

    def held(self, host) -> np.ndarray:
        """Return a bit mask of the fixed or absent dofs of path nodes (longest, columns)."""
        result = np.zeros(self.path.shape, np.uint8)
        for blocks, components in zip(self.places[: len(self._dofs)], (3, 1), strict=False):
            missing = (blocks < 0)[..., None] | host.fixed[blocks, :components]
            result |= (missing << (3 * (components == 1) + np.arange(components))).sum(-1).astype(np.uint8)
        return result

    def find(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return positions of blocks in H, -1 for absent blocks or negative rows and columns."""
        if not len(self._keys):
            return np.full(len(row), -1)
        keys = row.astype(np.int64) * self._blocks + column
        index = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return np.where((row >= 0) & (column >= 0) & (self._keys[index] == keys), self._order[index], -1)

    def _joints(self, host, node, angle, rod) -> tuple[np.ndarray, np.ndarray]:
        """Take the joints out of the rods: `pairs` and `joint_row`.

        Returns:
            Couplings of the remaining path nodes: index of the later one, and distance.
        """
        spins = [element_set.slots[[0, 3]].T for element_set in host.sets if element_set.term.measure.spins]
        rotations = np.unique(np.concatenate(spins), axis=0) if spins else np.zeros((0, 2), int)
        is_joint = np.bincount(node, minlength=host.blocks) > 1
        if host.rigid_bodies:  # a body is a joint of its centre and its rotation
            bodies = host.rigid_bodies
            of_bodies = np.column_stack([bodies.origins, bodies.spins])
            of_joints = ~np.isin(rotations[:, 1], np.append(bodies.spins, bodies.world))
            rotations = np.concatenate([rotations[of_joints], of_bodies])
            is_joint[bodies.carried] = True
        is_joint[rotations[:, 0]] = True
        rotation = np.full(host.blocks, -1)
        rotation[rotations[::-1, 0]] = rotations[::-1, 1]
        # of second rigid joints at a node
        further_rotations = rotations[rotation[rotations[:, 0]] != rotations[:, 1], 1]
        path_node = np.full(host.blocks, -1)
        index = np.arange(len(node))
        path_node[node[~is_joint[node]]] = index[~is_joint[node]]
        path_node[angle[angle >= 0]] = index[angle >= 0]
        a, b = _couplings(host, path_node, rod)
        cut = np.unique(a[a - b > 2])
        shared = np.flatnonzero(is_joint)
        pairs = [
            np.column_stack([np.where(self._held[shared], -1, shared), rotation[shared]]),
            np.column_stack([np.full(len(further_rotations), -1), further_rotations]),
            np.column_stack([np.where(is_joint[node[cut]], -1, node[cut]), angle[cut]]),
        ]
        pairs = np.concatenate(pairs)
        self.pairs = pairs[(pairs >= 0).any(1)]
        self.joint_row = np.full(host.blocks, -1)
        taken = self.pairs.ravel()
        self.joint_row[taken[taken >= 0]] = np.flatnonzero(taken >= 0)
        self._out = is_joint | (self.joint_row >= 0)
        remaining = ~(np.isin(a, cut) | np.isin(b, cut))
        return a[remaining], (a - b)[remaining]

    def _arrange(self, kept, node, angle, path) -> None:
        """Arrange paths in columns: `path`, `count` and `where`."""
        lengths = np.bincount(path)
        begin, column = np.zeros(len(lengths), int), np.zeros(len(lengths), int)
        filled, longest = [0], lengths.max()
        for i in np.argsort(-lengths, kind="stable"):
            if filled[-1] + lengths[i] > longest:
                filled.append(0)
            begin[i], column[i] = filled[-1], len(filled) - 1
            filled[-1] += lengths[i]
        self.count = np.array(filled)
        width = len(filled)
        k = np.arange(len(node)) - np.repeat(np.cumsum(lengths) - lengths, lengths) + begin[path]
        self._at = np.full((2, len(kept)), -1)
        self._at[:, kept] = k, column[path]
        self._dofs = [node, angle] if self.twist else [node]
        self._path_of, self._k, self._c = path, k, column[path]
        self.where = np.full(self._blocks, -1)
        for block in self._dofs:
            self.where[block[block >= 0]] = (k * width + self._c)[block >= 0]
        self.path = np.full((longest, width), -1)
        self.path[k, self._c] = path

    def _positions(self) -> None:
        """Find blocks of path nodes and positions of couplings: `places`."""
        rows, positions = list(self._dofs), []
        for s in range(self.span + 1):
            together = np.append(self._path_of[s:] == self._path_of[: len(self._path_of) - s], np.zeros(s, bool))
            for p in self._dofs:
                for q in self._dofs:
                    positions.append(self.find(p, np.where(together, np.roll(q, -s), -1)))
        rows += positions if any((each >= 0).any() for each in positions) else []
        self.places = np.full((len(rows), *self.path.shape), -1)
        self.places[:, self._k, self._c] = rows

    def _take(self, rows, columns, near, kept) -> None:
        """Find the positions that bands replace (`taken`), and whether they solve all of H (`complete`)."""
        k, c = np.divmod(self.where, self.path.shape[1])
        a, b = (np.where(rows >= 0, blocks, 0) for blocks in (rows, columns))
        inside, free = self.where >= 0, ~self._held
        both = inside[a] & inside[b] & (rows >= 0) & free[a] & free[b]
        same = both & near & (c[a] == c[b]) & (np.abs(k[a] - k[b]) <= self.span)
        same &= self.path[k[a], c[a]] == self.path[k[b], c[b]]
        self.taken = np.zeros(0, int) if kept is None else np.flatnonzero(same)
        joint = np.where(self.joint_row >= 0, self.joint_row // 2, -1)
        between = (joint[a] != joint[b]) & (rows >= 0) & free[a] & free[b] & ~(inside[a] | inside[b])
        self.complete = not (both & ~same).any() and not (free & ~inside & (joint < 0)).any() and not between.any()

    def _couple(self, host, rows, columns) -> None:
        """Find the couplings of free dofs between paths and joints."""
        real = (rows >= 0) & ~(self._held[rows] | self._held[columns])
        inside, joint = (np.where(real, table[b], -1) for b, table in ((rows, self.where), (columns, self.joint_row)))
        is_coupled = np.flatnonzero((inside >= 0) & (joint >= 0))
        starts, items = lists(rows[is_coupled], host.blocks)
        self.of_places = starts, is_coupled[items]
        inside, joint = (np.where(real, table[b], -1) for b, table in ((columns, self.where), (rows, self.joint_row)))
        is_coupled = np.flatnonzero((inside >= 0) & (joint >= 0))
        starts, items = lists(joint[is_coupled], 2 * len(self.pairs))
        self.of_joints = starts, is_coupled[items]
        a, b = self.pairs.T
        self.own = np.column_stack([self.find(a, a), self.find(b, b), self.find(a, b)])

    def _colour(self, host, columns) -> np.ndarray:
        """Colour the joints so that two on one path differ, and write the probing vectors.

        Returns:
            The path of every (path, joint) meeting.
        """
        joints = len(self.pairs)
        starts, items = self.of_joints
        joint = np.repeat(np.arange(2 * joints), np.diff(starts)) // 2
        k, column = np.divmod(self.where[columns[items]], self.path.shape[1])
        meetings = np.unique(np.column_stack([column, k, joint]), axis=0)
        neighbours = [set() for _ in range(joints)]
        for lag in (1, 2, 3):
            near = (meetings[lag:, 0] == meetings[:-lag, 0]) & (meetings[lag:, 2] != meetings[:-lag, 2])
            for first, neighbour in zip(meetings[:-lag][near, 2], meetings[lag:][near, 2], strict=True):
                neighbours[first].add(neighbour)
                neighbours[neighbour].add(first)
        self.colour = np.full(joints, -1)
        for m in range(joints):
            taken = {self.colour[neighbour] for neighbour in neighbours[m]}
            self.colour[m] = next(c for c in range(joints) if c not in taken)
        path, joint = np.unique(np.column_stack([self.path[meetings[:, 1], meetings[:, 0]], meetings[:, 2]]), axis=0).T
        colours = self.colour.max(initial=-1) + 1
        joints_of = np.full((colours, self.path.max() + 1), -1)
        joints_of[self.colour[joint], path] = joint
        alone = np.unique(path * colours + self.colour[joint]).size == path.size
        self.met = np.where(self.path >= 0, joints_of[:, self.path], -1) if len(path) and alone else None
        self.size = 6 if (self.pairs[:, 1] >= 0).any() else 3
        solves = self.size * colours if len(path) else 0
        self.units = np.zeros((solves, 1, 2 * joints, 3))
        for m, colour in enumerate(self.colour) if solves else ():
            for d in range(self.size):
                block = self.pairs[m, d // 3]
                if block >= 0 and not host.fixed[block, d % 3]:
                    self.units[colour * self.size + d, 0, 2 * m + d // 3, d % 3] = 1.0
        return path


def _couplings(host, path_node: np.ndarray, rod: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of path nodes of one rod that elements couple, the later one first.

    `path_node` is the index of each block, -1 for none.
    """
    later, earlier = [np.zeros(0, int)], [np.zeros(0, int)]
    for element_set in host.sets:
        if element_set.term.measure.apart:
            continue
        nodes = path_node[element_set.slots]
        nodes = nodes[:, (nodes >= 0).sum(0) > 1]
        for i, first in enumerate(nodes):
            for second in nodes[:i]:
                high, low = np.maximum(first, second), np.minimum(first, second)
                both = (low >= 0) & (high > low)
                both[both] = rod[high[both]] == rod[low[both]]
                later.append(high[both])
                earlier.append(low[both])
    return np.concatenate(later), np.concatenate(earlier)

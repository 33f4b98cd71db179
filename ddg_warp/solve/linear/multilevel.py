"""Multilevel preconditioner of the coupled system on a device; see `kernels.linear.multilevel`."""

import numpy as np
import warp as wp

from ddg_warp.kernels.linear import multilevel
from ddg_warp.kernels.linear.multilevel import GROUP, PIECE


class Multilevel:
    """Node groups of all levels, and their additive (BPX) preconditioner.

    Args:
        `coupled`, `table`: `CoupledModel` and its `SparseSystem`; linear: type of the linear algebra.
    """

    def __init__(self, coupled, table, linear):
        self.coupled, self.table, self.device = coupled, table, coupled.device
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
        nodes, worlds = coupled.host.nodes, coupled.worlds
        order = curve_order(coupled.host.rest[:nodes])
        rank = np.full(coupled.blocks, -1)
        rank[order] = np.arange(nodes)
        self.counts = [nodes]
        while self.counts[-1] > GROUP:
            self.counts.append(-(-self.counts[-1] // GROUP))
        self.counts = self.counts[1:] or [1]
        rows, columns = table.rows.numpy(), table.columns.numpy()
        real = rows >= 0
        a, b = np.where(real, rank[rows], -1), np.where(real, rank[columns], -1)
        both = (a >= 0) & (b >= 0)
        self.lists, size = [], GROUP
        for groups in self.counts:
            within = both & (a // size == b // size)
            positions = np.flatnonzero(within)
            target = a[positions] // size
            self.lists.append(self._pieces(positions[np.argsort(target, kind="stable")], target, groups, M))
            both &= ~within
            size *= GROUP
        self.order = wp.array(order.astype(np.int32), dtype=int, device=self.device)
        self.group = wp.array(np.where(rank >= 0, rank // GROUP, -1).astype(np.int32), dtype=int, device=self.device)
        self._none = wp.zeros(1, dtype=int, device=self.device)

        def make(dtype):
            return [wp.zeros(worlds * groups, dtype=dtype, device=self.device) for groups in self.counts]

        self.blocks, self.inverses, self.sums, self.corrections = make(M), make(M), make(H), make(H)
        self._no_members = wp.zeros(1, dtype=M, device=self.device)
        self._collect, self._gather, self._restrict, self._correct, self._finish = multilevel.level_kernels(linear)

    def _pieces(self, items: np.ndarray, target: np.ndarray, groups: int, M) -> tuple:
        """Return items of all groups in order, offsets of their pieces, first piece of each group, and buffers of piece sums."""
        counts = np.bincount(target, minlength=groups)
        pieces = -(-counts // PIECE)
        first = np.concatenate([[0], np.cumsum(pieces)])
        begins = np.concatenate([[0], np.cumsum(counts)])
        within = np.arange(first[-1]) - np.repeat(first[:-1], pieces)
        starts = np.append(np.repeat(begins[:-1], pieces) + PIECE * within, begins[-1])

        def put(values):
            return wp.array(values.astype(np.int32), dtype=int, device=self.device)

        sums = wp.zeros(self.coupled.worlds * max(1, int(first[-1])), dtype=M, device=self.device)
        return put(items), put(starts), put(first), sums

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._collect, self._gather, self._restrict, self._correct, self._finish]

    def prepare(self, matrix: wp.array, fixed: wp.array, wanted: wp.array) -> None:
        """Sum and invert the diagonal blocks of all levels, in worlds that need a direction."""
        table, members, count = self.table, self._no_members, 0
        worlds = self.coupled.worlds
        for groups, pieces_of_level, block, inverse in zip(
            self.counts, self.lists, self.blocks, self.inverses, strict=True
        ):
            items, pieces, starts, sums = pieces_of_level
            size = pieces.shape[0] - 1
            wp.launch(
                self._collect,
                worlds * size,
                [matrix, table.rows, table.columns, fixed, pieces, items, size, table.positions, wanted],
                [sums],
                device=self.device,
            )
            wp.launch(
                self._gather,
                worlds * groups,
                [sums, size, starts, members, count, groups, wanted],
                [block, inverse],
                device=self.device,
            )
            members, count = block, groups

    def apply(self, residual, inactive_mask, wanted, z: wp.array, dots: wp.array) -> None:
        """Add the corrections of coarse levels to z, which has the finest one, and write r . z block by block."""
        worlds, nodes, blocks = self.coupled.worlds, self.coupled.host.nodes, self.coupled.blocks
        values, order, count, stride = residual, self.order, nodes, blocks
        for groups, sums in zip(self.counts, self.sums, strict=True):
            wp.launch(
                self._restrict,
                worlds * groups,
                [values, order, count, stride, groups, wanted],
                [sums],
                device=self.device,
            )
            values, order, count, stride = sums, self._none, groups, groups
        above, above_groups = self.corrections[-1], 0
        for level in reversed(range(len(self.counts))):
            wp.launch(
                self._correct,
                worlds * self.counts[level],
                [self.inverses[level], self.sums[level], above, above_groups, self.counts[level], wanted],
                [self.corrections[level]],
                device=self.device,
            )
            above, above_groups = self.corrections[level], self.counts[level]
        wp.launch(
            self._finish,
            worlds * blocks,
            [residual, self.corrections[0], self.group, inactive_mask, self.counts[0], blocks, wanted],
            [z, dots],
            device=self.device,
        )


def curve_order(points: np.ndarray) -> np.ndarray:
    """Return the order of points (n, 3) along a Morton curve through their bounding box."""
    low, span = points.min(0), np.ptp(points, axis=0)
    cells = ((points - low) / max(span.max(), 1e-300) * (2**20 - 1)).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(20):
        for d in range(3):
            code |= ((cells[:, d] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + d)
    return np.argsort(code, kind="stable")

"""Multilevel preconditioner of the coupled system on a device; see `kernels.linear.multilevel`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import multilevel
from ddg_warp.kernels.linear.sliced_ell import SLICE
from ddg_warp.solve.linear.hat_functions import coarse_levels
from ddg_warp.solve.linear.sparse_system import slice_rows


class Multilevel:
    """Hat functions of all levels: additive on the finest level of a large sheet, V-cycle over the others.

    Args:
        `coupled`, `table`: `CoupledModel` and its `SparseSystem`; linear: type of the linear algebra.

    Attributes:
        counts: number of hats of each level, from fine to coarse.
        bounds: first hat of each level, and the end, in the numbering of all levels; hats: that end, padding to slices included.
        additive: hats of additive levels.
        `members`, `parents`: weighted points of each hat, nodes or hats of the level below; weighted hats above each hat.
        node_parents: weighted hats of each node.
        `matrix`, `product`, `node_product`: P^T A P of all levels, A P of all levels, A P of nodes.
        diagonal: position of the diagonal block of each hat in `matrix`; inverse: (W hats,) inverses, damped in the V-cycle.
    """

    def __init__(self, coupled, table, linear):
        self.coupled, self.table, self.device = coupled, table, coupled.device
        nodes, worlds, serial = coupled.host.nodes, coupled.worlds, device_arrays.serial(coupled.device)
        levels = coarse_levels(coupled.host.rest[:nodes], _node_pattern(table, nodes))
        self.counts = [level.weights.shape[1] for level in levels]
        self.bounds = [0, *np.cumsum([-(-count // SLICE) * SLICE for count in self.counts]).tolist()]
        self.hats, bounds = self.bounds[-1], self.bounds
        additive = int(max(self.counts[:1], default=0) > multilevel.LARGE[self.device.is_cuda])
        self.additive = bounds[additive]
        # first level in the block of threads
        self._tail = max(additive, sum(count > multilevel.SMALL for count in self.counts))
        self._threads = multilevel.SMALL if self.device.is_cuda else 1
        each = [level.weights for level in levels]
        shape = self.hats, max(nodes, self.hats)
        self.members = _list(_joined([weights.T for weights in each], bounds, [0, *bounds], shape), linear, self.device)
        self.node_parents = _list(_joined(each[:1], [0], [0], (nodes, self.hats)), linear, self.device)
        shape = self.hats, self.hats
        self.parents = _list(_joined(each[1:], bounds, bounds[1:], shape), linear, self.device)
        pattern = _joined([level.pattern for level in levels], bounds, bounds, shape)
        self.matrix, diagonal = _sliced(pattern, worlds, linear, self.device)
        pattern = _joined([level.product for level in levels[1:]], bounds, bounds[1:], shape)
        self.product, _ = _sliced(pattern, worlds, linear, self.device)
        pattern = _joined([level.product for level in levels[:1]], [0], [0], (nodes, self.hats))
        self.node_product, _ = _sliced(pattern, worlds, linear, self.device)
        self.diagonal = _put(diagonal, self.device)
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
        self.inverse = wp.zeros(worlds * self.hats, dtype=M, device=self.device)
        self._residual, self._change, self._z, self._correction = (
            wp.zeros(worlds * self.hats, dtype=H, device=self.device) for _ in range(4)
        )
        self._bounds = _put(bounds, self.device)
        self._dots = wp.zeros((2, worlds * self.hats), dtype=linear, device=self.device)
        self._sums = wp.zeros((2, worlds * len(levels) * self._threads), dtype=linear, device=self.device)
        self._finest = multilevel.sliced_type(linear)()
        self._finest.columns, self._finest.slices, self._finest.positions = table.columns, table.slices, table.positions
        self._no_mask, self._no_blocks = (wp.zeros(0, dtype=dtype, device=self.device) for dtype in (wp.uint8, M))
        self._outdated, self._first = (wp.zeros(worlds, dtype=int, device=self.device) for _ in range(2))
        self._any_outdated = wp.zeros(1, dtype=int, device=self.device)
        *set_up, self._damp = multilevel.setup_kernels(linear, serial)
        self._begin, self._spread, self._contract, self._invert, self._iterate = set_up
        self._restrict, self._subtract, self._correct, self._cycle, self._finish = multilevel.level_kernels(
            linear, serial
        )
        blocks_of_threads = [(kernel, self._threads) for kernel in (self._damp, self._cycle)]
        self.kernels = [*set_up, self._restrict, self._subtract, self._correct, self._finish, *blocks_of_threads]

    def prepare(self, system, more: wp.array, iteration: wp.array | None = None) -> None:
        """Set up the levels of a `LinearSystem` where H has changed.

        Args:
            more: blocks (W N,) to be added to the diagonal of H, or empty.
            iteration: (W,) iterations of Newton's method, of which the first set-up serves all; None for a set-up in each.
        """
        self._any_outdated.zero_()
        inputs = [system.outdated, self._first if iteration is None else iteration]
        outputs = [self._outdated, self._any_outdated]
        wp.launch(self._begin, self.coupled.worlds, inputs, outputs, device=self.device)
        wp.capture_if(self._any_outdated, lambda: self.set_up(system.matrix, system.masks.fixed, more))

    def set_up(self, matrix: wp.array, fixed: wp.array, more: wp.array) -> None:
        """Compute the matrices of all levels, and the inverses of their diagonal blocks, in outdated worlds."""
        worlds, nodes, blocks, hats = self.coupled.worlds, self.coupled.host.nodes, self.coupled.blocks, self.hats
        self._finest.values = matrix
        product, rows = self.node_product, (0, nodes)
        read = [self._finest, fixed, more, blocks, nodes, self.node_parents]
        for level in range(len(self.counts)):
            self._sweep(self._spread, rows[1], [*read, *rows, self._outdated], [product])
            rows = _range(self.bounds, level)
            self._sweep(self._contract, rows[1], [product, self.members, *rows, self._outdated], [self.matrix])
            product = self.product
            read = [self.matrix, self._no_mask, self._no_blocks, hats, hats, self.parents]
        read = [self.matrix, self.diagonal, self.members, self.additive, hats, self._outdated]
        wp.launch(self._invert, worlds * hats, read, [self.inverse], device=self.device)
        smoothed = [level for level, first in enumerate(self.bounds[:-2]) if first >= self.additive]
        if smoothed:
            first, count = self.additive, self.bounds[-2] - self.additive
            v, next = self._z, self._change
            for power in range(multilevel.POWER + 2):
                read = [self.matrix, self.inverse, first, count, hats, power == 0, self._outdated, v]
                self._sweep(self._iterate, count, read, [next, self._dots])
                v, next = next, v
            read = [self._bounds, smoothed[0], len(smoothed), hats, self._threads, self._dots, self._outdated]
            self._launch_blocks(self._damp, len(smoothed), read, [self._sums, self.inverse])

    def apply(self, residual, inactive_mask, wanted, z: wp.array, dots: wp.array) -> None:
        """Add the corrections of coarse levels to z, which has the finest one, and write r . z block by block."""
        if not self.counts:
            return
        nodes, blocks, hats, last = self.coupled.host.nodes, self.coupled.blocks, self.hats, len(self.counts) - 1
        values, points = residual, blocks
        for level in range(self._tail):
            first, count = _range(self.bounds, level)
            read = [values, points, self.members, self.inverse, first, count, hats, wanted]
            self._sweep(self._restrict, count, read, [self._residual, self._z])
            values, points = self._residual, hats
            if level < last and first >= self.additive:
                read = [self.matrix, self._residual, self._z, first, count, hats, wanted]
                self._sweep(self._subtract, count, read, [self._change])
                values = self._change
        above = self._z
        if self._tail <= last:
            read = [values, points, self.members, self.parents, self.matrix, self.product, self.inverse, self._bounds]
            read += [self._tail, hats, self._threads, wanted]
            outputs = [self._residual, self._change, self._z, self._correction]
            self._launch_blocks(self._cycle, 1, read, outputs)
            above = self._correction
        for level in reversed(range(min(self._tail, last))):
            first, count = _range(self.bounds, level)
            read = [self.product, self.inverse, self.parents, above, self._change, self._z, first, count, hats]
            self._sweep(self._correct, count, [*read, first >= self.additive, wanted], [self._correction])
            above = self._correction
        read = [residual, above, self.node_parents, inactive_mask, nodes, blocks, hats, wanted]
        self._sweep(self._finish, blocks, read, [z, dots])

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        device_arrays.sweep(kernel, self.coupled.worlds * count, inputs, outputs, self.device)

    def _launch_blocks(self, kernel, count: int, inputs: list, outputs: list) -> None:
        """Launch `count` blocks of threads in every world."""
        threads = self.coupled.worlds * count * self._threads
        wp.launch(kernel, threads, inputs, outputs, device=self.device, block_dim=self._threads)


def _range(bounds: list[int], k: int) -> tuple[int, int]:
    """Return the first index and the number of indices of range k."""
    return bounds[k], bounds[k + 1] - bounds[k]


def _joined(matrices: list, rows: list[int], columns: list[int], shape: tuple[int, int]):
    """Return a CSR matrix of blocks that begin at the given rows and columns."""
    from scipy.sparse import coo_matrix

    entries, none = [each.tocoo() for each in matrices], np.zeros(0, int)
    row = np.concatenate([none, *(each.row + first for each, first in zip(entries, rows, strict=False))])
    column = np.concatenate([none, *(each.col + first for each, first in zip(entries, columns, strict=False))])
    values = np.concatenate([np.zeros(0), *(each.data for each in entries)])
    result = coo_matrix((values, (row, column)), shape=shape).tocsr()
    result.sort_indices()
    return result


def _node_pattern(table, nodes: int):
    """Return the pattern of the matrix of nodes, symmetric with its diagonal, as a CSR matrix."""
    from scipy.sparse import coo_matrix

    rows, columns = table.rows.numpy(), table.columns.numpy()
    real = (rows >= 0) & (rows < nodes) & (columns < nodes)
    all_rows, all_columns = (np.concatenate([each[real], np.arange(nodes)]) for each in (rows, columns))
    result = coo_matrix((np.ones(len(all_rows), np.int32), (all_rows, all_columns)), shape=(nodes, nodes)).tocsr()
    result.sort_indices()
    return result


def _put(values: np.ndarray, device) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)


def _sliced(pattern, worlds: int, linear, device):
    """Return the matrices of all worlds in sliced ELLPACK, and the positions of diagonal blocks."""
    blocks = pattern.shape[0]
    row, column = np.repeat(np.arange(blocks), np.diff(pattern.indptr)), pattern.indices
    slices, position = slice_rows(row, blocks)
    columns, diagonal = np.full(slices[-1], -1), np.full(blocks, -1)
    columns[position] = column
    diagonal[row[row == column]] = position[row == column]
    result = multilevel.sliced_type(linear)()
    result.columns, result.slices, result.positions = _put(columns, device), _put(slices, device), len(columns)
    result.values = wp.zeros((9, worlds * len(columns)), dtype=linear, device=device)
    return result, diagonal


def _list(matrix, linear, device):
    result = multilevel.list_type(linear)()
    result.starts, result.items = _put(matrix.indptr, device), _put(matrix.indices, device)
    result.weights = wp.array(matrix.data, dtype=linear, device=device)
    return result

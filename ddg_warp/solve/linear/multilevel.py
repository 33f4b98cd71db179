"""Multilevel preconditioner of the coupled system on a device; see `kernels.linear.multilevel`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import multilevel
from ddg_warp.solve.linear.hat_functions import coarse_levels


class Multilevel:
    """Hat functions of all levels, and their additive (BPX) preconditioner.

    Args:
        `coupled`, `table`: `CoupledModel` and its `SparseSystem`; linear: type of the linear algebra.

    Attributes:
        levels: `DeviceLevel` of each level, from fine to coarse.
    """

    def __init__(self, coupled, table, linear):
        self.coupled, self.table, self.device = coupled, table, coupled.device
        nodes, worlds = coupled.host.nodes, coupled.worlds
        levels = coarse_levels(coupled.host.rest[:nodes], _node_pattern(table, nodes))
        self.levels = [DeviceLevel(level, worlds, linear, self.device) for level in levels]
        M = wp.types.matrix((3, 3), linear)
        largest = max((level.product.nnz for level in levels), default=0)
        self._product = wp.zeros(worlds * largest, dtype=M, device=self.device)
        self._outdated = wp.zeros(worlds, dtype=int, device=self.device)
        self._any_outdated = wp.zeros(1, dtype=int, device=self.device)
        self._first = wp.zeros(worlds, dtype=int, device=self.device)
        made = multilevel.setup_kernels(linear, device_arrays.serial(self.device))
        self._begin, self._spread, self._spread_coarse, self._contract, self._invert = made
        self._restrict, self._correct, self._finish = multilevel.level_kernels(linear)
        self.kernels = [*made, self._restrict, self._correct, self._finish]

    def prepare(self, system, more: wp.array, iteration: wp.array | None = None) -> None:
        """Set up the levels of a `LinearSystem` where H has changed.

        Args:
            more: blocks (W N,) to be added to the diagonal of H, or empty.
            iteration: (W,) iterations of Newton's method, of which the first set-up serves all; None for a set-up in each.
        """
        self._any_outdated.zero_()
        inputs = [system.outdated, self._first if iteration is None else iteration]
        self._launch(self._begin, self.coupled.worlds, inputs, [self._outdated, self._any_outdated])
        wp.capture_if(self._any_outdated, lambda: self.set_up(system.matrix, system.masks.fixed, more))

    def set_up(self, matrix: wp.array, fixed: wp.array, more: wp.array) -> None:
        """Compute the matrices of all levels, and the inverses of their diagonal blocks, in outdated worlds."""
        table, coupled, below = self.table, self.coupled, None
        for level in self.levels:
            read = [level.parents, level.product_pattern, self._outdated]
            if below is None:
                finest = [matrix, table.columns, table.slices, table.positions, fixed, more]
                read = [*finest, coupled.blocks, coupled.host.nodes, *read]
                kernel = self._spread
            else:
                read, kernel = [below.matrix, below.pattern, *read], self._spread_coarse
            self._sweep(kernel, level.product_pattern, read, [self._product])
            read = [self._product, level.product_pattern, level.members, level.pattern, self._outdated]
            self._sweep(self._contract, level.pattern, read, [level.matrix])
            read = [level.matrix, level.diagonal, level.pattern.rows.shape[0], self._outdated]
            self._launch(self._invert, coupled.worlds * level.hats, read, [level.inverse])
            below = level

    def apply(self, residual, inactive_mask, wanted, z: wp.array, dots: wp.array) -> None:
        """Add the corrections of coarse levels to z, which has the finest one, and write r . z block by block."""
        if not self.levels:
            return
        worlds, nodes, blocks = self.coupled.worlds, self.coupled.host.nodes, self.coupled.blocks
        values, stride = residual, blocks
        for level in self.levels:
            read = [values, stride, level.members, level.hats, wanted]
            self._launch(self._restrict, worlds * level.hats, read, [level.sums])
            values, stride = level.sums, level.hats
        above = self.levels[-1]
        for level, upper in zip(reversed(self.levels), [None, *reversed(self.levels[1:])], strict=True):
            hats, parents = (upper.hats, upper.parents) if upper else (0, level.parents)
            read = [level.inverse, level.sums, above.correction, hats, parents, level.hats, wanted]
            self._launch(self._correct, worlds * level.hats, read, [level.correction])
            above = level
        read = [residual, above.correction, above.parents, inactive_mask, above.hats, nodes, blocks, wanted]
        self._launch(self._finish, worlds * blocks, read, [z, dots])

    def _sweep(self, kernel, pattern, inputs: list, outputs: list) -> None:
        device_arrays.sweep(kernel, self.coupled.worlds * pattern.rows.shape[0], inputs, outputs, self.device)

    def _launch(self, kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device)


class DeviceLevel:
    """Device arrays of a `Level`.

    Attributes:
        hats: number of hats.
        `parents`, `members`: hats of each point of the level below, points of each hat, with weights.
        `product_pattern`, `pattern`: patterns of A P and P^T A P; `diagonal`: entries P^T A P of one hat.
        `matrix`, `inverse`: P^T A P, and inverses of its diagonal blocks.
        `sums`, `correction`: restricted residual, correction.
    """

    def __init__(self, level, worlds: int, linear, device):
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
        self.hats = level.weights.shape[1]
        self.parents, self.members = (_list(each.tocsr(), linear, device) for each in (level.weights, level.weights.T))
        self.product_pattern, self.pattern = (_pattern(each, device) for each in (level.product, level.pattern))
        rows = _rows(level.pattern)
        self.diagonal = _put(np.flatnonzero(rows == level.pattern.indices), device)
        self.matrix = wp.zeros(worlds * len(rows), dtype=M, device=device)
        self.inverse = wp.zeros(worlds * self.hats, dtype=M, device=device)
        self.sums, self.correction = (wp.zeros(worlds * self.hats, dtype=H, device=device) for _ in range(2))


def _node_pattern(table, nodes: int):
    """Return the pattern of the matrix of nodes, symmetric with its diagonal, as a CSR matrix."""
    from scipy.sparse import coo_matrix

    rows, columns = table.rows.numpy(), table.columns.numpy()
    real = (rows >= 0) & (rows < nodes) & (columns < nodes)
    all_rows, all_columns = (np.concatenate([each[real], np.arange(nodes)]) for each in (rows, columns))
    result = coo_matrix((np.ones(len(all_rows), np.int32), (all_rows, all_columns)), shape=(nodes, nodes)).tocsr()
    result.sort_indices()
    return result


def _rows(matrix) -> np.ndarray:
    """Return the row of each entry of a CSR matrix."""
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))


def _put(values: np.ndarray, device) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)


def _pattern(matrix, device) -> multilevel.Pattern:
    result = multilevel.Pattern()
    result.rows, result.columns = _put(_rows(matrix), device), _put(matrix.indices, device)
    result.starts = _put(matrix.indptr, device)
    return result


def _list(matrix, linear, device):
    result = multilevel.list_type(linear)()
    result.starts, result.items = _put(matrix.indptr, device), _put(matrix.indices, device)
    result.weights = wp.array(matrix.data, dtype=linear, device=device)
    return result

"""Multilevel preconditioner of the coupled system on a device; see `kernels.linear.multilevel`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import multilevel
from ddg_warp.solve.linear.hat_functions import coarse_levels


class Multilevel:
    """Hat functions of all levels: additive (BPX) preconditioner of the large ones, V-cycle over the small ones.

    Args:
        `coupled`, `table`: `CoupledModel` and its `SparseSystem`; linear: type of the linear algebra.

    Attributes:
        levels: `DeviceLevel` of each level, from fine to coarse; tail: the `DeviceTail` of the small ones, if any.
    """

    def __init__(self, coupled, table, linear):
        self.coupled, self.table, self.device = coupled, table, coupled.device
        from scipy.sparse import csr_matrix

        nodes, worlds = coupled.host.nodes, coupled.worlds
        levels = coarse_levels(coupled.host.rest[:nodes], _node_pattern(table, nodes))
        self._large = sum(level.weights.shape[1] > multilevel.SMALL for level in levels)
        small = levels[self._large :]
        self.tail = DeviceTail(small, worlds, linear, self.device) if small else None
        self.levels = [DeviceLevel(level, worlds, linear, self.device) for level in levels[: self._large]]
        self.levels += self.tail.levels if small else []
        coarsest = levels[-1].weights.shape[1] if levels else nodes
        self._no_parents = _list(csr_matrix((coarsest, 0)), linear, self.device)
        M = wp.types.matrix((3, 3), linear)
        largest = max((level.product.nnz for level in levels), default=0)
        self._product = wp.zeros(worlds * largest, dtype=M, device=self.device)
        self._outdated = wp.zeros(worlds, dtype=int, device=self.device)
        self._any_outdated = wp.zeros(1, dtype=int, device=self.device)
        self._first = wp.zeros(worlds, dtype=int, device=self.device)
        made = multilevel.setup_kernels(linear, device_arrays.serial(self.device))
        self._begin, self._spread, self._spread_coarse, self._contract, self._invert = made
        self._restrict, self._correct, self._finish = multilevel.level_kernels(linear)
        self.kernels = [*made, self._restrict, self._correct, self._finish, *(self.tail.kernels if self.tail else [])]

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
        for index, level in enumerate(self.levels):
            read = [level.parents, level.product_pattern, self._outdated]
            if below is None:
                finest = [matrix, table.columns, table.slices, table.positions, fixed, more]
                read = [*finest, coupled.blocks, coupled.host.nodes, *read]
                self._sweep(self._spread, coupled.host.nodes, read, [self._product])
            else:
                read = [below.matrix, below.pattern, *read]
                self._sweep(self._spread_coarse, level.product_pattern.rows.shape[0], read, [self._product])
            read = [self._product, level.product_pattern, level.members, level.pattern, self._outdated]
            self._sweep(self._contract, level.pattern.rows.shape[0], read, [level.matrix])
            read = [level.matrix, level.diagonal, level.members, int(index < self._large), self._outdated]
            self._launch(self._invert, coupled.worlds * level.hats, read, [level.inverse])
            below = level
        if self.tail:
            self.tail.damp(self._outdated)

    def apply(self, residual, inactive_mask, wanted, z: wp.array, dots: wp.array) -> None:
        """Add the corrections of coarse levels to z, which has the finest one, and write r . z block by block."""
        if not self.levels:
            return
        worlds, nodes, blocks = self.coupled.worlds, self.coupled.host.nodes, self.coupled.blocks
        values, large = residual.reshape((worlds, blocks)), self.levels[: self._large]
        for level in large:
            self._launch(self._restrict, worlds * level.hats, [values, level.members, level.hats, wanted], [level.sums])
            values = level.sums
        above, parents = values, self._no_parents
        if self.tail:
            self.tail.correct(values, wanted)
            above, parents = self.tail.levels[0].correction, self.tail.levels[0].parents
        for level in reversed(large):
            read = [level.inverse, level.sums, above, parents, level.hats, wanted]
            self._launch(self._correct, worlds * level.hats, read, [level.correction])
            above, parents = level.correction, level.parents
        read = [residual, above, parents, inactive_mask, nodes, blocks, wanted]
        self._launch(self._finish, worlds * blocks, read, [z, dots])

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        device_arrays.sweep(kernel, self.coupled.worlds * count, inputs, outputs, self.device)

    def _launch(self, kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device)


class DeviceLevel:
    """Device arrays of a `Level`.

    Attributes:
        hats: number of hats.
        `parents`, `members`: hats of each point of the level below, points of each hat, with weights.
        `product_pattern`, `pattern`: patterns of A P and P^T A P; `diagonal`: entries P^T A P of one hat.
        `matrix`, `inverse`: P^T A P, and inverses of its diagonal blocks, by world.
        `sums`, `correction`: restricted residual, correction, by world.
    """

    def __init__(self, level, worlds: int, linear, device, arrays: list | None = None):
        self.hats = level.weights.shape[1]
        self.parents, self.members = (_list(each.tocsr(), linear, device) for each in (level.weights, level.weights.T))
        self.product_pattern, self.pattern = (_pattern(each, device) for each in (level.product, level.pattern))
        self.diagonal = _put(np.flatnonzero(_rows(level.pattern) == level.pattern.indices), device)
        if arrays is None:
            arrays = _arrays(level.pattern.nnz, self.hats, worlds, linear, device)
        self.matrix, self.inverse, self.sums, self.correction = arrays


class DeviceTail:
    """V-cycle over the small levels, one block of threads a world; see `kernels.linear.multilevel.tail_kernels`.

    Attributes:
        levels: `DeviceLevel` of each level, with views of common arrays.
    """

    def __init__(self, levels, worlds: int, linear, device):
        H = wp.types.vector(3, linear)
        bounds = np.cumsum([0, *(level.weights.shape[1] for level in levels)])
        entries = np.cumsum([0, *(level.pattern.nnz for level in levels)])
        self._worlds, self._device = worlds, wp.get_device(device)
        self._threads = multilevel.SMALL_THREADS if self._device.is_cuda else 1
        arrays = _arrays(entries[-1], bounds[-1], worlds, linear, device)
        self.levels = [
            DeviceLevel(level, worlds, linear, device, [arrays[0][:, p:q], *(each[:, a:b] for each in arrays[1:])])
            for level, p, q, a, b in zip(
                levels, *(each.tolist() for each in (entries, entries[1:], bounds, bounds[1:])), strict=False
            )
        ]
        self._matrix, self._inverse, self._residual, self._correction = arrays
        self._change, self._z = (wp.zeros((worlds, bounds[-1]), dtype=H, device=device) for _ in range(2))
        self._dots = wp.zeros((worlds, 2 * self._threads), dtype=linear, device=device)
        self._damping = wp.ones((worlds, len(levels)), dtype=linear, device=device)
        self._tail = multilevel.Tail()
        self._tail.bounds = _put(bounds, device)
        starts = [level.pattern.indptr[:-1] + first for level, first in zip(levels, entries, strict=False)]
        self._tail.starts = _put(np.append(np.concatenate(starts), entries[-1]), device)
        columns = [level.pattern.indices + first for level, first in zip(levels, bounds, strict=False)]
        self._tail.columns = _put(np.concatenate(columns), device)
        upward = _shifted([level.weights for level in levels[1:]], bounds)
        self._parents, self._members = (_list(each.tocsr(), linear, device) for each in (upward, upward.T))
        self._damp, self._cycle = multilevel.tail_kernels(linear)
        self.kernels = [(kernel, self._threads) for kernel in (self._damp, self._cycle)]

    def damp(self, outdated: wp.array) -> None:
        """Find the damping of the smoothers in outdated worlds."""
        read = [self._tail, self._matrix, self._inverse, self._threads, outdated]
        self._launch(self._damp, read, [self._change, self._z, self._dots, self._damping])

    def correct(self, values: wp.array, wanted: wp.array) -> None:
        """Write the correction of the largest small level from `values` (worlds, points) of the level below."""
        read = [values, self.levels[0].members, self._tail, self._members, self._parents]
        read += [self._matrix, self._inverse, self._damping, self._threads, wanted]
        self._launch(self._cycle, read, [self._residual, self._change, self._z, self._correction])

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        threads = self._worlds * self._threads
        wp.launch(kernel, threads, inputs, outputs, device=self._device, block_dim=self._threads)


def _arrays(entries: int, hats: int, worlds: int, linear, device) -> list[wp.array]:
    """Return matrix, inverses, restricted residual and correction of levels, by world."""
    H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
    sizes = (entries, M), (hats, M), (hats, H), (hats, H)
    return [wp.zeros((worlds, int(count)), dtype=dtype, device=device) for count, dtype in sizes]


def _shifted(weights: list, bounds: np.ndarray):
    """Return the weights of levels over each other as one CSR matrix (hats, hats), in the numbering of all levels."""
    from scipy.sparse import coo_matrix

    entries = [each.tocoo() for each in weights]
    rows = [each.row + first for each, first in zip(entries, bounds, strict=False)]
    columns = [each.col + first for each, first in zip(entries, bounds[1:], strict=False)]
    none, size = np.zeros(0, int), int(bounds[-1])
    values = np.concatenate([np.zeros(0), *(each.data for each in entries)])
    return coo_matrix((values, (np.concatenate([none, *rows]), np.concatenate([none, *columns]))), (size, size)).tocsr()


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

"""Sparse system of the coupled dofs on a device: incidence lists, and H in sliced ELLPACK; see `kernels.linear.sliced_ell`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.linear import coupled_pcg, sliced_ell
from ddg_warp.kernels.linear.sliced_ell import SLICE
from ddg_warp.kernels.residual.coupled_residual import ITEM
from ddg_warp.solve.linear.condensation import CondensationPlan
from ddg_warp.timers import timer


class SparseSystem:
    """Sparsity and incidence lists of the coupled system, common to all worlds.

    Args:
        `coupled`: `CoupledModel`.
        kept: blocks (N,) bool whose couplings along rods are stored in bands, see `kernels.linear.rod_bands`. Entries of fixed blocks
            then are left out. None stores all entries here.

    Attributes:
        `positions`: number of entries of H in a world, padding included.
        `rows`, `columns`: block of each position, -1 in the padding.
        `slices`: offset of each slice.
        angles: first block of a twist angle, and the first one after all of them; has_angles: True if there are any.
        `diagonal`: position of each H_ii, -1 if in bands or left out.
        condensed: arrays of `kernels.rigid_bodies.condensation.condense_kernel` by name; None without rigid bodies. Entries of carried
            nodes follow the slices, and are left out of products.
        `meets`, `adds`: incidence lists (offsets, items) of each element set, by blocks and by positions.
    """

    def __init__(self, coupled, kept: np.ndarray | None = None):
        blocks, device = coupled.blocks, coupled.device
        self.angles = coupled.host.nodes, blocks - coupled.host.spins
        self.has_angles = self.angles[0] < self.angles[1]
        rigid, raw_blocks = coupled.host.rigid_bodies, np.zeros(blocks, bool)
        if rigid:
            raw_blocks[rigid.carried] = True
        out = None if kept is None else coupled.host.fixed.all(1) & ~raw_blocks
        pairs = [_pairs(element_set.host, kept, out) for element_set in coupled.sets]
        diagonal_blocks = np.arange(blocks) if kept is None else np.flatnonzero(~(kept | out))
        row = np.concatenate([*(rows for rows, *_ in pairs), diagonal_blocks]).astype(np.int32)
        column = np.concatenate([*(columns for _, columns, _ in pairs), diagonal_blocks]).astype(np.int32)
        raw = raw_blocks[row] | raw_blocks[column]
        raw_index, raw_row, raw_column = unique_entries(row[raw], column[raw], blocks)
        entry_row, entry_column, plan = row[~raw], column[~raw], None
        if rigid:
            plan = CondensationPlan(rigid, raw_row, raw_column, np.zeros(blocks, bool) if out is None else out)
            entry_row, entry_column = np.append(entry_row, plan.rows), np.append(entry_column, plan.columns)
        index, entry_row, entry_column = unique_entries(entry_row, entry_column, blocks)
        slices, position = slice_rows(entry_row, blocks)
        first_raw = int(slices[-1])
        self.positions = first_raw + len(raw_row)
        if self.positions * coupled.worlds >= 2**31:
            raise SceneError(
                "the coupled system is too large: its matrix has more than 2^31 entries; build fewer worlds at once"
            )
        targets = np.empty(len(row), int)
        targets[~raw], targets[raw] = position[index[: np.count_nonzero(~raw)]], first_raw + raw_index
        rows, columns = np.full(self.positions, -1), np.full(self.positions, -1)
        rows[position], columns[position] = entry_row, entry_column
        rows[first_raw:], columns[first_raw:] = raw_row, raw_column

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        self.rows, self.columns, self.slices = put(rows), put(columns), put(slices)
        diagonal = np.full(blocks, -1)
        on_diagonal = entry_row == entry_column
        diagonal[entry_row[on_diagonal]] = position[on_diagonal]
        self.diagonal, self.entries = put(diagonal), len(entry_row)
        self.condensed = None
        if plan:
            keys = entry_row.astype(np.int64) * blocks + entry_column
            raw_position = first_raw + np.arange(len(raw_row))
            self.condensed = {n: put(v) for n, v in plan.bind(keys, position, raw_position, blocks).items()}
        begin, self.adds, self.meets = 0, [], []
        for element_set, (rows, _, pair_indices) in zip(coupled.sets, pairs, strict=True):
            own_targets, begin = targets[begin : begin + len(rows)], begin + len(rows)
            starts, items = lists(own_targets, self.positions)
            self.adds.append((put(starts), put(items if pair_indices is None else pair_indices[items])))
            starts, items = lists(element_set.host.slots.T.ravel(), blocks)
            element, local = np.divmod(items, len(element_set.host.slots))
            self.meets.append((put(starts), put(element * ITEM + local)))


def unique_entries(row: np.ndarray, column: np.ndarray, blocks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the index of every entry among unique entries, and their rows and columns, sorted by rows, then columns."""
    order = lists(column, blocks)[1]
    order = order[lists(row[order], blocks)[1]]
    row, column = row[order], column[order]
    first = (np.diff(row, prepend=-1) != 0) | (np.diff(column, prepend=-1) != 0)
    index = np.empty(len(order), int)
    index[order] = np.cumsum(first) - 1
    return index, row[first], column[first]


def slice_rows(row: np.ndarray, blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the offsets of slices, and the positions of entries that are sorted by their `row`, of a matrix of `blocks` rows."""
    counts = np.bincount(row, minlength=blocks)
    padded = np.zeros(-(-blocks // SLICE) * SLICE, int)
    padded[:blocks] = counts
    slices = np.concatenate([[0], np.cumsum(padded.reshape(-1, SLICE).max(1) * SLICE)])
    rank = np.arange(len(row)) - (np.cumsum(counts) - counts)[row]
    return slices, slices[row // SLICE] + rank * SLICE + row % SLICE


def _pairs(element_set, kept, out) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return rows and columns that the elements of a set add to H, and indices of their node pairs; None for all in order.

    The index of a pair is (element * nodes + row's node) * nodes + column's node, in local node indices.
    """
    nodes = element_set.slots.T.astype(np.int32)
    n = nodes.shape[1]
    if kept is None:
        return np.repeat(nodes, n, axis=1).ravel(), np.tile(nodes, n).ravel(), None
    wanted = ~out[nodes]
    off_path = wanted & ~kept[nodes] if element_set.along else wanted
    elements = np.flatnonzero(off_path.any(1))
    pair = (
        wanted[elements, :, None]
        & wanted[elements, None, :]
        & (off_path[elements, :, None] | off_path[elements, None, :])
    )
    element, row, column = np.nonzero(pair)
    pair_indices = (elements[element] * n + row) * n + column
    return nodes[elements[element], row], nodes[elements[element], column], pair_indices


def lists(target: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the incidence list of `count` targets: offsets (count + 1,) and items, the indices into `target` in order."""
    from scipy.sparse import csr_array

    one = csr_array((np.ones(len(target), bool), target, np.arange(len(target) + 1)), shape=(len(target), count))
    table = one.tocsc()  # counting sort, faster than a sort by comparison
    return table.indptr, table.indices


class Sums:
    """Sums (or largest entries) of values (worlds, n) over each world.

    Attributes:
        kernels: kernels to load before a capture, with their number of threads a block.
    """

    def __init__(self, worlds: int, n: int, real, device, largest: bool = False):
        self.device = wp.get_device(device)
        serial = not self.device.is_cuda  # only there a block has several threads
        self._tiles = max(1, -(-n // coupled_pcg.TILE))
        self._threads = worlds if serial else worlds * self._tiles * coupled_pcg.THREADS
        self._partial = wp.zeros(worlds * self._tiles, dtype=real, device=device)
        self._counts = wp.zeros(worlds, dtype=int, device=device)
        self._total = coupled_pcg.sum_kernel(real, largest, serial)
        self.kernels = [(self._total, coupled_pcg.THREADS)]

    def __call__(self, values: wp.array, out: wp.array) -> None:
        """Write the sums to `out` (worlds,)."""
        self.launch(self._total, values, [], [out])

    @timer("reductions")
    def launch(self, kernel, values: wp.array, inputs: list, outputs: list) -> None:
        """Launch a kernel that sums values by `coupled_pcg.reduce_function`."""
        inputs = [values, self._tiles, self._partial, self._counts, *inputs]
        wp.launch(kernel, self._threads, inputs, outputs, device=self.device, block_dim=coupled_pcg.THREADS)


class MatrixAssembly:
    """Assembly of H from element contributions, `sliced_ell.SETS` element sets a launch.

    Args:
        written: the arrays "factor", "tension" and "second" of each set.
        exact_from: first iteration of each set with second derivatives, or None.
        local: for each set, True if its factor is of the local dofs.
        quadratic: True if blocks have a quadratic potential; see `kernels.core.inertia`.
    """

    def __init__(
        self,
        coupled,
        table: SparseSystem,
        written: list[dict],
        linear,
        exact_from: tuple,
        local: tuple,
        quadratic: bool,
    ):
        serial = device_arrays.serial(coupled.device)
        self.coupled, self.table, self.kernels, self._own = coupled, table, [], []
        for first in range(0, len(coupled.sets), sliced_ell.SETS):
            sets, from_iteration, local_dofs = (
                each[first : first + sliced_ell.SETS] for each in (coupled.sets, exact_from, local)
            )
            terms = tuple(part.term for part in sets)
            stiffened = coupled.has_quadratic_matrix(quadratic)
            layout = from_iteration, local_dofs, stiffened, table.has_angles, serial
            self.kernels.append(sliced_ell.assemble_kernel(terms, coupled.real, linear, first == 0, *layout))
            set_data = []
            for i in range(first, first + len(sets)):
                data = sliced_ell.contributions(linear, local[i])()
                data.factor, data.tension, data.second = (written[i][name] for name in ("factor", "tension", "second"))
                data.starts, data.items = table.adds[i]
                data.elements = coupled.sets[i].elements
                set_data.append(data)
            self._own.append(set_data + [set_data[-1]] * (sliced_ell.SETS - len(set_data)))

    def __call__(self, mass: wp.array, islands, matrix: wp.array) -> None:
        """Write H (9, positions of all worlds) in worlds that need a direction."""
        table = self.table
        for kernel, set_data in zip(self.kernels, self._own, strict=True):
            device_arrays.sweep(
                kernel,
                self.coupled.worlds * table.positions,
                [mass, *islands.arrays, table.rows, table.columns, table.positions, *table.angles, *set_data],
                [matrix],
                self.coupled.device,
            )

"""The sparse system of a net on a device: what meets at each block, and H in slices; see `kernels.matrix.sliced`."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.matrix import sliced
from ddg_warp.kernels.matrix.sliced import SLICE
from ddg_warp.kernels.net.balance import ITEM
from ddg_warp.kernels.solve import krylov


class NetSystem:
    """Sparsity and lists of a net, once for all worlds.

    Args:
        net: `DeviceNet`.
        kept: blocks (N,) bool between which chains keep what elements along rods add, see `kernels.matrix.bands`; entries of held
            blocks then are left out. None: all is here.

    Attributes:
        positions: entries of H in a world, padding included.
        rows, columns: block of each position, -1 in the padding; slices: start of each slice; diagonal: position of each H_ii, -1
            of those that chains keep, and of held ones then.
        meets: of each set, (starts, items) of the blocks; adds: (starts, items) of the positions.
    """

    def __init__(self, net, kept: np.ndarray | None = None):
        blocks, device = net.blocks, net.device
        out = None if kept is None else net.host.fixed.all(1)
        pairs = [_pairs(part.host, kept, out) for part in net.sets]
        own = np.arange(blocks) if kept is None else np.flatnonzero(~(kept | out))
        row = np.concatenate([*(rows for rows, *_ in pairs), own]).astype(np.int32)
        column = np.concatenate([*(columns for _, columns, _ in pairs), own]).astype(np.int32)
        order = lists(column, blocks)[1]
        order = order[lists(row[order], blocks)[1]]  # by rows and, of one row, by columns
        row, column = row[order], column[order]
        first = (np.diff(row, prepend=-1) != 0) | (np.diff(column, prepend=-1) != 0)
        inverse = np.empty(len(order), int)
        inverse[order] = np.cumsum(first) - 1
        row, column = row[first], column[first]
        counts = np.bincount(row, minlength=blocks)
        padded = np.zeros(-(-blocks // SLICE) * SLICE, int)
        padded[:blocks] = counts
        slices = np.concatenate([[0], np.cumsum(padded.reshape(-1, SLICE).max(1) * SLICE)])
        rank = np.arange(len(row)) - (np.cumsum(counts) - counts)[row]
        place = slices[row // SLICE] + rank * SLICE + row % SLICE
        self.positions = int(slices[-1])
        if self.positions * net.worlds >= 2**31:
            raise SceneError("the net is too large: its matrix has more than 2^31 entries; build fewer worlds at once")
        rows, columns = np.full(self.positions, -1), np.full(self.positions, -1)
        rows[place], columns[place] = row, column

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        self.rows, self.columns, self.slices = put(rows), put(columns), put(slices)
        diagonal = np.full(blocks, -1)
        diagonal[row[row == column]] = place[row == column]
        self.diagonal, self.entries = put(diagonal), len(row)
        at, self.adds, self.meets = 0, [], []
        for part, (rows, _, which) in zip(net.sets, pairs, strict=True):
            targets, at = place[inverse[at : at + len(rows)]], at + len(rows)
            starts, items = lists(targets, self.positions)
            self.adds.append((put(starts), put(items if which is None else which[items])))
            starts, items = lists(part.host.slots.T.ravel(), blocks)
            element, slot = np.divmod(items, len(part.host.slots))
            self.meets.append((put(starts), put(element * ITEM + slot)))


def _pairs(part, kept, out) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Rows and columns of what the elements of a set add to H, and which of all pairs of slots they are; None: all in order.

    A pair is (element * slots + row's slot) * slots + column's slot.
    """
    slots = part.slots.T.astype(np.int32)
    n = slots.shape[1]
    if kept is None:
        return np.repeat(slots, n, axis=1).ravel(), np.tile(slots, n).ravel(), None
    wanted = ~out[slots]
    other = wanted & ~kept[slots] if part.along else wanted
    some = np.flatnonzero(other.any(1))
    pair = wanted[some, :, None] & wanted[some, None, :] & (other[some, :, None] | other[some, None, :])
    element, row, column = np.nonzero(pair)
    which = (some[element] * n + row) * n + column
    return slots[some[element], row], slots[some[element], column], which


def lists(target: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Items (indices into `target`) of each of `count` targets, in order: starts (count + 1,) and items."""
    from scipy.sparse import csr_array

    one = csr_array((np.ones(len(target), bool), target, np.arange(len(target) + 1)), shape=(len(target), count))
    table = one.tocsc()  # counts, which takes less than a sort
    return table.indptr, table.indices


class Sums:
    """Sums (or largest entries) of values (worlds, n) over each world.

    Attributes:
        kernels: to load before a capture, with their number of threads a block.
    """

    def __init__(self, worlds: int, n: int, real, device, largest: bool = False):
        tiles = -(-n // krylov.TILE)
        if tiles > krylov.TILES:
            raise SceneError(f"the net has {n} blocks or edges; there may be {krylov.TILE * krylov.TILES}")
        self.worlds, self.tiles, self.device = worlds, tiles, wp.get_device(device)
        cuda = self.device.is_cuda
        self._own = krylov.sum_kernels(real, largest) if cuda else (krylov.serial_sum_kernel(real, largest),)
        self.kernels = [(kernel, krylov.THREADS) for kernel in self._own]
        self._partial = wp.zeros((worlds, tiles), dtype=real, device=device)

    def __call__(self, values: wp.array, out: wp.array) -> None:
        """Write the sums to `out` (worlds,)."""
        if not self.device.is_cuda:
            wp.launch(self._own[0], self.worlds, [values, out], device=self.device)
            return
        for kernel, grid, inputs in (
            (self._own[0], (self.worlds, self.tiles), [values, self._partial]),
            (self._own[1], (self.worlds,), [self._partial, out]),
        ):
            wp.launch_tiled(kernel, dim=grid, inputs=inputs, block_dim=krylov.THREADS, device=self.device)


class Assembly:
    """Sums H from what the elements of all sets write, `sliced.SETS` sets a launch.

    Args:
        written: of each set, the arrays "factor", "tension" and "second".
        exact_from: of each set, the iteration from which on second derivatives are written, or None.
        local: of each set, whether its factor is of the local dofs.
        drag: whether blocks have more than a mass.
    """

    def __init__(
        self,
        net,
        table: NetSystem,
        written: list[dict],
        real,
        linear,
        exact_from: tuple,
        local: tuple,
        drag: bool,
    ):
        serial = arrays.serial(net.device)
        self.net, self.table, self.kernels, self._own = net, table, [], []
        for first in range(0, len(net.sets), sliced.SETS):
            sets, late, own_dofs = (of[first : first + sliced.SETS] for of in (net.sets, exact_from, local))
            terms = tuple(part.term for part in sets)
            self.kernels.append(sliced.assemble_kernel(terms, real, linear, first == 0, late, own_dofs, drag, serial))
            own = []
            for i in range(first, first + len(sets)):
                data = sliced.contributions(linear, local[i])()
                data.factor, data.tension, data.second = (written[i][name] for name in ("factor", "tension", "second"))
                data.starts, data.items = table.adds[i]
                data.elements = net.sets[i].elements
                own.append(data)
            self._own.append(own + [own[-1]] * (sliced.SETS - len(own)))

    def __call__(self, mass: wp.array, islands, matrix: wp.array) -> None:
        """Write H (9, positions of all worlds) of the worlds that want it."""
        table = self.table
        for kernel, own in zip(self.kernels, self._own, strict=True):
            arrays.sweep(
                kernel,
                self.net.worlds * table.positions,
                [mass, *islands.arrays, table.rows, table.columns, table.positions, *own],
                [matrix],
                self.net.device,
            )

"""Block-pentadiagonal systems of chains on a device: few, long chains by many threads each, or many by one each."""

import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.matrix import block_band
from ddg_warp.kernels.solve import cyclic_reduction, paired, reduction_again
from ddg_warp.solve.choice import LONGEST_REPEATED

REDUCING = 128  # threads of a block in a level of the reduction
THREADS = 32  # of a block of threads that walk: few chains reach more multiprocessors
MOST = 512  # threads of a block that has one chain
TOGETHER = 4  # neighbouring chains in a block of threads, which read 16 bytes at a time


class CyclicReduction:
    """Levels of the reduction of open chains of at most `nodes` nodes of `nb` dofs; see `kernels.solve.cyclic_reduction`.

    Args:
        tensions: how many dofs of a node are; with any, the system comes in the form of a level. See `kernels.solve.paired`.
        repeated: whether there are many right-hand sides of the same matrix: chains that are not too long then keep what these
            need; see `kernels.solve.reduction_again`.

    Attributes:
        repeats: whether it keeps that.
    """

    def __init__(self, nb: int, nodes: int, columns: int, linear, device, tensions: int = 0, repeated: bool = False):
        self.columns, self.device, self.dofs, self._linear = columns, device, 2 * nb, linear
        self.blocks = [-(-nodes // 2)]  # of every level
        while self.blocks[-1] > 1:
            self.blocks.append(-(-self.blocks[-1] // 2))
        matrix_rows, right_rows, kept_rows = cyclic_reduction.level_rows(nb)

        def vectors(rows, blocks):
            return arrays.allocate((rows, blocks, columns), linear, device)

        self.repeats = repeated and nodes <= LONGEST_REPEATED
        levels = len(self.blocks) - 1
        self.matrices = [vectors(matrix_rows, blocks) for blocks in self.blocks[1:]]
        self._reduce = [
            cyclic_reduction.reduce_kernel(nb, linear, not tensions and level == 0, tensions, self.repeats)
            for level in range(levels)
        ]
        if not self.repeats:
            self.rights = [vectors(right_rows, blocks) for blocks in self.blocks[1:]]
            self.kept = [vectors(kept_rows, blocks // 2) for blocks in self.blocks[:-1]]
            self._last = cyclic_reduction.last_kernel(nb, linear, not tensions and levels == 0, tensions)
            self._expand = cyclic_reduction.expand_kernel(nb, linear)
            return
        number = 1 + sum(blocks // 2 for blocks in self.blocks)
        self._packed = wp.zeros((columns, number, 3 * self.dofs**2), dtype=linear, device=device)
        self._rest, self._found = (
            wp.zeros((columns, self.blocks[0], self.dofs), dtype=linear, device=device) for _ in range(2)
        )
        self._none = wp.zeros((0, 0, 0), dtype=linear, device=device)
        self._pack = reduction_again.pack_kernel(nb, linear, not tensions and levels == 0, tensions)
        self._again = reduction_again.again_kernel(nb, linear)
        self._threads = 1
        if wp.get_device(device).is_cuda:
            self._threads = min(MOST, -(-(self.blocks[0] + 1) // 2 * self.dofs // 32) * 32)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        own = [(kernel, REDUCING) for kernel in self._reduce[:2]]
        if self.repeats:
            return [*own, self._pack, (self._again, self._threads)]
        return [*own, (self._last, 32), self._expand]

    def solve(self, matrix, right, count, wanted, solution: wp.array, bad: wp.array, again: bool = False) -> None:
        """Solution of the wanted columns from the blocks of their nodes; adds the pivots they lose to `bad`.

        `again` is for a further right-hand side of the same matrix. The solution may take the place of the right-hand side.
        """
        if self.repeats:
            if not again:
                self.factorise(matrix, count, wanted, bad)
            self.again(right, count, wanted, 1, solution)
            return
        for level, kernel in enumerate(self._reduce):
            outputs = [self.matrices[level], self.rights[level], self.kept[level]]
            self._eliminate(level, kernel, 2 * self.dofs + 1, [matrix, right, count, wanted], 0, outputs, bad)
            matrix, right = outputs[:2]
        wp.launch(
            self._last,
            self.columns,
            [matrix, right, count, wanted],
            [solution, bad],
            device=self.device,
            block_dim=32,
        )
        for level in reversed(range(len(self.kept))):
            wp.launch(
                self._expand,
                (self.dofs, self.blocks[level] // 2, self.columns),
                [self.kept[level], count, wanted, 2 << level],
                [solution],
                device=self.device,
            )

    def factorise(self, matrix, count, wanted, bad: wp.array) -> None:
        """What `again` needs of the wanted columns, where this `repeats`; adds the pivots they lose to `bad`."""
        at = 0
        for level, kernel in enumerate(self._reduce):
            outputs = [self.matrices[level], self._none, self._packed]
            self._eliminate(level, kernel, 2 * self.dofs, [matrix, self._none, count, wanted], at, outputs, bad)
            at += self.blocks[level] // 2
            matrix = self.matrices[level]
        inputs = [matrix, count, wanted, at]
        wp.launch(self._pack, (self.columns, self.dofs), inputs, [self._packed, bad], device=self.device)

    def _eliminate(self, level: int, kernel, threads: int, inputs: list, at: int, outputs: list, bad: wp.array) -> None:
        together = min(TOGETHER, self.columns)
        wp.launch(
            kernel,
            (self.blocks[level + 1], -(-self.columns // together), threads, together),
            [*inputs, self.blocks[level], 2, at, together],
            [*outputs, bad],
            device=self.device,
            block_dim=REDUCING,
        )

    def again_kernel_at_places(self, twist: bool):
        """Kernel of `again_at_places`, and how many threads a block of it has."""
        return reduction_again.again_at_places_kernel(twist, self._linear), self._threads

    def again_at_places(self, twist: bool, residual, places, held, count, idle, wanted, blocks: int, z, dots) -> None:
        """As `again`, of the chains of a net with so many blocks in a world, see `reduction_again.again_at_places_kernel`."""
        kernel, threads = self.again_kernel_at_places(twist)
        wp.launch(
            kernel,
            self.columns * threads,
            [self._packed, residual, places, held, count, idle, wanted, blocks, self.blocks[0], threads],
            [self._rest, self._found, z, dots],
            device=self.device,
            block_dim=threads,
        )

    def again(self, right, count, wanted: wp.array, width: int, solution: wp.array) -> None:
        """Solution, once factors are there, of the columns of which `wanted` is 1, of every `width` of them."""
        wp.launch(
            self._again,
            self.columns * self._threads,
            [self._packed, right, count, wanted, width, self.blocks[0], self._threads],
            [self._rest, self._found, solution],
            device=self.device,
            block_dim=self._threads,
        )


class Elimination:
    """Node by node, with a thread each, of the same chains by the same calls: for many of them.

    Args:
        kind: `ChainKind` of the chains; columns: how many there are.
    """

    def __init__(self, kind, nodes: int, columns: int, linear, device):
        self.columns, self.device = columns, device
        self._factors = arrays.allocate((3 * kind.block**2 + kind.block, nodes, columns), linear, device)
        self._first = wp.zeros(columns, dtype=int, device=device)  # iteration
        self._factor, self._direct = block_band.factor_kernel(kind, linear), block_band.direct_kernel(kind, linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [(self._factor, THREADS), (self._direct, THREADS)]

    def solve(self, matrix, right, count, wanted, solution: wp.array, bad: wp.array, again: bool = False) -> None:
        """As `CyclicReduction.solve`."""
        if not again:
            self._launch(self._factor, [matrix, count, wanted, self._first, 0], [self._factors, bad])
        self._launch(self._direct, [self._factors, right, count, wanted], [solution])

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.columns, inputs, outputs, device=self.device, block_dim=THREADS)


class TensionReduction:
    """The same of a group of rods with the tensions of their edges as unknowns; see `kernels.solve.paired`."""

    def __init__(self, group, real, linear, device):
        kind, columns = group.kind, group.columns
        size = kind.block + paired.TENSIONS
        self.group, self.device = group, device
        self.levels = CyclicReduction(size, group.nodes, columns, linear, device, paired.TENSIONS)
        matrix_rows, right_rows, _ = cyclic_reduction.level_rows(size)
        pairs = self.levels.blocks[0]
        self.matrix, self.right = (
            arrays.allocate((rows, pairs, columns), linear, device) for rows in (matrix_rows, right_rows)
        )
        self.solution = arrays.allocate((size, group.nodes, columns), linear, device)
        self._pair = paired.pair_kernel(kind, linear)
        self._unpair = paired.unpair_kernel(kind, real, linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._pair, self._unpair, *self.levels.kernels]

    def solve(self, blocks, factor, right, x, islands, direction: wp.array) -> None:
        """Directions of wanted rods and what their edges lengthen by, from the blocks of nodes and the factor of elements."""
        group = self.group
        wp.launch(
            self._pair,
            self.right.shape,
            [blocks, factor, group.fixed, right, group.count, islands.wanted],
            [self.matrix, self.right],
            device=self.device,
        )
        self.levels.solve(self.matrix, self.right, group.count, islands.wanted, self.solution, islands.bad)
        wp.launch(
            self._unpair,
            self.solution.shape[1:],
            [self.solution, factor, x, group.count, *islands.arrays],
            [direction],
            device=self.device,
        )

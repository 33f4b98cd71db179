"""Block-pentadiagonal solvers of rod paths on a device: many threads each for few long rods, else one each."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import cyclic_reduction, cyclic_reduction_solve, mixed_pairs, rod_elimination
from ddg_warp.solve.linear.solver_selection import LONGEST_REPEATED

REDUCING = 128  # Threads of a block in a reduction level.
THREADS = 32  # Threads of a block in the sweep: small blocks spread few rods over more multiprocessors.
MOST = 512  # Largest block for one rod.
TOGETHER = 4  # Neighbouring rods in a block, for reads of 16 bytes.


class CyclicReduction:
    """Block cyclic reduction of open rods of at most `nodes` nodes of `nb` dofs; see `kernels.linear.cyclic_reduction`.

    Args:
        tensions: number of tension dofs of a node; if positive, the system comes in the form of a level. See
            `kernels.linear.mixed_pairs`.
        repeated: True for many right-hand sides of one matrix: factors of rods up to a length are kept; see
            `kernels.linear.cyclic_reduction_solve`.

    Attributes:
        repeats: True if factors are kept.
    """

    def __init__(self, nb: int, nodes: int, columns: int, linear, device, tensions: int = 0, repeated: bool = False):
        self.columns, self.device, self.dofs, self._linear = columns, device, 2 * nb, linear
        self.blocks = [-(-nodes // 2)]  # blocks of every level
        while self.blocks[-1] > 1:
            self.blocks.append(-(-self.blocks[-1] // 2))
        matrix_rows, right_rows, kept_rows = cyclic_reduction.level_rows(nb)

        def vectors(rows, blocks):
            return device_arrays.allocate((rows, blocks, columns), linear, device)

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
        self._pack = cyclic_reduction_solve.pack_kernel(nb, linear, not tensions and levels == 0, tensions)
        self._again = cyclic_reduction_solve.again_kernel(nb, linear)
        self._threads = 1
        if wp.get_device(device).is_cuda:
            self._threads = min(MOST, -(-(self.blocks[0] + 1) // 2 * self.dofs // 32) * 32)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        reducing = [(kernel, REDUCING) for kernel in self._reduce[:2]]
        if self.repeats:
            return [*reducing, self._pack, (self._again, self._threads)]
        return [*reducing, (self._last, 32), self._expand]

    def solve(self, matrix, rhs, count, wanted, solution: wp.array, lost: wp.array) -> None:
        """Solve the wanted columns from the blocks of nodes; count lost pivots in `lost`.

        The solution may overwrite the right-hand side.
        """
        if self.repeats:
            self.factorise(matrix, count, wanted, lost)
            self.again(rhs, count, wanted, 1, solution)
            return
        for level, kernel in enumerate(self._reduce):
            outputs = [self.matrices[level], self.rights[level], self.kept[level]]
            self._eliminate(level, kernel, 2 * self.dofs + 1, [matrix, rhs, count, wanted], 0, outputs, lost)
            matrix, rhs = outputs[:2]
        wp.launch(
            self._last,
            self.columns,
            [matrix, rhs, count, wanted],
            [solution, lost],
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

    def factorise(self, matrix, count, wanted, lost: wp.array) -> None:
        """Factorise the wanted columns for `again`; count lost pivots in `lost`."""
        offset = 0
        for level, kernel in enumerate(self._reduce):
            outputs = [self.matrices[level], self._none, self._packed]
            self._eliminate(level, kernel, 2 * self.dofs, [matrix, self._none, count, wanted], offset, outputs, lost)
            offset += self.blocks[level] // 2
            matrix = self.matrices[level]
        inputs = [matrix, count, wanted, offset]
        wp.launch(self._pack, (self.columns, self.dofs), inputs, [self._packed, lost], device=self.device)

    def _eliminate(
        self, level: int, kernel, threads: int, inputs: list, offset: int, outputs: list, lost: wp.array
    ) -> None:
        together = min(TOGETHER, self.columns)
        wp.launch(
            kernel,
            (self.blocks[level + 1], -(-self.columns // together), threads, together),
            [*inputs, self.blocks[level], 2, offset, together],
            [*outputs, lost],
            device=self.device,
            block_dim=REDUCING,
        )

    def again_kernel_at_places(self, twist: bool):
        """Return the kernel of `again_at_places` and the block size."""
        return cyclic_reduction_solve.solve_at_path_nodes_kernel(twist, self._linear), self._threads

    def again_at_places(
        self, twist: bool, residual, places, fixed, count, inactive, wanted, blocks: int, z, dots
    ) -> None:
        """Solve rod paths of the coupled system with kept factors, see `cyclic_reduction_solve.solve_at_path_nodes_kernel`."""
        kernel, threads = self.again_kernel_at_places(twist)
        wp.launch(
            kernel,
            self.columns * threads,
            [self._packed, residual, places, fixed, count, inactive, wanted, blocks, self.blocks[0], threads],
            [self._rest, self._found, z, dots],
            device=self.device,
            block_dim=threads,
        )

    def again(self, rhs, count, wanted: wp.array, width: int, solution: wp.array) -> None:
        """Solve columns with kept factors; `wanted` has one flag for every `width` columns."""
        wp.launch(
            self._again,
            self.columns * self._threads,
            [self._packed, rhs, count, wanted, width, self.blocks[0], self._threads],
            [self._rest, self._found, solution],
            device=self.device,
            block_dim=self._threads,
        )


class Elimination:
    """Block LDL^T of open or closed rods with one thread a rod, for many rods; interface of `CyclicReduction`.

    Args:
        kind: `RodKind` of the rods; columns: number of rods in all worlds.
        iteration: iteration of every column, if factors of the first one are reused; else None.
        once: True if each matrix has one right-hand side, which open rods solve for as they factorise.
    """

    def __init__(
        self, kind, nodes: int, columns: int, linear, device, iteration: wp.array | None = None, once: bool = False
    ):
        self.columns, self.device = columns, device
        once = once and not kind.closed
        self._factors = device_arrays.allocate((rod_elimination.kept_rows(kind, once), nodes, columns), linear, device)
        self._solve = rod_elimination.solve_kernel(kind, linear) if once else None
        self._reuse = iteration is not None
        self._iteration = iteration if self._reuse else wp.zeros(columns, dtype=int, device=device)
        self._factor, self._direct = rod_elimination.elimination_kernels(kind, linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [(kernel, THREADS) for kernel in ([self._solve] if self._solve else [self._factor, self._direct])]

    def solve(self, matrix, rhs, count, wanted, solution: wp.array, lost: wp.array) -> None:
        """Solve the wanted columns; see `CyclicReduction.solve`."""
        if self._solve:
            self._launch(self._solve, [matrix, rhs, count, wanted], [self._factors, solution, lost])
            return
        inputs = [matrix, count, wanted, self._iteration, int(self._reuse)]
        self._launch(self._factor, inputs, [self._factors, lost])
        self._launch(self._direct, [self._factors, rhs, count, wanted], [solution])

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.columns, inputs, outputs, device=self.device, block_dim=THREADS)


class TensionReduction:
    """Block cyclic reduction of a rod group in the mixed axial-force formulation; see `kernels.linear.mixed_pairs`."""

    def __init__(self, group, real, linear, device):
        kind, columns = group.kind, group.columns
        size = kind.block + mixed_pairs.TENSIONS
        self.group, self.device = group, device
        self.levels = CyclicReduction(size, group.nodes, columns, linear, device, mixed_pairs.TENSIONS)
        matrix_rows, right_rows, _ = cyclic_reduction.level_rows(size)
        pairs = self.levels.blocks[0]
        self.matrix, self.rhs = (
            device_arrays.allocate((rows, pairs, columns), linear, device) for rows in (matrix_rows, right_rows)
        )
        self.solution = device_arrays.allocate((size, group.nodes, columns), linear, device)
        self._pair = mixed_pairs.pair_kernel(kind, linear)
        self._unpair = mixed_pairs.unpair_kernel(kind, real, linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._pair, self._unpair, *self.levels.kernels]

    def solve(self, blocks, factor, rhs, x, islands, direction: wp.array) -> None:
        """Solve for directions and edge elongations of wanted rods, from dof blocks and Gauss-Newton factors."""
        group = self.group
        wp.launch(
            self._pair,
            self.rhs.shape,
            [blocks, factor, group.fixed, rhs, group.count, islands.needs_direction],
            [self.matrix, self.rhs],
            device=self.device,
        )
        self.levels.solve(
            self.matrix, self.rhs, group.count, islands.needs_direction, self.solution, islands.lost_pivots
        )
        wp.launch(
            self._unpair,
            self.solution.shape[1:],
            [self.solution, factor, x, group.count, *islands.arrays],
            [direction],
            device=self.device,
        )

"""Contact on one list of pairs: memory and launches of `kernels.contact.pair_terms` and `kernels.contact.gather`."""

import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SolverError
from ddg_warp.kernels.contact import gather, sums
from ddg_warp.kernels.contact.pair_energy import rows_of
from ddg_warp.kernels.contact.pair_terms import energy_kernels, evaluate_kernel, exact_product_kernel, product_kernel
from ddg_warp.kernels.contact.surfaces import EDGES
from ddg_warp.kernels.densities import Density
from ddg_warp.solve.contact.pairs import PairList, RunningSums
from ddg_warp.solve.net.system import Sums

MOST = 2**31 // gather.SLOTS  # pairs whose slots can be counted


class ListTerms:
    """Contact of the pairs of one list; see `PairTerms`.

    Args:
        nodes: of all worlds; worlds: how many.
        linear: type of factors; atomic: whether sums are added atomically.
    """

    def __init__(self, pairs: PairList, law: Density, nodes: int, worlds: int, real, linear, atomic: bool):
        self.pairs, self.device, self._real, self._linear, self._atomic = pairs, pairs.device, real, linear, atomic
        serial, kind, rows = arrays.serial(self.device), pairs.kind, rows_of(pairs.kind)
        self._rows = rows
        self._listing = gather.list_kernels(kind, real, serial)
        self._evaluate = evaluate_kernel(kind, law, real, linear, serial)
        self._product = product_kernel(rows, linear, serial)
        self._exact = exact_product_kernel(kind, law, real, linear, serial)
        self._add = {dtype: gather.sum_kernels(dtype, serial)[int(atomic)] for dtype in (real, linear)}
        self._blocks = gather.block_kernels(rows, real, linear, serial)
        self._energies = energy_kernels(real)
        self._numbers, self._filled = (wp.zeros(nodes, dtype=int, device=self.device) for _ in range(2))
        self._starts = RunningSums(self._numbers)
        self._of_things = wp.zeros((worlds, pairs.first.count), dtype=real, device=self.device)
        self._sum = Sums(worlds, pairs.first.count, real, self.device)
        self._of_worlds = wp.zeros(worlds, dtype=real, device=self.device)
        self.factor = gather.factor_struct(linear)()
        self.kernels = [
            *self._listing,
            *self._add.values(),
            *self._blocks,
            *self._energies,
            *self._sum.kernels,
            self._evaluate,
            self._product,
            self._exact,
            sums.add_pieces,
            sums.run,
        ]
        self.reserve()

    def reserve(self) -> None:
        """Make room for as many pairs as the list has.

        Raises:
            SolverError: if there are more than can be counted.
        """
        capacity, linear = self.pairs.capacity, self._linear
        if capacity > MOST:
            raise SolverError(
                f"contact has room for {MOST} pairs, not {capacity}; use a smaller margin or reach",
                outcome="too_many_pairs",
            )
        vector = wp.types.vector(3, linear)
        self.factor.nodes = wp.zeros(capacity, dtype=wp.vec4i, device=self.device)
        self.factor.used = wp.zeros(capacity, dtype=int, device=self.device)
        self.factor.direction = arrays.allocate((self._rows, capacity), vector, self.device)
        self.factor.weight = arrays.allocate((self._rows, capacity), wp.types.vector(4, linear), self.device)
        self._items = wp.zeros(gather.SLOTS * capacity, dtype=int, device=self.device)
        self._energy = wp.zeros(capacity, dtype=self._real, device=self.device)
        shape = (gather.SLOTS, capacity)
        self._parts = arrays.allocate(shape, vector, self.device)
        self._gradient = self._parts
        if linear is not self._real:
            self._gradient = arrays.allocate(shape, wp.types.vector(3, self._real), self.device)

    def list(self) -> None:
        """List the nodes of pairs, and the pairs of nodes."""
        pairs, (number, fill, sort) = self.pairs, self._listing
        self._numbers.zero_()
        self._filled.zero_()
        self._sweep(number, pairs.capacity, [pairs.pairs, pairs.count, pairs.sides], [self.factor.nodes, self._numbers])
        self._starts()
        inputs = [pairs.count, self.factor.nodes, self._starts.starts]
        self._sweep(fill, pairs.capacity, inputs, [self._filled, self._items])
        self._sweep(sort, len(self._numbers), [self._starts.starts, self._numbers], [self._items])

    def evaluate(self, x: wp.array, law, forces: wp.array, energy: wp.array, overflow: wp.array) -> None:
        """Write factors at x; add to the forces on nodes and to the energies of worlds."""
        pairs, (things, total) = self.pairs, self._energies
        inputs = [pairs.pairs, pairs.count, pairs.sides, law, x]
        self._sweep(self._evaluate, pairs.capacity, inputs, [self.factor, self._energy, self._gradient])
        self._add_up(self._gradient, -1.0, forces)
        inputs = [pairs.count, pairs.starts, pairs.partners, self._energy]
        wp.launch(things, self._of_things.shape, inputs, [self._of_things], device=self.device)
        self._sum(self._of_things, self._of_worlds)
        wp.launch(total, len(energy), [self._of_worlds, overflow], [energy], device=self.device)

    def product(self, v: wp.array, out: wp.array, x: wp.array | None, law) -> None:
        """Add the product of the Gauss-Newton matrix with v, or, with positions x, of the exact Hessian."""
        pairs = self.pairs
        if x is None:
            self._sweep(self._product, pairs.capacity, [pairs.count, self.factor, v], [self._parts])
        else:
            inputs = [pairs.pairs, pairs.count, pairs.sides, law, x, self.factor, v]
            self._sweep(self._exact, pairs.capacity, inputs, [self._parts])
        self._add_up(self._parts, 1.0, out)

    def blocks(self, diagonal: wp.array, between: wp.array) -> None:
        """Add the blocks of nodes, and those between the nodes of edges."""
        lists, (nodes, edges) = [self._starts.starts, self._numbers, self._items], self._blocks
        self._sweep(nodes, len(diagonal), [self.factor, *lists], [diagonal])
        if self.pairs.kind == EDGES:
            self._sweep(edges, len(between), [self.factor, self.pairs.pairs, self.pairs.sides, *lists], [between])

    def _add_up(self, parts: wp.array, scale: float, out: wp.array) -> None:
        kernel = self._add[out.dtype._wp_scalar_type_]
        if self._atomic:
            inputs = [self.pairs.count, parts, self.factor.used, self.factor.nodes, scale]
            self._sweep(kernel, self.pairs.capacity, inputs, [out])
        else:
            inputs = [parts, self.factor.used, self._starts.starts, self._numbers, self._items, scale]
            self._sweep(kernel, len(out), inputs, [out])

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        arrays.sweep(kernel, count, inputs, outputs, self.device)

"""Near-parallel edges: exact Hessians for `PairProduct`; see `kernels.collision.contact.pair_evaluation`."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.contact.assembly import PAIR_NODES
from ddg_warp.kernels.collision.contact.pair_evaluation import columns_kernel, exact_product_kernel, mark_kernel
from ddg_warp.kernels.collision.primitives import EDGES
from ddg_warp.kernels.core.prefix_sum import choose
from ddg_warp.kernels.densities import Density
from ddg_warp.solve.collision.candidate_list import RunningSums

ROOM = 4  # capacity: one in so many pairs; more keep the Gauss-Newton matrix, which only costs iterations
LEAST = 256  # smallest capacity in pairs
MOST = (
    2**15
)  # largest number of threads that differentiate: with one for each column of the capacity, most would do nothing


class NearParallelEdges:
    """Exact Hessians of near-parallel edge pairs among `ContactSet`, stored.

    Attributes:
        keeps: True: `PairProduct` multiplies the Hessians with all others.
        marks, starts, columns: see `kernels.collision.contact.assembly.set_struct`.
    """

    keeps = True

    def __init__(self, elements, law: Density):
        self._of = elements
        self._mark = mark_kernel(elements.linear)
        self._differentiate = columns_kernel(EDGES, law, elements.real, elements.linear)
        self.kernels = [self._mark, choose, self._differentiate]
        self._number = wp.zeros(1, dtype=int, device=elements.device)

    def reserve(self) -> None:
        """Make room for as many pairs as `CollisionSet`."""
        elements, capacity = self._of, self._of.found.capacity
        room = max(LEAST, capacity // ROOM)
        self.marks = wp.zeros(capacity, dtype=int, device=elements.device)
        self._running = RunningSums(self.marks)
        self.starts = self._running.starts
        self._chosen = wp.zeros(room, dtype=int, device=elements.device)
        vector = wp.types.vector(3, elements.linear)
        self.columns = device_arrays.allocate((3 * PAIR_NODES, PAIR_NODES, room), vector, elements.device)

    def differentiate(self, x: wp.array, law, wanted: wp.array) -> None:
        """Find near-parallel pairs at positions x and differentiate, in `wanted` worlds."""
        elements = self._of
        inputs = [elements.pairs, elements.count, elements.found.first.count, wanted, elements.factor]
        tiles = self._running.tiles
        self._sweep(self._mark, len(self.marks), inputs, [self.marks, tiles])
        self._running()
        chosen = [self._chosen, self._number]
        self._sweep(choose, len(self.marks), [elements.count, self.marks, self.starts], [*chosen, tiles])
        threads = device_arrays.takers(min(3 * PAIR_NODES * len(self._chosen), MOST), elements.device)
        inputs = [elements.pairs, elements.found.sides, law, x, elements.factor, *chosen, threads]
        wp.launch(self._differentiate, threads, inputs, [self.columns], device=elements.device)

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        device_arrays.take_turns(kernel, count, inputs, outputs, self._of.device)


class RecomputedHessians:
    """Exact Hessians of near-parallel edge pairs in every world, recomputed in every product."""

    keeps = False

    def __init__(self, elements, law: Density):
        self._of = elements
        self._multiply = exact_product_kernel(elements.found.kind, law, elements.real, elements.linear, unbent=True)
        self.kernels = [self._multiply]

    def reserve(self) -> None:
        """Do nothing: no Hessian is stored."""

    def differentiate(self, x: wp.array, law, wanted: wp.array) -> None:
        """Set the positions x of the Hessians."""
        self._at = x, law

    def multiply(self, v: wp.array) -> None:
        """Write products of the Hessians with v."""
        elements, (x, law) = self._of, self._at
        inputs = [elements.pairs, elements.count, elements.found.sides, law, x, elements.factor, v, elements.ranks]
        device_arrays.take_turns(self._multiply, elements.found.capacity, inputs, [elements.placed], elements.device)

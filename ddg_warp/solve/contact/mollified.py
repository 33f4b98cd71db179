"""Exact Hessians of edges that are all but parallel, for `PairProduct`; see `kernels.contact.pair_terms`."""

import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.contact.gather import SLOTS
from ddg_warp.kernels.contact.pair_terms import columns_kernel, exact_product_kernel, mark_kernel
from ddg_warp.kernels.contact.sums import choose
from ddg_warp.kernels.contact.surfaces import EDGES
from ddg_warp.kernels.densities import Density
from ddg_warp.solve.contact.pairs import RunningSums

ROOM = 4  # one in so many pairs may be such a one; more keep the Gauss-Newton matrix, which takes iterations alone
LEAST = 256  # pairs that there is room for
MOST = 2**15  # threads that differentiate: with a thread for all there is room for, most would have nothing to do


class Mollified:
    """Those among the `ContactElements` of edges with a law, kept.

    Attributes:
        keeps: whether they are, so that `PairProduct` multiplies them beside all others.
        marks, starts, columns: see `kernels.contact.gather.set_struct`.
    """

    keeps = True

    def __init__(self, elements, law: Density):
        self._of = elements
        self._mark = mark_kernel(elements.linear)
        self._differentiate = columns_kernel(EDGES, law, elements.real, elements.linear)
        self.kernels = [self._mark, choose, self._differentiate]
        self._number = wp.zeros(1, dtype=int, device=elements.device)

    def reserve(self) -> None:
        """Make room, as `PairElements` do."""
        of, capacity = self._of, self._of.found.capacity
        room = max(LEAST, capacity // ROOM)
        self.marks = wp.zeros(capacity, dtype=int, device=of.device)
        self._running = RunningSums(self.marks)
        self.starts = self._running.starts
        self._chosen = wp.zeros(room, dtype=int, device=of.device)
        vector = wp.types.vector(3, of.linear)
        self.columns = arrays.allocate((3 * SLOTS, SLOTS, room), vector, of.device)

    def differentiate(self, x: wp.array, law, wanted: wp.array) -> None:
        """Find them at positions x in worlds that want it, and their Hessians."""
        of = self._of
        inputs = [of.pairs, of.count, of.found.first.count, wanted, of.factor]
        self._sweep(self._mark, len(self.marks), inputs, [self.marks])
        self._running()
        chosen = [self._chosen, self._number]
        self._sweep(choose, len(self.marks), [of.count, self.marks, self.starts], chosen)
        threads = arrays.takers(min(3 * SLOTS * len(self._chosen), MOST), of.device)
        inputs = [of.pairs, of.found.sides, law, x, of.factor, *chosen, threads]
        wp.launch(self._differentiate, threads, inputs, [self.columns], device=of.device)

    def _sweep(self, kernel, count: int, inputs: list, outputs: list) -> None:
        arrays.take_turns(kernel, count, inputs, outputs, self._of.device)


class Unkept:
    """The same of all of them, in every world, whose Hessians are not kept but found anew in every product."""

    keeps = False

    def __init__(self, elements, law: Density):
        self._of = elements
        self._multiply = exact_product_kernel(elements.found.kind, law, elements.real, elements.linear, unbent=True)
        self.kernels = [self._multiply]

    def reserve(self) -> None:
        """As of `Mollified`: nothing is kept."""

    def differentiate(self, x: wp.array, law, wanted: wp.array) -> None:
        """From now on those at positions x."""
        self._at = x, law

    def multiply(self, v: wp.array) -> None:
        """Write their products with v."""
        of, (x, law) = self._of, self._at
        inputs = [of.pairs, of.count, of.found.sides, law, x, of.factor, v, of.ranks]
        arrays.take_turns(self._multiply, of.found.capacity, inputs, [of.placed], of.device)

"""Contact on one list of pairs: memory and launches of `kernels.contact.pair_terms`, and which pairs each node is in."""

import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.contact.pair_energy import rows_of
from ddg_warp.kernels.contact.pair_terms import evaluate_kernels, exact_product_kernel
from ddg_warp.kernels.contact.sums import choose_kernel
from ddg_warp.kernels.contact.surfaces import EDGES
from ddg_warp.kernels.densities import Density
from ddg_warp.solve.contact.mollified import Mollified, Unkept
from ddg_warp.solve.contact.pair_elements import PairElements
from ddg_warp.solve.contact.pairs import PairList, RunningSums


class ContactElements(PairElements):
    """Contact of the pairs of one list; see `PairTerms` and, for arguments, `PairElements`.

    Attributes:
        density: the law.
    """

    def __init__(
        self,
        found: PairList,
        law: Density,
        nodes: int,
        real,
        linear,
        silent: wp.array,
        exact: bool,
    ):
        kind = found.kind
        super().__init__(found, rows_of(kind), nodes, real, linear, silent)
        self.density = law
        serial = arrays.serial(self.device)
        self._sieve, self._evaluate = evaluate_kernels(kind, law, real, linear, serial)
        self._choose = choose_kernel(serial)
        self._exact = exact_product_kernel(kind, law, real, linear, serial)
        self.kernels += [self._sieve, self._evaluate, self._exact]
        self.kernels += [] if serial else [self._choose]
        self.mollified = (Unkept if exact else Mollified)(self, law) if kind == EDGES else None
        self.count, self.starts, self.partners = found.count, found.starts, found.partners
        self.reserve()

    def reserve(self) -> None:
        super().reserve()
        self.pairs = self.found.pairs
        self._running = None if arrays.serial(self.device) else RunningSums(self.factor.used)
        if self.mollified:
            self.mollified.reserve()

    def list(self) -> None:
        """Name the nodes of pairs, after a search."""
        inputs = [self.pairs, self.count, self.found.sides]
        self._sweep(self._items.name, self.found.capacity, inputs, [self.factor.nodes])

    def write(self, x: wp.array, law, gap: wp.array) -> None:
        """List the pairs that push each other at x, and write what they do; lower the smallest gaps of worlds to those of pairs."""
        lists, given, room = [self.listed, self.number], [self.found.sides, law, x], self.found.capacity
        self._sweep(self._sieve, room, [self.pairs, self.count, *given, self.factor], [*lists, gap])
        if self._running:
            self._running()
            self._sweep(self._choose, room, [self.count, self.factor.used, self._running.starts], lists)
        self._sweep(self._evaluate, room, [self.pairs, *lists, *given], [self.factor, self.energy, self.gradient])

    def evaluate(self, x: wp.array, law, gap: wp.array) -> None:
        """The same; and list the pairs of nodes."""
        self.write(x, law, gap)
        self._items.list(self.listed, self.number, self.factor.nodes)

    def exact_product(self, v: wp.array, x: wp.array, law) -> None:
        """Place the product of the exact Hessian at x, those of `evaluate`, with v."""
        inputs = [self.pairs, self.listed, self.number, self.found.sides, law, x, self.factor, v, self.ranks]
        self._sweep(self._exact, self.found.capacity, inputs, [self.placed])

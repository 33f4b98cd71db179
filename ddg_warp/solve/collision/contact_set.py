"""Contact potential on the pairs of one list:

memory and launches of `kernels.collision.contact.pair_evaluation`, and incidence lists.
"""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.contact.pair_evaluation import evaluate_kernels, exact_product_kernel
from ddg_warp.kernels.collision.contact.potential import rows_of
from ddg_warp.kernels.collision.primitives import EDGES
from ddg_warp.kernels.densities import Density
from ddg_warp.solve.collision.candidate_list import CandidateList, RunningSums
from ddg_warp.solve.collision.collision_set import CollisionSet
from ddg_warp.solve.collision.parallel_edges import NearParallelEdges, RecomputedHessians


class ContactSet(CollisionSet):
    """Active contact pairs of one list; see `ContactPotential` and, for arguments, `CollisionSet`.

    Attributes:
        density: contact potential.
    """

    def __init__(
        self,
        candidates: CandidateList,
        law: Density,
        nodes: int,
        real,
        linear,
        silent: wp.array,
        exact: bool,
    ):
        kind = candidates.kind
        super().__init__(candidates, rows_of(kind), nodes, real, linear, silent)
        self.density = law
        serial = device_arrays.serial(self.device)
        self._sieve, self._pack, self._evaluate = evaluate_kernels(kind, law, real, linear, serial)
        self._exact = exact_product_kernel(kind, law, real, linear)
        self.kernels += [self._sieve, self._evaluate]
        self.kernels += [] if serial else [self._pack]
        self.mollified = (RecomputedHessians if exact else NearParallelEdges)(self, law) if kind == EDGES else None
        self.reserve()

    def reserve(self) -> None:
        super().reserve()
        serial = device_arrays.serial(self.device)
        self._marks = wp.zeros(0 if serial else self.found.capacity, dtype=int, device=self.device)
        self._running = None if serial else RunningSums(self._marks)
        self._tiles = self._running.tiles if self._running else self._marks
        if self.mollified:
            self.mollified.reserve()

    def write(self, x: wp.array, law, gap: wp.array) -> None:
        """Find the active pairs at x, write energies, forces and factors; lower the smallest gaps to the candidates'."""
        self._find(x, law, gap)
        inputs = [self.pairs, self.count, self.found.sides, law, x]
        outputs = [self.factor, self.energy, self.gradient]
        self._take_turns(self._evaluate, self.found.capacity, inputs, outputs)

    def evaluate(self, x: wp.array, law, gap: wp.array) -> None:
        """Find and evaluate the active pairs as `write`, and build the incidence lists."""
        self.write(x, law, gap)
        self._items.list(self.count, self.factor)

    def _find(self, x: wp.array, law, gap: wp.array) -> None:
        candidates, data = self.found, [self.found.sides, law, x]
        lists = [self.pairs, self.factor.nodes, self.starts, self.partners, self.count]
        if not self._running:
            self.partners.zero_()
        inputs = [candidates.pairs, candidates.count, *data]
        self._take_turns(self._sieve, candidates.capacity, inputs, [self._marks, self._tiles, gap, *lists])
        if self._running:
            self._running()
            inputs = [candidates.pairs, candidates.count, candidates.starts, candidates.partners, candidates.sides]
            room = max(candidates.capacity, len(candidates.starts))
            self._take_turns(self._pack, room, [*inputs, self._marks, self._running.starts, self._tiles], lists)

    def exact_product(self, v: wp.array, x: wp.array, law) -> None:
        """Write the product of the exact Hessian at x, the position of `evaluate`, with v to `placed`."""
        inputs = [self.pairs, self.count, self.found.sides, law, x, self.factor, v, self.ranks]
        self._take_turns(self._exact, self.found.capacity, inputs, [self.placed])

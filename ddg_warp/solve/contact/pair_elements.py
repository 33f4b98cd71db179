"""Elements on pairs: memory of their factors, and what nodes and worlds get of them; see `kernels.contact.gather`."""

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.errors import SolverError
from ddg_warp.kernels.contact import gather
from ddg_warp.solve.contact.node_items import NodeItems
from ddg_warp.solve.contact.pairs import PairList

MOST = 2**31 // gather.ITEMS  # pairs whose items can be counted


class PairElements:
    """Elements on pairs, a factor of `rows` rows each. A subclass says which pairs those are, and writes what they are.

    Args:
        found: list of a search, whose kind of pairs and capacity these have.
        nodes: of all worlds; silent: those of a world that are told of nothing.
        linear: type of factors; rolls: whether they turn rods.

    Attributes:
        factor: see `gather.factor_struct`; energy: of each pair (capacity,) [J]; gradient: by slot (SLOTS or ITEMS, capacity) [N, N m].
        placed, idle: see `gather.set_struct`.
        pairs, count, starts, partners: as those of a `PairList`.
        mollified: those whose matrices take more than a factor and what turns (`Mollified`); None without.
        numbers, places, items, ranks, angle_ranks: as of `NodeItems`, which the subclass has list the pairs.
    """

    mollified = None

    def __init__(self, found: PairList, rows: int, nodes: int, real, linear, silent: wp.array, rolls: bool = False):
        self.found, self.device, self.rows, self.real, self.linear = found, found.device, rows, real, linear
        self.rolls, self._items = rolls, NodeItems(found.kind, nodes, silent, rolls)
        self.numbers, self.places = self._items.numbers, self._items.places
        self.factor = gather.factor_struct(linear)()
        self.count = wp.zeros(1, dtype=int, device=self.device)
        self.starts, self.partners = (wp.zeros(found.first.all, dtype=int, device=self.device) for _ in range(2))
        self.kernels = [*self._items.kernels]

    def reserve(self) -> None:
        """Make room for as many pairs as the list of the search has.

        Raises:
            SolverError: if there are more than can be counted.
        """
        capacity, linear = self.found.capacity, self.linear
        if capacity > MOST:
            raise SolverError(
                f"contact has room for {MOST} pairs, not {capacity}; use a smaller margin or reach",
                outcome="too_many_pairs",
            )
        self.pairs = wp.zeros(capacity, dtype=wp.vec2i, device=self.device)
        self.factor.nodes = wp.zeros(capacity, dtype=wp.vec4i, device=self.device)
        self.factor.used = wp.zeros(capacity, dtype=int, device=self.device)
        self.factor.bend = wp.zeros(capacity, dtype=linear, device=self.device)
        self.factor.row = arrays.allocate((self.rows, capacity), wp.types.vector(gather.ROW, linear), self.device)
        self.energy = wp.zeros(capacity, dtype=self.real, device=self.device)
        slots, turned = (gather.ITEMS, capacity) if self.rolls else (gather.SLOTS, 0)
        self.gradient = arrays.allocate((slots, capacity), wp.types.vector(3, self.real), self.device)
        self.factor.angles = wp.zeros(turned, dtype=wp.vec2i, device=self.device)
        self.factor.lever = arrays.allocate((self.rows, turned), wp.types.vector(gather.ANGLES, linear), self.device)
        self._items.reserve(capacity)
        self.items, self.ranks, self.angle_ranks = self._items.items, self._items.ranks, self._items.angle_ranks
        self.idle = wp.zeros(capacity, dtype=wp.uint8, device=self.device)
        self.placed = wp.zeros(len(self.items), dtype=wp.types.vector(gather.PLACED, linear), device=self.device)

    def forces(self) -> tuple[np.ndarray, np.ndarray]:
        """Pairs that bring anything (n,), and forces on their first things (n, 3) [N]. Reads from the device."""
        used = np.flatnonzero(self.factor.used.numpy()[: int(self.count.numpy()[0])])
        return used, -self.gradient.numpy()[: self.found.kind.first, used].sum(0)

    def _take_turns(self, kernel, count: int, inputs: list, outputs: list) -> None:
        arrays.take_turns(kernel, count, inputs, outputs, self.device)

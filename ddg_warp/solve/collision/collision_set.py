"""Elements on collision pairs: memory of factors, and assembly to nodes and worlds; see `kernels.collision.contact.assembly`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SolverError
from ddg_warp.kernels.collision.contact import assembly
from ddg_warp.solve.collision.candidate_list import CandidateList
from ddg_warp.solve.collision.incidence import Incidence

MOST = 2**31 // assembly.ITEMS  # largest number of pairs with countable items


class CollisionSet:
    """Elements on collision pairs, with a factor of `rows` rows each. A subclass selects and evaluates the pairs.

    Args:
        candidates: list of a search, with the kind and capacity of the pairs.
        nodes: nodes of all worlds; silent: nodes of a world that receive nothing.
        linear: type of factors; rolls, rotates: True if pairs rotate rods, or rigid bodies.

    Attributes:
        `factor`: see `assembly.factor_struct`.
        `energy`, `gradient`: of each pair (capacity,) [J]; by local index (`PAIR_NODES` or `ITEMS`, capacity) [N, N m].
        `placed`, `idle`: see `assembly.set_struct`.
        `pairs`, `count`, `starts`, `partners`: as of `CandidateList`.
        `mollified`: near-parallel edges (`NearParallelEdges`) with exact Hessians; None without.
        `numbers`, `places`, `items`, `ranks`, `angle_ranks`, `rotation_ranks`: as of `Incidence`, whose lists the subclass builds.
    """

    mollified = None

    def __init__(
        self,
        candidates: CandidateList,
        rows: int,
        nodes: int,
        real,
        linear,
        silent: wp.array,
        rolls: bool = False,
        rotates: bool = False,
    ):
        self.found, self.device, self.rows, self.real, self.linear = candidates, candidates.device, rows, real, linear
        self.rolls, self.rotates = rolls, rotates
        self._items = Incidence(candidates.kind, nodes, silent, rolls, rotates)
        self.numbers, self.places = self._items.numbers, self._items.places
        self.factor = assembly.factor_struct(linear)()
        self.count = wp.zeros(1, dtype=int, device=self.device)
        self.starts, self.partners = (wp.zeros(candidates.first.all, dtype=int, device=self.device) for _ in range(2))
        self.kernels = [*self._items.kernels]

    def reserve(self) -> None:
        """Make room for as many pairs as the list of the search.

        Raises:
            SolverError: there are more pairs than can be counted.
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
        self.factor.row = device_arrays.allocate(
            (self.rows, capacity), wp.types.vector(assembly.ROW, linear), self.device
        )
        self.energy = wp.zeros(capacity, dtype=self.real, device=self.device)
        items = assembly.ITEMS if self.rolls or self.rotates else assembly.PAIR_NODES
        angle_capacity, rotation_capacity = capacity * self.rolls, capacity * self.rotates
        self.gradient = device_arrays.allocate((items, capacity), wp.types.vector(3, self.real), self.device)
        self.factor.angles = wp.zeros(angle_capacity, dtype=wp.vec2i, device=self.device)
        self.factor.lever = device_arrays.allocate(
            (self.rows, angle_capacity), wp.types.vector(assembly.ANGLES, linear), self.device
        )
        self.factor.rotations = wp.zeros(rotation_capacity, dtype=wp.vec2i, device=self.device)
        radii = wp.types.vector(assembly.BODIES, linear)
        self.factor.radii = wp.zeros(rotation_capacity, dtype=radii, device=self.device)
        spins = (self.rows, rotation_capacity)
        self.factor.spin = device_arrays.allocate(spins, wp.types.vector(3, linear), self.device)
        self._items.reserve(capacity)
        for name in ("items", "ranks", "angle_ranks", "rotation_ranks"):
            setattr(self, name, getattr(self._items, name))
        self.idle = wp.zeros(capacity, dtype=wp.uint8, device=self.device)
        self.placed = wp.zeros(len(self.items), dtype=wp.types.vector(assembly.PLACED, linear), device=self.device)

    def forces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the active pairs (n,), and forces on first primitives (n, 3) [N]. Reads from the device."""
        used = np.flatnonzero(self.factor.used.numpy()[: int(self.count.numpy()[0])])
        return used, -self.gradient.numpy()[: self.found.kind.first, used].sum(0)

    def _take_turns(self, kernel, count: int, inputs: list, outputs: list) -> None:
        device_arrays.take_turns(kernel, count, inputs, outputs, self.device)

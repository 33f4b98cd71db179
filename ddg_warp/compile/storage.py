"""Storages, a group of rods on their own or a net, as what a scene puts on them sees them: places with three components each.

Places are numbered nodes first, then angles. The components of a node are those of its position; an angle is component 0 of its own.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ddg_warp.compile.loads import DeadLoad, accumulate

FREE = -1  # instead of a pose, of a dof that no motion moves


@dataclass(frozen=True)
class Along:
    """Places along rods: number k of row r is `start[r] + step * k`, or what `table` has there."""

    start: np.ndarray
    step: int = 1
    table: np.ndarray | None = None

    def __call__(self, rows: np.ndarray, k) -> np.ndarray:
        at = self.start[rows] + self.step * k
        return at if self.table is None else self.table[at]


@dataclass(frozen=True)
class RodPlaces:
    """Where the rods of a storage are, one a row.

    Attributes:
        rods: scene's indices (R,).
        own: nodes without ghosts (R,); closed, twist: (R,) bool; length: at rest (R,) [m].
        nodes, angles: places of nodes and of the angles of edges, counted from the first own one; ghosts are -1 and `own`.
    """

    rods: np.ndarray
    own: np.ndarray
    closed: np.ndarray
    twist: np.ndarray
    length: np.ndarray
    nodes: Along
    angles: Along

    @cached_property
    def _row(self) -> np.ndarray:
        """Of every rod of the scene up to the last one here, and of one beyond; -1 of those that are elsewhere."""
        row = np.full(self.rods.max(initial=-1) + 2, -1)
        row[self.rods] = np.arange(len(self.rods))
        return row

    def among(self, rods: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which of some rods are here, and their rows."""
        rows = self._row[np.minimum(rods, len(self._row) - 1)]
        found = np.flatnonzero(rows >= 0)
        return found, rows[found]

    def node(self, rows: np.ndarray, k: int) -> np.ndarray:
        """Places of node k, from the last if negative."""
        return self.nodes(rows, k % self.own[rows])

    def edge(self, rows: np.ndarray, k: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Places of both nodes of edge k and of its angle (n, 3) of the rods with twist; of both nodes (n, 2) of those without.

        Each with the lengths of the rods (n,).
        """
        found = []
        for twist in (True, False):
            some = rows[self.twist[rows] == twist]
            first = k % (self.own[some] - np.where(self.closed[some], 0, 1))
            ends = [self.nodes(some, first), self.nodes(some, (first + 1) % self.own[some])]
            places = np.column_stack([*ends, self.angles(some, first)] if twist else ends)
            found.append((places, self.length[some]))
        return found


@dataclass(frozen=True)
class Held:
    """Dofs that a support holds: (place, component) pairs; or the nodes on an oblique plane with this normal."""

    places: np.ndarray
    components: np.ndarray
    normal: tuple | None = None


@dataclass(kw_only=True, eq=False)
class Storage:
    """What a scene puts on a group of rods or on a net.

    Attributes:
        held: what each support holds here: of the rods, then of the shells and rings of a net.
        moving: nodes that supports move, and the pose of each component, `FREE` of those that none does (n, 4).
        turning: angles that supports turn, and their pose (n, 2).
        dead: loads that follow nothing; followers: those that do, see `compile.loads`.
        size: number of places; nodes: of nodes among them; places: where its rods are; axes: components that nodes have.
    """

    held: list[Held] = field(default_factory=list)
    moving: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), int))
    turning: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), int))

    dead: list[DeadLoad] = field(default_factory=list)
    followers: list = field(default_factory=list)

    axes = (0, 1, 2)

    def add_load(self, places: np.ndarray, force, amplitude=None) -> None:
        """Add a dead load of (3,) or (n, 3) on places."""
        if len(places):
            self.dead.append(DeadLoad(places, np.broadcast_to(np.asarray(force, float), (len(places), 3)), amplitude))

    @cached_property
    def constant(self) -> DeadLoad:
        """All loads that neither change nor follow, as one."""
        loads = [load for load in self.dead if load.amplitude is None]
        places = np.concatenate([np.zeros(0, int), *(load.places for load in loads)])
        return DeadLoad(places, np.concatenate([np.zeros((0, 3)), *(load.force for load in loads)]))

    @property
    def loaded(self) -> bool:
        """Whether there is any load."""
        return bool(self.dead or self.followers)

    def constant_loads(self) -> np.ndarray:
        """Constant forces on all places (size, 3) [N], moments [N m] in component 0 of angles."""
        result = np.zeros((self.size, 3))
        accumulate(result, self.constant.places, self.constant.force)
        return result

    @property
    def timed(self) -> list[DeadLoad]:
        """Loads that change and follow nothing."""
        return [load for load in self.dead if load.amplitude is not None]

    @property
    def moves(self) -> bool:
        """Whether supports move something."""
        return bool(len(self.moving) or len(self.turning))

    def index(self, places: np.ndarray) -> np.ndarray:
        """Where places are in the array that has them, which of chains is another one for angles."""
        return places

    def fix(self, nodes: np.ndarray, along: list[int], angles: np.ndarray) -> None:
        """Hold nodes along some components, and angles."""
        raise NotImplementedError

    def add_mass(self, places: np.ndarray, mass: float) -> None:
        """Add a mass [kg] to each of some nodes."""
        raise NotImplementedError

    def points(self, nodes: np.ndarray) -> np.ndarray:
        """Positions of nodes at rest (n, 3) [m]."""
        raise NotImplementedError

    def name(self, place: int) -> str:
        """A place, as a message has it."""
        raise NotImplementedError

    def edge_ends(self, angles: np.ndarray) -> np.ndarray:
        """Nodes of the rod edges whose angles these are (n, 2)."""
        raise NotImplementedError

    def holding(self, nodes: np.ndarray) -> np.ndarray:
        """Which components of nodes (..., 3) are held, or not there."""
        raise NotImplementedError

    def dofs(self, places: np.ndarray) -> np.ndarray:
        """Dofs of the components of places (..., 3) as a `Tangent` counts them in one world; -1 where there is none."""
        raise NotImplementedError


def gathered(values: np.ndarray, dofs: np.ndarray) -> np.ndarray:
    """Values of dofs, zero where there is none (-1)."""
    return np.where(dofs < 0, 0.0, values[dofs])

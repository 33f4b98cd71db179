"""Common interface of rod groups and the coupled system, for boundary conditions, masses and loads.

A storage has dof blocks of three components, numbered nodes first, then twist angles. The components of a node are its position; a
twist angle is component 0 of its block.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ddg_warp.compile.loads import DeadLoad, accumulate

FREE = -1  # pose index of a dof without prescribed motion


@dataclass(frozen=True)
class RodIndexMap:
    """Index map along rods: entry k of row r is `start[r] + step * k`, looked up in `table` if given."""

    start: np.ndarray
    step: int = 1
    table: np.ndarray | None = None

    def __call__(self, rows: np.ndarray, k) -> np.ndarray:
        index = self.start[rows] + self.step * k
        return index if self.table is None else self.table[index]


@dataclass(frozen=True)
class RodDofMap:
    """Dof map of the rods of a storage, one a row.

    Attributes:
        rods: indices in the scene (R,).
        own: number of nodes without ghosts (R,).
        closed, twist: flags (R,) bool.
        length: rest length (R,) [m].
        nodes, angles: indices of nodes and of twist angles, counted from the first that is no ghost; ghosts are -1 and `own`.
    """

    rods: np.ndarray
    own: np.ndarray
    closed: np.ndarray
    twist: np.ndarray
    length: np.ndarray
    nodes: RodIndexMap
    angles: RodIndexMap

    @cached_property
    def _row(self) -> np.ndarray:
        """Row of each rod of the scene, -1 for rods of other storages; up to one beyond the last row."""
        row = np.full(self.rods.max(initial=-1) + 2, -1)
        row[self.rods] = np.arange(len(self.rods))
        return row

    def among(self, rods: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (positions among `rods`, rows) of the rods in this storage."""
        rows = self._row[np.minimum(rods, len(self._row) - 1)]
        positions = np.flatnonzero(rows >= 0)
        return positions, rows[positions]

    def node(self, rows: np.ndarray, k: int) -> np.ndarray:
        """Return the indices of node k, counted from the last if negative."""
        return self.nodes(rows, k % self.own[rows])

    def edge(self, rows: np.ndarray, k: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the indices of edge k and the rod lengths (n,), for rods with twist and for rods without.

        Indices are of both nodes and the twist angle (n, 3) with twist, of both nodes (n, 2) without.
        """
        result = []
        for twist in (True, False):
            some = rows[self.twist[rows] == twist]
            first = k % (self.own[some] - np.where(self.closed[some], 0, 1))
            ends = [self.nodes(some, first), self.nodes(some, (first + 1) % self.own[some])]
            places = np.column_stack([*ends, self.angles(some, first)] if twist else ends)
            result.append((places, self.length[some]))
        return result


@dataclass(frozen=True)
class Held:
    """Dofs fixed by a support: (index, component) pairs, or the nodes of a skew support with this normal."""

    places: np.ndarray
    components: np.ndarray
    normal: tuple | None = None


@dataclass(kw_only=True, eq=False)
class DofStorage:
    """Boundary conditions and loads of a rod group or of the coupled system.

    Attributes:
        held: dofs fixed by each support: of the rods, then of the shells and rings of the coupled system.
        moving: nodes with prescribed motion and the pose of each component, `FREE` without (n, 4).
        turning: twist angles with prescribed motion and their pose (n, 2).
        dead: dead loads; followers: follower loads, see `compile.loads`.
        size: number of dof blocks; nodes: number of nodes.
        places: dof map of the rods; axes: components of nodes.
    """

    held: list[Held] = field(default_factory=list)
    moving: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), int))
    turning: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), int))

    dead: list[DeadLoad] = field(default_factory=list)
    followers: list = field(default_factory=list)

    axes = (0, 1, 2)

    def add_load(self, places: np.ndarray, force, amplitude=None) -> None:
        """Add a dead load of (3,) or (n, 3) at indices `places` (n,)."""
        if len(places):
            self.dead.append(DeadLoad(places, np.broadcast_to(np.asarray(force, float), (len(places), 3)), amplitude))

    @cached_property
    def constant(self) -> DeadLoad:
        """All constant dead loads as one."""
        loads = [load for load in self.dead if load.amplitude is None]
        places = np.concatenate([np.zeros(0, int), *(load.places for load in loads)])
        return DeadLoad(places, np.concatenate([np.zeros((0, 3)), *(load.force for load in loads)]))

    @property
    def loaded(self) -> bool:
        """True if there is any load."""
        return bool(self.dead or self.followers)

    def constant_loads(self) -> np.ndarray:
        """Return the constant dead loads of all dof blocks (size, 3) [N], moments [N m] in component 0 of angles."""
        result = np.zeros((self.size, 3))
        accumulate(result, self.constant.places, self.constant.force)
        return result

    @property
    def timed(self) -> list[DeadLoad]:
        """Dead loads with an amplitude."""
        return [load for load in self.dead if load.amplitude is not None]

    @property
    def moves(self) -> bool:
        """True if a support has a prescribed motion."""
        return bool(len(self.moving) or len(self.turning))

    def index(self, places: np.ndarray) -> np.ndarray:
        """Return array positions of indices; rod groups store nodes and angles in separate arrays."""
        return places

    def fix(self, nodes: np.ndarray, along: list[int], angles: np.ndarray) -> None:
        """Fix nodes along some components, and angles."""
        raise NotImplementedError

    def add_mass(self, places: np.ndarray, mass: float) -> None:
        """Add a mass [kg] to each of some nodes."""
        raise NotImplementedError

    def points(self, nodes: np.ndarray) -> np.ndarray:
        """Return the rest positions of nodes (n, 3) [m]."""
        raise NotImplementedError

    def name(self, place: int) -> str:
        """Return the name of a dof block for messages."""
        raise NotImplementedError

    def edge_ends(self, angles: np.ndarray) -> np.ndarray:
        """Return both nodes of each rod edge, by twist angle (n, 2)."""
        raise NotImplementedError

    def holding(self, nodes: np.ndarray) -> np.ndarray:
        """Return the mask of fixed or absent components of nodes (..., 3) bool."""
        raise NotImplementedError

    def dofs(self, places: np.ndarray) -> np.ndarray:
        """Return the dofs of dof blocks (..., 3) as numbered by `Tangent` in one world; -1 for absent components."""
        raise NotImplementedError


def gathered(values: np.ndarray, dofs: np.ndarray) -> np.ndarray:
    """Return the values of dofs, zero for absent ones (-1)."""
    return np.where(dofs < 0, 0.0, values[dofs])

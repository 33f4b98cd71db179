"""What the parts of a tangent have in common, groups of rods and the net: outer forces on their dofs, and the derivatives of these."""

from functools import cached_property

import numpy as np
from scipy import sparse

from ddg_warp.compile.storage import gathered
from ddg_warp.solve.controls import loaded_rows


class Part:
    """A part of a model's tangent; dofs are numbered world by world. See `Tangent` for the methods.

    Attributes:
        host: its `Storage`.
        offset, size: of its dofs among all.
        islands: number of islands, whose dofs follow one another and are as many in each; body_count: of bodies.
        block: dofs of a node, positions first.
        given: outer forces of controls on the dofs of every world, in space, at full load (worlds, n) [N, N m].

    Args:
        part: `Group` or `DeviceNet`.
    """

    def __init__(self, model, part, offset: int, size: int):
        self.model, self.part, self.host, self.offset, self.size = model, part, part.host, offset, size
        self.worlds = model.worlds
        self.given = np.zeros((self.worlds, size // self.worlds))

    @property
    def mass(self) -> np.ndarray:
        """Of every dof (size,) [kg, kg m^2]."""
        return self.part.dof_masses() if self.part.weighed else self._usual_mass

    @cached_property
    def _usual_mass(self) -> np.ndarray:
        return self.part.dof_masses()

    @property
    def parts(self) -> list:
        """Itself alone, so that a part at offset 0 serves where a `Tangent` does."""
        return [self]

    @property
    def axis(self) -> np.ndarray:
        """Axis of every dof that is a displacement (size,), 0 to 2; any of others."""
        return np.minimum(np.arange(self.size) % self.block, 2)

    @property
    def balances(self) -> np.ndarray:
        """Which dofs have forces that add up to nothing over a free piece in equilibrium (size,) bool."""
        return ~self.angle

    @property
    def component(self) -> np.ndarray:
        """Index of the connected component of every dof (size,), from 0."""
        return np.repeat(np.arange(self.islands), self.size // self.islands)

    def accelerations(self, gravity: np.ndarray) -> np.ndarray:
        """Those that gravity (3,) means on the dofs of a node, or of every block (1 or N, dofs of one) [m/s^2]."""
        raise NotImplementedError

    def into(self, values: np.ndarray) -> np.ndarray:
        """Vectors in space (size,) as the dofs are."""
        return values

    def back(self, values: np.ndarray) -> np.ndarray:
        """Dofs, forces or steps (size,) as vectors in space."""
        return values

    def matrix(self, values: sparse.csc_matrix) -> sparse.csc_matrix:
        """A matrix of dofs in space as one of dofs as they are."""
        return values

    def weight(self, gravity: np.ndarray | None = None) -> np.ndarray:
        """Gravity (3,) or (worlds, 3), by default the scene's, on the dofs of every world, in space (worlds, n) [N]."""
        gravity = np.asarray(self.model.scene.gravity if gravity is None else gravity, float)
        given = np.broadcast_to(gravity, (self.worlds, 3))
        masses = self.mass.reshape(self.worlds, -1)
        own = (self.accelerations(g) for g in given)
        return np.array([(m.reshape(-1, a.shape[1]) * a).ravel() for m, a in zip(masses, own, strict=True)])

    def give(self, found: dict[str, np.ndarray]) -> None:
        """Take the loads among what `Controls.checked` found; none without."""
        self.given[:] = 0.0
        if "gravity" in found:
            self.given[:] = self.weight(found["gravity"] - self.model.scene.gravity)
        places, rows = loaded_rows(self.model, self.part)
        for name, own in (("forces", places < self.host.nodes), ("moments", places >= self.host.nodes)):
            if name in found:
                dofs, values = self.host.dofs(places[own]), found[name][:, rows[own]]
                values = values if name == "forces" else values[..., None] * [1.0, 0.0, 0.0]
                for force, each in zip(self.given, np.broadcast_to(values, (self.worlds, *dofs.shape)), strict=True):
                    _add(force, dofs, each)

    def dead_loads(self, factor: float) -> np.ndarray:
        """Outer forces on the dofs of every world, in space, that do not follow it (worlds, n)."""
        result = np.zeros(self.size // self.worlds)
        for load in (self.host.constant, *self.host.timed):
            _add(result, self.host.dofs(load.places), load.at(factor, factor) * load.force)
        return result + factor * (self.weight() + self.given)

    def loads(self, factor: float, q: np.ndarray) -> np.ndarray:
        result = self.dead_loads(factor)
        for load in self.host.followers:
            dofs, scale = self.host.dofs(load.places), load.at(factor, factor)
            for force, x in zip(result, self.back(q).reshape(self.worlds, -1), strict=True):
                _add(force, dofs, scale * load.forces(gathered(x, dofs)))
        return self.into(result.ravel())

    def load_stiffness(self, factor: float, q: np.ndarray) -> sparse.csc_matrix | None:
        if not self.host.followers:
            return None
        rows, columns, values = [], [], []
        for load in self.host.followers:
            dofs, scale = self.host.dofs(load.places), load.at(factor, factor)
            row, column = np.broadcast_arrays(dofs[:, :, :, None, None], dofs[:, None, None])
            known = (row >= 0) & (column >= 0)
            for world, x in enumerate(self.back(q).reshape(self.worlds, -1)):
                rows.append(row[known] + world * len(x))
                columns.append(column[known] + world * len(x))
                values.append(-scale * load.derivative(gathered(x, dofs))[known])
        data, *places = (np.concatenate(parts) for parts in (values, rows, columns))
        return self.matrix(sparse.csc_matrix((data, places), shape=(self.size, self.size)))


def _add(total: np.ndarray, dofs: np.ndarray, values: np.ndarray) -> None:
    """Add values to those of dofs; a dof may come several times, -1 is none."""
    known = dofs >= 0
    np.add.at(total, dofs[known], values[known])

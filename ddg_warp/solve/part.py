"""What the parts of a tangent have in common, groups of rods and the net: outer forces on their dofs, and the derivatives of these."""

import numpy as np
from scipy import sparse

from ddg_warp.compile.storage import gathered


class Part:
    """A part of a model's tangent; dofs are numbered world by world. See `Tangent` for the methods.

    Attributes:
        host: its `Storage`.
        offset, size: of its dofs among all.
        mass: of every dof (size,) [kg, kg m^2].
        gravity: on the dofs of a node, or of every block (1 or N, dofs of one) [m/s^2].
    """

    def __init__(self, model, host, offset: int, size: int, mass: np.ndarray, gravity: np.ndarray):
        self.model, self.host, self.offset, self.size = model, host, offset, size
        self.mass, self.gravity = mass, gravity
        self.worlds = model.worlds

    def into(self, values: np.ndarray) -> np.ndarray:
        """Vectors in space (size,) as the dofs are."""
        return values

    def back(self, values: np.ndarray) -> np.ndarray:
        """Dofs, forces or steps (size,) as vectors in space."""
        return values

    def matrix(self, values: sparse.csc_matrix) -> sparse.csc_matrix:
        """A matrix of dofs in space as one of dofs as they are."""
        return values

    def weight(self) -> np.ndarray:
        """Gravity on the dofs of a world, in space [N]."""
        own = self.mass[: self.size // self.worlds].reshape(-1, self.gravity.shape[1])
        return (own * self.gravity).ravel()

    def dead_loads(self, factor: float) -> np.ndarray:
        """Outer forces on the dofs of a world, in space, that do not follow it."""
        result = factor * self.weight()
        for load in (self.host.constant, *self.host.timed):
            _add(result, self.host.dofs(load.places), load.at(factor, factor) * load.force)
        return result

    def loads(self, factor: float, q: np.ndarray) -> np.ndarray:
        result = np.tile(self.dead_loads(factor), (self.worlds, 1))
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

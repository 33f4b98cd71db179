"""Base class of tangent blocks: external forces and load stiffness of rod groups and the coupled system."""

from functools import cached_property

import numpy as np
from scipy import sparse

from ddg_warp.compile.dof_map import gathered
from ddg_warp.solve.forces.control_loads import loaded_rows


class TangentBlock:
    """Tangent block of a model, with dofs numbered world by world. See `Tangent` for the methods.

    Attributes:
        host: `DofStorage` of the block.
        offset, size: range of dofs among all.
        islands: number of islands, with contiguous dofs of equal number; body_count: number of bodies.
        block: dofs of a node, positions first.
        given: control loads on the dofs of every world, in space, at full load (worlds, n) [N, N m].

    Args:
        part: `RodGroup` or `CoupledModel`.
    """

    def __init__(self, model, part, offset: int, size: int):
        self.model, self.part, self.host, self.offset, self.size = model, part, part.host, offset, size
        self.worlds = model.worlds
        self.given = np.zeros((self.worlds, size // self.worlds))

    @property
    def mass(self) -> np.ndarray:
        """Mass and rotary inertia of every dof (size,) [kg, kg m^2]."""
        return self.part.dof_masses() if self.part.has_custom_mass else self._usual_mass

    @cached_property
    def _usual_mass(self) -> np.ndarray:
        return self.part.dof_masses()

    @property
    def parts(self) -> list:
        """List of this block alone, so that a block at offset 0 acts as a `Tangent`."""
        return [self]

    @property
    def axis(self) -> np.ndarray:
        """Axis of every displacement dof (size,), 0 to 2; arbitrary for others."""
        return np.minimum(np.arange(self.size) % self.block, 2)

    @property
    def balances(self) -> np.ndarray:
        """Mask of dofs with forces that sum to zero over a free component in equilibrium (size,) bool."""
        return ~self.angle

    @property
    def component(self) -> np.ndarray:
        """Index of the connected component of every dof (size,), from 0."""
        return np.repeat(np.arange(self.islands), self.size // self.islands)

    def accelerations(self, gravity: np.ndarray) -> np.ndarray:
        """Return accelerations by gravity (3,) on the dofs of a node, or of every dof block (1 or N, dofs of one) [m/s^2]."""
        raise NotImplementedError

    def into(self, values: np.ndarray) -> np.ndarray:
        """Return vectors in space (size,) as dofs."""
        return values

    def back(self, values: np.ndarray) -> np.ndarray:
        """Return dofs, forces or steps (size,) as vectors in space."""
        return values

    def matrix(self, values: sparse.csc_matrix) -> sparse.csc_matrix:
        """Return a matrix of spatial dofs as a matrix of dofs."""
        return values

    def weight(self, gravity: np.ndarray | None = None) -> np.ndarray:
        """Return weights by gravity (3,) or (worlds, 3), by default of the scene, on spatial dofs (worlds, n) [N]."""
        gravity = np.asarray(self.model.scene.gravity if gravity is None else gravity, float)
        gravities = np.broadcast_to(gravity, (self.worlds, 3))
        masses = self.mass.reshape(self.worlds, -1)
        accelerations = (self.accelerations(g) for g in gravities)
        return np.array([(m.reshape(-1, a.shape[1]) * a).ravel() for m, a in zip(masses, accelerations, strict=True)])

    def give(self, inputs: dict[str, np.ndarray]) -> None:
        """Set the control loads of `Controls.checked`, none by default."""
        self.given[:] = 0.0
        if "gravity" in inputs:
            self.given[:] = self.weight(inputs["gravity"] - self.model.scene.gravity)
        places, rows = loaded_rows(self.model, self.part)
        for name, selected in (("forces", places < self.host.nodes), ("moments", places >= self.host.nodes)):
            if name in inputs:
                dofs, values = self.host.dofs(places[selected]), inputs[name][:, rows[selected]]
                values = values if name == "forces" else values[..., None] * [1.0, 0.0, 0.0]
                for force, each in zip(self.given, np.broadcast_to(values, (self.worlds, *dofs.shape)), strict=True):
                    _add(force, dofs, each)

    def dead_loads(self, factor: float) -> np.ndarray:
        """Return dead loads on the spatial dofs of every world (worlds, n)."""
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

    def work(self, factor: float, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the work of mean external forces on every dof between two dof vectors (size,) [J]."""
        return 0.5 * (self.loads(factor, before) + self.loads(factor, after)) * (after - before)

    def spread(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return a step (size,) with displacements of dependent dofs, which only `CoupledTangent` has."""
        return step

    def load_stiffness(self, factor: float, q: np.ndarray) -> sparse.csc_matrix | None:
        if not self.host.followers:
            return None
        rows, columns, values = [], [], []
        for load in self.host.followers:
            dofs, scale = self.host.dofs(load.places), load.at(factor, factor)
            row, column = np.broadcast_arrays(dofs[:, :, :, None, None], dofs[:, None, None])
            present = (row >= 0) & (column >= 0)
            for world, x in enumerate(self.back(q).reshape(self.worlds, -1)):
                rows.append(row[present] + world * len(x))
                columns.append(column[present] + world * len(x))
                values.append(-scale * load.derivative(gathered(x, dofs))[present])
        data, *places = (np.concatenate(parts) for parts in (values, rows, columns))
        return self.matrix(sparse.csc_matrix((data, places), shape=(self.size, self.size)))


def _add(total: np.ndarray, dofs: np.ndarray, values: np.ndarray) -> None:
    """Add values at dofs; a dof may repeat, -1 is skipped."""
    present = dofs >= 0
    np.add.at(total, dofs[present], values[present])

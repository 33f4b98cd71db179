"""Carried nodes of rigid bodies in tangents on the host: forces and stiffness condensed onto the dofs of their bodies.

Small rotations dw in space, from the orientation of the state, move a node at the arm y from the origin of its body by
dx = dc + dw x y. Forces f add to the body f and y x f. Stiffness K adds P^T K P with dx = P (dc, dw). As x is of second order in dw, a
force -f of the node adds the geometric stiffness

    -f . d^2 x / dw^2 = (f . y) I - (f y^T + y f^T) / 2 .
"""

import numpy as np
from scipy import sparse


class CarriedDofs:
    """Condensation of carried nodes onto rigid bodies, in all worlds.

    Args:
        host: `CoupledSystem` with rigid bodies; worlds: number of worlds.
    """

    def __init__(self, host, worlds: int):
        rigid, shift = host.rigid_bodies, host.blocks * np.arange(worlds)[:, None]
        self._moments = rigid.moments
        self._size = 3 * worlds * host.blocks
        self.carried, self.origins, self.spins = (
            (shift + blocks).ravel() for blocks in (rigid.carried, rigid.origins[rigid.owner], rigid.spins[rigid.owner])
        )
        self.bodies = (shift + rigid.spins).ravel()  # rotation blocks of all bodies
        self._free = np.ones(self._size, bool)
        self._free.reshape(-1, 3)[self.carried] = False

    def arms(self, q: np.ndarray) -> np.ndarray:
        """Return y of all carried nodes (n, 3) [m] at dofs q (size,)."""
        x = q.reshape(-1, 3)
        return x[self.carried] - x[self.origins]

    def spread(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return a step (size,) with small displacements of carried nodes."""
        result = step.reshape(-1, 3).copy()
        result[self.carried] = result[self.origins] + np.cross(result[self.spins], self.arms(q))
        return result.ravel()

    def place(self, q: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return dofs `moved` (size,) with carried nodes placed by origins and rotation vectors there, from dofs q."""
        from scipy.spatial.transform import Rotation

        result = moved.reshape(-1, 3).copy()
        turned = Rotation.from_rotvec(result[self.spins]).apply(self.arms(q)) if len(self.carried) else 0.0
        result[self.carried] = result[self.origins] + turned
        return result.ravel()

    def condense(self, q: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Return forces (size,), with the forces on carried nodes moved to the bodies."""
        result = forces.reshape(-1, 3).copy()
        of_nodes = result[self.carried].copy()
        result[self.carried] = 0.0
        np.add.at(result, self.origins, of_nodes)
        np.add.at(result, self.spins, np.cross(self.arms(q), of_nodes))
        return result.ravel()

    def matrix(self, q: np.ndarray, values: sparse.csc_matrix) -> sparse.csc_matrix:
        """Return P^T K P of a matrix (size, size)."""
        projection = self.projection(q)
        return sparse.csc_matrix(projection.T @ values @ projection)

    def projection(self, q: np.ndarray) -> sparse.csc_matrix:
        """Return P (size, size), the displacements of nodes by dofs."""
        y, shape = self.arms(q), (self._size, self._size)
        identity = sparse.diags(self._free.astype(float))
        rows = 3 * np.repeat(self.carried, 3) + np.tile(np.arange(3), len(self.carried))
        columns = 3 * np.repeat(self.origins, 3) + np.tile(np.arange(3), len(self.carried))
        along = sparse.csc_matrix((np.ones(len(rows)), (rows, columns)), shape=shape)
        crossed = _crosses(y)
        row, column = np.indices((3, 3)).reshape(2, -1)
        turns = sparse.csc_matrix(
            (
                -crossed.reshape(-1, 9).ravel(),
                ((3 * self.carried[:, None] + row).ravel(), (3 * self.spins[:, None] + column).ravel()),
            ),
            shape=shape,
        )
        return (identity + along + turns).tocsc()

    def geometric(self, q: np.ndarray, gradient: np.ndarray) -> sparse.csc_matrix:
        """Return the geometric stiffness of energy gradients (size,) on carried nodes."""
        y, g = self.arms(q), gradient.reshape(-1, 3)[self.carried]
        mixed = np.einsum("ni,nj->nij", g, y)
        blocks = 0.5 * (mixed + mixed.transpose(0, 2, 1)) - np.sum(g * y, 1)[:, None, None] * np.eye(3)
        row, column = np.indices((3, 3)).reshape(2, -1)
        places = (3 * self.spins[:, None] + row).ravel(), (3 * self.spins[:, None] + column).ravel()
        return sparse.csc_matrix((blocks.reshape(-1, 9).ravel(), places), shape=(self._size, self._size))

    def principal(self, state) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rotation blocks of all bodies (n,), orientations (n, 3, 3) and principal moments (n, 3) of a coupled state."""
        rotation = state.rotation.numpy().astype(float)
        return self.bodies, rotation, np.tile(self._moments, (len(rotation) // len(self._moments), 1))

    def rotated(self, q: np.ndarray, state, reference) -> np.ndarray:
        """Return dofs q (size,) with the rotation vectors of bodies from a `reference` to a coupled state."""
        from scipy.spatial.transform import Rotation

        result = q.reshape(-1, 3).copy()
        end, start = (each.rotation.numpy().astype(float) for each in (state, reference))
        result[self.bodies] = Rotation.from_matrix(end @ start.transpose(0, 2, 1)).as_rotvec()
        return result.ravel()

    def turn(self, state, q: np.ndarray) -> None:
        """Rotate the bodies of a coupled state by the rotation vectors in dofs q (size,)."""
        from scipy.spatial.transform import Rotation

        rotation = state.rotation.numpy().astype(float)
        state.rotation.assign(Rotation.from_rotvec(q.reshape(-1, 3)[self.bodies]).as_matrix() @ rotation)


def _crosses(y: np.ndarray) -> np.ndarray:
    """Return the matrices of y x (n, 3, 3)."""
    result = np.zeros((len(y), 3, 3))
    result[:, [2, 0, 1], [1, 2, 0]] = y[:, [0, 1, 2]]
    result[:, [1, 2, 0], [2, 0, 1]] = -y[:, [0, 1, 2]]
    return result

"""Description of rigid bodies in recordings: names, masses and shapes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ddg_warp.io.obstacles import Obstacles


@dataclass(frozen=True)
class Bodies:
    """Rigid bodies of a model; see `model.rigid_bodies`.

    Attributes:
        names: Name of each body, shape (N,), str.
        mass: Masses [kg], shape (N,).
        center: Centres of mass at rest, without carried nodes [m], shape (N, 3).
        origin: Rest positions of recorded positions, the centres of mass with carried nodes [m], shape (N, 3).
        moments: Principal moments of inertia [kg m^2], shape (N, 3).
        axes: Principal axes at rest, columns of rotation matrices, shape (N, 3, 3).
        shapes: Number of shapes of each body, shape (N,), int; the last of `Obstacles`, body after body.
    """

    names: np.ndarray
    mass: np.ndarray
    center: np.ndarray
    origin: np.ndarray
    moments: np.ndarray
    axes: np.ndarray
    shapes: np.ndarray

    @classmethod
    def of(cls, bodies, origin: np.ndarray) -> Bodies:
        """Describe rigid bodies of a scene, with the rest positions of poses (N, 3) [m]."""
        return cls(
            names=np.array([body.name for body in bodies], object),
            mass=np.array([body.mass for body in bodies], float),
            center=np.array([body.center for body in bodies], float),
            origin=np.array(origin, float),
            moments=np.array([body.moments for body in bodies], float),
            axes=np.array([body.axes for body in bodies], float),
            shapes=np.array([len(body.shapes) for body in bodies]),
        )

    def __len__(self) -> int:
        return len(self.names)

    def nodes(self, obstacles: Obstacles | None, poses: np.ndarray) -> np.ndarray:
        """Return the nodes of all shapes [m], shape (..., M, 3), for poses (..., N, 3, 4); see `State.body_poses`."""
        count = int(self.shapes.sum())
        if not count:
            return np.zeros((*np.shape(poses)[:-3], 0, 3))
        counts = obstacles.counts[-count:]
        owner = np.repeat(np.repeat(np.arange(len(self)), self.shapes), counts)
        arms = obstacles.rest[-counts.sum() :] - self.origin[owner]
        of_nodes = poses[..., owner, :, :]
        return of_nodes[..., 3] + np.einsum("...nij,nj->...ni", of_nodes[..., :3], arms)

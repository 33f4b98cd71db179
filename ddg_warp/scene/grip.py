"""Kinematic supports with poses given per step and world, instead of by a function of time."""

from dataclasses import dataclass

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.typing import Floats, Numbers, Vector


@argument_checks.called
@dataclass(frozen=True, eq=False)
class Grip:
    """Kinematic support with a pose given in each step: `integrator.step(state, dt, Controls(poses=...))`; see `Controls`.

    A grip replaces a `Motion`, and moves all its supports as one body. A pose is a translation (3,) [m] and a rotation vector
    (3,) [rad], both relative to rest: a point X of the rest state moves to pivot + R (X - pivot) + translation.

    In a step the translation is linear, and the rotation is the shorter one between both orientations, at most pi. Longer rotation
    vectors are refused. Rotations accumulate over steps, as of a `Motion`. Without a pose a grip stays fixed for the step. The poses
    are part of a `State` (`State.poses`), and are the default of post-processing and equilibria.

    Attributes:
        pivot: centre of rotation at rest (3,) [m].
    """

    pivot: Vector = (0.0, 0.0, 0.0)

    # interface of `Motion` for compilation: one pose for all nodes, which may rotate, and may be planar (`Controls` are checked)
    count = None
    turns = True
    planar = True
    by_rod = False

    def __post_init__(self):
        object.__setattr__(self, "pivot", argument_checks.vector("Grip: pivot", self.pivot))

    def pose(self, t0: float, t1: float, start: float = 0.0, part: float = 1.0) -> Floats:
        """Return the row of `Motion.pose` (1, 21) of a grip at rest; the device adds the pose."""
        return np.concatenate([np.zeros(3), np.eye(3).ravel(), self.pivot, np.zeros(6)])[None]

    def at(self, position: Numbers, quaternion: Numbers = (1.0, 0.0, 0.0, 0.0), near: Numbers | None = None) -> Floats:
        """Return the pose (..., 6) with the pivot at a position (..., 3) [m], rotated from rest by a quaternion (..., 4).

        Args:
            position: of the pivot (..., 3) [m].
            quaternion: unit quaternion (w, x, y, z) relative to rest.
            near: earlier pose (..., 6), whose number of revolutions is kept: rotation vectors of a continuous rotation are continuous.
                By default rotation vectors are at most pi long.

        Raises:
            SceneError: a shape does not fit, or a quaternion is not of unit length to 1e-3.
        """
        from scipy.spatial.transform import Rotation

        position = argument_checks.array("Grip.at: position", position, "give (..., 3) [m]")
        quaternion = argument_checks.array("Grip.at: quaternion", quaternion, "give (..., 4), as (w, x, y, z)")
        for name, values, size in (("position", position, 3), ("quaternion", quaternion, 4)):
            if values.shape[-1:] != (size,) or not np.isfinite(values).all():
                raise SceneError(f"Grip.at: {name} has shape {values.shape}; give finite numbers (..., {size})")
        if (np.abs(np.linalg.norm(quaternion, axis=-1) - 1.0) > 1e-3).any():
            raise SceneError("Grip.at: the quaternion is not of unit length; give (w, x, y, z) over its length")
        rotation = Rotation.from_quat(np.roll(quaternion, -1, axis=-1).reshape(-1, 4)).as_rotvec()
        rotation = rotation.reshape(*quaternion.shape[:-1], 3)
        shape = np.broadcast_shapes(position.shape[:-1], rotation.shape[:-1])
        if near is not None:
            near = argument_checks.broadcast("Grip.at: near", near, (*shape, 6), own=1)
            rotation = _nearest_turn(np.broadcast_to(rotation, (*shape, 3)), near[..., 3:])
        pose = np.empty((*shape, 6))
        pose[..., :3], pose[..., 3:] = position - self.pivot, rotation
        return pose

    def jump(self, t0: float, t1: float) -> None:
        """Return None: a grip never jumps within a step."""
        return None

    def turn(self, poses: Floats, vectors: Floats) -> Floats:
        """Return vectors of the rest state (n, 3) rotated by poses (worlds, 6): (worlds, n, 3)."""
        from scipy.spatial.transform import Rotation

        return np.einsum("wij,nj->wni", Rotation.from_rotvec(poses[:, 3:]).as_matrix(), vectors)


def _nearest_turn(rotation: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) of the same orientations that are nearest to others (..., 3)."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    length = np.linalg.norm(near, axis=-1, keepdims=True)
    axis = np.where(
        angle > 0.0, rotation / np.where(angle > 0.0, angle, 1.0), near / np.where(length > 0.0, length, 1.0)
    )
    turns = np.rint(((near * axis).sum(-1, keepdims=True) - angle) / (2.0 * np.pi))
    return axis * (angle + 2.0 * np.pi * turns)

"""Kinematic supports with poses given per step and world, instead of by a function of time."""

from dataclasses import dataclass

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.typing import Floats, Vector


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

    def __post_init__(self):
        object.__setattr__(self, "pivot", argument_checks.vector("Grip: pivot", self.pivot))

    def pose(self, t0: float, t1: float, start: float = 0.0, part: float = 1.0) -> Floats:
        """Return the row of `Motion.pose` (1, 21) of a grip at rest; the device adds the pose."""
        return np.concatenate([np.zeros(3), np.eye(3).ravel(), self.pivot, np.zeros(6)])[None]

    def jump(self, t0: float, t1: float) -> None:
        """Return None: a grip never jumps within a step."""
        return None

    def turn(self, poses: Floats, vectors: Floats) -> Floats:
        """Return vectors of the rest state (n, 3) rotated by poses (worlds, 6): (worlds, n, 3)."""
        from scipy.spatial.transform import Rotation

        return np.einsum("wij,nj->wni", Rotation.from_rotvec(poses[:, 3:]).as_matrix(), vectors)

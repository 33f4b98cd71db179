"""Supports that are moved from step to step, world by world, instead of by a function of time."""

from dataclasses import dataclass

import numpy as np

from ddg_warp import arguments


@arguments.called
@dataclass(frozen=True, eq=False)
class Grip:
    """A rigid motion of supports that every step is told: `integrator.step(state, dt, Controls(poses=...))`; see `Controls`.

    It stands wherever a `Motion` does, and moves all supports that it is given to as one body. A pose is a translation (3,) [m] and
    a rotation vector (3,) [rad], both relative to rest: a point X of the rest state is at pivot + R (X - pivot) + translation. Over
    a step the translation runs straight and the rotation the shorter way from one orientation to the next, half a turn at most:
    rotation vectors that count more are refused. Turns add up from step to step, as those of a `Motion` do. A grip that a step is
    told nothing of rests where it was. Its poses are part of a `State` (`State.poses`): questions, and equilibria that are told
    nothing of it, find it where the state has it.

    Attributes:
        pivot: what it turns about at rest (3,) [m].
    """

    pivot: tuple = (0.0, 0.0, 0.0)

    # what compilation asks of a Motion, too: one pose for all nodes, which may turn, and may stay in a plane (`Controls` are checked)
    count = None
    turns = True
    planar = True

    def __post_init__(self):
        object.__setattr__(self, "pivot", arguments.vector("Grip: pivot", self.pivot))

    def pose(self, t0: float, t1: float, start: float = 0.0, part: float = 1.0) -> np.ndarray:
        """The row of `Motion.pose` (1, 21) of a grip at rest; what moves it is found on the device."""
        return np.concatenate([np.zeros(3), np.eye(3).ravel(), self.pivot, np.zeros(6)])[None]

    def jump(self, t0: float, t1: float) -> None:
        """It has no value in between that could jump."""
        return None

    def turn(self, poses: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Where vectors of the rest state (n, 3) point in poses (worlds, 6): (worlds, n, 3)."""
        from scipy.spatial.transform import Rotation

        return np.einsum("wij,nj->wni", Rotation.from_rotvec(poses[:, 3:]).as_matrix(), vectors)

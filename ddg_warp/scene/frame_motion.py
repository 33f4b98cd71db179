"""Prescribed motion of rods one by one: a moving frame for each, such as of the point of a surface that a hair grows from."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.typing import Bools, Floats, Integers, Numbers


@argument_checks.called
@dataclass(frozen=True, eq=False)
class FrameMotion:
    """Rigid motion of each rod of a support, `clamp` or `clamp_end`: nodes and the frame of the end follow it exactly.

    A point X of the rest state of rod k moves to point_k + R_k(t) (X - point_k) + translation_k(t). Rotations between the ends of a
    step have a constant rate.

    Attributes:
        points: a point of each rod at rest (n, 3) [m], the centre of its rotation.
        frames: t -> (translations (n, 3) [m], rotation matrices (n, 3, 3)) from rest; zero and unit at t = 0.
    """

    points: Numbers
    frames: Callable[[float], tuple[Floats, Floats]]
    _cache: dict = field(init=False, repr=False, default_factory=dict)

    # interface of `Motion`
    turns = shifts = by_rod = True
    planar = False
    pivot = np.zeros(3)
    axis = "axes of its own for each rod"

    def __post_init__(self):
        points = argument_checks.array("FrameMotion: points", self.points, "give (rods, 3) [m]")
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise SceneError(f"FrameMotion: points have shape {points.shape}; give finite ones (rods, 3) [m]")
        object.__setattr__(self, "points", points)
        if not callable(self.frames):
            raise SceneError(f"FrameMotion: frames is {self.frames!r}; give a function of the time")
        self._checked(0.0, SceneError)

    @property
    def count(self) -> int:
        """Number of rods."""
        return len(self.points)

    def moves(self, duration: float) -> Bools:
        """Return the moving components of a point (3,), all."""
        return np.ones(3, bool)

    def shift(self, t: float) -> Floats:
        """Return translations at t (n, 3) [m]."""
        return self._at(t)[0]

    def turned(self, t: float) -> float:
        """Return the largest rotation at t from rest [rad]."""
        return float(np.linalg.norm(_rotation_vectors(self._at(t)[1]), axis=1).max(initial=0.0))

    def pose(self, t0: float, t1: float, start: float = 0.0, part: float = 1.0) -> Floats:
        """Return rows (n, 21) for the device; see `Motion.pose`."""
        (first, before), (last, after) = self._at(t0), self._at(t1)
        turn = _rotation_vectors(after @ before.swapaxes(1, 2))
        if part < 1.0:
            turn, rate = turn / part, (last - first) / part
            first, last = first - start * rate, last + (1.0 - start - part) * rate
            before = _rotations(-start * turn) @ before
        return np.column_stack([turn, before.reshape(-1, 9), self.points, first, last])

    def jump(self, t0: float, t1: float) -> None:
        """Return None: frames are taken to be continuous."""
        return None

    def place(self, t: float, points: Floats, rows: Integers) -> Floats:
        """Return points of the rest state (m, 3) of the rods `rows` moved to t [m]."""
        shift, rotation = self._at(t)
        centres = self.points[rows]
        return np.einsum("mij,mj->mi", rotation[rows], points - centres) + centres + shift[rows]

    def _at(self, t: float) -> tuple[Floats, Floats]:
        if t not in self._cache:
            while len(self._cache) >= 2:  # the ends of a step
                self._cache.pop(next(iter(self._cache)))
            self._cache[t] = self._checked(t, SolverError)
        return self._cache[t]

    def _checked(self, t: float, error: type[Exception]) -> tuple[Floats, Floats]:
        shift, rotation = (np.asarray(values, float) for values in self.frames(t))
        count = len(self.points)
        for name, values, shape in (("translations", shift, (count, 3)), ("rotations", rotation, (count, 3, 3))):
            if values.shape != shape:
                raise error(f"FrameMotion: {name} at t = {t:g} have shape {values.shape}; give {shape}")
            for k in np.flatnonzero(~np.isfinite(values.reshape(count, -1)).all(1))[:1]:
                raise error(
                    f"FrameMotion: {name} at t = {t:g} of rod {k} are not finite; give finite ones at all times"
                )
        return shift, rotation


def nearest_rotations(matrices: Floats) -> Floats:
    """Return the rotations nearest to matrices (n, 3, 3): their polar factors, with the sign that makes them rotations."""
    u, _, v = np.linalg.svd(matrices)
    rotations = u @ v
    return rotations * np.sign(np.linalg.det(rotations))[:, None, None]


def _rotation_vectors(rotations: Floats) -> Floats:
    """Return the rotation vectors (n, 3) of matrices (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotations).as_rotvec() if len(rotations) else np.zeros((0, 3))


def _rotations(vectors: Floats) -> Floats:
    """Return the matrices (n, 3, 3) of rotation vectors (n, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()

"""Sampled poses of USD prims, and the rigid motion between two sets of points."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Usd, UsdGeom

DOUBLE = UsdGeom.XformOp.PrecisionDouble  # USD takes angles from arc cosines, which lose small ones of float32
POSE = 56  # size of a translation and a quaternion [bytes]


class PoseOps:
    """Translation and orientation of a prim, with a default and time samples.

    Args:
        prim: The prim, without transforms.
    """

    def __init__(self, prim: UsdGeom.Xformable):
        self._translate, self._orient = prim.AddTranslateOp(), prim.AddOrientOp(DOUBLE)
        self._last: Gf.Quatd | None = None

    def write(self, code: Usd.TimeCode, rotation: np.ndarray, position: np.ndarray) -> int:
        """Write a rotation matrix (3, 3) and a position (3,); return the size of the values [bytes].

        The sign of the quaternion follows the sample before. The first pose is the default, too.
        """
        turned, moved = quaternion(rotation), Gf.Vec3d(*map(float, position))
        first = self._last is None
        self._last = turned if first or Gf.Dot(turned, self._last) >= 0.0 else -turned
        for time in (Usd.TimeCode.Default(), code) if first else (code,):
            self._translate.Set(moved, time)
            self._orient.Set(self._last, time)
        return POSE * (1 + first)


def quaternion(rotation: np.ndarray) -> Gf.Quatd:
    """Return the quaternion of a rotation matrix (3, 3)."""
    matrix = Gf.Matrix4d(Gf.Matrix3d(*map(float, rotation.T.ravel())), Gf.Vec3d(0.0))  # of row vectors
    return matrix.ExtractRotationQuat().GetNormalized()


def rigid_motion(rest: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return (rotation (3, 3), centre (3,), largest deviation) of the rigid motion nearest to moved points.

    Source: Kabsch, A solution for the best rotation to relate two sets of vectors, 1976.

    Args:
        rest: Points about their mean, shape (P, 3).
        moved: Points after the motion, shape (P, 3).
    """
    centre = moved.mean(0)
    left, _, right = np.linalg.svd((moved - centre).T @ rest)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return rotation, centre, float(np.abs(moved - centre - rest @ rotation.T).max())

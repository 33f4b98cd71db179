"""Axis that points up in a file, and rotation to z up."""

import numpy as np

Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
TO_Z_UP = {"x": np.roll(np.eye(3), 1, axis=1), "y": Y_UP_TO_Z_UP, "z": np.eye(3)}
"""Rotation matrix by the axis of the file that points up."""


def in_metres(points: np.ndarray, unit: float | None, up: str | None) -> np.ndarray:
    """Return points (P, 3) in metres with z up; without a unit they are in metres, without an axis z is up."""
    return points * (1.0 if unit is None else unit) @ TO_Z_UP[up or "z"].T

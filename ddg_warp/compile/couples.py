"""Couples with axes fixed in space on edges of rods, in NumPy: what they put on nodes and angle, and the derivatives of that.

A couple M on an edge e is the force M x e / |e|^2 on its second node, the opposite one on its first, and the moment M . t about it.
"""

import numpy as np


def couple_forces(e: np.ndarray, couple: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force on the second nodes (n, dim) [N] and moment about edges e (n, dim), which is zero in the plane (n,) [N m]."""
    square = np.sum(e * e, -1, keepdims=True)
    if e.shape[1] == 2:
        return couple[1] * np.stack([e[:, 1], -e[:, 0]], -1) / square, np.zeros(len(e))
    return np.cross(couple, e) / square, e @ couple / np.sqrt(square[:, 0])


def couple_derivatives(e: np.ndarray, couple: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of both with respect to e, (n, dim, dim) and (n, dim); the former is symmetric only in the plane."""
    square = np.sum(e * e, -1)[:, None, None]
    if e.shape[1] == 2:
        cross, about = couple[1] * np.array([[0.0, 1.0], [-1.0, 0.0]]), np.zeros_like(e)
    else:
        cross = np.cross(couple, np.eye(3)).T
        about = (couple - e * ((e @ couple)[:, None] / square[:, 0])) / np.sqrt(square[:, 0])
    return (cross - 2.0 * (e @ cross.T)[:, :, None] * e[:, None] / square) / square, about

"""Shapes to look at: an equilibrium, displaced along the mode in which it is least stiff."""

import numpy as np

from ddg_warp.solve.stability import spectrum
from ddg_warp.solve.tangent import Tangent

SMALL = 1e-4  # of the size asked for, to which a mode is taken as linear


def buckled_points(model, state, size: float) -> np.ndarray:
    """Points (P, 3) [m] of a model of one world, displaced along its lowest mode by `size` [m] at most, on the side of the axis
    in which it moves most.

    Args:
        model, state: an equilibrium, at or near its critical load.
        size: largest displacement.
    """
    tangent = Tangent(model)
    mode = spectrum(model, state, 1, "unit", tangent).modes[:, 0]
    moved, points = state.copy(), state.points()
    tangent.assign(moved, tangent.retract(tangent.dofs(state), SMALL * size / np.abs(mode).max() * mode))
    shift = moved.points() - points
    largest = shift[np.unravel_index(np.abs(shift).argmax(), shift.shape)]
    return points + size / np.linalg.norm(shift, axis=1).max() * np.sign(largest) * shift

"""Buckled shapes: an equilibrium displaced along its lowest mode."""

import numpy as np

from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.tangent import Tangent

SMALL = 1e-4  # of the given size: displacement for which the mode is taken as linear


def buckled_points(model, state, size: float) -> np.ndarray:
    """Return the points (P, 3) [m] of a state displaced along its lowest mode.

    The largest component of the displacement is positive.

    Args:
        model, state: an equilibrium, at or near its critical load, of one world.
        size: largest displacement [m].
    """
    tangent = Tangent(model)
    mode = spectrum(model, state, 1, "unit", tangent).modes[:, 0]
    moved, points = state.copy(), state.points()
    tangent.assign(moved, tangent.retract(tangent.dofs(state), SMALL * size / np.abs(mode).max() * mode))
    shift = moved.points() - points
    largest = shift[np.unravel_index(np.abs(shift).argmax(), shift.shape)]
    return points + size / np.linalg.norm(shift, axis=1).max() * np.sign(largest) * shift

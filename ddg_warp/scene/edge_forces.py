"""Forces on rods with coefficients of edges: laws, and the effect of coefficients on massless rods. NumPy only."""

import numpy as np

from ddg_warp.scene import drag

LAWS = (drag.Laws,)
HOLD = "give the material a density, the section a mass_per_length, or the rod drag along and across"  # for a massless node


def laws_of(scene) -> list:
    """Return the laws of all rods of a scene, an object for each force.

    Raises:
        SceneError: a rod has two laws of a force.
    """
    return [laws(scene) for laws in LAWS]


def holds(coefficients: dict[str, np.ndarray]) -> np.ndarray:
    """Return masks of first and last nodes of edges (2, ...) that forces hold in all directions, by coefficients (rows, ...)."""
    return np.any([laws.holds(coefficients[laws.name]) for laws in LAWS if laws.name in coefficients], axis=0)


def least(coefficients: dict[str, np.ndarray]) -> np.ndarray:
    """Return the smallest resistance per length [N s/m^2] of rods (R,) from coefficients (R, edges, rows)."""
    return np.sum([laws.least(coefficients[laws.name]) for laws in LAWS if laws.name in coefficients], axis=0)

"""Densities: the constitutive laws. A density gives the energy per rest measure of n strains, psi(e; p)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

VALID = {  # which values of a parameter have a meaning, by its name without the number of its strain
    "measure": ("positive", lambda v: v > 0.0),
    "stiffness": ("not negative", lambda v: v >= 0.0),
    "viscosity": ("not negative", lambda v: v >= 0.0),
    "poisson": ("between -1 and 1", lambda v: abs(v) < 1.0),
    "metric_11": ("positive", lambda v: v > 0.0),
    "metric_22": ("positive", lambda v: v > 0.0),
    "metric_12": ("finite", np.isfinite),
    "rest": ("finite", np.isfinite),
}


def valid(parameter: str) -> tuple[str, Callable]:
    """Which values a parameter may have, in words and as a function of arrays."""
    return VALID.get(parameter) or VALID[parameter.rpartition("_")[0] or parameter]


@dataclass(frozen=True)
class Density:
    """One constitutive law of n strains.

    Attributes:
        name: field's name of the law.
        parameters: n -> names of the parameters, in the order of p.
        lagged: whether p ends with the strains of the last step (n) and the reciprocal of the time step (1).
        coupled: whether psi'' is a full matrix.
        functions: (real, n) -> (energy(e, p), slope(e, p), root(e, p, shift)), where root is the square root of the diagonal
            of psi'' + diag(shift), made positive semi-definite, as a vector. Of a coupled law it is the matrix R (n x n) with
            R^T R = psi'', and shift is ignored.
    """

    name: str
    parameters: Callable
    functions: Callable
    lagged: bool = False
    coupled: bool = False

    def parameter_size(self, strains: int) -> int:
        """Reals in p, those of the last step included."""
        return len(self.parameters(strains)) + (strains + 1 if self.lagged else 0)

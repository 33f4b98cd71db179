"""Densities: the constitutive laws. A density gives the energy per rest measure of n strains, psi(e; p).

A law says its parameters once: their names, units, defaults and the values that have a meaning. Whoever binds values to a term
(`kernels.terms.Term.bind`), changes them or reports them goes by these.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

POSITIVE = "positive", lambda v: v > 0.0
NOT_NEGATIVE = "not negative", lambda v: v >= 0.0
FINITE = "finite", np.isfinite


@dataclass(frozen=True)
class Parameter:
    """A parameter of a law.

    Attributes:
        family: what it is; there is one, or one a strain.
        unit: its unit.
        valid: which values have a meaning, in words and as a function of arrays.
        number: of its strain or component where there are several, counted as in its name: "1", "12"; else empty.
        rest: whether it belongs to the rest shape, as rest strains do.
        default: value where none is given; None if one has to be.
    """

    family: str
    unit: str
    valid: tuple[str, Callable]
    number: str = ""
    rest: bool = False
    default: float | None = None

    @property
    def name(self) -> str:
        """Name that users know it by."""
        return f"{self.family}_{self.number}" if self.number else self.family


@dataclass(frozen=True)
class Density:
    """One constitutive law of n strains.

    Attributes:
        name: field's name of the law.
        parameters: n -> its parameters, in the order of p.
        laws: (real, n) -> (energy(e, p), slope(e, p), curvature(e, p)) = (psi, psi', psi''); the last is a matrix (n x n) of a
            coupled law, else its diagonal as a vector.
        strains: of how many it is; None where of any number.
        lagged: whether p ends with the strains of the last step (n) and the reciprocal of the time step (1).
        coupled: whether psi'' is a full matrix.
        quadratic: whether psi'' depends on no strain.
        kept: of a coupled law, how many strains the root is of: the first ones, or all (0). What else there is of psi'' is left to the
            exact Hessian.
        own_root: (real, n) -> root(e, p, shift) as in `functions`, where it has a closed form; else it is found.
    """

    name: str
    parameters: Callable
    laws: Callable
    strains: int | None = None
    lagged: bool = False
    coupled: bool = False
    quadratic: bool = False
    kept: int = 0
    own_root: Callable | None = None
    undamped: "Density | None" = None  # the law that this is with strain-rate damping

    def parameter_size(self, strains: int) -> int:
        """Reals in p, those of the last step included."""
        return len(self.parameters(strains)) + (strains + 1 if self.lagged else 0)

    def functions(self, real, strains: int):
        """(energy, slope, root): root(e, p, shift) is the square root of psi'' + diag(shift), made positive semi-definite.

        It is a vector, of a coupled law the matrix R (n x n) with R^T R = psi''; laws with a root of their own may leave out `shift`.
        """
        from ddg_warp.kernels.densities.definite import root_function

        energy, slope, _ = self.laws(real, strains)
        own = self.own_root(real, strains) if self.own_root else root_function(self, real, strains)
        return energy, slope, own


def each(strains: int, family: str, unit: str, valid, **options) -> tuple[Parameter, ...]:
    """One parameter a strain."""
    numbers = [str(i + 1) for i in range(strains)] if strains > 1 else [""]
    return tuple(Parameter(family, unit, valid, number, **options) for number in numbers)

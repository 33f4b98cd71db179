"""Energy densities: constitutive laws. A density gives the energy per rest measure of n strains, psi(e; p).

A density declares its parameters once: names, units, defaults and valid values. Code that binds values to a term
(`kernels.terms.Term.bind`), changes or reports them reads this declaration.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

POSITIVE = "positive", lambda v: v > 0.0
NOT_NEGATIVE = "not negative", lambda v: v >= 0.0
FINITE = "finite", np.isfinite


@dataclass(frozen=True)
class Parameter:
    """A parameter of an energy density.

    Attributes:
        family: quantity; one parameter, or one per strain.
        unit: unit.
        valid: valid values, in words and as a function of arrays.
        number: number of the strain or component if there are several, as in the name: "1", "12"; else empty.
        rest: True if it belongs to the rest shape, as rest strains do.
        default: default value; None for a required parameter.
    """

    family: str
    unit: str
    valid: tuple[str, Callable]
    number: str = ""
    rest: bool = False
    default: float | None = None

    @property
    def name(self) -> str:
        """Name in the user interface."""
        return f"{self.family}_{self.number}" if self.number else self.family


@dataclass(frozen=True)
class Density:
    """A constitutive law of n strains.

    Attributes:
        name: name of the law.
        parameters: n -> parameters, in the order of p.
        laws: (real, n) -> (energy(e, p), slope(e, p), curvature(e, p)) = (psi, psi', psi''). psi'' is a matrix (n x n) for a coupled
            law, else its diagonal as a vector.
        strains: number of strains; None for any.
        lagged: True if p ends with the strains of the last step (n) and the reciprocal of the time step (1).
        coupled: True if psi'' is a full matrix.
        quadratic: True if psi'' depends on no strain.
        own_root: (real, n) -> root(e, p, shift) as in `functions`, if it has a closed form; else computed numerically.
    """

    name: str
    parameters: Callable
    laws: Callable
    strains: int | None = None
    lagged: bool = False
    coupled: bool = False
    quadratic: bool = False
    own_root: Callable | None = None
    undamped: "Density | None" = None  # the same law without strain-rate damping

    def parameter_size(self, strains: int) -> int:
        """Return the number of reals in p, including lagged strains and the time step."""
        return len(self.parameters(strains)) + (strains + 1 if self.lagged else 0)

    def functions(self, real, strains: int):
        """Return the device functions (energy, slope, root).

        `root(e, p, shift)` is the square root of psi'' + diag(shift), made positive semidefinite: a vector, or for a coupled law the
        matrix R (n x n) with R^T R = psi''. A closed form may ignore `shift`.
        """
        from ddg_warp.kernels.densities.psd_square_root import root_function

        energy, slope, _ = self.laws(real, strains)
        root = self.own_root(real, strains) if self.own_root else root_function(self, real, strains)
        return energy, slope, root


def each(strains: int, family: str, unit: str, valid, **options) -> tuple[Parameter, ...]:
    """Return one parameter per strain."""
    numbers = [str(i + 1) for i in range(strains)] if strains > 1 else [""]
    return tuple(Parameter(family, unit, valid, number, **options) for number in numbers)

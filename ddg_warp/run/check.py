"""Check of a scene: a measured number against its reference, within a tolerance."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Check:
    """Number that a scene must reproduce.

    Attributes:
        name: Name of the quantity, with its unit.
        measured: The value found.
        reference: The value it should have.
        tolerance: Largest error that passes, in the unit of the value, or relative to the reference.
        source: Where the reference comes from: a formula, a publication, another program.
        relative: Whether the error is divided by |reference|.
        skipped: Why there is nothing to compare, such as "needs 2 s"; empty where there is.
    """

    COARSEST: ClassVar[float] = 0.05
    """Largest relative error that a coarse mesh excuses: tolerances that grow with its cells end here."""

    name: str
    measured: float
    reference: float
    tolerance: float
    source: str = ""
    relative: bool = False
    skipped: str = ""

    @classmethod
    def skip(cls, name: str, why: str) -> "Check":
        """Return a check that this run cannot make; it neither passes nor fails."""
        return cls(name, math.nan, math.nan, math.nan, skipped=why)

    @property
    def error(self) -> float:
        """|measured - reference|, divided by |reference| if `relative`; NaN if either is."""
        error = abs(float(self.measured) - float(self.reference))
        if not self.relative:
            return error
        return error / abs(self.reference) if self.reference else math.nan

    @property
    def passed(self) -> bool:
        """True if the error is within the tolerance; False for NaN."""
        return bool(self.error <= self.tolerance)

    @property
    def failed(self) -> bool:
        """True if the check was made and did not pass."""
        return not (self.passed or self.skipped)

    def as_dict(self) -> dict:
        """Return the entry of `checks` in summary.json."""
        return {
            "name": self.name,
            "measured": float(self.measured),
            "reference": float(self.reference),
            "error": self.error,
            "tolerance": float(self.tolerance),
            "passed": self.passed,
            "source": self.source,
        } | ({"skipped": self.skipped} if self.skipped else {})


def once_reached(result, t: float, names: Iterable[str], make: Callable[[], list[Check]]) -> list[Check]:
    """Return the checks of `make` if the run has reached time t, else skipped checks of these names.

    Args:
        result: The run.
        t: Time that the checks need [s], or the load parameter in statics.
        names: Names of the checks.
        make: Returns the checks; not called if the run is shorter.
    """
    if len(result.times) and result.times[-1] >= t - 1e-3 * (result.dt or 1e-6):
        return make()
    unit = "s" if result.dt else "of the load"
    return [Check.skip(name, f"needs {t:g} {unit}") for name in names]

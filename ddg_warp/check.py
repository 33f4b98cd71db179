"""A check: a measured number against its reference, within a tolerance. Every scene ends in some."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """One number that a scene must reproduce.

    Attributes:
        name: What is compared, with its unit.
        measured: The value found.
        reference: The value it should have.
        tolerance: Largest error that passes, in the unit of the value, or relative to the reference.
        source: Where the reference comes from: a formula, a publication, another program.
        relative: Whether the error is divided by |reference|.
    """

    name: str
    measured: float
    reference: float
    tolerance: float
    source: str = ""
    relative: bool = False

    @property
    def error(self) -> float:
        """|measured - reference|, divided by |reference| if `relative`; NaN if either is."""
        error = abs(float(self.measured) - float(self.reference))
        if not self.relative:
            return error
        return error / abs(self.reference) if self.reference else math.nan

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance; NaN never is."""
        return bool(self.error <= self.tolerance)

    def as_dict(self) -> dict:
        """The entry of `checks` in summary.json."""
        return {
            "name": self.name,
            "measured": float(self.measured),
            "reference": float(self.reference),
            "error": self.error,
            "tolerance": float(self.tolerance),
            "passed": self.passed,
            "source": self.source,
        }

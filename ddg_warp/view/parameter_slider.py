"""Parameters of a model that a slider changes."""

from __future__ import annotations

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError

DECADES = 2.0  # range of a factor to either side


def adjustable(model) -> dict[str, tuple]:
    """Return the parameters that can be set by name of `model.parameters()`: (term, parameter, table, name in the table)."""
    result = {}
    for i, group in enumerate(model.groups):
        for name in group.parameters.values:
            term, _, parameter = name.partition(".")
            result[f"{i}/{term}/{parameter}"] = term, parameter, group.parameters, name
    laws: dict[str, int] = {}
    for part in model.coupled.sets if model.coupled is not None else ():
        term = part.term.name
        number = laws[term] = laws.get(term, -1) + 1
        place = f"net/{term}" + (f" {number}" if number else "")
        for name in part.parameters.values:
            result[f"{place}/{name}"] = term, name, part.parameters, name
    return {name: entry for name, entry in result.items() if entry[3] not in entry[2].prescribed}


class ParameterSlider:
    """Parameter of one rod group or element set, changed by one number.

    Args:
        model: The model.
        name: Name of `model.parameters()`.
        low, high: Ends; values of all elements are then the number itself. Without, the number is the power of ten that the values
            at the start are multiplied by. Parameters that are zero everywhere are the number itself, from -1 to 1.

    Attributes:
        factor: Whether the number is a power of ten.
        value: The current number.

    Raises:
        SceneError: There is no such parameter, it cannot be set, or an end is no number.
    """

    def __init__(self, model, name: str, low: float | None = None, high: float | None = None):
        entries = adjustable(model)
        if name not in entries:
            raise SceneError(
                f"Viewer.slider: no parameter {name!r} can be set; there is {', '.join(entries) or 'none'}"
            )
        if (low is None) != (high is None):
            raise SceneError(f"Viewer.slider: {name!r} has low = {low} and high = {high}; give both, or none")
        self.name, self._model = name, model
        term, parameter, self._table, self._key = entries[name]
        self._rule = model.parameter_rule(term, parameter)
        self._base = np.array(self._table.values[self._key])
        self.factor = low is None and bool(self._base.any())
        if low is None:
            low, high = (-DECADES, DECADES) if self.factor else (-1.0, 1.0)
        self.low = argument_checks.number("Viewer.slider: low", low)
        self.high = argument_checks.number("Viewer.slider: high", high)
        if not self.low < self.high:
            raise SceneError(f"Viewer.slider: {name!r}: low = {low} is not below high = {high}")
        self.value = 0.0 if self.factor else float(np.clip(self._base.mean(), self.low, self.high))

    def set(self, value: float) -> None:
        """Set the parameter; a value that its rule forbids changes nothing."""
        self.value = value
        values = self._base * 10.0**value if self.factor else np.full_like(self._base, value)
        _, holds = self._rule
        if np.all(holds(values)):
            self._model.note_change(self._table.set(**{self._key: values}))

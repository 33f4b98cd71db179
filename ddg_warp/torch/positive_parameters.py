"""Modules of learned parameters; positive ones are learned as logarithms."""

from collections.abc import Mapping

import torch

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError


class PositiveParameters(torch.nn.Module):
    """Positive parameters "term.parameter", each learned as a logarithm; calling the module returns input of `Simulator.step`.

    Args:
        values: initial values by name, tensors that broadcast to (B, E).

    Raises:
        SceneError: `values` is no dict of positive finite real numbers by names; names the parameter.
    """

    def __init__(self, values: dict[str, torch.Tensor]):
        super().__init__()
        if not isinstance(values, Mapping):
            raise SceneError(f"PositiveParameters: values are {values!r:.60}; give a dict of tensors by name")
        self._names = list(values)
        self.logarithms = torch.nn.ParameterList(
            torch.nn.Parameter(torch.log(_positive(name, value))) for name, value in values.items()
        )

    def forward(self) -> dict[str, torch.Tensor]:
        """Return the parameter values by name."""
        return {name: value.exp() for name, value in zip(self._names, self.logarithms, strict=True)}


def _positive(name, value) -> torch.Tensor:
    """Return positive finite numbers as a floating-point tensor."""
    try:
        numbers = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        numbers = torch.zeros(0, dtype=torch.bool)
    numbers = numbers.to(torch.get_default_dtype()) if numbers.dtype in (torch.int32, torch.int64) else numbers
    if not isinstance(name, str) or not numbers.is_floating_point() or not numbers.numel():
        raise SceneError(
            f"PositiveParameters: {name!r} is {value!r:.60}; give names of parameters, and numbers for each"
        )
    if not (torch.isfinite(numbers) & (numbers > 0.0)).all():
        raise SceneError(f"PositiveParameters: {name!r} is not positive and finite; give positive numbers")
    return numbers.detach()


def parameter_key(name: str) -> str:
    """Return the buffer name of a parameter."""
    return f"_{name.replace('.', '_')}"


def usual_values(simulator, name: str) -> torch.Tensor:
    """Return the values of a parameter in a model (1, E), or (B, E) if its worlds differ."""
    values = simulator.parameter(name)
    return (values[:1] if (values == values[:1]).all() else values).clone()


def requested(call: str, simulator, names, batch: int | None) -> tuple[tuple[str, ...], int]:
    """Return the names and batch size (1 by default) requested from a module of a simulator's parameters.

    Raises:
        SceneError: the simulator is none, names are no texts, or there is none; names the call.
    """
    if not hasattr(simulator, "initial_state"):
        raise SceneError(f"{call}: {argument_checks.shown(simulator)} is no simulator; give Simulator(model, dt)")
    if not isinstance(names, tuple | list) or not names or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{call}: names are {argument_checks.shown(names)}; give several in a tuple, one at least")
    if len(set(names)) < len(names):
        raise SceneError(f"{call}: names are {argument_checks.shown(names)}; give each once")
    return tuple(names), 1 if batch is None else argument_checks.count(f"{call}: batch", batch)

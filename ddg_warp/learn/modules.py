"""Parameters as modules: positive ones are learned as logarithms."""

from collections.abc import Mapping

import torch

from ddg_warp import arguments
from ddg_warp.errors import SceneError


class PositiveParameters(torch.nn.Module):
    """Parameters "term.parameter" that are positive, each learned as its logarithm; called, it gives what `Simulator.step` takes.

    Args:
        values: first values by name, tensors that broadcast to (B, E).

    Raises:
        SceneError: they are no dict of positive finite real numbers by names; names the parameter.
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
        """Their values."""
        return {name: value.exp() for name, value in zip(self._names, self.logarithms, strict=True)}


def _positive(name, value) -> torch.Tensor:
    """Positive finite numbers of floating point."""
    try:
        found = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        found = torch.zeros(0, dtype=torch.bool)
    found = found.to(torch.get_default_dtype()) if found.dtype in (torch.int32, torch.int64) else found
    if not isinstance(name, str) or not found.is_floating_point() or not found.numel():
        raise SceneError(
            f"PositiveParameters: {name!r} is {value!r:.60}; give names of parameters, and numbers for each"
        )
    if not (torch.isfinite(found) & (found > 0.0)).all():
        raise SceneError(f"PositiveParameters: {name!r} is not positive and finite; give positive numbers")
    return found.detach()


def parameter_key(name: str) -> str:
    """Of a parameter, as a buffer."""
    return f"_{name.replace('.', '_')}"


def usual_values(simulator, name: str) -> torch.Tensor:
    """The values that a model has of a parameter (1, E), or (B, E) where its worlds differ."""
    found = simulator.parameter(name)
    return (found[:1] if (found == found[:1]).all() else found).clone()


def asked(call: str, simulator, names, batch: int | None) -> tuple[tuple[str, ...], int]:
    """Names and batch size (1 by default) that a module of a simulator's parameters is asked for.

    Raises:
        SceneError: what is given is no simulator, names are no texts, or there is none; names the call.
    """
    if not hasattr(simulator, "initial_state"):
        raise SceneError(f"{call}: {arguments.shown(simulator)} is no simulator; give Simulator(model, dt)")
    if not isinstance(names, tuple | list) or not names or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{call}: names are {arguments.shown(names)}; give several in a tuple, one at least")
    if len(set(names)) < len(names):
        raise SceneError(f"{call}: names are {arguments.shown(names)}; give each once")
    return tuple(names), 1 if batch is None else arguments.count(f"{call}: batch", batch)

"""Parameters as modules: positive ones are learned as logarithms."""

import torch


class PositiveParameters(torch.nn.Module):
    """Parameters "term.parameter" that are positive, each learned as its logarithm; called, it gives what `Simulator.step` takes.

    Args:
        values: first values by name, tensors that broadcast to (B, E).
    """

    def __init__(self, values: dict[str, torch.Tensor]):
        super().__init__()
        self._names = list(values)
        self.logarithms = torch.nn.ParameterList(
            torch.nn.Parameter(torch.log(torch.as_tensor(v))) for v in values.values()
        )

    def forward(self) -> dict[str, torch.Tensor]:
        """Their values."""
        return {name: value.exp() for name, value in zip(self._names, self.logarithms, strict=True)}


def parameter_key(name: str) -> str:
    """Of a parameter, as a buffer."""
    return f"_{name.replace('.', '_')}"


def usual_values(simulator, name: str) -> torch.Tensor:
    """The values that a model has of a parameter (1, E), or (B, E) where its worlds differ."""
    found = simulator.parameter(name)
    return (found[:1] if (found == found[:1]).all() else found).clone()

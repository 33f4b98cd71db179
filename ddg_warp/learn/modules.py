"""Parameters as modules: positive ones are learned as logarithms."""

import torch

from ddg_warp.errors import SceneError


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


class RodParameters(torch.nn.Module):
    """Stiffnesses of a simulator's rods over those it was built with: positive factors, learned as logarithms.

    Args:
        simulator: whose rods they are.
        batch: worlds that have factors of their own; by default all share one.
        names: which are learned, among "stretching" (EA), "bending" (EI, in both directions) and "twisting" (GJ).

    Raises:
        SceneError: the model has no rods, or none with such a stiffness.
    """

    def __init__(
        self, simulator, batch: int | None = None, names: tuple[str, ...] = ("stretching", "bending", "twisting")
    ):
        super().__init__()
        found = _stiffnesses(simulator.model)
        for name in names:
            if name not in found:
                raise SceneError(f"RodParameters: no rod has {name!r}; there is {', '.join(found) or 'no rod'}")
        self.logarithms = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(torch.zeros((batch or 1, 1), dtype=torch.float64)) for name in names}
        )
        self._owned = {name: found[name] for name in names}
        # in one order, as DistributedDataParallel tells buffers of its processes apart by that
        for own in dict.fromkeys(each for owned in self._owned.values() for each in owned):
            self.register_buffer(parameter_key(own), simulator.parameter(own)[:1].clone())

    def forward(self) -> dict[str, torch.Tensor]:
        """Their values, as `Simulator.step` takes them."""
        return {
            own: getattr(self, parameter_key(own)) * self.logarithms[name].exp()
            for name, owned in self._owned.items()
            for own in owned
        }


def parameter_key(name: str) -> str:
    """Of a parameter, as a buffer."""
    return f"_{name.replace('.', '_')}"


def _stiffnesses(model) -> dict[str, list[str]]:
    """Parameters of a model's rods by what they resist."""
    terms = [term for group in model.groups for term in group.kind.terms]
    terms += [
        part.term for part in (model.net.sets if model.net is not None else ()) if part.term.name.startswith("rod")
    ]
    found: dict[str, list[str]] = {}
    for term in dict.fromkeys(terms):
        for own, strain in zip(term.stiffness, term.measure.strains, strict=False):
            kind = "stretching" if term.measure.span == 1 else "twisting" if strain.startswith("twist") else "bending"
            owned = found.setdefault(kind, [])
            if f"{term.name}.{own}" not in owned:
                owned.append(f"{term.name}.{own}")
    return found

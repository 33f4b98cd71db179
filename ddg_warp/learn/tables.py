"""Parameters of a model as tensors, and what its kernels read."""

import numpy as np
import torch
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels import outcome
from ddg_warp.learn import constants
from ddg_warp.learn.places import ArrayPlace, TermPlace
from ddg_warp.model.parameters import valid_numbers


class Tables:
    """Of a model: what its parameters are, how tensors are put in their place, and derivatives by them.

    Attributes:
        invalid: of every world the code of the outcome that one of its parameters is refused by, 0 where all are good (worlds,).
    """

    def __init__(self, model):
        self.model, self.device = model, str(wp.device_to_torch(model.wp_device))
        self._found, self._written, self._rules, self._full = {}, {}, {}, {}
        self.invalid = torch.zeros(model.worlds, dtype=torch.int32, device=self.device)

    def of(self, name: str) -> tuple[int, list[TermPlace | ArrayPlace]]:
        """How many elements have a parameter, and where it lies.

        Of "term.parameter" elements are counted rod by rod, those of clamped ends included, then through the element sets of the net;
        of others see `constants`.

        Raises:
            SceneError: nothing has it.
        """
        if not isinstance(name, str):
            raise SceneError(f"parameters: {name!r} is no name; this model has {', '.join(self.names())}")
        if name not in self._found:
            found = constants.array_places(self.model, name) if name in constants.NAMES else self._of_terms(name)
            if not found[1]:
                raise SceneError(f"parameters: nothing has {name!r}; this model has {', '.join(self.names())}")
            self._found[name] = found
        return self._found[name]

    def _of_terms(self, name: str) -> tuple[int, list[TermPlace]]:
        model, own = self.model, name.rpartition(".")
        start, groups = model.order.elements(name)
        found = [TermPlace(model, model.groups.index(g), True, name, rows, inside) for g, inside, rows in groups]
        for i, part in enumerate(model.net.sets if model.net is not None else ()):
            if part.term.name == own[0] and own[2] in part.parameters.values:
                found.append(TermPlace(model, i, False, name, start + np.arange(part.elements), None))
                start += part.elements
        return start, found

    def names(self) -> list[str]:
        """Names of all parameters, those of terms first."""
        model = self.model
        result = {name for group in model.groups for name in group.parameters.values}
        for part in model.net.sets if model.net is not None else ():
            result.update(f"{part.term.name}.{name}" for name in part.parameters.values)
        return sorted(result) + [name for name in constants.NAMES if constants.array_places(model, name)[1]]

    def full_of(self, name: str, values: torch.Tensor) -> list[torch.Tensor]:
        """As `full`; of a constant tensor that was handed in last as it is, what was found then."""
        if values.requires_grad or torch._C._are_functorch_transforms_active():
            return self.full(name, values)
        kept = self._full.get(name)
        if kept is None or kept[0] is not values or kept[1] != values._version:
            kept = self._full[name] = values, values._version, self.full(name, values)
        return kept[2]

    def full(self, name: str, values: torch.Tensor, judged: bool = False) -> list[torch.Tensor]:
        """A parameter of shape (), (B,), (E,) or (B, E) as each place has it with one number an element and world.

        Unless values have been `judged`, those that the parameter may not have are not numbers there; see `invalid`.
        """
        count, found = self.of(name)
        worlds, real = self.model.worlds, wp.dtype_to_torch(self.model.types.real)
        shape = tuple(values.shape)
        values = values if judged else torch.where(self._good(name, values), values, torch.nan)
        if shape == ():
            wide = values.expand(worlds, count)
        elif shape in ((worlds, 1), (1, count), (worlds, count), (1, 1)):
            wide = values.expand(worlds, count)
        elif shape == (worlds,) and worlds != count and worlds > 1:
            wide = values[:, None].expand(worlds, count)
        elif shape == (count,) and (worlds != count or worlds == 1):
            wide = values.expand(worlds, count)
        else:
            raise SceneError(
                f"parameters: {name} has shape {shape}; give (), ({worlds}, 1) for each world, (1, {count}) for each element, or "
                f"({worlds}, {count})"
            )
        wide = wide.to(device=self.device, dtype=real)
        # whether all elements are alike
        alike = values.shape[-1:] in ((), (1,)) or shape == (worlds,) != (count,)
        return [place.full(wide, alike) for place in found]

    def _good(self, name: str, values: torch.Tensor) -> torch.Tensor:
        """Whether values are finite and such as a parameter may have, each; nothing is read from the device."""
        _, holds = self.rule(name)
        values, finite = values.detach(), torch.isfinite(values)
        if holds is np.isfinite:
            return finite
        return finite & torch.as_tensor(holds(values), device=values.device)

    def rule(self, name: str) -> tuple:
        """What values of a parameter are, in words, and whether numbers are that."""
        if name not in self._rules:
            if name in constants.NAMES:
                self._rules[name] = constants.rule(name, self._usual(name))
            else:
                term, parameter = name.rsplit(".", 1)
                self._rules[name] = self.model.parameter_rule(term, parameter)
        return self._rules[name]

    def valid(self, name: str, values) -> np.ndarray:
        """Values of a parameter that there is as an array of numbers.

        Raises:
            ValueError: they are no numbers, not finite, or none that the parameter may have.
        """
        return valid_numbers(name, values, *self.rule(name))

    def value(self, name: str) -> torch.Tensor:
        """The values that the model has of a parameter (worlds, elements)."""
        real = wp.dtype_to_torch(self.model.types.real)
        return torch.tensor(self._usual(name), dtype=real, device=self.device)

    def _usual(self, name: str) -> np.ndarray:
        count, found = self.of(name)
        result = np.zeros((self.model.worlds, count))
        for place in found:
            elements, values = place.values()
            result[:, elements] = values
        return result

    def write(self, names: tuple, values: list[torch.Tensor]) -> None:
        """Put full parameters in place; what is there already stays, and others are as the model has them."""
        values, given, anew = iter(values), {}, False
        for name in names:
            for place in self.of(name)[1]:
                given.setdefault(place.key, []).append((place, next(values)))
        for (place, _), *_ in given.values():  # first, as this makes their memory anew
            if place.widen():
                self.model.layout += 1
                # with what it holds; other tables still hold what was written
                self._written = {
                    key: kept for key, kept in self._written.items() if kept[0][0].memory is not place.memory
                }
        for key in self._written.keys() - given.keys():  # back to what the model has
            self._written.pop(key)[0][0].restore()
            anew = True
        for key, entries in given.items():
            # the places and tensors that it holds, so that nothing else gets their ids
            kept = [(place, value, value._version) for place, value in entries]
            if not _alike(self._written.get(key, ()), kept):
                entries[0][0].put(entries)
                self._written[key], anew = kept, True
        if anew:
            self._judge()

    def restore(self) -> None:
        """Put back what the model has of all that was written."""
        for (place, *_), *_ in self._written.values():
            place.restore()
        self._written = {}
        self.invalid.zero_()

    def refuse_invalid(self) -> None:
        """Read from the device whether parameters are good.

        Raises:
            SceneError: one is not finite in a world, or none that it may be; names it.
        """
        for entries in self._written.values() if bool(self.invalid.any()) else ():
            for place, value, _ in entries:
                for world in torch.nonzero(self._bad(place, value)).flatten().tolist():
                    name = self._name_of(place)
                    raise SceneError(
                        f"parameters: {name} is refused in world {world}; give values that are finite and {self.rule(name)[0]}"
                    )

    def _name_of(self, place) -> str:
        return next(name for name, (_, places) in self._found.items() if any(own is place for own in places))

    def _judge(self) -> None:
        """Find the worlds in which a parameter that was written is not a number."""
        self.invalid.zero_()
        for entries in self._written.values():
            for place, value, _ in entries:
                self.invalid.masked_fill_(self._bad(place, value), outcome.INVALID_INPUT)

    def _bad(self, place, value: torch.Tensor) -> torch.Tensor:
        """Whether what was written to a place is not a number, in every world (worlds,)."""
        bad = torch.isnan(value)
        return bad.view(len(bad), self.model.worlds, -1).any(2).any(0) if place.chain else bad.any(1)

    @property
    def given(self) -> bool:
        """Whether anything is another than that of the model."""
        return bool(self._written)

    @property
    def weighs(self) -> bool:
        """Whether masses are other ones than those of the model."""
        return any(place.weighs for (place, *_), *_ in self._written.values())

    def axes(self, names: tuple) -> list[int]:
        """Axes along which the worlds of full parameters lie."""
        return [int(place.chain) for name in names for place in self.of(name)[1]]

    def pull(self, names: tuple, inputs: list, flags) -> list[torch.Tensor]:
        """Derivatives by full parameters, in the order of `write`."""
        return [place.pull(inputs, flags) for name in names for place in self.of(name)[1]]


def _alike(before: list, now: list) -> bool:
    """Whether tensors are those that were put in place, as they were then."""
    return len(before) == len(now) and all(
        a is x and b is y and version == z for (a, b, version), (x, y, z) in zip(before, now, strict=True)
    )

"""Parameters of a model as tensors: values, storage that kernels read, and gradients."""

import numpy as np
import torch
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.kernels.core import outcome
from ddg_warp.model.joint_drives import PARAMETERS
from ddg_warp.model.parameters import valid_numbers
from ddg_warp.torch import named_parameters, user_force_parameters
from ddg_warp.torch.parameter_storage import ArrayParameterView, TermParameterView

DRIVEN = {f"hinge.{parameter}": control for control, parameter in PARAMETERS.items()}  # controls of driven parameters


class ParameterTensors:
    """Parameters of a model: names and values, writes of tensors to storage, and gradients.

    Attributes:
        invalid: per world, the outcome code of a refused parameter; 0 if all are valid (worlds,).
    """

    def __init__(self, model):
        self.model, self.device = model, str(wp.device_to_torch(model.wp_device))
        self._found, self._written, self._rules, self._full = {}, {}, {}, {}
        self.invalid = torch.zeros(model.worlds, dtype=torch.int32, device=self.device)

    def of(self, name: str) -> tuple[int, list[TermParameterView | ArrayParameterView]]:
        """Return the number of elements with a parameter, and its storage.

        Elements of "term.parameter" are counted rod by rod, clamped ends included, then through the element sets of the coupled
        system; for others see `named_parameters`.

        Raises:
            SceneError: nothing has it.
        """
        if not isinstance(name, str):
            raise SceneError(f"parameters: {name!r} is no name; this model has {', '.join(self.names())}")
        if name not in self._found:
            if name in user_force_parameters.names(self.model):
                storage = user_force_parameters.array_views(self.model, name)
            elif name in named_parameters.NAMES:
                storage = named_parameters.array_views(self.model, name)
            else:
                storage = self._of_terms(name)
            if any(isinstance(view, TermParameterView) and view.prescribed for view in storage[1]):
                if name in DRIVEN:
                    raise SceneError(f"parameters: {name} drives hinges; give controls={{'{DRIVEN[name]}': tensor}}")
                raise SceneError(
                    f"parameters: {name} is prescribed by a field of the scene; give controls={{'fields': {{name: tensor}}}}"
                )
            if not storage[1]:
                near = argument_checks.nearest(name, self.names())
                raise SceneError(f"parameters: no object has {name!r}; this model has {', '.join(self.names())}{near}")
            self._found[name] = storage
        return self._found[name]

    def _of_terms(self, name: str) -> tuple[int, list[TermParameterView]]:
        model, name_parts = self.model, name.rpartition(".")
        start, groups = model.order.elements(name)
        storage = [
            TermParameterView(model, model.groups.index(g), True, name, rows, inside) for g, inside, rows in groups
        ]
        for i, part in enumerate(model.coupled.sets if model.coupled is not None else ()):
            if part.term.name == name_parts[0] and name_parts[2] in part.parameters.values:
                storage.append(TermParameterView(model, i, False, name, start + np.arange(part.elements), None))
                start += part.elements
        return start, storage

    def names(self) -> list[str]:
        """Return the names of all parameters, term parameters first."""
        model = self.model
        result = {name for group in model.groups for name in group.parameters.values}
        for part in model.coupled.sets if model.coupled is not None else ():
            result.update(f"{part.term.name}.{name}" for name in part.parameters.values)
        if model.drives.joints:
            result -= DRIVEN.keys()
        return sorted(result) + [
            *(name for name in named_parameters.NAMES if named_parameters.array_views(model, name)[1]),
            *user_force_parameters.names(model),
        ]

    def full_of(self, name: str, values: torch.Tensor) -> list[torch.Tensor]:
        """Return `full`, cached for a constant tensor passed unchanged again."""
        if values.requires_grad or torch._C._are_functorch_transforms_active():
            return self.full(name, values)
        kept = self._full.get(name)
        if kept is None or kept[0] is not values or kept[1] != values._version:
            kept = self._full[name] = values, values._version, self.full(name, values)
        return kept[2]

    def full(self, name: str, values: torch.Tensor, checked: bool = False) -> list[torch.Tensor]:
        """Return a parameter of shape (), (B,), (E,) or (B, E) for each storage, with one number per element and world.

        Invalid values become NaN, unless `checked`; see `invalid`.
        """
        count, storage = self.of(name)
        worlds, real = self.model.worlds, wp.dtype_to_torch(self.model.types.real)
        shape = tuple(values.shape)
        values = values if checked else torch.where(self._good(name, values), values, torch.nan)
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
        # True if all elements have one value
        alike = values.shape[-1:] in ((), (1,)) or shape == (worlds,) != (count,)
        return [place.full(wide, alike) for place in storage]

    def _good(self, name: str, values: torch.Tensor) -> torch.Tensor:
        """Return a mask of values that are finite and valid for a parameter; nothing is read from the device."""
        _, holds = self.rule(name)
        values, finite = values.detach(), torch.isfinite(values)
        if holds is np.isfinite:
            return finite
        return finite & torch.as_tensor(holds(values), device=values.device)

    def rule(self, name: str) -> tuple:
        """Return the rule for values of a parameter in words, and a function that tests values."""
        if name not in self._rules:
            if name in user_force_parameters.names(self.model):
                self._rules[name] = "a number", np.isfinite
            elif name in named_parameters.NAMES:
                self._rules[name] = named_parameters.rule(name, self._usual(name))
            else:
                term, parameter = name.rsplit(".", 1)
                self._rules[name] = self.model.parameter_rule(term, parameter)
        return self._rules[name]

    def valid(self, name: str, values) -> np.ndarray:
        """Return values of an existing parameter as an array of numbers.

        Raises:
            ValueError: values are no numbers, not finite, or invalid for the parameter.
        """
        return valid_numbers(name, values, *self.rule(name))

    def value(self, name: str) -> torch.Tensor:
        """Return the values of a parameter in the model (worlds, elements)."""
        real = wp.dtype_to_torch(self.model.types.real)
        return torch.tensor(self._usual(name), dtype=real, device=self.device)

    def _usual(self, name: str) -> np.ndarray:
        count, storage = self.of(name)
        result = np.zeros((self.model.worlds, count))
        for place in storage:
            elements, values = place.values()
            result[:, elements] = values
        return result

    def write(self, names: tuple, values: list[torch.Tensor]) -> None:
        """Write full parameters to storage; skip unchanged ones and restore all others to the values of the model."""
        values, entries_by_key, changed = iter(values), {}, False
        for name in names:
            for place in self.of(name)[1]:
                entries_by_key.setdefault(place.key, []).append((place, next(values)))
        for (place, _), *_ in entries_by_key.values():  # first, since this may reallocate memory
            if place.widen():
                self.model.layout += 1
                # forget values in the reallocated memory; other memory still has them
                self._written = {
                    key: kept for key, kept in self._written.items() if kept[0][0].memory is not place.memory
                }
        for key in self._written.keys() - entries_by_key.keys():  # back to the values of the model
            self._written.pop(key)[0][0].restore()
            changed = True
        for key, entries in entries_by_key.items():
            # keep storage and tensors alive, so that their ids are not reused
            kept = [(place, value, value._version) for place, value in entries]
            if not _alike(self._written.get(key, ()), kept):
                entries[0][0].put(entries)
                self._written[key], changed = kept, True
        if changed:
            self.find_invalid()

    def restore(self) -> None:
        """Restore all written parameters to the values of the model."""
        for (place, *_), *_ in self._written.values():
            place.restore()
        self._written = {}
        self.invalid.zero_()

    def refuse_invalid(self) -> None:
        """Refuse invalid parameters. Reads from the device.

        Raises:
            SceneError: names a parameter that is not finite or invalid in a world.
        """
        for entries in self._written.values() if bool(self.invalid.any()) else ():
            for place, value, _ in entries:
                for world in torch.nonzero(self._bad(place, value)).flatten().tolist():
                    name = self._name_of(place)
                    raise SceneError(
                        f"parameters: {name} is refused in world {world}; give values that are finite and {self.rule(name)[0]}"
                    )

    def _name_of(self, place) -> str:
        return next(name for name, (_, places) in self._found.items() if any(storage is place for storage in places))

    def find_invalid(self) -> None:
        """Find the worlds with NaN in a written parameter."""
        self.invalid.zero_()
        for entries in self._written.values():
            for place, value, _ in entries:
                self.invalid.masked_fill_(self._bad(place, value), outcome.INVALID_INPUT)

    def _bad(self, place, value: torch.Tensor) -> torch.Tensor:
        """Return a mask of worlds with NaN in the values written to a storage (worlds,)."""
        is_nan = torch.isnan(value)
        return is_nan.view(len(is_nan), self.model.worlds, -1).any(2).any(0) if place.is_rod_group else is_nan.any(1)

    @property
    def given(self) -> bool:
        """True if any parameter differs from the model."""
        return bool(self._written)

    @property
    def weighs(self) -> bool:
        """True if masses differ from the model."""
        return any(place.weighs for (place, *_), *_ in self._written.values())

    def axes(self, names: tuple) -> list[int]:
        """Return the world axes of full parameters."""
        return [int(place.is_rod_group) for name in names for place in self.of(name)[1]]

    def vjp(self, names: tuple, inputs: list, flags) -> list[torch.Tensor]:
        """Return the gradients by full parameters, in the order of `write`."""
        return [place.vjp(inputs, flags) for name in names for place in self.of(name)[1]]


def _alike(before: list, after: list) -> bool:
    """Return True if tensors and versions equal the record of the last write."""
    return len(before) == len(after) and all(
        a is x and b is y and version == z for (a, b, version), (x, y, z) in zip(before, after, strict=True)
    )

"""Recipe of a model: rebuild it with its parameters and rest shapes, with other worlds or in another process."""

import numpy as np

from ddg_warp.errors import SceneError


class ModelBuilder:
    """Scene, options, parameters and rest shapes of a model, for rebuilding it with `worlds` worlds on a device, by default its own.

    Raises:
        SceneError: a parameter differs between the model's worlds, and `worlds` is another number.
    """

    def __init__(self, model, worlds: int, device: str | None = None):
        self.scene = model.scene
        self.options = {
            "device": device or model.device,
            "precision": model.precision,
            "worlds": worlds,
            "allow_rounding": model.allow_rounding,
        }
        self.version = model.version
        model.fields.to(0.0)  # without controls, which may differ between worlds
        self.parameters = [
            {name: _in_worlds(name, values, axis, model.worlds, worlds) for name, values in table.values.items()}
            for table, axis in _tables(model)
        ]
        self.user_forces = [
            {name: _in_worlds(name, values, 0, model.worlds, worlds) for name, values in force.values.items()}
            for force in _user_forces(model)
        ]
        self.plates = [shell.plate for shell in _shells(model)]

    def build(self):
        """Build the model."""
        model = self.scene.build(**self.options)
        if self.version:  # else it is as it was built
            self.put(model)
        return model

    def put(self, model) -> None:
        """Copy parameters and rest shapes to a model of the same scene and number of worlds."""
        remade = False
        for (table, _), values in zip(_tables(model), self.parameters, strict=True):
            changed = {name: new for name, new in values.items() if not np.array_equal(table.values[name], new)}
            remade |= bool(changed) and table.set(**changed)
        for force, values in zip(_user_forces(model), self.user_forces, strict=True):
            for name, new in values.items():
                force.set(name, new if len(new) == model.worlds else new[0])
        for shell, plate in zip(_shells(model), self.plates, strict=True):
            shell.plate = plate
        model.note_change(remade)


def _tables(model) -> list:
    """Return parameter tables of rod groups and element sets, each with its axis of worlds."""
    sets = model.coupled.sets if model.coupled is not None else ()
    return [(group.parameters, 1) for group in model.groups] + [(part.parameters, 0) for part in sets]


def _user_forces(model) -> list:
    return model.coupled.user_forces if model.coupled is not None else []


def _shells(model) -> list:
    return model.coupled.host.shells if model.coupled is not None else []


def _in_worlds(name: str, values: np.ndarray, axis: int, worlds: int, wanted: int) -> np.ndarray:
    """Convert a parameter of `worlds` worlds to `wanted` worlds."""
    if worlds == wanted or values.shape[axis] == 1:
        return values
    of_worlds = np.stack(np.split(values, worlds, axis))
    if (of_worlds != of_worlds[0]).any():
        raise SceneError(
            f"the parameter {name} differs between the {worlds} worlds of the model, so that those of {wanted} worlds are not known; "
            "give it as a tensor, or build the model with as many worlds"
        )
    return np.concatenate([of_worlds[0]] * wanted, axis)

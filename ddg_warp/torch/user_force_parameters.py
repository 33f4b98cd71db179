"""Parameters of user-defined forces as tensors: `name.parameter`, by node; vectors have three elements a node."""

import numpy as np
import torch

from ddg_warp.torch.state_layout import view


def names(model) -> list[str]:
    """Return the names of all parameters of user-defined forces."""
    forces = model.coupled.user_forces if model.coupled is not None else ()
    return [f"{force.name}.{name}" for force in forces for name in force.values]


def array_views(model, name: str) -> tuple[int, list["UserForceParameterView"]]:
    """Return the number of elements of a parameter, and its storage."""
    force_name, _, parameter = name.partition(".")
    index = next(i for i, force in enumerate(model.coupled.user_forces) if force.name == force_name)
    storage = UserForceParameterView(model, index, parameter)
    return storage.size, [storage]


class UserForceParameterView:
    """Storage of a parameter of a user-defined force; attributes as of `ArrayParameterView`."""

    is_rod_group = weighs = False

    def __init__(self, model, index: int, name: str):
        self.model, self.index, self.name, self.force = model, index, name, model.coupled.user_forces[index]
        self.key, self.memory, self._columns = ("user force", index, name), self, self.force.columns(name)
        self._view = view(self.force.numbers)[..., self._columns]
        self.size = self._view[0].numel()

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """Return element numbers, and values (W, elements) of the model."""
        return np.arange(self.size), self.force.values[self.name].reshape(self.model.worlds, -1)

    def full(self, wide: torch.Tensor, alike: bool) -> torch.Tensor:
        """Return values (W, elements) in storage layout."""
        return wide

    def widen(self) -> bool:
        """Return False: storage always has a value per world and node."""
        return False

    def put(self, entries: list) -> None:
        """Write the single (storage, tensor) pair to memory."""
        self._view.copy_(entries[0][1].reshape(self._view.shape))

    def restore(self) -> None:
        """Write the values of the model back."""
        self._view.copy_(torch.as_tensor(self.values()[1]).reshape(self._view.shape))

    def vjp(self, inputs: list, flags) -> torch.Tensor:
        """Return the gradient by the values written."""
        gradient = view(inputs[-1].user_forces[self.index])[..., self._columns]
        return gradient.reshape(self.model.worlds, -1) * flags[-1][:, None]

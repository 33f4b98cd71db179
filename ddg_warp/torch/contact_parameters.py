"""Named contact parameters; see `ddg_warp.torch.named_parameters`."""

import numpy as np
import torch

from ddg_warp.errors import SceneError
from ddg_warp.kernels.adjoint.contact import FRICTION, RANGE, STIFFNESS
from ddg_warp.torch.state_layout import view

ROWS = {"contact.stiffness": STIFFNESS, "contact.range": RANGE, "contact.friction": FRICTION}
RADIUS = "contact.radius"
NAMES = (*ROWS, RADIUS)
ROUNDING = 1e-6  # relative excess of an activation distance over the search distance that is accepted


def contact_elements(model, name: str) -> list:
    """Return the owners of a contact parameter, in the order of its values.

    They are pairs of object names, or labels of bodies; an empty list without contact.
    """
    contact = model.coupled.host.contact_parameters if model.coupled is not None else None
    if contact is None or (name == "contact.friction" and not contact.has_friction):
        return []
    if name == RADIUS:
        return [contact.bodies[i].label for i in _round(contact)]
    return [(contact.names[g], contact.names[h]) for g, h in zip(*contact.meeting, strict=True)]


def sized(model, shells: bool) -> dict[int, int]:
    """Return {row of "contact.radius": shell index} of bodies whose radius follows from a rod section or a shell thickness."""
    contact = model.coupled.host.contact_parameters if model.coupled is not None else None
    if contact is None:
        return {}
    bodies = [contact.bodies[i] for i in _round(contact)]
    derived = [i for i, body in enumerate(bodies) if not body.still and body.name not in contact.law.radius]
    return {i: bodies[i].shell for i in derived if (bodies[i].shell >= 0) == shells}


def _round(contact) -> np.ndarray:
    """Return the bodies that have a radius or thickness."""
    return np.flatnonzero(contact.numbers["radius"] > 0.0)


class ContactParameterView:
    """Storage of a contact parameter in the arrays that collision detection and contact terms of the coupled system read.

    Attributes: see `TermParameterView`.
    """

    is_rod_group = weighs = False

    def __init__(self, model, name: str):
        contact, coupled = model.coupled.host.contact_parameters, model.coupled
        self.model, self.name, self.memory, self.key = model, name, self, ("contact", name)
        parameter = name.partition(".")[2]
        self._view, usual = view(coupled.contact_parameters[parameter]), contact.numbers[parameter]
        self._search_distance = contact.search_distance * (1.0 + ROUNDING)
        indices = (_round(contact),) if name == RADIUS else contact.meeting
        self._usual = np.tile(usual[indices], (model.worlds, 1))
        self._at = [torch.as_tensor(index, device=self._view.device) for index in indices]

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """Return element numbers and values (W, E) of the model."""
        return np.arange(self._usual.shape[1]), self._usual

    def full(self, wide: torch.Tensor, alike: bool) -> torch.Tensor:
        """Return values (W, E) in storage layout."""
        return wide

    def widen(self) -> bool:
        """Return False: storage always has a value per world."""
        return False

    def put(self, entries: list) -> None:
        """Write the tensor of the single (storage, tensor) pair.

        Raises:
            SceneError: an activation distance exceeds the search distance; this check reads from the device.
        """
        ((_, values),) = entries
        if self.name == "contact.range" and bool((values > self._search_distance).any()):
            world, pair = (int(i) for i in torch.nonzero(values > self._search_distance)[0])
            one, second = contact_elements(self.model, self.name)[pair]
            raise SceneError(
                f"parameters: contact.range of {one!r} and {second!r} is {float(values[world, pair]):.6g} m in world {world}, beyond "
                f"the search distance {self._search_distance:.6g} m; build the scene with the largest range in use"
            )
        usual = torch.as_tensor(self._usual, dtype=values.dtype, device=values.device)
        # Collision detection runs over all worlds at once, refused ones included.
        self._assign(torch.where(torch.isnan(values), usual, values))

    def restore(self) -> None:
        """Write the values of the model back."""
        self._assign(torch.as_tensor(self._usual, dtype=self._view.dtype, device=self._view.device))

    def vjp(self, inputs: list, flags) -> torch.Tensor:
        """Return the gradient with respect to the values written."""
        if self.name == RADIUS:
            (bodies,) = self._at
            return view(inputs[-1].radius)[:, bodies] * flags[-1][:, None]
        first, second = self._at
        gradient = view(inputs[-1].contact_parameters)[ROWS[self.name]]
        transposed = torch.where(first == second, 0.0, gradient[:, second, first])
        return (gradient[:, first, second] + transposed) * flags[-1][:, None]

    def _assign(self, values: torch.Tensor) -> None:
        if self.name == RADIUS:
            self._view[:, self._at[0]] = values
        else:
            first, second = self._at
            self._view[:, first, second] = values
            self._view[:, second, first] = values

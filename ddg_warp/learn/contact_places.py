"""Numbers of contact as parameters by name; see `ddg_warp.learn.constants`."""

import numpy as np
import torch

from ddg_warp.errors import SceneError
from ddg_warp.kernels.adjoint.contact import FRICTION, RANGE, STIFFNESS
from ddg_warp.learn.layout import view

ROWS = {"contact.stiffness": STIFFNESS, "contact.range": RANGE, "contact.friction": FRICTION}
RADIUS = "contact.radius"
NAMES = (*ROWS, RADIUS)
ROUNDING = 1e-6  # by which a range may exceed what is searched


def contact_elements(model, name: str) -> list:
    """What has such a number, in the order of its values: pairs of names of objects, or labels of bodies; nothing without contact."""
    given = model.net.host.touching if model.net is not None else None
    if given is None or (name == "contact.friction" and not given.rubs):
        return []
    if name == RADIUS:
        return [given.bodies[i].label for i in _round(given)]
    return [(given.names[g], given.names[h]) for g, h in zip(*given.meeting, strict=True)]


def sized(model, shells: bool) -> dict[int, int]:
    """Of the values of "contact.radius" those that sections of rods, or thicknesses of shells, tell, and of which shell each is."""
    given = model.net.host.touching if model.net is not None else None
    if given is None:
        return {}
    bodies = [given.bodies[i] for i in _round(given)]
    told = [i for i, body in enumerate(bodies) if not body.still and body.name not in given.law.radius]
    return {i: bodies[i].shell for i in told if (bodies[i].shell >= 0) == shells}


def _round(given) -> np.ndarray:
    """Bodies that have a radius, or a thickness."""
    return np.flatnonzero(given.numbers["radius"] > 0.0)


class ContactPlace:
    """A number of contact, in the arrays that all searches and terms of a net read; attributes as of `TermPlace`."""

    chain = weighs = False

    def __init__(self, model, name: str):
        given, net = model.net.host.touching, model.net
        self.model, self.name, self.memory, self.key = model, name, self, ("contact", name)
        own = name.partition(".")[2]
        self._view, usual = view(net.touching[own]), given.numbers[own]
        self._reach = given.reach * (1.0 + ROUNDING)
        at = (_round(given),) if name == RADIUS else given.meeting
        self._usual = np.tile(usual[at], (model.worlds, 1))
        self._at = [torch.as_tensor(index, device=self._view.device) for index in at]

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """As of `TermPlace`."""
        return np.arange(self._usual.shape[1]), self._usual

    def full(self, wide: torch.Tensor, alike: bool) -> torch.Tensor:
        """As of `TermPlace`."""
        return wide

    def widen(self) -> bool:
        """It has numbers of every world."""
        return False

    def put(self, given: list) -> None:
        """Put the tensor of the one (place, tensor).

        Raises:
            SceneError: a range is larger than what is searched, which is read from the device.
        """
        ((_, values),) = given
        if self.name == "contact.range" and bool((values > self._reach).any()):
            world, pair = (int(i) for i in torch.nonzero(values > self._reach)[0])
            one, other = contact_elements(self.model, self.name)[pair]
            raise SceneError(
                f"parameters: contact.range of {one!r} and {other!r} is {float(values[world, pair]):.6g} m in world {world}, but what "
                f"may touch is searched for within {self._reach:.6g} m; build the scene with the largest range that is to be used"
            )
        usual = torch.as_tensor(self._usual, dtype=values.dtype, device=values.device)
        # Searches are of all worlds, refused ones among them.
        self._assign(torch.where(torch.isnan(values), usual, values))

    def restore(self) -> None:
        """As of `TermPlace`."""
        self._assign(torch.as_tensor(self._usual, dtype=self._view.dtype, device=self._view.device))

    def pull(self, inputs: list, flags) -> torch.Tensor:
        """As of `TermPlace`."""
        if self.name == RADIUS:
            (bodies,) = self._at
            return view(inputs[-1].radius)[:, bodies] * flags[-1][:, None]
        first, second = self._at
        found = view(inputs[-1].touching)[ROWS[self.name]]
        other = torch.where(first == second, 0.0, found[:, second, first])
        return (found[:, first, second] + other) * flags[-1][:, None]

    def _assign(self, values: torch.Tensor) -> None:
        if self.name == RADIUS:
            self._view[:, self._at[0]] = values
        else:
            first, second = self._at
            self._view[:, first, second] = values
            self._view[:, second, first] = values

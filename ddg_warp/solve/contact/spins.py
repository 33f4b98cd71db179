"""How far objects have turned whose surfaces friction takes along where their nodes stay; see `kernels.contact.spins`."""

import numpy as np
import warp as wp

from ddg_warp.kernels.contact.spins import MARKERS, spin_kernels


class Spins:
    """Objects of a `BroadPhase` that spin, if any.

    Attributes:
        any: whether there are some; places: of each object its first node and its markers, below zero of others (objects,), none
            without any.
        turned: of all objects in all worlds (worlds, objects) [rad], zero of those that do not; see `kernels.contact.spins`.
    """

    def __init__(self, search):
        shapes, real, self.device = search.shapes, search.real, search.device
        self.any, self._nodes = bool(shapes.spinning), len(shapes.points)
        self._spinning = shapes.spinning
        places = np.full((len(shapes.names) if self.any else 0, 1 + MARKERS), -1, np.int32)
        for number, nodes in shapes.spinning.items():
            places[number] = nodes
        self.places = wp.array(places, dtype=wp.vec4i, device=self.device)
        self.turned = wp.zeros((search.worlds, len(places)), dtype=wp.types.vector(3, real), device=self.device)
        self._turn, self._pull = spin_kernels(real)
        self.kernels = [self._turn, self._pull] if self.any else []

    def __call__(self, start: wp.array, x: wp.array) -> None:
        """How far they turned from positions at the start to x."""
        if self.any:
            self._launch(self._turn, [start, x], [self.turned])

    def pull(self, start: wp.array, x: wp.array, by: wp.array, outputs: list[wp.array]) -> None:
        """From derivatives `by` components of `turned` and radii (4, worlds, objects) add those by positions, both, and radii."""
        self._launch(self._pull, [start, x, by], outputs)

    def forces(self, x: wp.array, frictions: list) -> np.ndarray:
        """Forces on nodes (W N, 3) [N] at x that have the couples of `FrictionElements` as evaluated last. Reads from the device."""
        out = np.zeros((len(x), 3))
        if not self.any:
            return out
        at = x.numpy().astype(float)
        couples = sum(part.couples() for part in frictions)
        for number, nodes in self._spinning.items():
            for world, couple in enumerate(couples[:, number]):
                first, *markers = nodes + world * self._nodes
                arms = at[markers] - at[first]
                # sum of arms x forces is the couple
                pushes = np.cross(couple, arms) * (0.5 * len(arms) / (arms**2).sum())
                out[markers] += pushes
                out[first] -= pushes.sum(0)
        return out

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.turned.shape, [self.places, self._nodes, *inputs], outputs, device=self.device)

"""Rotating surfaces: rotation of obstacles whose nodes stay, for friction; see `kernels.collision.friction.surface_rotation`."""

import numpy as np
import warp as wp

from ddg_warp.kernels.collision.friction.surface_rotation import MARKERS, spin_kernels


class RotatingSurfaces:
    """Rotating surfaces of a `BroadPhase`, if any.

    Attributes:
        any: True if there are some.
        `places`: first node and markers of each object (objects,), negative for objects at rest; empty without rotating surfaces.
        `turned`: rotation vectors of all objects (worlds, objects) [rad], zero at rest; see
            `kernels.collision.friction.surface_rotation`.
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
        self._turn, self._vjp = spin_kernels(real)
        self.kernels = [self._turn, self._vjp] if self.any else []

    def __call__(self, start: wp.array, x: wp.array) -> None:
        """Write the rotations from positions at the start to x."""
        if self.any:
            self._launch(self._turn, [start, x], [self.turned])

    def vjp(self, start: wp.array, x: wp.array, cotangent: wp.array, outputs: list[wp.array]) -> None:
        """Add cotangents of positions (start, x) and radii, given cotangents of `turned` and radii (4, worlds, objects)."""
        self._launch(self._vjp, [start, x, cotangent], outputs)

    def forces(self, x: wp.array, frictions: list) -> np.ndarray:
        """Return nodal forces (W N, 3) [N] at x with the torques of `FrictionSet`, as evaluated last. Reads from the device."""
        out = np.zeros((len(x), 3))
        if not self.any:
            return out
        positions = x.numpy().astype(float)
        couples = sum(friction.couples() for friction in frictions)
        for number, nodes in self._spinning.items():
            for world, couple in enumerate(couples[:, number]):
                first, *markers = nodes + world * self._nodes
                arms = positions[markers] - positions[first]
                # the sum of arms x forces is the torque
                pushes = np.cross(couple, arms) * (0.5 * len(arms) / (arms**2).sum())
                out[markers] += pushes
                out[first] -= pushes.sum(0)
        return out

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.turned.shape, [self.places, self._nodes, *inputs], outputs, device=self.device)

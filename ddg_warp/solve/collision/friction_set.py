"""Friction on lagged contact pairs: memory and launches of `kernels.collision.friction.potential`."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.contact.assembly import ANGLES, BODIES
from ddg_warp.kernels.collision.friction.potential import ROWS, friction_kernel, lag_kernel, lagged_struct
from ddg_warp.kernels.densities import Density
from ddg_warp.solve.collision.collision_mesh import CollisionMesh
from ddg_warp.solve.collision.collision_set import CollisionSet
from ddg_warp.solve.collision.contact_set import ContactSet
from ddg_warp.solve.collision.surface_rotation import RotatingSurfaces


class FrictionSet(CollisionSet):
    """Friction of the pairs of one list, with lists of their own, which later searches leave alone; see `ContactPotential`.

    Args:
        contact: contact of the same pairs; nodes, silent: as of `CollisionSet`.
        velocity: stick threshold [m/s].
        coefficients: by groups, coefficients over `friction` forwards, backwards and across (groups, groups, 3), see `lag_kernel`.
            None: isotropic friction.
        shapes: collision mesh; spins: rotation of its objects since slips started.

    Attributes:
        directions: neighbour nodes of first primitives (primitives, 2) and coefficients on the device, if needed, else None.
        work: of each pair (capacity,) [J], by the slip of the last `evaluate`.
    """

    def __init__(
        self,
        contact: ContactSet,
        density: Density,
        velocity: float,
        coefficients: np.ndarray | None,
        shapes: CollisionMesh,
        spins: RotatingSurfaces,
        nodes: int,
        real,
        linear,
        silent: wp.array,
    ):
        candidates, kind = contact.found, contact.found.kind
        angles = [shapes.angles(primitives.size) for primitives in (candidates.first, candidates.second)]
        rolls, rotations = any((each >= 0).any() for each in angles), shapes.body_rotations
        super().__init__(candidates, ROWS, nodes, real, linear, silent, rolls, bool((rotations >= 0).any()))
        self._contact, self._velocity, self._spins = contact, velocity, spins
        variant = coefficients is not None, spins.any, self.rolls, self.rotates
        self._lag = lag_kernel(kind, real, linear, *variant)
        self._evaluate = friction_kernel(density, real, linear, *variant)
        self._rows, neighbours = ROWS + (coefficients is not None), None
        if coefficients is not None:
            coefficients = wp.array(coefficients, dtype=wp.types.vector(3, real), device=self.device)
        if coefficients is not None or self.rolls:
            neighbours = self._upload(shapes.beside(candidates.first.size))
        self.directions = neighbours, coefficients
        self.angles = [self._upload(each) if self.rolls else None for each in angles]
        rotations = rotations.astype(np.int32) if self.rotates else np.zeros(0, np.int32)
        self._body_rotations = wp.array(rotations, dtype=int, device=self.device)
        self.kernels += [self._lag, self._evaluate]
        self._onward = 0
        self._kept = ("count", "starts", "partners")
        self.lagged = lagged_struct(real)()
        self.reserve()

    def reserve(self) -> None:
        """Make room as `CollisionSet.reserve`; lagged data is lost."""
        super().reserve()
        for name in self._kept:
            getattr(self, name).zero_()
        capacity = self.found.capacity
        pair = wp.types.vector(2, self.real)
        self._slip, self._along = (device_arrays.allocate((2, capacity), pair, self.device) for _ in range(2))
        self.work, self.lagged.bound = (wp.zeros(capacity, dtype=self.real, device=self.device) for _ in range(2))
        self.lagged.weight = wp.zeros(capacity, dtype=wp.types.vector(4, self.real), device=self.device)
        vector = wp.types.vector(3, self.real)
        self.lagged.tangent = device_arrays.allocate((self._rows, capacity), vector, self.device)
        spinning = capacity if self._spins.any else 0
        self.lagged.spinning = wp.zeros(spinning, dtype=int, device=self.device)
        self.lagged.arm = wp.zeros(spinning, dtype=vector, device=self.device)
        self.lagged.lever = device_arrays.allocate((ANGLES, capacity if self.rolls else 0), vector, self.device)
        rotating, radii = capacity if self.rotates else 0, wp.types.vector(BODIES, self.real)
        self.lagged.normal = wp.zeros(rotating, dtype=vector, device=self.device)
        self.lagged.radii = wp.zeros(rotating, dtype=radii, device=self.device)

    def lag(self, law, x: wp.array, again: bool, more: wp.array) -> None:
        """Copy the active contact pairs as evaluated last, at x; `again`: within a solve, with the directions of slips.

        `more`: added to normal forces (worlds,) [N].
        """
        self._onward = int(again)
        contact = self._contact
        inputs = [
            contact.pairs,
            contact.count,
            self.found.sides,
            law,
            x,
            *self.directions,
            self._spins.places,
            *self.angles,
            self._body_rotations,
        ]
        inputs += [contact.factor, contact.gradient, self._onward, more, self.count]
        outputs = [self.pairs, self.factor, self.lagged, self._slip, self._along]
        self._take_turns(self._lag, self.found.capacity, inputs, outputs)
        for name in self._kept:
            wp.copy(getattr(self, name), getattr(contact, name))
        self._items.list(self.count, self.factor)

    def evaluate(self, x, start, rate: wp.array, iterates: tuple) -> None:
        """Write energies, work, gradients and factors at x for the slip since `start` and rotations of objects."""
        inputs = [self.pairs, self.count, self.found.first.count]
        inputs += [self.lagged, self._velocity, rate, *iterates, self._onward, x, start, self._spins.turned.flatten()]
        outputs = [self._slip, self._along, self.factor, self.energy, self.work, self.gradient]
        self._take_turns(self._evaluate, self.found.capacity, inputs, outputs)

    def _upload(self, values: np.ndarray) -> wp.array:
        return device_arrays.upload(values.astype(np.int32), wp.vec2i, self.device)

    def couples(self) -> np.ndarray:
        """Return the torques of pairs on rotating objects (worlds, objects, 3) [N m], as evaluated last. Reads from the device."""
        used, forces = self.forces()
        spinning, (worlds, objects) = self.lagged.spinning.numpy()[used], self._spins.turned.shape
        result = np.zeros((worlds * objects, 3))
        np.add.at(result, spinning[spinning >= 0], np.cross(self.lagged.arm.numpy()[used], forces)[spinning >= 0])
        return result.reshape(worlds, objects, 3)

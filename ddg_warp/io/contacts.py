"""What touches what, as it is asked of a model, recorded and read back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# of each pair, and their shapes
FIELDS = {"world": (), "objects": (2,), "point": (3,), "gap": (), "force": (3,), "friction": (3,)}
LEAST, MOST = 1e-3, 10.0  # of the typical force, shares that are told apart
WHOLE = ("world", "objects")  # those that are whole numbers


@dataclass(frozen=True)
class Contacts:
    """Pairs of edges, points or triangles in contact at a state; see `Model.contacts`.

    Attributes:
        world: (n,) that each pair is in; objects: (n, 2), both their objects, places in `names`.
        names: of rods, shells and obstacles that may touch, such as "rod 3".
        point: between the closest points (n, 3) [m]; gap: (n,) [m].
        force: of contact, without friction, on the first object (n, 3) [N]; the second has its opposite.
        friction: on the first object (n, 3) [N], by the velocities of the state and its forces of contact; a step takes those forces
            as they were at its start. Of an equilibrium with friction it is by the way there; else nothing rubs in a state at rest.
    """

    world: np.ndarray
    objects: np.ndarray
    names: list[str]
    point: np.ndarray
    gap: np.ndarray
    force: np.ndarray
    friction: np.ndarray

    def __len__(self) -> int:
        return len(self.gap)


@dataclass(frozen=True)
class Touching:
    """What recordings of contact need to know; `Model.touching`.

    Attributes:
        names: of what may touch, as in `Contacts`.
        size: a typical radius [m]; force: a typical force of contact [N], the stiffness times the range.
    """

    names: list[str]
    size: float
    force: float

    def widths(self, force: np.ndarray) -> np.ndarray:
        """Diameters [m] (n,) of the balls by which forces (n, 3) are shown: their volume grows with the force."""
        share = np.linalg.norm(force, axis=-1) / self.force
        return 2.0 * self.size * np.cbrt(np.clip(share, LEAST, MOST))

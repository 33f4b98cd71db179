"""Contacts of a state: pairs in contact with gaps, points and forces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ddg_warp.typing import Floats, Integers

# fields of a pair, with their shapes
FIELDS = {"world": (), "objects": (2,), "point": (3,), "gap": (), "force": (3,), "friction": (3,)}
LEAST, MOST = 1e-3, 10.0  # bounds of displayed forces, over the typical force
WHOLE = ("world", "objects")  # fields of whole numbers


@dataclass(frozen=True)
class Contacts:
    """Pairs of edges, points or triangles in contact at a state; see `Model.contacts`.

    Attributes:
        world: world of each pair (n,); objects: both objects of each pair, as indices into `names` (n, 2).
        names: of rods, shells and obstacles with contact, such as "rod 3".
        point: midpoint of the closest points (n, 3) [m]; gap: (n,) [m].
        force: contact force without friction on the first object (n, 3) [N], opposite on the second.
        friction: friction force on the first object (n, 3) [N], from velocities and contact forces of the state. A step uses the
            contact forces at its start. Frictional equilibria depend on the load path; other states at rest have no friction.
    """

    world: Integers
    objects: Integers
    names: list[str]
    point: Floats
    gap: Floats
    force: Floats
    friction: Floats

    def __len__(self) -> int:
        return len(self.gap)


@dataclass(frozen=True)
class ContactScales:
    """Names and typical scales of contact, for recordings; `Model.contact_scales`.

    Attributes:
        names: of objects with contact, as in `Contacts`.
        size: a typical radius [m]; force: a typical contact force [N], stiffness times activation distance.
    """

    names: list[str]
    size: float
    force: float

    def widths(self, force: Floats) -> Floats:
        """Return the diameters [m] (n,) of balls that show forces (n, 3): the volume is proportional to the force."""
        ratio = np.linalg.norm(force, axis=-1) / self.force
        return 2.0 * self.size * np.cbrt(np.clip(ratio, LEAST, MOST))

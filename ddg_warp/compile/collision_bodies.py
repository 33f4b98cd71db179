"""Collision bodies of a scene and the contact parameters of pairs of groups."""

from dataclasses import dataclass, field

import numpy as np

from ddg_warp.kernels.densities import Density
from ddg_warp.scene.contact import Contact

ROD = "rod"


@dataclass
class Body:
    """Collision body: a rod, a shell, a shape of a rigid body, or an obstacle.

    Attributes:
        nodes, cells: nodes, and cells of nodes.
        kind, radius: kind of body and radius [m].
        name: name of the group; label: name in messages.
        shell, rigid: index of the shell or rigid body, -1 without.
        markers: carried nodes of a rotating surface; angles: twist angles of edges with rolling contact.
    """

    nodes: np.ndarray
    kind: str
    radius: float
    name: str
    label: str
    cells: np.ndarray | None = None
    closed: bool = False
    still: bool = False
    shell: int = -1
    rigid: int = -1
    markers: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    angles: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


@dataclass
class ContactParameters:
    """Contact of the coupled system.

    Attributes:
        law: contact description of the scene; bodies: collision bodies, obstacles last.
        density: contact law as a function of the distance; min_separation_fraction: fraction of the thickness that motion preserves.
        names: names of the groups with common parameters; group (bodies,): index of the group of each body.
        friction, stiffness [N/m], range [m]: parameters of pairs of groups (groups, groups).
        inertia: masses [kg] of pairs of groups (groups, groups). Divided by the step squared, they bound the stiffness of a step that
            ended at the minimum gap from below; zero for a given stiffness.
        ways: anisotropic friction multipliers for sliding forwards, backwards and across a rod (groups, groups, 3).
        ignored: pairs of groups without contact.
        roots: arc length from the first node of rods [m] that has no contact with other groups, by group of the rods.
    """

    law: Contact
    density: Density
    min_separation_fraction: float
    bodies: list[Body]
    names: list[str]
    group: np.ndarray
    friction: np.ndarray
    ways: np.ndarray
    stiffness: np.ndarray
    range: np.ndarray
    inertia: np.ndarray
    ignored: list[tuple[int, int]] = field(default_factory=list)
    roots: dict[int, tuple[float, list[int]]] = field(default_factory=dict)

    @property
    def numbers(self) -> dict[str, np.ndarray]:
        """Parameters that may differ per world, by name: of pairs of groups (groups, groups), and "radius" (bodies,)."""
        named = {name: getattr(self, name) for name in ("stiffness", "range", "friction")}
        return named | {"radius": np.array([body.radius for body in self.bodies])}

    @property
    def meeting(self) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of groups that may come into contact, as two index arrays."""
        moving = np.zeros(len(self.names), bool)
        moving[self.group[[not body.still for body in self.bodies]]] = True
        meet = np.triu(moving[:, None] | moving)
        for g, h in self.ignored:
            meet[min(g, h), max(g, h)] = False
        return np.nonzero(meet)

    @property
    def has_friction(self) -> bool:
        """True if there is friction."""
        return bool(self.friction.any())

    @property
    def search_distance(self) -> float:
        """Largest activation distance [m]."""
        return float(self.range.max())

    @property
    def size(self) -> float:
        """Median radius of bodies other than obstacles [m]."""
        return float(np.median([body.radius for body in self.bodies if not body.still]))

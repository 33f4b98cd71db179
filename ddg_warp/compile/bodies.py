"""What may touch what, and by which numbers."""

from dataclasses import dataclass, field

import numpy as np

from ddg_warp.scene.contact import Contact

ROD = "rod"


@dataclass
class Body:
    """A rod, shell or obstacle: nodes, kind, radius [m], name of its group, how messages call it, cells of nodes, which shell it
    is, -1 for none, the markers of one that spins, and the angles of the edges of one that friction may roll."""

    nodes: np.ndarray
    kind: str
    radius: float
    name: str
    label: str
    cells: np.ndarray | None = None
    closed: bool = False
    still: bool = False
    shell: int = -1
    markers: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    angles: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


@dataclass
class Touching:
    """Contact of a net.

    Attributes:
        law: what the scene says; bodies: what may touch, obstacles at last.
        names: of the groups that numbers are of, one a name; group (bodies,): number of that of each.
        friction, stiffness [N/m], range [m]: of two groups (groups, groups).
        inertia: masses [kg] of two groups (groups, groups); times the square of a rate the least stiffness of a step that had no room;
            zero where the stiffness is given.
        ways: what friction is multiplied by where a rod slides forwards, backwards and across (groups, groups, 3).
        ignored: pairs of groups that pass through each other.
    """

    law: Contact
    bodies: list[Body]
    names: list[str]
    group: np.ndarray
    friction: np.ndarray
    ways: np.ndarray
    stiffness: np.ndarray
    range: np.ndarray
    inertia: np.ndarray
    ignored: list[tuple[int, int]] = field(default_factory=list)

    @property
    def numbers(self) -> dict[str, np.ndarray]:
        """What may differ from world to world, by name: of two groups (groups, groups), and the "radius" of bodies (bodies,)."""
        named = {name: getattr(self, name) for name in ("stiffness", "range", "friction")}
        return named | {"radius": np.array([body.radius for body in self.bodies])}

    @property
    def meeting(self) -> tuple[np.ndarray, np.ndarray]:
        """Two groups each, of which something may touch."""
        moving = np.zeros(len(self.names), bool)
        moving[self.group[[not body.still for body in self.bodies]]] = True
        meet = np.triu(moving[:, None] | moving)
        for g, h in self.ignored:
            meet[min(g, h), max(g, h)] = False
        return np.nonzero(meet)

    @property
    def rubs(self) -> bool:
        """Whether there is friction."""
        return bool(self.friction.any())

    @property
    def reach(self) -> float:
        """Largest range [m]."""
        return float(self.range.max())

    @property
    def size(self) -> float:
        """Typical radius of what is not an obstacle [m]."""
        return float(np.median([body.radius for body in self.bodies if not body.still]))

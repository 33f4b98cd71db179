"""The net of a scene on the host: shells, joined rods and what they share, as blocks of three dofs and element sets.

Blocks are numbered nodes first, then angles (of rod edges, then of mesh edges), then rotations of rigid joints. See
`ddg_warp.compile.net.blocks` for how a scene becomes a net.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ddg_warp.compile import axisymmetric
from ddg_warp.compile import shells as shell_terms
from ddg_warp.compile.bodies import Touching
from ddg_warp.compile.loads import accumulate
from ddg_warp.compile.net.outwards import Outwards, outwards
from ddg_warp.compile.precision import float32_error, largest_carried, stiffnesses
from ddg_warp.compile.rods import Piece
from ddg_warp.compile.storage import Along, RodPlaces, Storage
from ddg_warp.compile.tolerance import Bodies
from ddg_warp.geometry import shell_forms
from ddg_warp.geometry.surface import Surface
from ddg_warp.scene import drag


@dataclass
class NetRod:
    """A rod of the net: blocks of its own nodes, angles of its own edges (indices of blocks; empty without twist)."""

    rod: int
    nodes: np.ndarray
    edges: np.ndarray
    first: int  # ghosts before its first node
    piece: Piece
    row: int  # of the piece
    all_nodes: np.ndarray  # with ghosts
    all_edges: np.ndarray

    @property
    def ends(self) -> np.ndarray:
        """Nodes of all its edges (E, 2), those of ghosts included."""
        pairs = np.column_stack([self.all_nodes, np.roll(self.all_nodes, -1)])
        return pairs if self.piece.kind.closed else pairs[:-1]


@dataclass
class NetShell:
    """A shell of the net: blocks of its vertices, block of the angle of each mesh edge (-1 without)."""

    surface: Surface
    nodes: np.ndarray
    edges: np.ndarray
    kinds: shell_forms.EdgeKinds
    supports: np.ndarray  # place among the scene's of the support that gives the normal at each mesh edge, -1 without
    plate: shell_terms.Plate
    corner_mass: np.ndarray  # a third of the mass of each triangle [kg]
    first: dict[str, int] = field(default_factory=dict)  # its first element in the set of each of its terms


@dataclass
class NetSet:
    """Elements of one term on blocks: slots (n, E), own lagged rows (m, E), data (d, E), parameters as of `ElementSet`.

    `owner` (2, E) is the rod or shell of each element, and its place in it: edge, vertex, triangle or hinge. `normals` (3, n) are
    element, first row of the data and support, counted over those of shells and then of rings, of every direction among the data
    that a support gives: the normal at a mesh edge, or the tangent of a meridian. Those `along` rods have the slots of as many nodes
    in a row as their measure spans edges, and one more, then the angles of these edges.
    """

    term: object
    slots: np.ndarray
    lag: np.ndarray
    data: np.ndarray
    parameters: dict[str, np.ndarray]
    owner: np.ndarray
    normals: np.ndarray = field(default_factory=lambda: np.zeros((3, 0), int))
    along: bool = False

    def __len__(self) -> int:
        return self.slots.shape[1]


@dataclass(kw_only=True, eq=False)
class Net(Storage):
    """A scene's net on the host: N blocks of three dofs.

    Attributes:
        rest: blocks at rest (N, 3): positions, then zeros.
        nodes, angles, spins: how many blocks of each kind; rod_edges: how many of the angles belong to rods.
        rods, shells, meridians: what the net was made from.
        sets: elements by term.
        ends: nodes of every rod edge (rod_edges, 2); frame: director and tangent of it (6, rod_edges).
        stiffness: EI1, EI2 and GJ of its section (3, rod_edges) [N m^2].
        mass: of every dof (N, 3) [kg, kg m^2]; fixed: held dofs (N, 3).
        obstacles: nodes of each, which are held; markers: three more of each that spins, as far from its first one as its radius, along
            x, y and z at rest; touching: contact, None without.
        frames: orthonormal rows (3, 3) that the held components of a node on an oblique plane refer to; see `compile.net.planes`.
    """

    rest: np.ndarray
    nodes: int
    angles: int
    spins: int
    rods: list[NetRod]
    shells: list[NetShell]
    sets: list[NetSet]
    ends: np.ndarray
    frame: np.ndarray
    stiffness: np.ndarray
    mass: np.ndarray
    fixed: np.ndarray
    meridians: list[axisymmetric.NetMeridian] = field(default_factory=list)
    obstacles: list[np.ndarray] = field(default_factory=list)
    markers: list[np.ndarray] = field(default_factory=list)
    touching: Touching | None = None
    frames: dict[int, np.ndarray] = field(default_factory=dict)

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.rest)

    @property
    def size(self) -> int:
        return self.blocks

    @property
    def of_obstacles(self) -> np.ndarray:
        """Nodes of all obstacles, markers included, which belong to no body."""
        return np.concatenate([np.zeros(0, int), *self.obstacles, *self.markers])

    @property
    def holds(self) -> np.ndarray:
        """Whether something of every dof in space is held (N, 3) bool."""
        result = self.fixed.copy()
        for block, frame in self.frames.items():
            result[block] = (np.abs(frame[self.fixed[block]]) > 1e-9).any(0)
        return result

    def holding(self, nodes: np.ndarray) -> np.ndarray:
        return self.fixed[nodes]

    @cached_property
    def places(self) -> RodPlaces:
        def each(value):
            return np.array([value(rod) for rod in self.rods], int)

        def along(lists):
            starts = np.cumsum([0, *map(len, lists)])[:-1] + each(lambda rod: rod.first)
            return Along(starts, table=np.concatenate([np.zeros(0, int), *lists]))

        return RodPlaces(
            rods=each(lambda rod: rod.rod),
            own=each(lambda rod: len(rod.nodes)),
            closed=each(lambda rod: rod.piece.kind.closed) > 0,
            twist=each(lambda rod: rod.piece.kind.twist) > 0,
            length=np.array([rod.piece.length[rod.row] for rod in self.rods]),
            nodes=along([rod.all_nodes for rod in self.rods]),
            angles=along([rod.all_edges for rod in self.rods]),
        )

    def fix(self, nodes: np.ndarray, along: list[int], angles: np.ndarray) -> None:
        self.fixed[nodes[:, None], along] = True
        self.fixed[angles, 0] = True

    def add_mass(self, places: np.ndarray, mass: float) -> None:
        accumulate(self.mass, places, np.full((len(places), 3), mass))

    def points(self, nodes: np.ndarray) -> np.ndarray:
        return self.rest[nodes]

    def edge_ends(self, angles: np.ndarray) -> np.ndarray:
        return self.ends[angles - self.nodes]

    def dofs(self, places: np.ndarray) -> np.ndarray:
        return 3 * places[..., None] + np.arange(3)

    def name(self, place: int) -> str:
        for rod in self.rods if place >= self.nodes else ():
            if place in rod.all_edges:
                return f"edge {int(np.argmax(rod.all_edges == place)) - rod.first} of rod {rod.rod}"
        return "the point at ({:g}, {:g}, {:g}) m".format(*self.rest[place])

    @cached_property
    def drag(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Edges that feel drag: their nodes (2, E), block of their angle (E,), -1 without, coefficients (rows, E); None without any."""
        found = []
        for rod in self.rods:
            if rod.piece.kind.drag:
                coefficients = rod.piece.drag[rod.row]
                ends = rod.ends[: len(coefficients)].T
                angles = rod.all_edges if rod.all_edges.size else np.full(len(coefficients), -1)
                found.append((ends, angles, coefficients.T))
        return tuple(np.concatenate(parts, -1) for parts in zip(*found, strict=True)) if found else None

    @cached_property
    def outwards(self) -> Outwards:
        """The order in which steps that turn edges place its rods."""
        held = self.fixed.all(1)
        for shell in (*self.shells, *self.meridians):
            held[shell.nodes] = True
        return outwards([rod.all_nodes for rod in self.rods], held)

    @cached_property
    def bodies(self) -> Bodies:
        """What its blocks belong to."""
        return Bodies(self)

    @cached_property
    def edges(self) -> np.ndarray:
        """Nodes of the edges whose turns limit a step (E, 2): of rods, meshes and meridians; of rods without twist, of all elements."""
        shells, meridians = (s.nodes[s.surface.edges] for s in self.shells), (m.ends for m in self.meridians)
        edges = np.concatenate([self.ends, *shells, *meridians])
        return edges if len(edges) else np.concatenate([part.slots[:2].T for part in self.sets])

    @cached_property
    def edge_lengths(self) -> np.ndarray:
        """Their lengths at rest (E,) [m]."""
        return np.linalg.norm(np.diff(self.rest[self.edges], axis=1)[:, 0], axis=1)

    @cached_property
    def pieces(self) -> list[tuple]:
        """Pieces of its rods, each with which of the rods it has, and their rows."""
        found = {}
        for number, rod in enumerate(self.rods):
            found.setdefault(id(rod.piece), (rod.piece, []))[1].append((number, rod.row))
        return [(piece, *np.array(rows).T) for piece, rows in found.values()]

    def rod_stiffnesses(self, s: float) -> np.ndarray:
        """Stiffnesses of every rod over a step of s [s] (3, rods), by the parameters of the scene; see `precision.stiffnesses`."""
        found = np.empty((3, len(self.rods)))
        for p, rods, rows in self.pieces:
            parameters = {name: v.T for name, v in p.parameters.items()}
            found[:, rods] = np.array(stiffnesses(p.kind, inert_mass(p, s), p.length, parameters, s))[:, rows]
        return found

    def split_errors(self, found: np.ndarray) -> np.ndarray:
        """What float32 makes of rods with such stiffnesses (3, W rods) where tensions are unknowns; infinite where they cannot be, of
        more than one stretch."""
        _, bending, softest = found
        errors = float32_error(np.maximum(bending, largest_carried(softest.min(initial=np.inf))), softest)
        kinds = (rod.piece.kind for rod in self.rods)
        splits = np.array([kind.edge_strains == kind.tensions == 1 for kind in kinds], bool)
        return np.where(np.resize(splits, errors.shape), errors, np.inf)

    def shell_errors(self, s: float) -> np.ndarray:
        """The same of shells (shells,): their membrane against inertia over a step and the lowest bending mode of a plate."""
        errors = []
        for shell in self.shells:
            plate, nodes = shell.plate, len(shell.nodes)
            area, membrane = plate.area.sum(), plate.young * plate.thickness / (1.0 - plate.poisson**2)
            bending = (membrane * plate.thickness**2).min() / 12.0 * (np.pi**4 / area**2) * (area / nodes)
            errors.append(float32_error(membrane.max(), self.mass[shell.nodes].mean() / s**2 + bending))
        return np.array(errors, float)

    @property
    def rod_edges(self) -> int:
        """Angles that belong to rod edges; they come first."""
        return len(self.ends)


def inert_mass(piece, s: float) -> np.ndarray:
    """Mean mass of the nodes of every rod of a piece (R,) [kg], with what drag resists over a step of s [s]."""
    mass = piece.mass.mean(1)
    if piece.kind.drag:
        mass = mass + s * drag.least(piece.drag) * piece.length / piece.mass.shape[1]
    return mass

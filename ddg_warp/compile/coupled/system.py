"""Coupled system of a scene on the host: dof blocks and element sets of shells and coupled rods.

Dof blocks are numbered nodes first, then angles (of rod edges, then of mesh edges), then rotations of rigid joints.
`ddg_warp.compile.coupled.builder` compiles them.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ddg_warp.compile import axisymmetric
from ddg_warp.compile import shells as shell_terms
from ddg_warp.compile.collision_bodies import ContactParameters
from ddg_warp.compile.coupled.rigid_bodies import RigidBodyArrays
from ddg_warp.compile.coupled.rod_ordering import RodOrder, rod_order
from ddg_warp.compile.dof_map import DofStorage, RodDofMap, RodIndexMap
from ddg_warp.compile.loads import accumulate
from ddg_warp.compile.precision import float32_error, largest_carried, stiffnesses
from ddg_warp.compile.residual_tolerance import ToleranceBodies
from ddg_warp.compile.rods import RodArrays
from ddg_warp.geometry import fundamental_forms
from ddg_warp.geometry.surface import Surface
from ddg_warp.scene import edge_forces


@dataclass
class CoupledRod:
    """Rod of the coupled system: dof blocks of nodes and of twist angles (empty without twist), ghosts excluded."""

    rod: int
    nodes: np.ndarray
    edges: np.ndarray
    first: int  # number of ghosts before the first node
    piece: RodArrays
    row: int  # row in the piece
    all_nodes: np.ndarray  # with ghosts
    all_edges: np.ndarray

    @property
    def ends(self) -> np.ndarray:
        """Nodes of all edges (E, 2), ghosts included."""
        pairs = np.column_stack([self.all_nodes, np.roll(self.all_nodes, -1)])
        return pairs if self.piece.kind.closed else pairs[:-1]


@dataclass
class CoupledShell:
    """Shell of the coupled system: dof blocks of vertices and of mesh-edge angles (-1 without)."""

    surface: Surface
    nodes: np.ndarray
    edges: np.ndarray
    kinds: fundamental_forms.EdgeKinds
    supports: np.ndarray  # index of the support that prescribes the normal at each mesh edge, -1 without
    plate: shell_terms.Plate
    corner_mass: np.ndarray  # a third of the mass of each triangle [kg]
    first: dict[str, int] = field(default_factory=dict)  # first element in the set of each term


@dataclass
class CoupledSet:
    """Element set of one term on dof blocks: lagged rows (m, E), data (d, E), parameters as in `ElementSet`.

    Attributes:
        slots: dof block of each local index (n, E).
        owner: rod or shell of each element, and the index of its edge, vertex, triangle or hinge (2, E).
        normals: (element, first row of data, support) of every direction that a support prescribes in the data (3, n): normals at
            mesh edges, tangents of meridians. Supports are numbered over shells, then rings.
        along: True for rod elements: consecutive nodes, one more than the edges of the measure, then the angles of these edges.
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
class CoupledSystem(DofStorage):
    """Coupled system of a scene on the host: N dof blocks of three components.

    Attributes:
        rest: dof blocks at rest (N, 3): positions, then zeros.
        nodes, angles, spins: number of dof blocks of each kind.
        rods, shells, meridians: members of the system.
        sets: element sets by term.
        ends: nodes of every rod edge (rod_edges, 2).
        frame: director and tangent of rod edges (6, rod_edges).
        stiffness: EI1, EI2 and GJ of rod edges (3, rod_edges) [N m^2].
        mass: of every dof (N, 3) [kg, kg m^2]; fixed: mask of fixed dofs (N, 3).
        obstacles: nodes of each obstacle, all fixed.
        markers: carried nodes of each rotating surface, at one radius from its first node along x, y and z at rest.
        contact_parameters: contact, None without.
        rigid_bodies: rigid bodies, None without.
        drag_triangles, shell_coefficients: triangles with drag (T, 3), and their coefficients (2, T); see `scene.drag.ShellDrag`.
        frames: nodal frames, orthonormal rows (3, 3), of nodes on skew supports, by node; see `compile.coupled.skew_supports`.
    """

    rest: np.ndarray
    nodes: int
    angles: int
    spins: int
    rods: list[CoupledRod]
    shells: list[CoupledShell]
    sets: list[CoupledSet]
    ends: np.ndarray
    frame: np.ndarray
    stiffness: np.ndarray
    mass: np.ndarray
    fixed: np.ndarray
    meridians: list[axisymmetric.CoupledMeridian] = field(default_factory=list)
    obstacles: list[np.ndarray] = field(default_factory=list)
    markers: list[np.ndarray] = field(default_factory=list)
    contact_parameters: ContactParameters | None = None
    frames: dict[int, np.ndarray] = field(default_factory=dict)
    rigid_bodies: RigidBodyArrays | None = None
    drag_triangles: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), int))
    shell_coefficients: np.ndarray = field(default_factory=lambda: np.zeros((2, 0)))

    @property
    def blocks(self) -> int:
        """Number of dof blocks."""
        return len(self.rest)

    @property
    def size(self) -> int:
        return self.blocks

    @property
    def of_obstacles(self) -> np.ndarray:
        """Nodes of all obstacles, carried nodes included, which belong to no body."""
        return np.concatenate([np.zeros(0, int), *self.obstacles, *self.markers])

    @property
    def holds(self) -> np.ndarray:
        """Mask of spatial dofs that a constraint involves (N, 3) bool."""
        result = self.fixed.copy()
        for block, frame in self.frames.items():
            result[block] = (np.abs(frame[self.fixed[block]]) > 1e-9).any(0)
        return result

    def holding(self, nodes: np.ndarray) -> np.ndarray:
        return self.fixed[nodes]

    @cached_property
    def places(self) -> RodDofMap:
        def each(value):
            return np.array([value(rod) for rod in self.rods], int)

        def along(lists):
            starts = np.cumsum([0, *map(len, lists)])[:-1] + each(lambda rod: rod.first)
            return RodIndexMap(starts, table=np.concatenate([np.zeros(0, int), *lists]))

        return RodDofMap(
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

    @property
    def quadratic(self) -> bool:
        """True if nodes have a quadratic potential; see `kernels.core.inertia`."""
        return any(rod.piece.kind.quadratic for rod in self.rods) or bool(len(self.drag_triangles))

    @cached_property
    def forced_edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (2, E), and angle block or -1 (E,), of the edges of rods with a quadratic potential."""
        ends, angles = [np.zeros((2, 0), int)], [np.zeros(0, int)]
        for rod in filter(lambda rod: rod.piece.kind.quadratic, self.rods):
            ends.append(rod.ends[: rod.piece.rotary.shape[1]].T)
            angles.append(rod.all_edges if rod.all_edges.size else np.full(ends[-1].shape[1], -1))
        return np.concatenate(ends, axis=1), np.concatenate(angles)

    @cached_property
    def coefficients(self) -> dict[str, np.ndarray]:
        """Coefficients of forces on `forced_edges` (rows, E) by name; see `scene.edge_forces`."""
        rods = [rod for rod in self.rods if rod.piece.kind.quadratic]
        return {
            name: np.concatenate([rod.piece.coefficients[name][rod.row].T for rod in rods], axis=-1)
            for name in (rods[0].piece.coefficients if rods else ())
        }

    @cached_property
    def rod_order(self) -> RodOrder:
        """Order of rods for edge-rotation updates."""
        anchors = self.fixed.all(1)
        for shell in (*self.shells, *self.meridians):
            anchors[shell.nodes] = True
        return rod_order([rod.all_nodes for rod in self.rods], anchors)

    @cached_property
    def bodies(self) -> ToleranceBodies:
        """Bodies of the residual tolerance."""
        return ToleranceBodies(self)

    @cached_property
    def edges(self) -> np.ndarray:
        """Nodes of edges under the rotation cap (E, 2): rods, meshes, meridians; without any, of all elements."""
        shells, meridians = (s.nodes[s.surface.edges] for s in self.shells), (m.ends for m in self.meridians)
        edges = np.concatenate([self.ends, *shells, *meridians])
        return edges if len(edges) or self.rigid_bodies else np.concatenate([part.slots[:2].T for part in self.sets])

    @cached_property
    def edge_lengths(self) -> np.ndarray:
        """Rest lengths of `edges` (E,) [m]."""
        lengths = np.linalg.norm(np.diff(self.rest[self.edges], axis=1)[:, 0], axis=1)
        return lengths if len(lengths) else np.array([self.bodies.shortest])

    @cached_property
    def pieces(self) -> list[tuple]:
        """(piece, rod numbers, rows) of all pieces."""
        members = {}
        for number, rod in enumerate(self.rods):
            members.setdefault(id(rod.piece), (rod.piece, []))[1].append((number, rod.row))
        return [(piece, *np.array(rows).T) for piece, rows in members.values()]

    def rod_stiffnesses(self, s: float) -> np.ndarray:
        """Return the stiffnesses of rods over a step of s [s] (3, rods), by the scene; see `precision.stiffnesses`."""
        result = np.empty((3, len(self.rods)))
        for p, rods, rows in self.pieces:
            parameters = {name: v.T for name, v in p.parameters.items()}
            result[:, rods] = np.array(stiffnesses(p.kind, inert_mass(p, s), p.length, parameters, s))[:, rows]
        return result

    def split_errors(self, values: np.ndarray) -> np.ndarray:
        """Return float32 errors of rods with stiffnesses (3, W rods) in the mixed axial-force formulation.

        Infinite for rods that it does not cover, with more than one stretch term.
        """
        _, bending, softest = values
        errors = float32_error(np.maximum(bending, largest_carried(softest.min(initial=np.inf))), softest)
        kinds = (rod.piece.kind for rod in self.rods)
        splits = np.array([kind.edge_strains == kind.tensions == 1 for kind in kinds], bool)
        return np.where(np.resize(splits, errors.shape), errors, np.inf)

    def shell_errors(self, s: float) -> np.ndarray:
        """Return float32 errors of shells (shells,): membrane against inertia over a step plus the lowest plate mode."""
        errors = []
        for shell in self.shells:
            plate, nodes = shell.plate, len(shell.nodes)
            area, membrane = plate.area.sum(), plate.young * plate.thickness / (1.0 - plate.poisson**2)
            bending = (membrane * plate.thickness**2).min() / 12.0 * (np.pi**4 / area**2) * (area / nodes)
            errors.append(float32_error(membrane.max(), self.mass[shell.nodes].mean() / s**2 + bending))
        return np.array(errors, float)

    @property
    def rod_edges(self) -> int:
        """Number of rod angles, the first of the angles."""
        return len(self.ends)


def inert_mass(piece, s: float) -> np.ndarray:
    """Return the mean nodal mass of rods of a piece (R,) [kg], plus the resistance of forces on edges times the step length s [s]."""
    mass = piece.mass.mean(1)
    if piece.kind.quadratic:
        mass = mass + s * edge_forces.least(piece.coefficients) * piece.length / piece.mass.shape[1]
    return mass

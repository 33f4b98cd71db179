"""Compilation of uncoupled rods to rod groups: one kind, similar length, padded arrays (node, rod)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ddg_warp.compile import boundary_conditions
from ddg_warp.compile.dof_map import DofStorage, RodDofMap, RodIndexMap
from ddg_warp.compile.ghost_nodes import GhostNodes
from ddg_warp.compile.rods import UniformRods, alike, compress, coupled_rods, piece_of
from ddg_warp.errors import SceneError
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.scene import edge_forces
from ddg_warp.scene.scene import Scene

PADDING = 1.25  # longest over shortest rod of a group


@dataclass(kw_only=True, eq=False)
class RodGroupData(DofStorage):
    """Rod group on the host: R rods of one kind and similar length, n nodes of the longest.

    Node k of rod r has the index k R + r.

    Attributes:
        kind: dimension, twist, closedness and terms.
        rods: indices of the rods in the scene (R,).
        first: number of ghosts before the first node (R,).
        own: number of nodes without ghosts (R,); count: with ghosts (R,).
        x: positions (n, R, dim) [m].
        frame: first director, tangent (n, R, 3) each and reference twist (n, R) [rad] of every edge, as (7, n, R).
        mass: mass of nodes (n, R) [kg]; rotary: inertia of edges about the tangent (n, R) [kg m^2].
        fixed: bits of the fixed components of a node; the bit after the components is the twist angle (n, R).
        length: rod lengths (R,) [m].
        coefficients: of forces on edges (rows, n, R) by name; see `scene.edge_forces`.
        parameters: parameters of all terms, "term.parameter", each broadcastable to (n, R).
    """

    kind: RodKind
    rods: np.ndarray
    first: np.ndarray
    own: np.ndarray
    count: np.ndarray
    x: np.ndarray
    frame: np.ndarray
    mass: np.ndarray
    rotary: np.ndarray
    fixed: np.ndarray
    length: np.ndarray
    coefficients: dict[str, np.ndarray]
    parameters: dict[str, np.ndarray]

    @property
    def shape(self) -> tuple[int, int]:
        """(nodes of the longest rod, rods)."""
        return self.mass.shape

    @property
    def axes(self) -> tuple[int, ...]:
        return (0, 2) if self.kind.dim == 2 else (0, 1, 2)

    @property
    def nodes(self) -> int:
        return self.mass.size

    @property
    def size(self) -> int:
        return self.nodes * (2 if self.kind.twist else 1)

    @cached_property
    def places(self) -> RodDofMap:
        rods = len(self.rods)
        closed, twist = np.full(rods, self.kind.closed), np.full(rods, self.kind.twist)
        first = self.first * rods + np.arange(rods)
        nodes, angles = RodIndexMap(first, rods), RodIndexMap(first + self.nodes, rods)
        return RodDofMap(self.rods, self.own, closed, twist, self.length, nodes, angles)

    def index(self, places: np.ndarray) -> np.ndarray:
        return places % self.nodes

    @property
    def anchored(self) -> np.ndarray:
        """Mask of nodes fixed in all directions (n, R) bool."""
        every = (1 << self.kind.dim) - 1
        return ((self.fixed & every) == every) & (np.arange(self.shape[0])[:, None] < self.count)

    def fix(self, nodes: np.ndarray, along: list[int], angles: np.ndarray) -> None:
        flat = self.fixed.reshape(-1)
        flat[nodes] |= np.uint8(sum(1 << bit for bit, d in enumerate(self.axes) if d in along))
        flat[self.index(angles)] |= np.uint8(1 << self.kind.dim)

    def add_mass(self, places: np.ndarray, mass: float) -> None:
        self.mass.reshape(-1)[places] += mass

    def points(self, nodes: np.ndarray) -> np.ndarray:
        result = np.zeros((len(nodes), 3))
        result[:, self.axes] = self.x.reshape(-1, self.kind.dim)[nodes]
        return result

    def edge_ends(self, angles: np.ndarray) -> np.ndarray:
        first = angles - self.nodes
        k, column = np.divmod(first, len(self.rods))
        seam = self.kind.closed & (k + 1 == self.count[column])
        return np.stack([first, np.where(seam, column, first + len(self.rods))], -1)

    def holding(self, nodes: np.ndarray) -> np.ndarray:
        fixed = np.ones((*nodes.shape, 3), bool)
        fixed[..., self.axes] = (self.fixed.ravel()[nodes][..., None] >> np.arange(self.kind.dim)) & 1 == 1
        return fixed

    def dofs(self, places: np.ndarray) -> np.ndarray:
        dim, angle = self.kind.dim, places >= self.nodes
        k, column = np.divmod(self.index(places), len(self.rods))
        first = (column * self.shape[0] + k) * self.kind.block
        result = np.full((*places.shape, 3), -1)
        result[..., self.axes] = np.where(angle[..., None], -1, first[..., None] + np.arange(dim))
        result[angle, 0] = first[angle] + dim
        return result

    def name(self, place: int) -> str:
        k, column = divmod(int(self.index(place)), len(self.rods))
        kind = "node" if place < self.nodes else "edge"
        return f"{kind} {k - self.first[column]} of rod {self.rods[column]}"


def compile_rod_groups(scene: Scene, chosen: np.ndarray | None = None) -> list[RodGroupData]:
    """Return the groups of uncoupled rods of a scene, with boundary conditions, masses and loads.

    Args:
        chosen: rods to compile as if they were uncoupled (R,) bool; by default the uncoupled ones.

    Raises:
        SceneError: the scene is invalid; the message names the object and its index.
    """
    if not any((scene.batches, scene.shells, scene.axisymmetric_shells, scene.bodies)):
        raise SceneError(
            "the scene has no rods, shells or bodies; add some with scene.add_rods(points, section=..., material=...)"
        )
    ghosts, laws = GhostNodes(scene), edge_forces.laws_of(scene)
    chosen = ~coupled_rods(scene) if chosen is None else chosen
    parts = [part for batch in scene.batches for part in alike(scene.dimension, batch, ghosts, laws, chosen)]
    parts.sort(key=lambda part: (*part.kind.key, part.nodes))
    groups: list[list[UniformRods]] = []
    for part in parts:
        last = groups[-1] if groups else None
        if last and last[0].kind == part.kind and part.nodes <= PADDING * last[0].nodes:
            last.append(part)
        else:
            groups.append([part])
    rod_groups = [_join(group, ghosts, laws) for group in groups]
    for rod_group in rod_groups:
        claims = boundary_conditions.ConstraintRegistry(scene, rod_group)
        boundary_conditions.fix_rods(scene, rod_group, claims)
        claims.finish()
        boundary_conditions.add_masses(scene, rod_group)
        boundary_conditions.load_rods(scene, rod_group)
    return rod_groups


def _join(parts: list[UniformRods], ghosts: GhostNodes, laws: list) -> RodGroupData:
    kind, rods = parts[0].kind, np.concatenate([part.rods for part in parts])
    count = np.concatenate([np.full(len(part.rods), part.nodes) for part in parts])
    n, total = int(count.max()), len(rods)
    x, frame = np.zeros((n, total, kind.dim)), np.zeros((kind.lagged_rows, n, total))
    mass, rotary, length, parameters, start = np.zeros((n, total)), np.zeros((n, total)), np.zeros(total), [], 0
    coefficients = {}
    for run in (run for part in parts for run in part.runs):
        piece, columns = piece_of(run, ghosts, laws), slice(start, start + len(run.rods))
        edges = piece.rotary.shape[1]
        x[: run.nodes, columns] = piece.x.swapaxes(0, 1)
        mass[: run.nodes, columns], rotary[:edges, columns] = piece.mass.T, piece.rotary.T
        if kind.twist:
            frame[0:3, :edges, columns], frame[3:6, :edges, columns] = piece.director.T, piece.tangent.T
            frame[6, : piece.reference_twist.shape[1], columns] = piece.reference_twist.T
        for name, values in piece.coefficients.items():
            along = coefficients.setdefault(name, np.zeros((values.shape[-1], n, total)))
            along[:, :edges, columns] = values.T
        length[columns], start = piece.length, columns.stop
        parameters.append((len(run.rods), piece.parameters))
    fixed = np.zeros((n, total), np.uint8)
    if kind.twist and not kind.closed:
        fixed[count - 1, np.arange(total)] = 1 << kind.dim  # the last node starts no edge
    return RodGroupData(
        kind=kind,
        rods=rods,
        first=np.concatenate([np.full(len(part.rods), part.ghosts[0]) for part in parts]),
        own=np.concatenate([np.full(len(part.rods), part.batch.nodes) for part in parts]),
        count=count,
        x=x,
        frame=frame,
        mass=mass,
        rotary=rotary,
        fixed=fixed,
        length=length,
        coefficients=coefficients,
        parameters={
            name: _join_parameter([(rods, values[name]) for rods, values in parameters], n) for name in parameters[0][1]
        },
    )


def _join_parameter(values: list[tuple[int, np.ndarray]], n: int) -> np.ndarray:
    """Return a parameter of runs of rods as (node, rod), with size 1 along an axis on which it does not depend."""
    along = any(value.shape[1] > 1 for _, value in values)
    out, start = np.zeros((n if along else 1, sum(rods for rods, _ in values))), 0
    for rods, value in values:
        columns, start = slice(start, start + rods), start + rods
        out[: value.shape[1], columns] = value.T
        out[value.shape[1] :, columns] = value.T[-1:]
    return compress(out.T).T

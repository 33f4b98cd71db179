"""User order of nodes and edges, and maps from there to storage of rod groups and the coupled system."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.compile import axisymmetric
from ddg_warp.errors import SceneError
from ddg_warp.io.bodies import Bodies
from ddg_warp.io.obstacles import Obstacles
from ddg_warp.io.shapes import Curves, Surfaces
from ddg_warp.model.rod_group import RodGroup
from ddg_warp.scene.handle import AXISYMMETRIC, OBSTACLE, ROD, SHELL, Handle, named, need
from ddg_warp.scene.material import DRAWN


class UserNumbering:
    """User order: nodes of rods as added, of meridians, then vertices of shells; edges likewise."""

    def __init__(self, model):
        self.model = model

    @cached_property
    def curves(self) -> Curves:
        """Rods, then meridians of axisymmetric shells with the radius of half the thickness."""
        batches, shells = self.model.scene.batches, self.model.scene.axisymmetric_shells
        if not batches and not shells:
            none = np.zeros(0, int)
            return Curves(none, none.astype(bool), np.zeros(0), np.zeros(0, object), none)
        counts = np.concatenate([*(np.full(b.rods, b.nodes) for b in batches), *([len(s.points)] for s in shells)])
        radius = [np.broadcast_to(_node_radius(b), (b.rods, b.nodes)).ravel() for b in batches]
        radius += [0.5 * axisymmetric.at_nodes(shell.thickness, len(shell.points)) for shell in shells]
        single = np.ones(len(shells), int)
        return Curves(
            counts=counts,
            closed=np.concatenate([*(np.full(b.rods, b.closed) for b in batches), single == 0]),
            radius=np.concatenate(radius),
            names=np.array([*(b.name for b in batches for _ in range(b.rods)), *(s.name for s in shells)], object),
            batch=np.repeat(_alike([*batches, *shells]), [*(b.rods for b in batches), *single]),
        )

    @cached_property
    def surfaces(self) -> Surfaces | None:
        """Shells as triangles among the rows of `State.points`; None without."""
        if not self.model.scene.shells:
            return None
        shells, rods = self.model.coupled.host.shells, int(self.curves.counts.sum())
        points = np.cumsum([0] + [len(shell.nodes) for shell in shells])
        triangles = np.cumsum([0] + [len(shell.surface.triangles) for shell in shells])
        return Surfaces(
            triangles=np.concatenate(
                [s.surface.triangles + rods + offset for s, offset in zip(shells, points, strict=False)]
            ),
            first=triangles[:-1],
            names=np.array([shell.name for shell in self.model.scene.shells], dtype=object),
            thickness=np.concatenate([shell.plate.thickness for shell in shells]),
            uv=_texture(self.model.scene.shells),
        )

    @cached_property
    def obstacles(self) -> Obstacles | None:
        """Obstacles, then the shapes of rigid bodies, as surfaces; None without."""
        scene = self.model.scene
        shapes = [(each.shape, each.name, each.motion is not None) for each in scene.obstacles]
        shapes += [(shape, body.name, True) for body in scene.bodies for shape in body.shapes]
        if not shapes:
            return None
        points = [batch.points.reshape(-1, 3) for batch in scene.batches] + [shell.points for shell in scene.shells]
        return Obstacles.of(shapes, np.concatenate([np.zeros((0, 3)), *points]))

    @cached_property
    def rigid_bodies(self) -> Bodies | None:
        """Rigid bodies, for recordings; None without."""
        bodies = self.model.scene.bodies
        if not bodies:
            return None
        host = self.model.coupled.host
        return Bodies.of(bodies, host.rest[host.rigid_bodies.centers])

    @cached_property
    def coupled_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows of `State.points` from the coupled system, and the dof blocks that fill them."""
        if self.model.coupled is None:
            return np.zeros(0, int), np.zeros(0, int)
        start, host = self.node_starts, self.model.coupled.host
        rows = [start[rod.rod] + np.arange(len(rod.nodes)) for rod in host.rods]
        first = len(start) - 1 - len(host.meridians)
        rows += [start[first + i] + np.arange(len(shell.nodes)) for i, shell in enumerate(host.meridians)]
        blocks = [np.zeros(0, int), *(body.nodes for body in (*host.rods, *host.meridians, *host.shells))]
        vertices = sum(len(shell.nodes) for shell in host.shells)
        return np.concatenate([*rows, start[-1] + np.arange(vertices)]).astype(int), np.concatenate(blocks)

    def places(self, group: RodGroup) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for the nodes of a rod group: node with ghosts, column, row of `State.points`."""
        return _user_index(group, group.host.own, self.node_starts)

    @property
    def points_count(self) -> int:
        """Rows of `State.points` in one world."""
        vertices = (
            0 if self.model.coupled is None else sum(len(shell.nodes) for shell in self.model.coupled.host.shells)
        )
        return int(self.curves.counts.sum()) + vertices

    @cached_property
    def node_starts(self) -> np.ndarray:
        """Offsets of the nodes of every curve (curves + 1,)."""
        return np.concatenate([[0], np.cumsum(self.curves.counts)])

    @cached_property
    def edge_starts(self) -> np.ndarray:
        """Offsets of the edges of every curve (curves + 1,)."""
        return np.concatenate([[0], np.cumsum(self.curves.counts - np.where(self.curves.closed, 0, 1))])

    @property
    def edges_count(self) -> int:
        """Rows of `State.angles` in one world."""
        return int(self.edge_starts[-1])

    @cached_property
    def twisted(self) -> np.ndarray:
        """Mask of the edges that have a twist angle (edges,)."""
        result = np.zeros(self.edges_count, bool)
        for group in self.model.groups:
            if group.kind.twist:
                result[self.edge_places(group)[2]] = True
        for rod in self.model.coupled.host.rods if self.model.coupled is not None else ():
            result[self.edge_starts[rod.rod] + np.arange(len(rod.edges))] = True
        return result

    def elements(self, name: str) -> tuple[int, list[tuple[RodGroup, np.ndarray, np.ndarray]]]:
        """Return the elements of uncoupled rods that have a parameter "term.parameter".

        Elements are numbered rod by rod, clamped ends included.

        Returns:
            The number of elements in one world, and (group, mask (n, R), numbers (n, R), 0 outside of the mask) of every group with
            some.
        """
        counts, groups = np.zeros(self.model.scene.rod_count, np.int64), []
        for group in self.model.groups:
            if name in group.parameters.values:
                term = next(term for term in group.kind.terms if name.startswith(f"{term.name}."))
                missing = 0 if group.kind.closed else term.measure.span
                inside = np.arange(group.nodes)[:, None] < group.host.count - missing
                counts[group.host.rods] = inside.sum(0)
                groups.append((group, inside))
        first = np.cumsum(counts) - counts
        numbers_of_groups = [first[group.host.rods] + np.arange(group.nodes)[:, None] for group, _ in groups]
        return int(counts.sum()), [
            (*each, np.where(each[1], numbers, 0)) for each, numbers in zip(groups, numbers_of_groups, strict=True)
        ]

    @property
    def meridian_rows(self) -> slice:
        """Rows of `State.points` that are nodes of meridians."""
        counts, meridians = self.curves.counts, len(self.model.scene.axisymmetric_shells)
        rods = len(counts) - meridians
        return slice(int(counts[:rods].sum()), int(counts.sum()))

    def handle(self, kind: str, item: int | str) -> Handle:
        """Return the handle of a rod, shell, shell of revolution or obstacle from its name, index or handle."""
        scene = self.model.scene
        if kind == ROD:
            return named(kind, item, self.curves.names[: scene.rod_count])
        objects = {SHELL: scene.shells, AXISYMMETRIC: scene.axisymmetric_shells, OBSTACLE: scene.obstacles}[kind]
        return named(kind, item, [each.name for each in objects])

    def find(self, name: str) -> Handle:
        """Return the handle of the rod, shell, shell of revolution or obstacle with a name.

        Raises:
            SceneError: nothing has the name, or several have it.
        """
        scene = self.model.scene
        names = {ROD: set(self.curves.names[: scene.rod_count])}
        for kind, objects in (
            (SHELL, scene.shells),
            (AXISYMMETRIC, scene.axisymmetric_shells),
            (OBSTACLE, scene.obstacles),
        ):
            names[kind] = {each.name for each in objects}
        kinds = [kind for kind, of_kind in names.items() if name in of_kind]
        if not kinds:
            raise SceneError(f"nothing is named {name!r}{argument_checks.meant(name, set().union(*names.values()))}")
        if len(kinds) > 1:
            raise SceneError(f"a {kinds[0]} and a {kinds[1]} are named {name!r}; give one by its handle")
        return self.handle(kinds[0], name)

    def nodes_of(self, item, values: np.ndarray) -> np.ndarray:
        """Return of values (..., P, d) in user order the values of a rod, rods, a shell or a shell of revolution.

        Args:
            item: handle, name, index of a rod, or several rods of equal node count, which get an axis (..., R, n, d).
            values: in the order of `State.points`.
        """
        item = self.find(item) if isinstance(item, str) else item
        if isinstance(item, Handle) and item.kind == SHELL:
            item = self.handle(SHELL, item)
            start = int(self.curves.counts.sum()) + sum(len(s.points) for s in self.model.scene.shells[:item])
            rows = start + np.arange(len(self.model.scene.shells[item].points))
        elif isinstance(item, Handle) and item.kind == AXISYMMETRIC:
            curve = self.model.scene.rod_count + self.handle(AXISYMMETRIC, item)
            rows = self.node_starts[curve] + np.arange(self.curves.counts[curve])
        else:
            rows = self._rows_of(item, self.node_starts, "node")
        return values[..., rows, :]

    def edges_of(self, item, values: np.ndarray, width: int = 0) -> np.ndarray:
        """Return of values (..., edges) or (..., edges, width) in user order the values of a rod, or of several, as `nodes_of`."""
        rows = self._rows_of(item, self.edge_starts, "edge")
        return values[..., rows, :] if width else values[..., rows]

    def _rows_of(self, item, starts: np.ndarray, kind: str) -> np.ndarray:
        if np.iterable(item) and not isinstance(item, str):
            need(ROD, item)
            rods = argument_checks.indices("rods", item, self.model.scene.rod_count)
            for rod in rods[(rods < 0) | (rods >= self.model.scene.rod_count)][:1]:
                raise SceneError(f"rod {rod} does not exist; there are {self.model.scene.rod_count}")
            counts = starts[rods + 1] - starts[rods]
            if (counts != counts[0]).any():
                raise SceneError(
                    f"rods have {counts.min()} to {counts.max()} {kind}s; take rods of one count at a time"
                )
            return starts[rods][:, None] + np.arange(counts[0])
        rod = self.handle(ROD, item)
        return np.arange(starts[rod], starts[rod + 1])

    def row(self, node: tuple) -> int:
        """Return the row of `State.points` of (rod, node) or (shell, vertex); a node counts from the end if negative."""
        item, local = node
        rows = self.nodes_of(item, np.arange(self.points_count)[:, None])[:, 0]
        name = repr(item) if isinstance(item, Handle) else f"rod {item!r}"
        if not -len(rows) <= (local := argument_checks.index("node", local)) < len(rows):
            raise SceneError(f"node {local} does not exist: {name} has {len(rows)}")
        return int(rows[local])

    def edge(self, row: int) -> tuple[int, int]:
        """Return edge and curve of a row of `State.angles`."""
        curve = int(np.searchsorted(self.edge_starts, row, side="right")) - 1
        return int(row - self.edge_starts[curve]), curve

    def edge_places(self, group: RodGroup) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for the edges of a rod group: edge with ghosts, column, row of `State.angles`."""
        return _user_index(group, _edges(group), self.edge_starts)

    def put_nodes(self, group: RodGroup, values, out: np.ndarray, label: str) -> None:
        """Write values in user order (P, 3) to (node, column, dim) of a group."""
        values = self._points(values, label)[..., _axes(group)]
        for rods in _rods_alike(group, group.host.own, self.node_starts):
            for world in range(self.model.worlds):
                rods.stored(out, world)[:] = rods.numbered(values if values.ndim == 2 else values[world])

    def put_blocks(self, values, blocks: np.ndarray, label: str) -> np.ndarray:
        """Return `blocks` (worlds N, 3) with values in user order (P, 3) filled in."""
        values = self._points(values, label)
        out = blocks.astype(float).reshape(self.model.worlds, -1, 3)
        rows, indices = self.coupled_rows
        out[:, indices] = (values if values.ndim == 3 else values[None])[:, rows]
        return out.reshape(-1, 3)

    def _points(self, values, label: str) -> np.ndarray:
        values, count = _numbers(label, values), self.points_count
        if values.shape not in ((count, 3), (self.model.worlds, count, 3)):
            raise ValueError(f"{label} have shape {values.shape}; they are ({count}, 3), or one such array a world")
        if not np.isfinite(values).all():
            raise ValueError(f"{label}: node {int(np.argwhere(~np.isfinite(values))[0][-2])} is not finite")
        return values

    def put_edges(self, group: RodGroup, values, out: np.ndarray, label: str = "spins") -> None:
        values, start = self.of_edges(values, label)
        for rods in _rods_alike(group, _edges(group), start):
            for world in range(self.model.worlds):
                rods.stored(out, world)[:] = rods.numbered(values if values.ndim == 1 else values[world])

    def of_edges(self, values, label: str) -> tuple[np.ndarray, np.ndarray]:
        """Return checked spins or angles in user order, and the edge offsets of rods."""
        values, count = _numbers(label, values), self.edges_count
        if values.shape not in ((count,), (self.model.worlds, count)):
            raise ValueError(f"{label} have shape {values.shape}; they are ({count},), or one such array a world")
        if not np.isfinite(values).all():
            raise ValueError(f"{label}: edge {int(np.argwhere(~np.isfinite(values))[0][-1])} is not finite")
        return values, self.edge_starts

    def nodes(self, values: list[np.ndarray], blocks: wp.array | None = None) -> np.ndarray:
        """Return nodal values in user order from group arrays (node, column, dim) and dof blocks (worlds N, 3)."""
        out = np.zeros((self.model.worlds, self.points_count, 3))
        if blocks is not None:
            rows, indices = self.coupled_rows
            out[:, rows] = np.asarray(blocks.numpy() if isinstance(blocks, wp.array) else blocks).reshape(
                self.model.worlds, -1, 3
            )[:, indices]
        for group, value in zip(self.model.groups, values, strict=True):
            for rods in _rods_alike(group, group.host.own, self.node_starts):
                for world in range(self.model.worlds):
                    rods.put(out[world][:, _axes(group)], rods.stored(value, world))
        return out[0] if self.model.worlds == 1 else out

    def edges(self, values: list[np.ndarray], coupled: np.ndarray | None = None, width: int = 0):
        """Return edge values in user order from groups (node, column) and coupled rod edges (worlds, edges)."""
        if not any(group.kind.twist for group in self.model.groups) and coupled is None:
            return None
        out = np.zeros((self.model.worlds, self.edges_count, *([width] if width else [])))
        for group, value in zip(self.model.groups, values, strict=True):
            if group.kind.twist:
                for rods in _rods_alike(group, _edges(group), self.edge_starts):
                    for world in range(self.model.worlds):
                        rods.put(out[world], rods.stored(value, world))
        for rod in self.model.coupled.host.rods if coupled is not None else ():
            rows = self.edge_starts[rod.rod] + np.arange(len(rod.edges))
            out[:, rows] = coupled[:, rod.edges - self.model.coupled.angle_start]
        return out[0] if self.model.worlds == 1 else out


def _texture(shells: list) -> np.ndarray | None:
    """Return texture coordinates of all triangles (T, 3, 2), NaN for shells without; None if no shell has any."""
    if all(shell.uv is None for shell in shells):
        return None
    none = [np.full((*shell.triangles.shape, 2), np.nan) for shell in shells]
    return np.concatenate([each if shell.uv is None else shell.uv for shell, each in zip(shells, none, strict=True)])


def _numbers(label: str, values) -> np.ndarray:
    values = argument_checks.array(label, values)
    argument_checks.sized(label, values, least=0.0)  # decayed velocities may be tiny
    return values


def _node_radius(batch) -> np.ndarray:
    radius = np.asarray(DRAWN if batch.section.radius is None else batch.section.radius, float)
    if radius.ndim == 0 or radius.shape[-1] == 1:
        return radius
    return 0.5 * (np.concatenate([radius[..., :1], radius], -1) + np.concatenate([radius, radius[..., -1:]], -1))


def _alike(batches) -> list[int]:
    """Return for each batch the first one with the same name and section; shells of revolution are distinct."""
    first: dict = {}
    keys = [(batch.name, _hashable(batch.section)) if hasattr(batch, "section") else id(batch) for batch in batches]
    return [first.setdefault(key, len(first)) for key in keys]


def _hashable(section) -> tuple:
    """Return the values of a section as a hashable key."""
    return tuple(
        np.asarray(value, dtype=object if value is None else float).tobytes() for value in vars(section).values()
    )


@dataclass(frozen=True)
class _Rods:
    """Consecutive rods of a group with equal nodes or edges.

    Attributes:
        group: the group; columns: of the rods.
        first: number of ghosts before the first node; count: nodes or edges of a rod without ghosts.
        start: index of the first node or edge of every rod in user order.
    """

    group: RodGroup
    columns: slice
    first: int
    count: int
    start: np.ndarray

    def stored(self, values: np.ndarray, world: int) -> np.ndarray:
        """Return a view (rods, count, ...) of values (node, column, ...) of a group."""
        first = world * self.group.rods
        columns = slice(self.columns.start + first, self.columns.stop + first)
        return values[self.first : self.first + self.count, columns].swapaxes(0, 1)

    def numbered(self, values: np.ndarray) -> np.ndarray:
        """Return (rods, count, ...) of values in user order, a view of rods that follow each other."""
        if self._together:
            return values[self.start[0] :][: len(self.start) * self.count].reshape(-1, self.count, *values.shape[1:])
        return values[self._index]

    def put(self, out: np.ndarray, values: np.ndarray) -> None:
        """Write (rods, count, ...) to values in user order."""
        if self._together:
            self.numbered(out)[:] = values
        else:
            out[self._index] = values

    @cached_property
    def _together(self) -> bool:
        return bool((np.diff(self.start) == self.count).all())

    @cached_property
    def _index(self) -> np.ndarray:
        return self.start[:, None] + np.arange(self.count)


def _rods_alike(group: RodGroup, counts: np.ndarray, start: np.ndarray) -> list[_Rods]:
    """Return the rods of a group in runs with equal counts of nodes or edges, and equal ghosts."""
    first, start = group.host.first, start[group.host.rods]
    ends = np.flatnonzero(np.diff(first, append=-1) | np.diff(counts, append=-1)) + 1
    runs = [slice(*run) for run in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True)]
    return [_Rods(group, run, int(first[run.start]), int(counts[run.start]), start[run]) for run in runs]


def _edges(group: RodGroup) -> np.ndarray:
    """Return the number of edges of every rod of a group without ghosts (R,)."""
    return group.host.own - (0 if group.kind.closed else 1)


def _axes(group: RodGroup) -> slice:
    """Return the space components that a group has."""
    return slice(0, 3, 2 if group.kind.dim == 2 else 1)


def _user_index(group: RodGroup, counts: np.ndarray, start: np.ndarray):
    """Return for nodes or edges (`counts` a rod): node with ghosts, column, index in user order."""
    column = np.repeat(np.arange(group.rods), counts)
    index = np.arange(counts.sum()) - np.repeat(np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
    return index + group.host.first[column], column, index + start[group.host.rods[column]]

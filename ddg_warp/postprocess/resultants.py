"""Stress resultants: axial force, shear, moments and torque of rods; membrane forces and moments of shells.

Moments of a rod follow from the conjugate stresses of its vertices, as vectors in space: the moment that the rod after a section exerts
on the rod before. The shear F of an edge with vector e balances its moments, M_end - M_start + e x F = 0.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ddg_warp import device_arrays
from ddg_warp.geometry import polyline
from ddg_warp.kernels.terms import MAGNETS
from ddg_warp.postprocess.element_strains import coupled_strains, group_strains
from ddg_warp.scene.handle import SHELL
from ddg_warp.typing import Floats

AXIAL = ("rod_stretch", "planar_stretch")
BENDING = ("shell_bend", "shell_bend_dof")
MEMBRANE = ("shell_stretch", "shell_stretch_curved")


@dataclass(frozen=True)
class RodResultants:
    """Stress resultants of one rod; several worlds are an axis in front.

    A moment is nan where only a support or a shell carries it: at the outer node of a clamped or glued end edge. So is the shear of
    an edge with such a moment, of a clamped edge, and of one with a couple. It is that of an equilibrium. At a rigid joint moments
    differ on both sides, and nodes have the mean.

    Attributes:
        axial_force: of edges (edges,) [N], positive in tension.
        shear: of edges (edges, 3) [N], the force across the tangent that the rod after the edge exerts on the rod before.
        moment: bending moment at nodes (nodes, 3) [N m], a vector in space across the tangent.
        torque: about the tangent at nodes (nodes,) [N m]; zero without twist.
        units: unit of each attribute.
    """

    axial_force: Floats
    shear: Floats
    moment: Floats
    torque: Floats

    units: ClassVar[dict[str, str]] = {"axial_force": "N", "shear": "N", "moment": "N m", "torque": "N m"}


@dataclass(frozen=True)
class ShellResultants:
    """Stress resultants of the triangles of one shell; several worlds are an axis in front.

    Components (11, 22, 12) are along the first edge of a triangle at rest and across. They are of the second Piola-Kirchhoff stress, at
    small strain the forces and moments themselves.

    Attributes:
        membrane_force: (T, 3) [N/m].
        moment: (T, 3) [N], positive if it raises the second fundamental form; None where bending is by hinges.
        von_mises: equivalent stress (T,) [Pa], the larger one of both surfaces.
        units: unit of each attribute.
    """

    membrane_force: Floats
    moment: Floats | None
    von_mises: Floats

    units: ClassVar[dict[str, str]] = {"membrane_force": "N/m", "moment": "N", "von_mises": "Pa"}


class Stresses(dict[str, list[Floats]]):
    """Conjugate stresses by term, see `quantities.stresses`; stress resultants of one object by `rod` and `shell`."""

    def __init__(self, values: dict[str, list], model, state):
        super().__init__(values)
        self._model, self._state, self._groups = model, state, {}

    def __reduce__(self):
        return dict, (dict(self),)

    def rod(self, item: int | str) -> RodResultants:
        """Return axial force, shear, moments and torque of a rod, given by handle, name or index."""
        return _rod_resultants(self, self._model, self._state, self._model.rod(item))

    def shell(self, item: int | str) -> ShellResultants:
        """Return membrane forces, moments and equivalent stress of a shell, given by handle, name or index."""
        shell = self._model.order.handle(SHELL, item)
        membrane = next(self[name][shell] for name in MEMBRANE if name in self and self[name][shell] is not None)
        bending = [self[name][shell] for name in BENDING if name in self and self[name][shell] is not None]
        thickness = self._model.scene.shells[shell].thickness[..., None]
        moment = bending[0] if bending else None
        bent = 0.0 if moment is None else 6.0 * moment / thickness**2
        surfaces = [_von_mises(membrane / thickness + side * bent) for side in (1.0, -1.0)]
        return ShellResultants(membrane, moment, np.maximum(*surfaces))

    def of_group(self, number: int) -> np.ndarray:
        """Return the stresses of a rod group (strains, nodes, worlds, rods), about mean directors."""
        if number not in self._groups:
            model = self._model
            self._groups[number] = group_strains(model, model.groups[number], self._state.groups[number])[1]
        return self._groups[number]


def _von_mises(stress: np.ndarray) -> np.ndarray:
    """Return the equivalent stress of plane stresses (..., 3), components (11, 22, 12)."""
    s, t, shear = np.moveaxis(stress, -1, 0)
    return np.sqrt(s**2 - s * t + t**2 + 3.0 * shear**2)


@dataclass
class _Rod:
    """One rod with ghosts: nodes (worlds, n, 3), first directors of edges or None, and moments that vertices carry.

    Attributes:
        first: number of ghosts before the first node; count: number of nodes.
        vertices: index of the node before each vertex, and its stresses (worlds, vertices, strains).
    """

    points: np.ndarray
    director: np.ndarray | None
    closed: bool
    first: int
    count: int
    vertices: list[tuple[np.ndarray, np.ndarray]]


def _rod_resultants(stresses: Stresses, model, state, rod: int) -> RodResultants:
    piece = _uncoupled(stresses, model, state, rod) or _coupled(model, state, rod)
    nodes = piece.points.shape[1]
    edges = nodes if piece.closed else nodes - 1
    vector = np.roll(piece.points, -1, 1)[:, :edges] - piece.points[:, :edges]
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    tangent = vector / length
    # moment at both ends of every edge, (worlds, edges, 2, 3)
    ends = np.full((*tangent.shape[:2], 2, 3), np.nan if piece.vertices else 0.0)
    for k, values in piece.vertices:
        moment = _vectors(values, tangent, piece.director, k, (k + 1) % edges)
        ends[:, k, 1], ends[:, (k + 1) % edges, 0] = moment, moment
    if model.coupled is not None:
        _add_joints(model, state, rod, ends)
    clamped, loaded, open_ends = _edges_without_balance(model, rod, piece)
    if not piece.closed:
        for node, edge, side in ((0, 0, 0), (nodes - 1, -1, 1)):
            if node in open_ends:
                ends[:, edge, side] = np.where(np.isnan(ends[:, edge, side]), 0.0, ends[:, edge, side])
    shear = np.cross(ends[:, :, 0] - ends[:, :, 1], tangent) / length
    shear[:, [*clamped, *loaded]] = np.nan
    before, after = (np.full((len(ends), nodes, 3), np.nan) for _ in range(2))
    after[:, :edges] = ends[:, :, 0]
    before[:, (np.arange(edges) + 1) % nodes] = ends[:, :, 1]
    moment = np.where(np.isnan(before), after, np.where(np.isnan(after), before, 0.5 * (before + after)))
    at_node = np.zeros_like(moment)
    at_node[:, :edges] += tangent
    at_node[:, (np.arange(edges) + 1) % nodes] += tangent
    at_node /= np.linalg.norm(at_node, axis=-1, keepdims=True)
    torque = (moment * at_node).sum(-1)
    own_nodes = slice(piece.first, piece.first + piece.count)
    own_edges = slice(piece.first, piece.first + piece.count - (0 if piece.closed else 1))
    axial = next(values[rod] for name in AXIAL if (values := stresses.get(name)) and values[rod] is not None)
    axial = axial[..., own_edges, 0]
    values = shear[:, own_edges], (moment - torque[..., None] * at_node)[:, own_nodes], torque[:, own_nodes]
    return RodResultants(axial, *(value[0] if model.worlds == 1 else value for value in values))


def _uncoupled(stresses: Stresses, model, state, rod: int) -> _Rod | None:
    """Return a rod of a rod group; None if it is in the coupled system."""
    for number, (group, data) in enumerate(zip(model.groups, state.groups, strict=True)):
        (column,) = np.nonzero(group.host.rods == rod)
        if not column.size:
            continue
        kind, host, column = group.kind, group.host, int(column[0])
        n, columns = int(host.count[column]), column + group.rods * np.arange(group.worlds)
        points = np.zeros((group.worlds, n, 3))
        x = device_arrays.download(data.x).astype(float)[:n, columns]
        points[..., slice(0, 3, 2 if kind.dim == 2 else 1)] = np.moveaxis(x, 0, 1)
        edges, director = n if kind.closed else n - 1, None
        if kind.twist:
            frame, theta = (device_arrays.download(array).astype(float) for array in (data.frame, data.theta))
            u, t = (np.moveaxis(frame[rows][:, :edges, columns], 0, -1) for rows in (slice(0, 3), slice(3, 6)))
            director = np.moveaxis(polyline.material_directors(u, t, theta[:edges, columns]), 0, 1)
        vertices = []
        for term, place in zip(kind.terms, kind.places(), strict=True):
            if term.measure.span == 2:
                rows = slice(place[3], place[3] + len(term.measure.strains))
                count = n if kind.closed else n - 2
                values = np.moveaxis(stresses.of_group(number)[rows, :count, :, column], (2, 1), (0, 1))
                vertices.append((np.arange(count), values))
        return _Rod(points, director, kind.closed, int(host.first[column]), int(host.own[column]), vertices)
    return None


def _coupled(model, state, rod: int) -> _Rod:
    """Return a rod of the coupled system."""
    coupled, worlds = model.coupled, model.worlds
    host = next(each for each in coupled.host.rods if each.rod == rod)
    blocks = state.coupled.q.numpy().astype(float).reshape(worlds, -1, 3)
    director, edges = None, host.all_edges
    if len(edges):
        frame = np.moveaxis(state.coupled.frame.numpy().astype(float).reshape(6, worlds, -1), 0, -1)
        frame = frame[:, edges - coupled.host.nodes]
        director = polyline.material_directors(frame[..., :3], frame[..., 3:], blocks[:, edges, 0])
    vertices = []
    for index, part in enumerate(coupled.sets):
        of_rod = part.host.owner[0] == rod
        if part.host.along and part.term.measure.span == 2 and of_rod.any():
            values = np.moveaxis(coupled_strains(coupled, state, index)[1], 0, -1)[:, of_rod]
            vertices.append((part.host.owner[1, of_rod], values))
    return _Rod(blocks[:, host.all_nodes], director, host.piece.kind.closed, host.first, len(host.nodes), vertices)


def _vectors(values: np.ndarray, tangent: np.ndarray, director: np.ndarray | None, k, after) -> np.ndarray:
    """Return moments (worlds, vertices, 3) in space from stresses between edges `k` and `after`."""
    strains = values.shape[-1]
    if strains == 1:  # in the plane of x and z, positive from x towards z
        return values * [0.0, -1.0, 0.0]
    if director is None:  # along the curvature binormal
        return values
    return _in_space(values, (director[:, k], tangent[:, k]), (director[:, after], tangent[:, after]))


def _in_space(values: np.ndarray, before: tuple, after: tuple) -> np.ndarray:
    """Return moments (..., 3) in space from moments about the mean directors of two edges, (director, tangent) each."""
    (u0, t0), (u1, t1) = before, after
    v0, v1 = np.cross(t0, u0), np.cross(t1, u1)
    along = (t0 + t1) / (1.0 + np.sum(t0 * t1, -1, keepdims=True))
    first, second, twist = np.moveaxis(values, -1, 0)[..., None]
    return 0.5 * first * (v0 + v1) - 0.5 * second * (u0 + u1) + twist * along


def _add_joints(model, state, rod: int, ends: np.ndarray) -> None:
    """Fill the moments at ends of edges next to rigid joints."""
    coupled, worlds = model.coupled, model.worlds
    for index, part in enumerate(coupled.sets):
        of_rod = part.host.owner[0] == rod
        if part.term.name != "rigid_joint" or not of_rod.any():
            continue
        host, measure, k = coupled.host, part.term.measure, part.host.owner[1, of_rod]
        edges = part.host.slots[measure.nodes][of_rod] - host.nodes
        frame = np.moveaxis(state.coupled.frame.numpy().astype(float).reshape(6, worlds, -1), 0, -1)[:, edges]
        angle = state.coupled.q.numpy().astype(float).reshape(worlds, -1, 3)[:, host.nodes + edges, 0]
        sign = part.host.data[0, of_rod]
        lag = state.coupled.lag[index].numpy().astype(float).reshape(-1, worlds, part.elements)
        lag = np.moveaxis(lag, 0, -1)[:, of_rod]
        values = np.moveaxis(coupled_strains(coupled, state, index)[1], 0, -1)[:, of_rod]
        director = polyline.material_directors(frame[..., :3], frame[..., 3:], angle)
        edge = director, sign[:, None] * frame[..., 3:]
        vectors = sign[:, None] * _in_space(values, (lag[..., :3], lag[..., 3:6]), edge)
        ends[:, k, np.where(sign > 0.0, 0, 1)] = vectors


def _edges_without_balance(model, rod: int, piece: _Rod) -> tuple[list, list, list]:
    """Return clamped edges, edges with couples, and end nodes without moment, numbered with ghosts."""
    scene, first, nodes = model.scene, piece.first, piece.count
    edges = nodes - (0 if piece.closed else 1)
    fixed, angles = set(), set()
    for support in scene.supports:
        if rod in support.rods:
            if set(support.components) >= ({"x", "z"} if scene.dimension == 2 else {"x", "y", "z"}):
                fixed |= {node % nodes for node in support.nodes}
            angles |= {edge % edges for edge in support.edges}
    clamped = [first + k for k in range(edges) if k in fixed and (k + 1) % nodes in fixed]
    loaded = [
        first + load.edge % edges
        for load in scene.loads
        if load.edge is not None and any(load.couple) and rod in load.rods
    ]
    glued = model.coupled is not None and any(
        (part.host.owner[0] == rod).any() for part in model.coupled.sets if part.term.name in (*MAGNETS, "glued_edge")
    )
    twisted = {first + k for k in angles} | {
        first + load.edge % edges for load in scene.loads if load.edge is not None and rod in load.rods
    }
    ends = ((0, first), (piece.points.shape[1] - 1, first + edges - 1))
    free = [node for node, edge in ends if not (glued or edge in clamped or edge in twisted)]
    return clamped, loaded, free

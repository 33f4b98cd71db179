"""Arrays of the rods of a batch: positions, frames, masses and term parameters, ghosts included."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ddg_warp.compile.ghost_nodes import GhostNodes, end_director, ghost_node
from ddg_warp.compile.half_cells import HalfCells
from ddg_warp.compile.laws import bind_law, check_laws
from ddg_warp.errors import SceneError
from ddg_warp.geometry import polyline
from ddg_warp.kernels.elements.rod_layout import RodKind
from ddg_warp.kernels.terms import REGISTRY, Term, term_key
from ddg_warp.scene.contact import contact_names
from ddg_warp.scene.descriptions import RodBatch
from ddg_warp.scene.scene import Scene
from ddg_warp.scene.validate import check_batch


@dataclass(frozen=True)
class UniformRods:
    """Rods of one batch with equal ghosts, all with forces on edges or all without."""

    batch: RodBatch
    rows: np.ndarray  # of the batch
    ghosts: tuple[int, int]  # at the first and last node, 0 or 1
    kind: RodKind

    @property
    def nodes(self) -> int:
        """Number of nodes of a rod, with ghosts."""
        return self.batch.nodes + sum(self.ghosts)

    @property
    def rods(self) -> np.ndarray:
        """Indices of the rods in the scene."""
        return self.batch.first + self.rows

    @property
    def runs(self) -> list["UniformRods"]:
        """Runs of a few rods each, so that intermediate arrays stay in the cache."""
        return [replace(self, rows=rows) for rows in self.batch.runs(self.rows)]


@dataclass
class RodArrays:
    """Arrays (R, ...) of a run of rods with equal ghosts, ghosts included; attributes as in `RodGroupData`."""

    batch: RodBatch
    rods: np.ndarray
    ghosts: tuple[int, int]
    kind: RodKind
    x: np.ndarray
    tangent: np.ndarray
    director: np.ndarray
    reference_twist: np.ndarray
    mass: np.ndarray
    rotary: np.ndarray
    length: np.ndarray
    parameters: dict[str, np.ndarray]
    stiffness: list[np.ndarray]  # EI1, EI2 and GJ of the section, each broadcastable to (R, edges)
    coefficients: dict[str, np.ndarray]  # of forces on edges (R, edges, rows) by name


def coupled_rods(scene: Scene) -> np.ndarray:
    """Return the mask of coupled rods (R,) bool.

    They are joined, attached, carried by a body, magnetised, in contact, or have a user-defined force.
    """
    members = [rod for joint in scene.joints for rod, _ in joint.members]
    members += [attachment.rod for attachment in scene.attachments]
    members += [attachment.index for attachment in scene.body_attachments if attachment.kind == "rod"]
    members += [rod for force in scene.user_forces for rod, _ in force.rods]
    chosen = np.zeros(scene.rod_count, bool)
    chosen[np.array(members, int)] = True
    for magnet in scene.magnets:
        chosen[magnet.rods] = True
    names = contact_names(scene)
    for batch in scene.batches:
        if batch.name in names:
            chosen[batch.first : batch.first + batch.rods] = True
    return chosen


def alike(dimension: int, batch: RodBatch, ghosts: GhostNodes, laws: list, chosen: np.ndarray) -> list[UniformRods]:
    """Return the chosen rods (R,) of a batch, grouped by ghosts and forces on edges; `laws`: see `edge_forces.laws_of`."""
    check_batch(batch, dimension)
    chosen = chosen[batch.first : batch.first + batch.rods]
    flags = ghosts.count[batch.first : batch.first + batch.rods]
    if batch.closed and flags.any():
        raise SceneError(f"rod {batch.first + int(np.argmax(flags.any(1)))} is closed: it has no end to clamp")
    forced = np.any([each.of_rods[batch.first : batch.first + batch.rods] >= 0 for each in laws], axis=0)
    result = []
    for *pattern, quadratic in product((0, 1), (0, 1), (False, True)):
        rows = np.flatnonzero((flags == pattern).all(1) & (forced == quadratic) & chosen)
        if rows.size:
            result.append(UniformRods(batch, rows, tuple(pattern), _kind(dimension, batch, quadratic)))
    return result


def _kind(dimension: int, batch: RodBatch, quadratic: bool) -> RodKind:
    prefix = "planar" if dimension == 2 else "rod"
    names = [f"{prefix}_stretch"]
    if batch.bend:
        names.insert(0, f"{prefix}_bend_twist" if batch.twist else f"{prefix}_bend")
    check_laws(f"rod {batch.first} ('{batch.name}')", batch.laws, names)
    viscous = bool(np.any(np.asarray(batch.section.viscosity) > 0.0))
    keys = [*(term_key(name, batch.by_angle) for name in names[:-1]), names[-1]]  # the last is stretch
    terms = tuple(REGISTRY[key].of(batch.laws).damped(viscous) for key in keys)
    return RodKind(dimension, batch.twist, batch.closed, terms, quadratic=quadratic)


def piece_of(part: UniformRods, outside: GhostNodes, laws: list) -> RodArrays:
    """Return the arrays of some rods.

    Raises:
        SceneError: a director, a law or a rest shape is impossible; names the first rod.
    """
    batch, rows, rods, kind, (before, after) = part.batch, part.rows, part.rods, part.kind, part.ghosts
    points = np.asfortranarray(batch.points[rows])  # as all derived arrays: components of vectors are contiguous
    if kind.dim == 2:
        points = points * [1.0, 0.0, 1.0]
    if before:
        points = np.concatenate([ghost_node(points, 0, 1, outside.tangent[rods, 0]), points], axis=1)
    if after:
        points = np.concatenate([points, ghost_node(points, -1, -2, outside.tangent[rods, 1])], axis=1)
    edges = polyline.edge_vectors(points, batch.closed)
    lengths = polyline.length(edges)
    real = slice(before, lengths.shape[1] - after)
    tangents = edges / lengths[..., None]
    section = batch.section

    def on_edges(value):
        """Return a section property on all edges with ghosts, (1, 1) where uniform."""
        value = np.asarray(value, float)
        if value.ndim == 0:
            return value[None, None]
        full = np.broadcast_to(np.atleast_2d(value), (batch.rods, lengths[:, real].shape[1]))[rows]
        return np.pad(full, ((0, 0), (before, after)), mode="edge")

    rod_lengths = np.zeros_like(lengths)
    rod_lengths[:, real] = lengths[:, real]
    line_mass = on_edges(section.mass_per_length) * rod_lengths
    mass = np.zeros_like(points[..., 0])
    if batch.closed:
        mass += 0.5 * (line_mass + np.roll(line_mass, 1, axis=1))
    else:
        mass[:, :-1] += 0.5 * line_mass
        mass[:, 1:] += 0.5 * line_mass
    director = batch.director
    if director is not None and director.ndim > 1:
        director = np.broadcast_to(director, (batch.rods, *director.shape[1:]))[rows]
    frames = np.zeros_like(tangents)
    if kind.twist:
        frames[:, real] = polyline.directors(tangents[:, real], director)
        for end, neighbour in ((0, 1),) * before + ((-1, -2),) * after:
            frames[:, end] = end_director(end, neighbour, lengths, tangents, frames, outside.director[rods, end])
            failed = np.flatnonzero(~np.isfinite(frames[:, end]).all(1))
            if failed.size:
                raise SceneError(
                    f"rod {rods[failed[0]]} ('{batch.name}'): the director or tangent prescribed at its {'last' if end else 'first'} "
                    "end lies along the other or points back; give a tangent along the rod and a director across it"
                )
    twist = polyline.reference_twist(tangents, frames, batch.closed) if kind.twist else np.zeros((len(rows), 0))
    voronoi = 0.5 * sum(polyline.next_edges(lengths, batch.closed))
    if before:
        voronoi[:, 0] = 0.5 * lengths[:, 1]
    if after:
        voronoi[:, -1] = 0.5 * lengths[:, -2]
    natural = _natural(batch, rows, part.ghosts, kind, edges, tangents, frames, twist, voronoi) if batch.bend else []
    damping = on_edges(section.viscosity)

    cells = HalfCells(lengths, batch.closed, on_edges(section.EI1))
    parameters = {}
    for term in kind.terms:
        stretch = term.measure.span == 1
        if stretch:
            stiffness, rest, weight, spread = [on_edges(section.EA)], [np.ones((1, 1))], lengths, damping
        else:
            stiffness = [cells.stiffness(on_edges(value)) for value in _bending(section, kind)]
            rest, weight, spread = natural, voronoi, cells.viscosity(damping)
        inputs = {"measure": weight, "stiffness": stiffness, "rest": rest, "viscosity": spread}

        values = _bound(batch, term, inputs, on_edges, None if stretch else cells)
        parameters |= {f"{term.name}.{name}": compress(np.atleast_2d(v)) for name, v in values.items()}
    radius = on_edges(np.nan if section.radius is None else section.radius)
    return RodArrays(
        batch,
        rods,
        part.ghosts,
        kind,
        points[..., [0, 2]] if kind.dim == 2 else points,
        tangents,
        frames,
        twist,
        mass,
        on_edges(section.rotary_inertia) * rod_lengths,
        rod_lengths.sum(1),
        parameters,
        [on_edges(value) for value in (section.EI1, section.EI2, section.GJ)],
        {each.name: each.coefficients(rods, batch, radius, rod_lengths) for each in laws} if kind.quadratic else {},
    )


def _bound(batch: RodBatch, term: Term, inputs: dict, on_edges, cells: HalfCells | None) -> dict[str, np.ndarray]:
    """Return the parameters of a term by name from rod and law, on edges or at the vertices of `cells`."""

    def along(family, value):
        return on_edges(value) if cells is None else cells.along(family, on_edges(value))

    where, families = (
        f"rod {batch.first} ('{batch.name}'), {term.name}",
        {parameter.family for parameter in term.parameters},
    )
    law = batch.laws.get(term.name)
    unstrained = 1.0 if term.measure.span == 1 else 0.0
    bent = (np.abs((value - unstrained) * inputs["measure"]).max() > 1e-9 for value in inputs["rest"])
    if law is not None and "rest" not in families and any(bent):
        raise SceneError(f"{where}: the law {term.density.name!r} has no strains at rest; give natural='straight'")
    return bind_law(where, term, law, inputs, along, f"the {batch.rods} rods and {batch.edges} edges")


def _bending(section, kind: RodKind) -> list:
    if kind.twist:
        return [section.EI1, section.EI2, section.GJ]
    return [section.EI1] * (3 if kind.dim == 3 else 1)


def _natural(batch, rows, ghosts, kind, edges, tangents, frames, twist, voronoi) -> list[np.ndarray]:
    """Return the rest strains of the bending term, (R, vertices) each [1/m]."""
    if isinstance(batch.natural, str) and batch.natural == "straight":
        return [np.zeros((1, 1))] * (1 if kind.dim == 2 else 3)
    if kind.dim == 2:
        shape = [polyline.planar_curvature(edges[..., [0, 2]], batch.closed, batch.by_angle)]
    elif kind.twist:
        shape = [*polyline.curvatures(tangents, frames, batch.closed, batch.by_angle), twist]
    else:
        (t0, t1) = polyline.next_edges(tangents, batch.closed)
        if np.any(polyline.length(polyline.cross(t0, t1)) > 1e-9):
            raise SceneError(
                f"rod {batch.first} ('{batch.name}') is curved at rest, which needs twist=True; "
                "or give natural='straight' if it is straight when free"
            )
        return [np.zeros((1, 1))] * 3
    if isinstance(batch.natural, str):
        return [value / voronoi for value in shape]
    vertices = voronoi.shape[1] - sum(ghosts)
    strains = [np.broadcast_to(np.asarray(value, float), (batch.rods, vertices))[rows] for value in batch.natural]
    return [np.pad(value, ((0, 0), ghosts), mode="edge") for value in strains]


def compress(values: np.ndarray) -> np.ndarray:
    """Drop constant axes: (1, 1) for one number, (1, vertices) if rods are equal, (R, 1) if uniform along rods."""
    if np.all(values == values[:1, :1]):
        return values[:1, :1]
    if np.all(values == values[:1]):
        return values[:1]
    return values[:, :1] if np.all(values == values[:, :1]) else values

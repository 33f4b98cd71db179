"""From a scene to chains: rods sorted into groups of one kind and similar length, padded, in arrays (node, rod).

An end clamp adds a ghost node outside the rod: an edge without mass that holds the prescribed tangent and frame. The vertex at the
end node then has the half cell of the real edge as its Voronoi length, so the clamp lies exactly at the node, with the same
elements as everywhere else. Users never see ghosts: rods are addressed by their own nodes.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.geometry import polyline
from ddg_warp.kernels.element import ChainKind
from ddg_warp.kernels.terms import REGISTRY, Term, term_key
from ddg_warp.scene.descriptions import RodBatch, Support
from ddg_warp.scene.scene import Scene
from ddg_warp.scene.validate import check_batch, check_index

PADDING = 1.25  # longest over shortest rod of a group
STILL, FREE = -1, -2  # instead of a pose, of a dof that is held still, and of one that is free


@dataclass(frozen=True)
class Alike:
    """Rods of one batch with the same ghosts."""

    batch: RodBatch
    rows: np.ndarray  # of the batch
    ghosts: tuple[int, int]  # at the first and last node, 0 or 1
    kind: ChainKind

    @property
    def nodes(self) -> int:
        """Nodes of a rod, with ghosts."""
        return self.batch.nodes + sum(self.ghosts)

    @property
    def rods(self) -> np.ndarray:
        """The scene's indices."""
        return self.batch.first + self.rows

    @property
    def runs(self) -> list["Alike"]:
        """The same rods, a few at a time, so that what is computed on the way to their arrays stays in the processor's cache."""
        return [replace(self, rows=rows) for rows in self.batch.runs(self.rows)]


@dataclass
class Piece:
    """A run of rods of one batch with the same ghosts: arrays (R, ...) including ghosts; see `ChainGroup` for their meaning."""

    batch: RodBatch
    rods: np.ndarray
    ghosts: tuple[int, int]
    kind: ChainKind
    x: np.ndarray
    tangent: np.ndarray
    director: np.ndarray
    reference_twist: np.ndarray
    mass: np.ndarray
    rotary: np.ndarray
    length: np.ndarray
    parameters: dict[str, np.ndarray]
    stiffness: list[np.ndarray]  # EI1, EI2 and GJ of the section, each broadcastable to (R, edges)


@dataclass(frozen=True)
class TimedLoad:
    """A load that changes: force on nodes k [N], or moment and couple on edges k [N m], of rods in `columns`."""

    k: np.ndarray
    columns: np.ndarray
    force: np.ndarray
    moment: float
    couple: np.ndarray
    amplitude: Callable[[float], float] | None

    def at(self, t: float, otherwise: float) -> float:
        """Its amplitude at t, or `otherwise` if it has none.

        Raises:
            SolverError: the amplitude is not finite; names the function and the time.
        """
        return otherwise if self.amplitude is None else float(arguments.value_at("the amplitude", self.amplitude, t))


@dataclass(eq=False)
class ChainGroup:
    """Rods of one kind and similar length, on the host. R rods, n nodes of the longest.

    Attributes:
        kind: dimension, twist, closedness and terms.
        rods: scene's indices of the rods (R,).
        first: number of ghosts before the first node (R,).
        own: nodes of the rods (R,); count: the same with ghosts (R,).
        x: positions (n, R, dim) [m].
        frame: first director, tangent (n, R, 3) each and reference twist (n, R) [rad] of every edge, as (7, n, R).
        mass: of nodes (n, R) [kg]; rotary: inertia of edges about the tangent (n, R) [kg m^2].
        fixed: bits of the held components of a node; the bit after the components is the angle (n, R).
        length: of the rod (R,) [m].
        load: force on nodes (n, R, dim) [N]; load_angle: twisting moment on edges (n, R) [N m]; None without constant loads.
        parameters: of all terms, "term.parameter", each broadcastable to (n, R).
        moving_nodes: arrays (., 5) of (node, rod, motion of each of three components, -1 for none); every node in one row.
        moving_edges: arrays (., 3) of (edge, rod, motion).
        timed_loads: loads with an amplitude, and couples.
    """

    kind: ChainKind
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
    parameters: dict[str, np.ndarray]
    load: np.ndarray
    load_angle: np.ndarray
    loaded: bool = False
    moving_nodes: list = field(default_factory=list)
    moving_edges: list = field(default_factory=list)
    timed_loads: list[TimedLoad] = field(default_factory=list)

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes of the longest rod, rods."""
        return self.mass.shape


@dataclass(frozen=True)
class Held:
    """Dofs that a support holds in one group: nodes with components, or edge angles (components 0)."""

    group: int
    k: np.ndarray
    columns: np.ndarray
    components: int


def compile_chains(scene: Scene) -> tuple[list[ChainGroup], list[list[Held]]]:
    """Groups of a scene's rods, and what each of its supports holds.

    Raises:
        SceneError: the scene is no simulation; the message names the object and its index.
    """
    if not scene.batches and not scene.shells and not scene.axisymmetric_shells:
        raise SceneError(
            "the scene has no rods and no shells; add some with scene.add_rods(points, section=..., material=...)"
        )
    ghosts, joined = Ghosts(scene), net_rods(scene)
    parts = [part for batch in scene.batches for part in alike(scene.dimension, batch, ghosts, ~joined)]
    parts.sort(key=lambda part: (*part.kind.key, part.nodes))
    groups: list[list[Alike]] = []
    for part in parts:
        last = groups[-1] if groups else None
        if last and last[0].kind == part.kind and part.nodes <= PADDING * last[0].nodes:
            last.append(part)
        else:
            groups.append([part])
    chains = [_join(group, ghosts) for group in groups]
    place = np.full((scene.rod_count, 2), -1)  # rods of the net have none
    for g, chain in enumerate(chains):
        place[chain.rods] = np.column_stack([np.full(len(chain.rods), g), np.arange(len(chain.rods))])
    claims = _Claims(scene, chains)
    held = [_hold(chains, place, support, claims) for support in scene.supports]
    claims.finish()
    _apply_loads(scene, chains, place)
    return chains, held


class Ghosts:
    """Ghost nodes outside the ends of a scene's rods.

    Attributes:
        count: at the first and last node of every rod (R, 2), 0 or 1.
        tangent, director: prescribed there (R, 2, 3); NaN where they are to be extrapolated.

    Raises:
        SceneError: two supports prescribe different tangents or directors of an end.
    """

    def __init__(self, scene: Scene):
        self.count = np.zeros((scene.rod_count, 2), int)
        self.tangent, self.director = (np.full((scene.rod_count, 2, 3), np.nan) for _ in range(2))
        for support in scene.supports:
            if not support.end:
                continue
            end = 0 if support.end == "first" else 1
            self.count[support.rods, end] = 1
            for name in ("tangent", "director"):
                given, known = getattr(support, name), getattr(self, name)
                if given is None:
                    continue
                before = known[support.rods, end]
                other = np.flatnonzero(np.abs(before - given).max(1) > 1e-12)  # nothing before is NaN, and not larger
                if other.size:
                    raise SceneError(
                        f"the {support.end} end of rod {support.rods[other[0]]} is clamped twice, with a {name} "
                        f"{before[other[0]]} and {given[other[0]]}; clamp it once"
                    )
                known[support.rods, end] = given


def net_rods(scene: Scene) -> np.ndarray:
    """Which rods belong to the scene's net: those that are joined or attached to something, or magnetised (R,) bool."""
    members = [rod for joint in scene.joints for rod, _ in joint.members]
    members += [attachment.rod for attachment in scene.attachments]
    chosen = np.zeros(scene.rod_count, bool)
    chosen[np.array(members, int)] = True
    for magnet in scene.magnets:
        chosen[magnet.rods] = True
    return chosen


def scene_motions(scene: Scene) -> list:
    """The different motions of a scene's supports, in order of appearance."""
    supports = [*scene.supports, *scene.shell_supports, *scene.ring_supports]
    return list({id(s.motion): s.motion for s in supports if s.motion is not None}.values())


def alike(dimension: int, batch: RodBatch, ghosts: Ghosts, chosen: np.ndarray) -> list[Alike]:
    """The chosen rods (R,) of a batch, those with the same ghosts together."""
    check_batch(batch, dimension)
    chosen = chosen[batch.first : batch.first + batch.rods]
    flags = ghosts.count[batch.first : batch.first + batch.rods]
    if batch.closed and flags.any():
        raise SceneError(f"rod {batch.first + int(np.argmax(flags.any(1)))} is closed: it has no end to clamp")
    result = []
    for pattern in product((0, 1), repeat=2):
        rows = np.flatnonzero((flags == pattern).all(1) & chosen)
        if rows.size:
            result.append(Alike(batch, rows, pattern, _kind(dimension, batch)))
    return result


def _kind(dimension: int, batch: RodBatch) -> ChainKind:
    prefix = "planar" if dimension == 2 else "rod"
    names = [f"{prefix}_stretch"]
    if batch.bend:
        names.insert(0, f"{prefix}_bend_twist" if batch.twist else f"{prefix}_bend")
    for term in batch.laws:
        if term not in names:
            raise SceneError(
                f"rod {batch.first} ('{batch.name}'): it has no term {term!r} to give a law; it has {', '.join(names)}"
            )
    viscous = bool(np.any(np.asarray(batch.section.viscosity) > 0.0))
    keys = [*(term_key(name, batch.by_angle) for name in names[:-1]), names[-1]]  # the last is stretch
    terms = tuple(REGISTRY[key].of(batch.laws).damped(viscous) for key in keys)
    return ChainKind(dimension, batch.twist, batch.closed, terms)


def piece_of(part: Alike, outside: Ghosts) -> Piece:
    """The arrays of some rods.

    Raises:
        SceneError: a director, a law or a rest shape that they cannot have; names the first rod.
    """
    batch, rows, rods, kind, (before, after) = part.batch, part.rows, part.rods, part.kind, part.ghosts
    points = np.asfortranarray(batch.points[rows])  # as what is made of it: components of vectors lie together
    if kind.dim == 2:
        points = points * [1.0, 0.0, 1.0]
    if before:
        points = np.concatenate([_ghost(points, 0, 1, outside.tangent[rods, 0]), points], axis=1)
    if after:
        points = np.concatenate([points, _ghost(points, -1, -2, outside.tangent[rods, 1])], axis=1)
    edges = polyline.edge_vectors(points, batch.closed)
    lengths = polyline.length(edges)
    real = slice(before, lengths.shape[1] - after)
    tangents = edges / lengths[..., None]
    section = batch.section

    def on_edges(value):
        """A stiffness on all edges with ghosts, (1, 1) where it is uniform."""
        value = np.asarray(value, float)
        if value.ndim == 0:
            return value[None, None]
        full = np.broadcast_to(np.atleast_2d(value), (batch.rods, lengths[:, real].shape[1]))[rows]
        return np.pad(full, ((0, 0), (before, after)), mode="edge")

    own = np.zeros_like(lengths)
    own[:, real] = lengths[:, real]
    line_mass = on_edges(section.mass_per_length) * own
    mass = np.zeros_like(points[..., 0])
    if batch.closed:
        mass += 0.5 * (line_mass + np.roll(line_mass, 1, axis=1))
    else:
        mass[:, :-1] += 0.5 * line_mass
        mass[:, 1:] += 0.5 * line_mass
    given = batch.director
    if given is not None and given.ndim > 1:
        given = np.broadcast_to(given, (batch.rods, *given.shape[1:]))[rows]
    frames = np.zeros_like(tangents)
    if kind.twist:
        frames[:, real] = polyline.directors(tangents[:, real], given)
        for end, neighbour in ((0, 1),) * before + ((-1, -2),) * after:
            frames[:, end] = _end_director(end, neighbour, lengths, tangents, frames, outside.director[rods, end])
            bad = np.flatnonzero(~np.isfinite(frames[:, end]).all(1))
            if bad.size:
                raise SceneError(
                    f"rod {rods[bad[0]]} ('{batch.name}'): the director or tangent prescribed at its {'last' if end else 'first'} "
                    "end lies along the other or points back; give a tangent along the rod and a director across it"
                )
    twist = polyline.reference_twist(tangents, frames, batch.closed) if kind.twist else np.zeros((len(rows), 0))
    voronoi = 0.5 * sum(polyline.ahead(lengths, batch.closed))
    if before:
        voronoi[:, 0] = 0.5 * lengths[:, 1]
    if after:
        voronoi[:, -1] = 0.5 * lengths[:, -2]
    natural = _natural(batch, rows, part.ghosts, kind, edges, tangents, frames, twist, voronoi) if batch.bend else []
    damping = on_edges(section.viscosity)

    def on_vertices(value):
        value = on_edges(value)
        return value if value.shape == (1, 1) else 0.5 * sum(polyline.ahead(value, batch.closed))

    parameters = {}
    for term in kind.terms:
        stretch = term.measure.span == 1
        if stretch:
            stiffness, rest, weight, spread = [on_edges(section.EA)], [np.ones((1, 1))], lengths, damping
        else:
            stiffness = [on_vertices(value) for value in _bending(section, kind)]
            rest, weight, spread = natural, voronoi, on_vertices(section.viscosity)
        given = {"measure": weight, "stiffness": stiffness, "rest": rest, "viscosity": spread}
        values = _bound(batch, term, given, on_edges if stretch else on_vertices)
        parameters |= {f"{term.name}.{name}": _compress(np.atleast_2d(v)) for name, v in values.items()}
    return Piece(
        batch,
        rods,
        part.ghosts,
        kind,
        points[..., [0, 2]] if kind.dim == 2 else points,
        tangents,
        frames,
        twist,
        mass,
        on_edges(section.rotary_inertia) * own,
        own.sum(1),
        parameters,
        [on_edges(value) for value in (section.EI1, section.EI2, section.GJ)],
    )


def _bound(batch: RodBatch, term: Term, given: dict, along) -> dict[str, np.ndarray]:
    """Parameters of a term by name, from what the rod gives and what its law says; `along` puts values where the term has them."""
    where, families = f"rod {batch.first} ('{batch.name}'), {term.name}", {known.family for known in term.parameters}
    law = batch.laws.get(term.name)
    unstrained = 1.0 if term.measure.span == 1 else 0.0
    bent = (np.abs((value - unstrained) * given["measure"]).max() > 1e-9 for value in given["rest"])
    if law is not None and "rest" not in families and any(bent):
        raise SceneError(f"{where}: the law {term.density.name!r} has no strains at rest; give natural='straight'")
    given = {family: value for family, value in given.items() if family in families}
    for family, value in law.values.items() if law else ():
        try:
            given[family] = [along(v) for v in value] if isinstance(value, list | tuple) else along(value)
        except (TypeError, ValueError):
            raise SceneError(
                f"{where}: {family} = {value!r}; give numbers that broadcast to the {batch.rods} rods and {batch.edges} edges"
            ) from None
    try:
        values = term.bind(**given)
    except TypeError as error:
        raise SceneError(f"{where}: law {term.density.name!r}: {error}; give it with Law(density, ...)") from None
    for known in term.parameters if law else ():
        rule, holds = known.valid
        if not np.all(np.isfinite(values[known.name]) & holds(values[known.name])):
            raise SceneError(f"{where}: {known.name} = {values[known.name]}; it is finite and {rule}")
    return values


def _ghost(points: np.ndarray, end: int, neighbour: int, given: np.ndarray) -> np.ndarray:
    """Ghost node outside the end of rods: along the `given` tangent (R, 3), or one extrapolated from the two edges there."""
    edge = points[:, end] - points[:, neighbour]
    length = np.linalg.norm(edge, axis=-1, keepdims=True)
    tangent = edge / length
    if points.shape[1] > 2:
        inner = points[:, neighbour] - points[:, 2 * neighbour - end]
        inner_length = np.linalg.norm(inner, axis=-1, keepdims=True)
        tangent = polyline.unit(tangent + (tangent - inner / inner_length) * (length / (length + inner_length)))
    outwards = given if end else -given
    tangent = np.where(np.isnan(given), tangent, outwards)
    return (points[:, end] + tangent * length)[:, None]


def _end_director(
    end: int, neighbour: int, lengths: np.ndarray, tangents: np.ndarray, frames: np.ndarray, given: np.ndarray
) -> np.ndarray:
    """First director of the ghost edges at an end of rods (R, 3): `given`, or turning on as between the two edges inside of it.

    NaN where there is none, since the tangent points back or `given` lies along it.
    """
    edges = [tuple(v[:, e] for v in (frames, tangents, lengths)) for e in (2 * neighbour - end, neighbour)]
    inner, outer = tangents[:, neighbour], tangents[:, end]
    bad = np.sum(inner * outer, -1, keepdims=True) <= -1.0 + 1e-12
    _, turned = polyline.frames_at_nodes(*edges, 1.0, np.where(bad, inner, outer))
    u = np.where(np.isnan(given), turned, given)
    across = u - outer * np.sum(u * outer, -1, keepdims=True)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    bad |= length < 1e-9
    return np.where(bad, np.nan, across / np.where(bad, 1.0, length))


def _bending(section, kind: ChainKind) -> list:
    if kind.twist:
        return [section.EI1, section.EI2, section.GJ]
    return [section.EI1] * (3 if kind.dim == 3 else 1)


def _natural(batch, rows, ghosts, kind, edges, tangents, frames, twist, voronoi) -> list[np.ndarray]:
    """Strains at rest of the bending term, (R, vertices) each [1/m]."""
    if isinstance(batch.natural, str) and batch.natural == "straight":
        return [np.zeros((1, 1))] * (1 if kind.dim == 2 else 3)
    if kind.dim == 2:
        shape = [polyline.planar_curvature(edges[..., [0, 2]], batch.closed, batch.by_angle)]
    elif kind.twist:
        shape = [*polyline.curvatures(tangents, frames, batch.closed, batch.by_angle), twist]
    else:
        (t0, t1) = polyline.ahead(tangents, batch.closed)
        if np.any(polyline.length(polyline.cross(t0, t1)) > 1e-9):
            raise SceneError(
                f"rod {batch.first} ('{batch.name}') is curved at rest, which needs twist=True; "
                "or give natural='straight' if it is straight when free"
            )
        return [np.zeros((1, 1))] * 3
    if isinstance(batch.natural, str):
        return [value / voronoi for value in shape]
    vertices = voronoi.shape[1] - sum(ghosts)
    given = [np.broadcast_to(np.asarray(value, float), (batch.rods, vertices))[rows] for value in batch.natural]
    return [np.pad(value, ((0, 0), ghosts), mode="edge") for value in given]


def _compress(values: np.ndarray) -> np.ndarray:
    """(1, 1) for one number, (1, vertices) where all rods are alike, (R, 1) where rods are uniform."""
    if np.all(values == values[:1, :1]):
        return values[:1, :1]
    if np.all(values == values[:1]):
        return values[:1]
    return values[:, :1] if np.all(values == values[:, :1]) else values


def _join(parts: list[Alike], ghosts: Ghosts) -> ChainGroup:
    kind, rods = parts[0].kind, np.concatenate([part.rods for part in parts])
    count = np.concatenate([np.full(len(part.rods), part.nodes) for part in parts])
    n, total = int(count.max()), len(rods)
    x, frame = np.zeros((n, total, kind.dim)), np.zeros((kind.lagged_rows, n, total))
    mass, rotary, length, parameters, at = np.zeros((n, total)), np.zeros((n, total)), np.zeros(total), [], 0
    for run in (run for part in parts for run in part.runs):
        piece, columns = piece_of(run, ghosts), slice(at, at + len(run.rods))
        edges = piece.rotary.shape[1]
        x[: run.nodes, columns] = piece.x.swapaxes(0, 1)
        mass[: run.nodes, columns], rotary[:edges, columns] = piece.mass.T, piece.rotary.T
        if kind.twist:
            frame[0:3, :edges, columns], frame[3:6, :edges, columns] = piece.director.T, piece.tangent.T
            frame[6, : piece.reference_twist.shape[1], columns] = piece.reference_twist.T
        length[columns], at = piece.length, columns.stop
        parameters.append((len(run.rods), piece.parameters))
    fixed = np.zeros((n, total), np.uint8)
    if kind.twist and not kind.closed:
        fixed[count - 1, np.arange(total)] = 1 << kind.dim  # the last node starts no edge
    return ChainGroup(
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
        parameters={
            name: _join_parameter([(rods, values[name]) for rods, values in parameters], n) for name in parameters[0][1]
        },
        load=np.zeros((n, total, kind.dim)),
        load_angle=np.zeros((n, total)),
    )


def _join_parameter(values: list[tuple[int, np.ndarray]], n: int) -> np.ndarray:
    """One parameter of runs of so many rods each as (node, rod), with size 1 along what it does not depend on."""
    along = any(value.shape[1] > 1 for _, value in values)
    out, at = np.zeros((n if along else 1, sum(rods for rods, _ in values))), 0
    for rods, value in values:
        columns, at = slice(at, at + rods), at + rods
        out[: value.shape[1], columns] = value.T
        out[value.shape[1] :, columns] = value.T[-1:]
    return _compress(out.T).T


def component_bits(components: str, dim: int) -> int:
    axes = "xz" if dim == 2 else "xyz"
    unknown = set(components) - set("xyz")
    if unknown:
        raise SceneError(f"fix: components {components!r}; they are letters of 'xyz'")
    return sum(1 << axes.index(c) for c in components if c in axes)


def _hold(chains: list[ChainGroup], place: np.ndarray, support: Support, claims: "_Claims") -> list[Held]:
    first = claims.first(support)
    each = first >= 0 and support.motion.count is not None

    def rows(chain, nth: int) -> np.ndarray:
        """Pose of the motion of the nth place named of each rod in a group, -1 for none."""
        among = np.flatnonzero(place[support.rods, 0] == chains.index(chain))
        return first + (among * len(support.nodes) + nth if each else 0 * among)

    found = [
        (n, at) for n, node in enumerate(support.nodes) for at in _places(chains, place, support.rods, node, "node")
    ]
    nodes = [(*at, rows(at[0], n)) for n, at in found]
    edges = [
        (*at, rows(at[0], 0)) for edge in support.edges for at in _places(chains, place, support.rods, edge, "edge")
    ]
    if support.end:
        for chain, k, columns in _places(chains, place, support.rods, 0 if support.end == "first" else -1, "node"):
            ghost, row = k + (-1 if support.end == "first" else 1), rows(chain, 0)
            nodes += [(chain, k, columns, row), (chain, ghost, columns, row)]
            edges += [(chain, np.minimum(k, ghost), columns, row)]
    held = []
    for chain, k, columns, row in nodes:
        bits = component_bits(support.components, chain.kind.dim)
        chain.fixed[k, columns] |= np.uint8(bits)
        claims.take(chain, k, columns, bits, row)
        held.append(Held(chains.index(chain), k, columns, bits))
    for chain, k, columns, row in edges:
        if chain.kind.twist:
            chain.fixed[k, columns] |= np.uint8(1 << chain.kind.dim)
            claims.take(chain, k, columns, 1 << chain.kind.dim, row)
            held.append(Held(chains.index(chain), k, columns, 0))
    return held


class _Claims:
    """Which pose moves each held dof of the chains; a dof that two poses, or one and a still support, claim is refused."""

    def __init__(self, scene: Scene, chains: list[ChainGroup]):
        motions = scene_motions(scene)
        start = pose_starts(motions)
        self.place = {id(motion): int(start[i]) for i, motion in enumerate(motions)}
        # without motions nothing can disagree
        shapes = [(*chain.shape, chain.kind.dim + 1) for chain in chains] if motions else []
        self.poses = {id(chain): np.full(shape, FREE) for chain, shape in zip(chains, shapes, strict=False)}
        self.chains = chains

    def first(self, support: Support) -> int:
        """First pose of a support's motion, `STILL` without."""
        return STILL if support.motion is None else self.place[id(support.motion)]

    def take(self, chain: ChainGroup, k: np.ndarray, columns: np.ndarray, bits: int, row: np.ndarray) -> None:
        """Give the dofs of nodes or edges k to the poses `row`, `STILL` for supports that stay."""
        if not self.poses:
            return
        poses, dim = self.poses[id(chain)], chain.kind.dim
        for d in (d for d in range(dim + 1) if (bits >> d) & 1):
            before = poses[k, columns, d]
            for i in np.flatnonzero((before != FREE) & (before != row))[:1]:
                at = f"{k[i] - chain.first[columns[i]]} of rod {chain.rods[columns[i]]}"
                where, axis = ("edge", "") if d == dim else ("node", f" along {('xz' if dim == 2 else 'xyz')[d]}")
                raise SceneError(disagreement(f"{where} {at}", axis, min(before[i], row[i]) == STILL))
            poses[k, columns, d] = row

    def finish(self) -> None:
        """Leave what moves to the chains."""
        for chain in self.chains if self.poses else ():
            poses, dim = self.poses[id(chain)], chain.kind.dim
            k, column = np.nonzero((poses[..., :dim] > STILL).any(-1))
            rows = np.full((len(k), 3), STILL)
            rows[:, :dim] = np.maximum(poses[k, column, :dim], STILL)
            chain.moving_nodes = [np.column_stack([k, column, rows])] if len(k) else []
            k, column = np.nonzero(poses[..., dim] > STILL)
            chain.moving_edges = [np.column_stack([k, column, poses[k, column, dim]])] if len(k) else []


def pose_starts(motions: list) -> np.ndarray:
    """First pose of every motion, among those of all: one a motion, or one for each node that it displaces."""
    return np.cumsum([0, *(motion.count or 1 for motion in motions)])


def disagreement(where: str, axis: str, still: bool) -> str:
    """What to tell of a dof that two supports would have in two places."""
    if still:
        return (
            f"{where} is held still by one support and moved by another{axis}; leave one of them out, give the moving one other "
            "components, or give both the same motion"
        )
    return f"{where} has two motions{axis}; give it one that does both"


def _apply_loads(scene: Scene, chains: list[ChainGroup], place: np.ndarray) -> None:
    keep = [0, 2] if scene.dimension == 2 else [0, 1, 2]
    for rods, node, mass in scene.masses:
        for chain, k, columns in _places(chains, place, rods, node, "node"):
            chain.mass[k, columns] += mass
    for load in scene.loads:
        force, couple = np.asarray(load.force, float)[keep], np.asarray(load.couple, float)
        what, index = ("node", load.node) if load.edge is None else ("edge", load.edge)
        for chain, k, columns in _places(chains, place, load.rods, index, what):
            chain.loaded = True
            if load.amplitude is None and not couple.any():
                np.add.at(chain.load, (k, columns), force)
                np.add.at(chain.load_angle, (k, columns), load.moment)
            else:
                chain.timed_loads.append(TimedLoad(k, columns, force, load.moment, couple, load.amplitude))


def _places(chains, place, rods, index, what):
    """Where node or edge `index` of rods lies: (chain, nodes, columns) of each group."""
    for g in np.unique(place[rods, 0][place[rods, 0] >= 0]):
        chain = chains[g]
        columns = place[rods, 1][place[rods, 0] == g]
        own = chain.own[columns] - (1 if what == "edge" and not chain.kind.closed else 0)
        check_index(what, index, own, chain.rods[columns])
        yield chain, chain.first[columns] + np.where(index < 0, own + index, index), columns

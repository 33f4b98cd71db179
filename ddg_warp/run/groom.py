"""Simulation of a groom: strands of a USD file on an animated skin, written back as a layer over the file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.kernels.densities.quadratic import quadratic
from ddg_warp.model.state import State
from ddg_warp.progress import progress_bar
from ddg_warp.scene.animated_mesh import AnimatedMesh, nearest_on_triangles
from ddg_warp.scene.law import Law
from ddg_warp.scene.material import Circle, Material
from ddg_warp.scene.scene import Scene
from ddg_warp.solve.stepping.integrator import Integrator
from ddg_warp.typing import Device, FilePath, Floats, Integers, Precision

if TYPE_CHECKING:
    from ddg_warp.io.usd_groom import Groom

SKIN = "skin"
RANGE = 5.0  # activation distance of contact with the skin over the largest radius
WEIGHTS = 3.0  # stiffness of contact with the skin times its range, in weights of the heaviest strand
GRAVITY = 9.81  # m/s^2
Value: TypeAlias = (
    "float | str | Mapping[int, float | str] | Mapping[str, float | str]"  # a number, a primvar, or either by group
)


@dataclass(frozen=True, eq=False)
class GroomScene:
    """Scene of the strands of a groom.

    Attributes:
        scene: the scene; strands are rods sorted by group and number of nodes.
        strands: strand of each rod (R,).
        nodes: node of the model of each node of the groom (P,).
        root_length: arc length from the roots without contact with the skin [m], by group.
    """

    scene: Scene
    strands: Integers
    nodes: Integers
    root_length: dict[str, float]


@dataclass(frozen=True, eq=False)
class GroomRun:
    """Finished simulation of a groom.

    Attributes:
        groom: the groom; `groom.unread` lists unread content.
        built: scene and order of strands.
        state: last state.
        path: the layer.
        error: largest distance between a node and its written curve [m], see `GroomLayer`.
        statistics: of the integrator.
    """

    groom: Groom
    built: GroomScene
    state: State
    path: Path
    error: float
    statistics: dict[str, object]


def groom_scene(
    groom: Groom,
    skin: AnimatedMesh | None = None,
    *,
    young: Value = 2e9,
    density: float = 1300.0,
    poisson: float = 0.4,
    radius: Value | None = None,
    curl: Value | None = None,
    twist: Value | None = None,
    group: str | None = None,
    sag_free: bool = False,
    damping: float = 1.0,
    friction: float = 0.2,
    contact: bool = True,
    self_contact: bool = False,
    range: float | None = None,
    root_length: float | None = None,
) -> GroomScene:
    """Return the scene of a groom on a skin.

    The first edge of each strand is clamped in a frame of the nearest triangle of the skin, or without a skin in the frame of its
    prim. Values along the strands are numbers, names of primvars of any interpolation, or either by group. Edges take the mean of
    both ends.

    Args:
        groom: strands, see `ddg.usd.open_groom`.
        skin: surface that strands grow from and collide with, see `ddg.usd.read_animated_mesh`.
        young: Young's modulus [Pa].
        density, poisson: density [kg/m^3] and Poisson's ratio.
        radius: radius [m]; by default half the widths of the file.
        curl, twist: natural curvature and twist [1/m], by default of the drawn shape.
        group: primvar whose values are the groups; by default `Groom.groups`.
        sag_free: whether rest shapes balance the weight, so that strands at rest hang as drawn.
        damping: mass-proportional damping [1/s].
        friction: coefficient of friction with the skin and among strands.
        contact: whether strands collide with the skin.
        self_contact: whether strands collide with each other, too; they must not overlap as drawn.
        range: gap below which contact with the skin acts [m]; by default five times the largest radius. Its stiffness makes it
            carry strands well within the range, and is far below the bending stiffness that bodies take by default.
        root_length: arc length from the root without contact with the skin [m]. By default each group has the least length with
            which all other nodes up to the first that is clear of the skin, beyond the range, are left out.

    Raises:
        SceneError: an invalid value; names group or strand.
        CurveError: a primvar is missing.
    """
    from ddg_warp.io.usd_groom import Groom

    if not isinstance(groom, Groom):
        raise SceneError(f"groom_scene: groom is {argument_checks.shown(groom)}; give the result of ddg.usd.open_groom")
    if skin is not None and not isinstance(skin, AnimatedMesh):
        raise SceneError(
            f"groom_scene: skin is {argument_checks.shown(skin)}; give an AnimatedMesh, as ddg.usd.read_animated_mesh returns"
        )
    flags = {"contact": contact, "self_contact": self_contact, "sag_free": sag_free}
    contact, self_contact, sag_free = (argument_checks.flag(f"groom: {name}", value) for name, value in flags.items())
    contact = contact and skin is not None
    groups = (groom.groups if group is None else groom.of_strands(group)).astype(str)
    strands = np.lexsort((groom.counts, groom.closed, groups))
    radius = _along(groom, "radius", groom.radius if radius is None else radius, groups)
    young = _along(groom, "young", young, groups)
    for label, values in (("radius", radius), ("young", young)):
        for node in np.flatnonzero(~((values > 0.0) & np.isfinite(values)))[:1]:
            raise SceneError(f"groom: {label} is {values[node]:g} at node {node}; give positive numbers")
    natural = {
        name: _along(groom, name, 0.0 if value is None else value, groups)
        for name, value in (("curl", curl), ("twist", twist))
    }
    drawn = curl is None and twist is None
    if sag_free and not drawn:
        raise SceneError("groom: sag_free finds natural curvature and twist; leave out sag_free, or curl and twist")
    scene, rods, chunks = Scene(mass_damping=damping), [], _chunks(strands, groups, groom)
    bodies = {"young": young, "radius": radius, "density": density, "poisson": poisson}
    rest = _sag_free(groom, chunks, **bodies) if sag_free else [{}] * len(chunks)
    for chunk, more in zip(chunks, rest, strict=True):
        if not drawn:
            inner = _nodes(groom, chunk)[:, slice(None) if groom.closed[chunk[0]] else slice(1, -1)]
            more = {"natural": [natural["curl"][inner], 0.0 * inner, natural["twist"][inner]]}
        rods += _add(scene, groom, chunk, **bodies, name=groups[chunk[0]], **more)
    first = np.cumsum(groom.counts) - groom.counts
    _hold(scene, rods, groom.points[first[strands]], groom, strands, skin)
    lengths = {}
    if contact or self_contact:
        scene.contact(friction=friction)
        if contact:
            range = (
                RANGE * float(radius.max()) if range is None else argument_checks.positive("groom: range", range, "m")
            )
            stiffness = WEIGHTS * _heaviest(groom, radius, density) / range
            scene.add_obstacle(skin.obstacle(), motion=skin.motion(), name=SKIN)
            clear = (
                _clear_lengths(groom, skin, radius + range)
                if root_length is None
                else np.full(len(groups), root_length)
            )
        for name in np.unique(groups).tolist():
            if contact:
                lengths[name] = float(clear[groups == name].max())
                scene.contact_between(name, SKIN, range=range, stiffness=stiffness, root_length=lengths[name])
            if not self_contact:
                for partner in np.unique(groups[groups >= name]).tolist():
                    scene.contact_between(name, partner, ignore=True)
    starts = np.empty(len(strands), int)
    starts[strands] = np.cumsum(groom.counts[strands]) - groom.counts[strands]
    nodes = np.arange(len(groom.points)) + np.repeat(starts - first, groom.counts)
    return GroomScene(scene, strands, nodes, lengths)


def simulate_groom(
    path: FilePath,
    prim: str | None = None,
    *,
    out: FilePath,
    skin: str | AnimatedMesh | None = None,
    samples: str | int = "interpolating",
    substeps: int = 4,
    frames: int | None = None,
    device: Device = None,
    precision: Precision | None = None,
    outside: bool = False,
    progress: bool = True,
    **options: Value | bool | None,
) -> GroomRun:
    """Simulate a groom over the time codes of a stage, and write a layer over the stage.

        ddg.simulate_groom("shot.usda", "/head/hair", skin="/head/mesh", out="hair.usda", young=1e9, sag_free=True)

    A frame is one time code. If a step fails, the frames before it are written.

    Args:
        path, prim, samples, outside: see `ddg.usd.open_groom`.
        out: the layer, see `ddg.usd.GroomLayer`.
        skin: path of the mesh that strands grow from, in the same file, or an `AnimatedMesh`.
        substeps: time steps of a frame.
        frames: number of frames after the first; by default up to the last time code.
        device, precision: see `Scene.build`.
        progress: whether to show progress.
        options: arguments of `groom_scene`.

    Raises:
        CurveError, MeshError, SceneError: see `ddg.usd.open_groom`, `ddg.usd.read_animated_mesh` and `groom_scene`.
        SolverError: a step fails.
    """
    for name in options:
        if name not in (valid := argument_checks.names(groom_scene)[2:]):
            near = argument_checks.meant(name, [*valid, *argument_checks.names(simulate_groom)])
            raise SceneError(f"simulate_groom takes no {name!r}{near}")
    from ddg_warp.io.usd_animated_mesh import read_animated_mesh
    from ddg_warp.io.usd_groom import open_groom
    from ddg_warp.io.usd_groom_layer import GroomLayer

    groom = open_groom(path, prim, samples=samples, outside=outside)
    if isinstance(skin, str):
        skin = read_animated_mesh(path, skin, start=groom.start, outside=outside)
    substeps = argument_checks.count("simulate_groom: substeps", substeps)
    last = (
        round(groom.end - groom.start) if frames is None else argument_checks.count("simulate_groom: frames", frames, 0)
    )
    built = groom_scene(groom, skin, **options)
    model = built.scene.build(device, precision)
    integrator, state = Integrator(model), model.state()
    with GroomLayer(groom, out) as layer:
        layer.write(0.0, state.points()[built.nodes], state.velocities()[built.nodes])
        with progress_bar(last, 0, argument_checks.flag("simulate_groom: progress", progress), unit="frame") as bar:
            for frame in range(1, last + 1):
                for _ in range(substeps):
                    state = integrator.step(state, 1.0 / (groom.rate * substeps))
                bar.set_description("groom")
                layer.write(frame / groom.rate, state.points()[built.nodes], state.velocities()[built.nodes])
                bar.update()
    return GroomRun(groom, built, state, layer.path, layer.error, integrator.statistics())


def _along(groom: Groom, label: str, value: Value | Floats | None, groups: np.ndarray) -> Floats:
    """Return the values at all nodes (P,)."""
    if value is None:
        raise SceneError(f"groom: the file has no widths; give {label}, a number [m] or a primvar")
    owners = np.repeat(groups, groom.counts)
    if isinstance(value, Mapping):
        named = {str(key): each for key, each in value.items()}
        result = np.empty(len(groom.points))
        for name in np.unique(groups).tolist():
            if name not in named:
                raise SceneError(
                    f"groom: {label} has no value for group {name!r}; it has {', '.join(map(repr, named))}; "
                    "group= names the primvar of the groups"
                )
            result[owners == name] = _along(groom, label, named[name], groups)[owners == name]
        return result
    if isinstance(value, str):
        value = groom.at_nodes(value)
    values = argument_checks.array(f"groom: {label}", value, "give a number, a primvar, or either by group")
    if values.shape not in ((), (len(groom.points),)):
        raise SceneError(
            f"groom: {label} has shape {values.shape}; give a number, or one for each of {len(groom.points)} nodes"
        )
    return np.broadcast_to(values, len(groom.points))


def _chunks(strands: Integers, groups: np.ndarray, groom: Groom) -> list[Integers]:
    """Return runs of strands of one group, one number of nodes and one kind, closed or open."""
    kinds = list(
        zip(groups[strands].tolist(), groom.counts[strands].tolist(), groom.closed[strands].tolist(), strict=True)
    )
    cuts = [k for k in range(1, len(kinds)) if kinds[k] != kinds[k - 1]]
    return np.split(strands, cuts)


def _nodes(groom: Groom, chunk: Integers) -> Integers:
    """Return the nodes of strands of one number of nodes (R, n)."""
    count = groom.counts[chunk[0]]
    return (np.cumsum(groom.counts)[chunk] - count)[:, None] + np.arange(count)


def _add(scene: Scene, groom: Groom, chunk: Integers, *, young, radius, density, poisson, name: str, **more) -> list:
    """Add strands of one number of nodes and one kind, and return the rods."""
    nodes, closed = _nodes(groom, chunk), bool(groom.closed[chunk[0]])

    def at_edges(values):
        mean = 0.5 * (values[nodes] + np.roll(values[nodes], -1, axis=1))
        return mean if closed else mean[:, :-1]

    material = Material(at_edges(young), poisson=poisson, density=density)
    bend = closed or nodes.shape[1] > 2
    more = {"material": material, "closed": closed, "bend": bend, "name": name, **more}
    return list(scene.add_rods(groom.points[nodes], section=Circle(at_edges(radius)), **more))


def _sag_free(groom: Groom, chunks: list[Integers], **bodies) -> list[dict]:
    """Return natural shapes and laws of rods by chunk, with which clamped strands hang as drawn."""
    from ddg_warp.postprocess.sag_free import rest_strains

    if groom.closed.any() or (groom.counts < 3).any():
        strand = np.flatnonzero(groom.closed | (groom.counts < 3))[0]
        raise SceneError(
            f"groom: sag_free is for open strands of 3 nodes or more, and strand {strand} is none; leave it out"
        )
    scene = Scene()
    for chunk in chunks:
        scene.clamp(_add(scene, groom, chunk, **bodies, name="strands"))
    result, edge, vertex = [], 0, 0
    *natural, stretch = (values[0] for values in rest_strains(scene.build("cpu", "float64")).values())
    for chunk in chunks:
        edges, count = int(groom.counts[chunk[0]]) - 1, len(chunk)
        rows, columns = slice(vertex, vertex + count * (edges - 1)), slice(edge, edge + count * edges)
        law = Law(quadratic, rest=stretch[columns].reshape(count, -1))
        shape = [values[rows].reshape(count, -1) for values in natural]
        result.append({"natural": shape, "laws": {"rod_stretch": law}})
        edge, vertex = columns.stop, rows.stop
    return result


def _hold(scene: Scene, rods: list, roots: Floats, groom: Groom, strands: Integers, skin: AnimatedMesh | None) -> None:
    """Clamp the first edge of each rod, in frames of the skin or of the moving prims."""
    if skin is not None:
        scene.clamp(rods, motion=skin.bind(roots) if skin.motion() else None, name="roots")
        return
    from ddg_warp.io.usd_groom import prim_motion

    scene.clamp(rods, motion=prim_motion(groom, roots, strands), name="roots")


def _heaviest(groom: Groom, radius: Floats, density: float) -> float:
    """Return the weight of the heaviest strand [N], open strands with the radius of the first node of edges."""
    lengths = np.linalg.norm(np.diff(groom.points, axis=0, append=groom.points[-1:]), axis=1)
    lengths[np.cumsum(groom.counts) - 1] = 0.0
    volumes = np.add.reduceat(np.pi * radius**2 * lengths, np.cumsum(groom.counts) - groom.counts)
    return GRAVITY * density * float(volumes.max())


def _clear_lengths(groom: Groom, skin: AnimatedMesh, least: Floats) -> Floats:
    """Return arc lengths of strands [m] up to the last node before a clear one.

    The first edge is always included.

    Args:
        groom, skin: the strands and the surface.
        least: height of a clear node above the skin (P,) [m].
    """
    triangle, weights = nearest_on_triangles(skin.rest, skin.triangles, groom.points, 2.0 * float(least.max()))
    a, b, c = np.moveaxis(skin.rest[skin.triangles[triangle]], 1, 0)
    away = groom.points - (weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c)
    outward = (away * np.cross(b - a, c - a)).sum(1)
    tips = np.cumsum(groom.counts) - 1
    outside = np.sign(np.median(outward[tips])) or 1.0  # most tips are outside
    height = np.where(outward * outside < 0.0, -1.0, 1.0) * np.linalg.norm(away, axis=1)
    clear = height > least
    result = np.empty(len(groom.counts))
    for strand, (points, mine) in enumerate(zip(groom.rods(), np.split(clear, tips[:-1] + 1), strict=True)):
        if not mine[1:].any():
            raise SceneError(
                f"groom: strand {strand} lies in the skin with all its nodes; move it out, or give root_length"
            )
        first = max(int(np.argmax(mine[1:])), 1)  # the last node that is not clear, or the second
        arcs = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))
        result[strand] = arcs[first - 1] * (1.0 + 1e-6)
    return result

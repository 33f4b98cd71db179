"""Validation of a scene before compilation: every error names the object, the index and the remedy."""

import numbers
import warnings

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SceneWarning
from ddg_warp.geometry import polyline
from ddg_warp.scene import edge_forces
from ddg_warp.scene.contact import check_contact
from ddg_warp.scene.descriptions import Dynamics, PathAnalysis, Statics, supports_of
from ddg_warp.scene.frame_motion import FrameMotion
from ddg_warp.scene.grip import Grip
from ddg_warp.scene.prescribed_motion import Motion

DOUBLED = 1e-10  # edge length over the longest of the rod below which both nodes coincide
STARTS = 1e-9  # displacement over the size of the scene, or angle [rad], up to which a motion starts at zero


def check_settings(scene) -> None:
    """Check gravity, dimension, damping, analysis and functions of a scene.

    Raises:
        SceneError: the first error.
    """
    argument_checks.vector("gravity", scene.gravity)
    if not (isinstance(scene.dimension, numbers.Integral) and scene.dimension in (2, 3)):
        raise SceneError(f"dimension = {argument_checks.shown(scene.dimension)}; a scene is of dimension 2 or 3")
    argument_checks.number(
        "mass_damping", scene.mass_damping, "one number, finite and not negative [1/s]", lambda v: v >= 0.0
    )
    if not callable(scene.flow):
        argument_checks.vector("flow", scene.flow)
    if not isinstance(scene.analysis, Dynamics | Statics | PathAnalysis):
        raise SceneError(f"analysis is {scene.analysis!r}; give Dynamics(...), Statics(...) or Trace(...)")
    if scene.initial is not None and not callable(scene.initial):
        raise SceneError(f"initial is {scene.initial!r}; give a function of the model that returns a state, or None")
    if not isinstance(scene.callbacks, list | tuple):
        raise SceneError(f"callbacks are {scene.callbacks!r}; give a list of functions of the state")
    for i, callback in enumerate(scene.callbacks):
        if not callable(callback):
            raise SceneError(f"callbacks[{i}] is {callback!r}; give functions of the state")


def check_scene(scene) -> None:
    """Check everything but rods: settings, gravity, forces, magnets, contact, and motions that start at rest.

    Raises:
        SceneError: the first error.
    """
    check_settings(scene)
    if scene.dimension == 2 and scene.gravity[1] != 0.0:
        raise SceneError(
            f"gravity is {tuple(scene.gravity)}; a scene of dimension 2 stays in the plane of x and z, give 0 along y"
        )
    for laws in edge_forces.LAWS:
        laws.check(scene)
    _check_magnets(scene)
    check_contact(scene)
    supports = [s for s in supports_of(scene) if isinstance(s.motion, Motion | FrameMotion)]  # a grip starts at rest
    if not supports or scene.initial is not None or not isinstance(scene.analysis, Dynamics):
        return  # an initial state may be displaced, and equilibria have no initial time
    objects = [*scene.batches, *scene.shells, *scene.axisymmetric_shells]
    size = max(
        (np.nanmax(np.ptp(o.points.reshape(-1, o.points.shape[-1]), axis=0)) for o in objects if o.points.size),
        default=1.0,
    )
    for support in supports:
        motion = support.motion
        fixed = ["xyz".index(c) for c in support.components]
        shift, angle = motion.shift(0.0)[:, fixed], motion.turned(0.0)
        if np.abs(shift).max() > STARTS * size:
            row = int(np.argmax(np.abs(shift).max(axis=1)))
            raise SceneError(
                f"{support.call}: the motion's translation at t = 0 is {tuple(shift[row].tolist())} m along "
                f"{support.components}; supports start where they are "
                "at rest, so subtract its value at 0, move the points, or give Scene(initial=...) a state that is there"
            )
        if abs(angle) > STARTS:
            raise SceneError(
                f"{support.call}: the motion's angle at t = 0 is {angle:g} rad; supports start as they are at rest, so subtract its "
                "value at 0, or rotate the points"
            )


def _check_magnets(scene) -> None:
    """Refuse a field or dipoles without magnetised rods, and magnets without field or dipoles."""
    magnetised = np.concatenate([np.zeros(0, int), *(magnet.rods for magnet in scene.magnets)])
    if scene.applied_field is not None and not magnetised.size:
        raise SceneError("magnetic_field: no rod is magnetised; add scene.magnetize(rod, ...), or leave the field out")
    for pairs in scene.dipoles:
        if pairs.rods is None and not magnetised.size:
            raise SceneError("add_dipoles: no rod is magnetised; add scene.magnetize(rod, ...)")
        for rod in [] if pairs.rods is None else np.setdiff1d(pairs.rods, magnetised)[:1]:
            raise SceneError(f"add_dipoles: rod {rod} is not magnetised; add scene.magnetize({rod}, ...)")
    if magnetised.size and scene.applied_field is None and not scene.dipoles:
        raise SceneError(
            f"magnetize: no field or dipole acts on rod {magnetised[0]}; add scene.magnetic_field(...) or scene.add_dipoles(...)"
        )


def check_motion(call: str, motion, planar: bool) -> None:
    """Refuse an object that is no motion, or a rotation out of the plane of x and z if `planar`."""
    if motion is not None and not isinstance(motion, Motion | Grip | FrameMotion):
        raise SceneError(f"{call}: motion is {motion!r}; give Motion(translation=..., angle=...) or Grip(pivot=...)")
    if motion is not None and motion.by_rod and call not in ("clamp", "clamp_end", "fix", "fix_twist"):
        raise SceneError(
            f"{call}: the motion has a frame for each rod; it moves rods alone, by clamp, clamp_end or fix"
        )
    if motion is not None and planar and not motion.planar:
        raise SceneError(
            f"{call}: the motion rotates about {tuple(motion.axis)}, out of the plane of x and z; give axis=(0, 1, 0)"
        )


def directions(label: str, value, rods: np.ndarray) -> np.ndarray:
    """Return unit vectors (rods, 3) from a direction (3,), or one a rod."""
    result = argument_checks.array(label, value, f"give (3,), or ({len(rods)}, 3) for {len(rods)} rods")
    if result.shape not in ((3,), (1, 3), (len(rods), 3)):
        shown = argument_checks.shown(value)
        raise SceneError(f"{label} is {shown}; give (3,), or ({len(rods)}, 3) for {len(rods)} rods")
    result = np.broadcast_to(result, (len(rods), 3))
    faulty = np.flatnonzero(~(np.isfinite(result).all(1) & result.any(1)))
    if faulty.size:
        raise SceneError(
            f"{label} of rod {rods[faulty[0]]} is {result[faulty[0]]}; give a finite vector that is not zero"
        )
    return argument_checks.unit(result)


def check_batch(batch, dimension: int) -> None:
    """Check points, lengths, folds and parameters of one `RodBatch`.

    Raises:
        SceneError: the first error.
    """
    name = f"('{batch.name}')"
    if not batch.rods:
        raise SceneError(f"rods {name}: there are none; give points of one rod at least")
    least = 3 if batch.bend or batch.closed else 2
    if batch.nodes < least:
        raise SceneError(f"rod {batch.first} {name} has {batch.nodes} nodes; it needs at least {least}")
    for rows in batch.runs(np.arange(batch.rods)):
        _check_shape(batch, rows, dimension)
    section = batch.section
    for parameter in ("EA", "EI1", "EI2", "GJ", "mass_per_length", "rotary_inertia", "radius", "viscosity", "area"):
        if parameter == "radius" and section.radius is None:
            continue
        try:
            value = argument_checks.array(parameter, getattr(section, parameter))
            np.broadcast_to(value, (batch.rods, batch.edges))
        except ValueError:
            raise SceneError(
                f"rod {batch.first} {name}: {parameter} = {argument_checks.shown(getattr(section, parameter))}; give a "
                f"number, or numbers that broadcast to the {batch.rods} rods and {batch.edges} edges"
            ) from None
        if not np.all(np.isfinite(value)) or np.any(value < 0.0):
            raise SceneError(f"rod {batch.first} {name}: {parameter} = {value}; it must be finite and not negative")
        argument_checks.sized(f"rod {batch.first} {name}: {parameter}", value)
    needed = ["EA"] + (["EI1", "EI2"] if batch.bend else []) + (["GJ"] if batch.twist else [])
    for parameter in needed:
        if np.any(np.asarray(getattr(section, parameter)) == 0.0):
            raise SceneError(
                f"rod {batch.first} {name}: {parameter} is zero; leave the term out (bend=False, twist=False) instead"
            )
    if batch.bend and not batch.twist and dimension == 3 and np.any(np.asarray(section.EI1) != np.asarray(section.EI2)):
        raise SceneError(f"rod {batch.first} {name}: EI1 and EI2 differ, which needs twist=True")
    _check_natural(batch, dimension)
    if batch.director is not None:
        _check_director(batch, dimension)


def _check_shape(batch, rows: np.ndarray, dimension: int) -> None:
    points = np.asfortranarray(batch.points[rows])
    _refuse(~np.isfinite(points).all(-1), batch, "node {k} is at a non-finite position; check the points", rows)
    edges = polyline.edge_vectors(points, batch.closed)
    if dimension == 2:
        outside = np.abs(edges[..., 1]) > DOUBLED * polyline.length(edges)
        message = "edge {k} leaves the plane of x and z, in which a scene of dimension 2 stays; give all nodes one y"
        _refuse(outside, batch, message, rows)
        edges = edges[..., [0, 2]]
    lengths = polyline.length(edges)
    doubled = lengths <= DOUBLED * lengths.max(axis=-1, keepdims=True)
    if batch.closed:
        message = f"node {batch.nodes - 1} lies on node 0, to which a closed rod joins it; leave the last point out"
        _refuse(doubled & (np.arange(batch.edges) == batch.edges - 1), batch, message, rows)
    message = "edge {k} has no length, nodes {k} and {k} + 1 lie at one point; remove one of them"
    _refuse(doubled, batch, message, rows)
    if batch.bend:
        before, after = polyline.next_edges(edges / lengths[..., None], batch.closed)
        message = "edges {k} and {k} + 1 fold back by 180 degrees, where curvature is infinite or has no direction; move a node"
        _refuse(polyline.dot(before, after) <= -1.0 + 1e-12, batch, message, rows)


def _check_natural(batch, dimension: int) -> None:
    natural, vertices = batch.natural, batch.edges - (0 if batch.closed else 1)
    if isinstance(natural, str) and natural in ("shape", "straight"):
        return
    count = 1 if dimension == 2 else 3
    where = f"rod {batch.first} ('{batch.name}')"
    several = isinstance(natural, list | tuple) or getattr(natural, "ndim", 0)
    if not several or len(natural) != count:
        shown = argument_checks.shown(natural)
        raise SceneError(f"{where}: natural is {shown}; give 'shape', 'straight' or {count} arrays [1/m]")
    for value in natural:
        try:
            value = np.broadcast_to(argument_checks.array(f"{where}: natural", value), (batch.rods, vertices))
        except ValueError:
            raise SceneError(
                f"{where}: natural holds {argument_checks.shown(value)}; give numbers that broadcast to the {batch.rods} rods "
                f"and {vertices} vertices"
            ) from None
        _refuse(
            ~np.isfinite(value), batch, "natural curvature or twist is not finite at vertex {k}; give finite numbers"
        )
        argument_checks.sized(f"{where}: natural", value)


def _check_director(batch, dimension: int) -> None:
    director, full = batch.director, (batch.rods, batch.edges, 3)
    if director.shape not in ((3,), (batch.rods, 3), full, (1, *full[1:])):
        raise SceneError(
            f"rod {batch.first} ('{batch.name}'): director has shape {director.shape}; give (3,), (rods, 3) or (rods, edges, 3)"
        )
    director = director if director.ndim == 3 else np.broadcast_to(director, (batch.rods, 3))[:, None]
    _refuse(~np.isfinite(director).all(-1), batch, "director of edge {k} is not finite; give finite numbers")
    if dimension == 3:
        tangents = polyline.unit(polyline.edge_vectors(batch.points, batch.closed)[:, : director.shape[1]])
        across = polyline.length(polyline.cross(director, tangents))
        _refuse(
            across <= 1e-9 * polyline.length(director),
            batch,
            "director of edge {k} is parallel to the edge; give one across it",
        )


def check_index(kind: str, index: int, size: np.ndarray, rods: np.ndarray) -> None:
    """Refuse a node or edge index out of range; `size` is the number of nodes or edges of each of `rods`."""
    missing = np.flatnonzero((index >= size) | (index < -size))
    if missing.size:
        raise SceneError(f"{kind} {index} does not exist: rod {rods[missing[0]]} has {size[missing[0]]} {kind}s")


def _refuse(faulty: np.ndarray, batch, message: str, rows: np.ndarray | None = None) -> None:
    """Raise for the first True of `faulty` (rods, items), of all rods of a batch or of `rows`."""
    if faulty.any():
        rod, k = np.argwhere(faulty)[0]
        rod = rod if rows is None else rows[rod]
        raise SceneError(f"rod {batch.first + rod} ('{batch.name}'): " + message.format(k=k))


def warn_of_massless(model) -> None:
    """Warn of massless rods and shells under gravity in statics."""
    if not any(model.scene.gravity):
        return
    for batch in model.scene.batches:
        if not np.any(np.asarray(batch.section.mass_per_length)):
            weighed = {rod for rods, _, _ in model.scene.masses for rod in rods}
            for rod in [rod for rod in range(batch.first, batch.first + batch.rods) if rod not in weighed][:1]:
                _warn(f"rod {rod} ('{batch.name}')", "mass_per_length, or its material a density")
    for kind, shells in (("shell", model.scene.shells), ("axisymmetric shell", model.scene.axisymmetric_shells)):
        for i, shell in enumerate(shells):
            if not np.any(np.asarray(shell.material.density)):
                _warn(f"{kind} {i} ('{shell.name}')", "a density")


def _warn(name: str, remedy: str) -> None:
    text = f"{name} has no mass, so that gravity does not act on it: give it {remedy}, or the scene gravity=(0, 0, 0)"
    warnings.warn(text, SceneWarning, stacklevel=5)

"""What a scene must fulfil before anything is built: every refusal names the object, its index and the remedy."""

import operator

import numpy as np

from ddg_warp import geometry
from ddg_warp.errors import SceneError


def check_scene(scene) -> None:
    """What belongs to no rod: gravity, damping, dimension; and the edges that supports name.

    Raises:
        SceneError: the first thing found wrong.
    """
    vector("gravity", scene.gravity)
    if scene.dimension not in (2, 3):
        raise SceneError(f"dimension = {scene.dimension}; a scene is of dimension 2 or 3")
    damping = scene.mass_damping
    if not (np.ndim(damping) == 0 and np.isfinite(damping) and damping >= 0.0):
        raise SceneError(f"mass_damping = {damping}; it is one number, finite and not negative [1/s]")
    if not scene.batches:
        return
    edges = np.concatenate([np.full(batch.rods, batch.edges) for batch in scene.batches])
    for support in scene.supports:
        for edge in support.edges:
            check_index("edge", edge, edges[support.rods], support.rods)


def vector(what: str, value) -> tuple[float, float, float]:
    """Three finite numbers, or a refusal that names `what`."""
    try:
        result = np.asarray(value, float)
    except (TypeError, ValueError):
        result = np.array(np.nan)
    if result.shape != (3,) or not np.isfinite(result).all():
        raise SceneError(f"{what} is {value!r}; give three finite numbers")
    return tuple(result.tolist())


def number(what: str, value) -> float:
    """One finite number, or a refusal that names `what`."""
    try:
        result = float(value)
    except (TypeError, ValueError):
        result = np.nan
    if not np.isfinite(result):
        raise SceneError(f"{what} is {value!r}; give one finite number")
    return result


def indices(what: str, values) -> tuple[int, ...]:
    """One or several whole numbers, or a refusal that names `what`."""
    values = list(values) if np.iterable(values) else [values]
    try:
        return tuple(operator.index(value) for value in values)
    except TypeError:
        raise SceneError(f"{what} {values} are no indices; give whole numbers") from None


def index(what: str, value) -> int:
    """One whole number, or a refusal that names `what`."""
    if np.iterable(value):
        raise SceneError(f"{what} is {value!r}; give one whole number")
    return indices(what, value)[0]


def directions(what: str, value, rods: np.ndarray) -> np.ndarray:
    """Unit vectors (rods, 3) from a direction (3,), or one a rod."""
    try:
        result = np.broadcast_to(np.asarray(value, float), (len(rods), 3))
    except (TypeError, ValueError):
        raise SceneError(f"{what} is {value!r}; give (3,), or ({len(rods)}, 3) for {len(rods)} rods") from None
    length = np.linalg.norm(result, axis=1, keepdims=True)
    bad = np.flatnonzero(~(np.isfinite(length[:, 0]) & (length[:, 0] > 0.0)))
    if bad.size:
        raise SceneError(f"{what} of rod {rods[bad[0]]} is {result[bad[0]]}; give a finite vector that is not zero")
    return result / length


def check_batch(batch, dimension: int) -> None:
    """Points, lengths, folds and parameters of one `RodBatch`.

    Raises:
        SceneError: the first thing found wrong.
    """
    name = f"('{batch.name}')"
    if not batch.rods:
        raise SceneError(f"rods {name}: there are none; give points of one rod at least")
    least = 3 if batch.bend or batch.closed else 2
    if batch.nodes < least:
        raise SceneError(f"rod {batch.first} {name} has {batch.nodes} nodes; it needs at least {least}")
    _refuse(~np.isfinite(batch.points).all(-1), batch, "node {k} is at a non-finite position; check the points")
    edges = geometry.edge_vectors(batch.points, batch.closed)
    if dimension == 2:
        edges = edges[..., [0, 2]]
    lengths = np.linalg.norm(edges, axis=-1)
    _refuse(lengths <= 0.0, batch, "edge {k} has no length; remove the doubled node")
    if batch.bend:
        before, after = geometry.ahead(edges / lengths[..., None], batch.closed)
        _refuse(
            np.sum(before * after, -1) <= -1.0 + 1e-12,
            batch,
            "edges {k} and {k} + 1 fold back by 180 degrees, where curvature is infinite; move a node",
        )
    section = batch.section
    for what in ("EA", "EI1", "EI2", "GJ", "mass_per_length", "rotary_inertia", "radius", "viscosity"):
        try:
            value = np.asarray(getattr(section, what), float)
            np.broadcast_to(value, (batch.rods, batch.edges))
        except (TypeError, ValueError):
            raise SceneError(
                f"rod {batch.first} {name}: {what} = {getattr(section, what)!r}; give a number, or numbers that broadcast "
                f"to the {batch.rods} rods and {batch.edges} edges"
            ) from None
        if not np.all(np.isfinite(value)) or np.any(value < 0.0):
            raise SceneError(f"rod {batch.first} {name}: {what} = {value}; it must be finite and not negative")
    needed = ["EA"] + (["EI1", "EI2"] if batch.bend else []) + (["GJ"] if batch.twist else [])
    for what in needed:
        if np.any(np.asarray(getattr(section, what)) == 0.0):
            raise SceneError(
                f"rod {batch.first} {name}: {what} is zero; leave the term out (bend=False, twist=False) instead"
            )
    if batch.bend and not batch.twist and dimension == 3 and np.any(np.asarray(section.EI1) != np.asarray(section.EI2)):
        raise SceneError(f"rod {batch.first} {name}: EI1 and EI2 differ, which needs twist=True")
    _check_natural(batch, dimension)
    if batch.director is not None:
        _check_director(batch, edges / lengths[..., None])


def _check_natural(batch, dimension: int) -> None:
    natural, vertices = batch.natural, batch.edges - (0 if batch.closed else 1)
    if isinstance(natural, str) and natural in ("shape", "straight"):
        return
    parts = 1 if dimension == 2 else 3
    where = f"rod {batch.first} ('{batch.name}')"
    if isinstance(natural, str) or not np.iterable(natural) or len(natural) != parts:
        raise SceneError(f"{where}: natural is {natural!r}; give 'shape', 'straight' or {parts} arrays [1/m]")
    for value in natural:
        try:
            value = np.broadcast_to(np.asarray(value, float), (batch.rods, vertices))
        except (TypeError, ValueError):
            raise SceneError(
                f"{where}: natural holds {value!r}; give numbers that broadcast to the {batch.rods} rods and {vertices} vertices"
            ) from None
        _refuse(
            ~np.isfinite(value), batch, "natural curvature or twist is not finite at vertex {k}; give finite numbers"
        )


def _check_director(batch, tangents: np.ndarray) -> None:
    given, full = batch.director, (batch.rods, batch.edges, 3)
    if given.shape not in ((3,), (batch.rods, 3), full, (1, *full[1:])):
        raise SceneError(
            f"rod {batch.first} ('{batch.name}'): director has shape {given.shape}; give (3,), (rods, 3) or (rods, edges, 3)"
        )
    given = given if given.ndim == 3 else np.broadcast_to(given, (batch.rods, 3))[:, None]
    _refuse(~np.isfinite(given).all(-1), batch, "director of edge {k} is not finite; give finite numbers")
    tangents = tangents[:, : given.shape[1]]
    if tangents.shape[2] == 3:
        across = np.linalg.norm(np.cross(given, tangents), axis=-1)
        _refuse(
            across <= 1e-9 * np.linalg.norm(given, axis=-1),
            batch,
            "director of edge {k} is parallel to the edge; give one across it",
        )


def check_index(what: str, index: int, size: np.ndarray, rods: np.ndarray) -> None:
    """Refuse a node or edge index that a rod does not have; `size` and `rods` run over the rods concerned."""
    bad = np.flatnonzero((index >= size) | (index < -size))
    if bad.size:
        raise SceneError(f"{what} {index} does not exist: rod {rods[bad[0]]} has {size[bad[0]]} {what}s")


def _refuse(bad: np.ndarray, batch, message: str) -> None:
    """Raise for the first True of bad (rods, nodes or edges or vertices)."""
    if bad.any():
        rod, k = np.argwhere(bad)[0]
        raise SceneError(f"rod {batch.first + rod} ('{batch.name}'): " + message.format(k=k))

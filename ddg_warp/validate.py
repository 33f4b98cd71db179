"""What a scene must fulfil before anything is built: every refusal names the object, its index and the remedy."""

import numpy as np

from ddg_warp import geometry
from ddg_warp.errors import SceneError


def check_batch(batch, dimension: int) -> None:
    """Points, lengths, folds and parameters of one `RodBatch`.

    Raises:
        SceneError: the first thing found wrong.
    """
    name = f"('{batch.name}')"
    least = 3 if batch.bend else 2
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
        value = np.asarray(getattr(section, what), float)
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
    if not (isinstance(batch.natural, str) and batch.natural in ("shape", "straight")):
        parts = 1 if dimension == 2 else 3
        if isinstance(batch.natural, str) or len(batch.natural) != parts:
            raise SceneError(
                f"rod {batch.first} {name}: natural is {batch.natural!r}; give 'shape', 'straight' or {parts} arrays [1/m]"
            )
        for value in batch.natural:
            if not np.all(np.isfinite(value)):
                raise SceneError(f"rod {batch.first} {name}: natural curvature or twist is not finite")


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

"""Curves read from a file, checked so that rods can be built from them."""

from dataclasses import dataclass, field

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.io.paths import CurveError
from ddg_warp.typing import Array, Bools, Floats, Integers, Names


@dataclass(frozen=True)
class CurveSet:
    """Polylines of one prim, dataset or section; z is up, lengths are in metres.

    A curve set has the attributes of `model.curves`, so that writers and pictures accept both.

    Attributes:
        points: Positions [m], shape (P, 3), float64; the rods one after the other.
        counts: Points of each rod, shape (R,), int; their sum is P.
        closed: Whether a rod's last point is joined to its first, shape (R,), bool.
        radius: Radius at each point [m], shape (P,), float64; None where the file gives none. Tips of open rods may have radius 0: an
            edge has the mean of its ends.
        path: Location of the curves in the file: a USD prim path, an HDF5 dataset, a section.
        attributes: Further values of each rod by name, shape (R,), such as ids and groups of a groom; a `Recorder` stores them.
        unread: Contents of the file that were not read, one text each.
    """

    points: Floats
    counts: Integers
    closed: Bools
    radius: Floats | None
    path: str
    attributes: dict[str, Array] = field(default_factory=dict)
    unread: tuple[str, ...] = ()

    @property
    def names(self) -> Names:
        """Name of each rod, shape (R,), str: the last component of `path` for all."""
        return np.full(len(self.counts), self.path.rstrip("/").rpartition("/")[2] or "rods")

    @property
    def batch(self) -> np.ndarray:
        """Batch of each rod, shape (R,), int: one for all."""
        return np.zeros(len(self.counts), dtype=int)

    def rods(self) -> list[np.ndarray]:
        """Return the points of each rod [m], each of shape (n, 3)."""
        return np.split(self.points, np.cumsum(self.counts)[:-1])


def checked_curves(points, counts, closed, radius, path: str, source: str) -> CurveSet:
    """Return a `CurveSet` from raw arrays, checked so that rods can be built from it.

    Args:
        points: Positions [m], shape (P, 3).
        counts: Points of each rod, shape (R,).
        closed: One flag or one for each rod.
        radius: Radius [m], one value, or shape (P,), or None.
        path: Location of the curves in the file.
        source: File name, for messages.
    """
    where = f"{source}, {path}"
    points, counts = argument_checks.floats(points), argument_checks.floats(counts).reshape(-1)
    if (points.ndim < 2 and points.size) or (points.ndim and points.shape[-1] != 3 and points.size):
        raise CurveError(
            f"{where}: the points have shape {points.shape} or are no numbers; give (P, 3), three numbers each"
        )
    if not (counts == np.round(counts)).all():
        raise CurveError(f"{where}: the curves' vertex counts are no whole numbers; give each curve's number of points")
    points, counts = points.reshape(-1, 3), counts.astype(int)
    if counts.sum() != len(points):
        raise CurveError(
            f"{where}: the curves' vertex counts sum to {counts.sum()}, but there are {len(points)} points; "
            "write the counts and the points of the same frame"
        )
    closed = np.asarray(closed)
    if closed.dtype.kind not in "biu" or closed.shape not in ((), counts.shape):
        raise CurveError(
            f"{where}: `closed` has shape {closed.shape}; give one flag, or one for each of {len(counts)} curves"
        )
    closed = np.broadcast_to(closed.astype(bool), counts.shape).copy()
    if radius is not None:
        radius = argument_checks.floats(radius)
        if radius.shape not in ((), (1,), (len(points),)):
            raise CurveError(
                f"{where}: there are {radius.size} radii for {len(points)} points; give one, or one a point"
            )
        radius = np.broadcast_to(radius, (len(points),)).copy()
    _refuse_unusable(points, counts, closed, radius, where)
    return CurveSet(points, counts, closed, radius, path)


def _refuse_unusable(points, counts, closed, radius, where: str) -> None:
    """Refuse curves that are too short, not finite or without thickness; the error names the first."""
    if not len(counts):
        raise CurveError(f"{where}: there is not a single curve; export it with its curves")
    least = np.where(closed, 3, 2)
    if (counts < least).any():
        curve = np.flatnonzero(counts < least)[0]
        raise CurveError(
            f"{where}: curve {curve} has {counts[curve]} vertices, it needs {least[curve]}; delete it or resample it"
        )
    owner = np.repeat(np.arange(len(counts)), counts)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        curve = owner[np.argmin(finite)]
        raise CurveError(f"{where}: curve {curve} has a point that is not finite; re-export it or delete it")
    if radius is not None:
        positive = np.isfinite(radius) & (radius > 0.0)
        last = np.cumsum(counts) - 1
        tips = np.zeros(len(radius), bool)
        tips[np.concatenate([last, last - counts + 1])] = np.tile(~closed, 2)
        tips &= np.repeat(np.logical_or.reduceat(positive, last - counts + 1), counts) & (radius == 0.0)
        for k in np.flatnonzero(~(positive | tips))[:1]:
            raise CurveError(
                f"{where}: curve {owner[k]} has a radius of {radius[k]} m; give it a positive width, which may taper to 0 at the "
                "ends of an open curve alone"
            )

"""Readers and writers of curves, meshes and trajectories; each format's library is loaded only by its own module.

`usd` (BasisCurves in; curves or tubes, and meshes out), `mesh_read` (meshes in), `hdf5` (trajectory.h5 in and out), `dismech`
(text in).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import DataError


class CurveError(ValueError):
    """A file holds no usable curves; the message names the file, the object, the index and the remedy."""


class MeshError(ValueError):
    """A file holds no usable mesh; the message names the file, the line or prim and the remedy."""


class MissingFileError(CurveError, MeshError, FileNotFoundError):
    """The file to read does not exist."""

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True)
class Curves:
    """Rods of a trajectory as runs of points; the attributes of `model.curves`.

    Attributes:
        counts: Points of each rod, shape (R,), int; their sum is P.
        closed: Whether a rod's last point is joined to its first, shape (R,), bool.
        radius: Radius at each point [m], shape (P,), float64.
        names: Name of each rod, shape (R,), str.
        batch: Batch of each rod, shape (R,), int; rods of a batch have one name and material.
    """

    counts: np.ndarray
    closed: np.ndarray
    radius: np.ndarray
    names: np.ndarray
    batch: np.ndarray

    @classmethod
    def tiled(cls, curves, worlds: int) -> Curves:
        """Return `worlds` copies of a model's curves, one after the other."""
        return cls(**{each.name: np.tile(getattr(curves, each.name), worlds) for each in fields(cls)})


@dataclass(frozen=True)
class Surfaces:
    """Triangles among the points of a trajectory; the attributes of `model.surfaces`, None without surfaces.

    Attributes:
        triangles: Rows of `state.points()` at the corners of each triangle, shape (T, 3), int; surface after surface.
        first: First triangle of each surface, shape (S,), int, increasing from 0.
        names: Name of each surface, shape (S,), str.
        thickness: Thickness of each triangle [m], shape (T,), float64.
    """

    triangles: np.ndarray
    first: np.ndarray
    names: np.ndarray
    thickness: np.ndarray

    def parts(self) -> list[slice]:
        """Return the triangles of each surface."""
        return [slice(a, b) for a, b in zip(self.first, [*self.first[1:], len(self.triangles)], strict=True)]

    @classmethod
    def tiled(cls, surfaces: Surfaces, worlds: int, point_count: int) -> Surfaces:
        """Return `worlds` copies of a model's surfaces, one after the other, each among its own `point_count` points."""
        world = np.arange(worlds)[:, None]
        return cls(
            triangles=(surfaces.triangles + point_count * world[..., None]).reshape(-1, 3),
            first=(surfaces.first + len(surfaces.triangles) * world).ravel(),
            names=np.tile(surfaces.names, worlds),
            thickness=np.tile(surfaces.thickness, worlds),
        )


@dataclass(frozen=True)
class Shapes:
    """Rods and surfaces of all worlds, with the rows of their points in a frame, world after world.

    In each world the points of rods come first, then points that only surfaces have.

    Attributes:
        curves: The rods of all worlds.
        rows: Row of each rod point in a frame, shape (n,), int.
        surfaces: The surfaces of all worlds, or None.
        point_count: Points of one world.
        worlds: Number of worlds.
    """

    curves: Curves
    rows: np.ndarray
    surfaces: Surfaces | None
    point_count: int
    worlds: int

    @classmethod
    def of(cls, curves, surfaces: Surfaces | None = None, worlds: int = 1) -> Shapes:
        """Return the shapes of all worlds from the `curves` and `surfaces` of one world of a model."""
        rod_points = int(np.sum(curves.counts))
        point_count = rod_points if surfaces is None else max(rod_points, int(surfaces.triangles.max()) + 1)
        rows = np.arange(rod_points) + point_count * np.arange(worlds)[:, None]
        tiled = None if surfaces is None else Surfaces.tiled(surfaces, worlds, point_count)
        return cls(Curves.tiled(curves, worlds), rows.ravel(), tiled, point_count, worlds)


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
    """

    points: np.ndarray
    counts: np.ndarray
    closed: np.ndarray
    radius: np.ndarray | None
    path: str
    attributes: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def names(self) -> np.ndarray:
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
    points, counts = arguments.floats(points), arguments.floats(counts).reshape(-1)
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
        radius = arguments.floats(radius)
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


def as_path(label: str, value, error: type[ValueError] = DataError) -> Path:
    """Return a path given as text or as a path, or raise an `error` that names `label`."""
    text = os.fspath(value) if isinstance(value, os.PathLike) else value
    if not isinstance(text, str) or not text or "\0" in text:
        raise error(f"{label} is {value!r}; give a path, as text or pathlib.Path")
    return Path(text)


def shown(words: list[str], most: int = 60) -> str:
    """Return words of a file on one line for a message, at most `most` letters, unprintable letters replaced."""
    text = "".join(letter if letter.isprintable() else "?" for letter in " ".join(words))
    return text if len(text) <= most else f"{text[:most]}..."


def is_file(path: Path) -> bool:
    """Return True if a path leads to a file."""
    try:
        return path.is_file()
    except OSError:  # a name too long, or a folder without permission
        return False


def existing(path) -> Path:
    """Return `path` as a Path, or raise a MissingFileError if no such file exists."""
    path = as_path("the file to read", path, MissingFileError)
    if not is_file(path):
        raise MissingFileError(f"{path}: there is no such file; check the path")
    return path


def read(path, outside: bool = False) -> list[CurveSet]:
    """Return the curves of a USD, HDF5 or DisMech text file, distinguished by suffix.

    Args:
        path: The file.
        outside: Whether other files that a USD or HDF5 file refers to may be opened: layers, references and payloads outside its
            folder, external links and virtual datasets.

    Raises:
        CurveError: The file holds no usable curves.
        TrajectoryError: An HDF5 file is damaged, or refers to another file without permission.
    """
    outside = arguments.flag("read: outside", outside)
    suffix = as_path("the file to read", path, MissingFileError).suffix.lower()
    if suffix in {".usd", ".usda", ".usdc", ".usdz"}:
        from ddg_warp.io.usd import read_curves

        return read_curves(path, outside=outside)
    if suffix in {".h5", ".hdf5"}:
        from ddg_warp.io.hdf5 import read_rods

        return read_rods(path, outside=outside)
    if suffix == ".txt":
        from ddg_warp.io.dismech import read_rods as read_text

        return [read_text(path)]
    raise CurveError(f"{path}: curves are read from .usd, .usda, .usdc, .usdz, .h5, .hdf5 and .txt (DisMech) files")

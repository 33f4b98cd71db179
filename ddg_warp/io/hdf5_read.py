"""The reading half of `hdf5`: trajectories, and rods from either kind of HDF5 file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields as fields_of
from pathlib import Path

import h5py
import numpy as np

from ddg_warp.io import CurveError, Curves, CurveSet, Surfaces, checked_curves, existing
from ddg_warp.io.contacts import FIELDS as PAIR_FIELDS
from ddg_warp.io.contacts import Contacts, Touching
from ddg_warp.io.journal import open_to_read
from ddg_warp.io.obstacles import Obstacles

CURVE_FIELDS = ("counts", "closed", "radius", "names", "batch")
SURFACE_FIELDS = ("triangles", "first", "names", "thickness")
FRAMES = ("points", "velocities", "directors", "obstacle_points")


class TrajectoryError(ValueError):
    """A trajectory cannot be read or continued; the message names the file, what is wrong with it and the remedy."""


@contextmanager
def undamaged(path: Path) -> Iterator[None]:
    """What HDF5 says, in errors of many kinds, of a damaged file becomes a TrajectoryError; errors of the disk stay."""
    try:
        yield
    except (TrajectoryError, CurveError):
        raise
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise TrajectoryError(
            f"{path}: the file is cut short or damaged ({' '.join(str(error).split())}); take a copy of it, or record the run anew"
        ) from error


class Frames:
    """A field of all frames, read when indexed; `shape`, `ndim` and `len` as of an array."""

    def __init__(self, dataset: h5py.Dataset, path: Path):
        self._dataset, self._path = dataset, path
        self.shape, self.ndim = dataset.shape, dataset.ndim

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, frames) -> np.ndarray:
        with undamaged(self._path):
            return self._dataset[frames]


class ContactFrames:
    """What touches in each frame, read when indexed by a number: `Contacts`."""

    def __init__(self, group: h5py.Group, names: list[str], path: Path):
        self._group, self._names, self._path = group, names, path
        self._ends = np.concatenate([[0], group["ends"][:]])

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __getitem__(self, frame: int) -> Contacts:
        first, last = self._ends[range(len(self))[frame] :][:2]
        with undamaged(self._path):
            found = {name: self._group[name][first:last] for name in PAIR_FIELDS}
        return Contacts(names=self._names, **found)


class TrajectoryReader:
    """Reads a trajectory file, also one that is being written or whose writer was killed.

    Attributes:
        time: Times of the frames [s], shape (F,).
        points: Positions [m], shape (F, P, 3) or (F, B, P, 3), read when indexed: `reader.points[f]`.
        velocities: Velocities [m/s], like `points`, or None.
        directors: First material directors, shape (F, E, 3) or (F, B, E, 3), read when indexed, or None.
        fields: Fields by name, read when indexed: of points (F, B P), of cells (F, B (R + T)), the rods, which have none, first.
        series: Observed values by name, each of shape (F,).
        curves: How the points are joined to rods.
        surfaces: How the points are joined to triangles, or None.
        obstacles: What rods and surfaces touch, as surfaces, or None.
        obstacle_points: Nodes of obstacles that something moves [m], shape (F, M, 3) or (F, B, M, 3), read when indexed, or None.
        contacts: What touches, `Contacts` of each frame, read when indexed by a number, or None where it was not recorded.
        touching: What recordings of contact need to know, or None.
        parameters: The model's parameters by name.
        attributes: Values of each rod by name that a groom came with.
        provenance: The attributes of the file.
        recorded: Names of the recorded fields.
    """

    def __init__(self, path):
        self.path = existing(path)
        with undamaged(self.path):
            self._file = open_to_read(self.path)
        try:
            with undamaged(self.path):
                self._read()
        except BaseException:
            self._file.close()
            raise

    def _read(self) -> None:
        """Everything but the fields of the frames."""
        if "trajectory" not in self._file:
            raise TrajectoryError(f"{self.path}: there is no group /trajectory; is it a trajectory.h5?")
        trajectory, model = self._file["trajectory"], self._file["model"]
        self.time = trajectory["time"][:]
        self.recorded = [name for name in FRAMES if name in trajectory]
        self.recorded += [f"{at}/{name}" for at in ("at_points", "at_cells") for name in trajectory.get(at, ())]
        fields = {name: Frames(trajectory[name], self.path) for name in self.recorded}
        self.points, self.velocities = fields["points"], fields.get("velocities")
        self.directors = fields.get("directors")
        self.fields = {name.rpartition("/")[2]: frames for name, frames in fields.items() if "/" in name}
        self.series = {name: values[:] for name, values in trajectory.get("series", {}).items()}
        self.curves = Curves(**{name: _array(model["curves"][name]) for name in CURVE_FIELDS})
        self.surfaces = None
        if "surfaces" in model:
            self.surfaces = Surfaces(**{name: _array(model["surfaces"][name]) for name in SURFACE_FIELDS})
        self.obstacles, self.obstacle_points = None, fields.get("obstacle_points")
        if "obstacles" in model:
            self.obstacles = Obstacles(
                **{field.name: _array(model["obstacles"][field.name]) for field in fields_of(Obstacles)}
            )
        self.touching = self.contacts = None
        if "touching" in model:
            names, size, force = (_array(model["touching"][name]) for name in ("names", "size", "force"))
            self.touching = Touching(names.tolist(), float(size), float(force))
        if "contacts" in trajectory:
            self.contacts = ContactFrames(trajectory["contacts"], self.touching.names, self.path)
        _refuse_misfits(self.curves, self.surfaces, self.points.shape[-2])
        self.parameters = _all_arrays(model["parameters"])
        self.attributes = _all_arrays(model["attributes"]) if "attributes" in model else {}
        self.provenance = {name: _plain(value) for name, value in self._file.attrs.items()}

    def __enter__(self) -> TrajectoryReader:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.time)

    @property
    def counts(self) -> np.ndarray:
        """Points of each rod, shape (R,), int."""
        return self.curves.counts

    @property
    def closed(self) -> np.ndarray:
        """Whether each rod is closed, shape (R,), bool."""
        return self.curves.closed

    @property
    def radius(self) -> np.ndarray:
        """Radius at each point [m], shape (P,)."""
        return self.curves.radius

    @property
    def checkpoint_slot(self) -> str:
        """Which of the two places holds the last checkpoint."""
        if "checkpoint" not in self._file:
            raise TrajectoryError(f"{self.path}: the run ended before its first block was written; start it again")
        return self._file["checkpoint"].attrs["current"]

    @property
    def checkpoint_frame(self) -> int:
        """Number of frames up to and with the checkpoint's."""
        slot = self.checkpoint_slot
        return int(self._file["checkpoint"][slot].attrs["frame"])

    def checkpoint(self) -> dict[str, np.ndarray]:
        """The last complete state, for `model.restore`."""
        frame = self.checkpoint_frame
        if frame > len(self):
            raise TrajectoryError(f"{self.path}: the checkpoint is of frame {frame}, but there are {len(self)}")
        with undamaged(self.path):
            return _all_arrays(self._file["checkpoint"][self.checkpoint_slot])

    def close(self) -> None:
        """Closes the file; arrays already read stay."""
        self._file.close()


def read_rods(path, frame: int = -1, world: int = 0) -> list[CurveSet]:
    """Rods from an HDF5 file, of either kind.

    A trajectory gives one set for each batch of rods, at one frame (by default the last) of one world.
    Any other file has at its root `points`, (R, n, 3) or (P, 3) [m]; with the latter `counts`, (R,); and it may have
    `closed`, one flag or (R,), and `radius`, one value or (P,) [m].
    """
    path = existing(path)
    with undamaged(path), open_to_read(path) as file:
        if "points" in file:
            return [_read_plain(file, path)]
    with TrajectoryReader(path) as reader:
        if not len(reader):
            raise CurveError(f"{path}: the trajectory has no frames; read a file of a run that wrote a block")
        points = reader.points[frame]
        return _by_batch(reader.curves, points if points.ndim == 2 else points[world], path)


def _read_plain(file: h5py.File, path: Path) -> CurveSet:
    points = file["points"][()]
    if "counts" in file:
        counts = file["counts"][()]
    elif points.ndim == 3:
        counts = np.full(points.shape[0], points.shape[1])
    else:
        raise CurveError(f"{path}: `points` has shape {points.shape} and there are no `counts`; add the points per rod")
    closed = file["closed"][()] if "closed" in file else False
    radius = file["radius"][()] if "radius" in file else None
    return checked_curves(points, counts, closed, radius, "points", str(path))


def _by_batch(curves: Curves, points: np.ndarray, path: Path) -> list[CurveSet]:
    sets = []
    for batch in np.unique(curves.batch):
        rods = curves.batch == batch
        mine = np.flatnonzero(np.repeat(rods, curves.counts))
        name = str(curves.names[rods][0])
        radius = curves.radius[mine]
        sets.append(checked_curves(points[mine], curves.counts[rods], curves.closed[rods], radius, name, str(path)))
    return sets


def _refuse_misfits(curves: Curves, surfaces: Surfaces | None, point_count: int) -> None:
    """Raises a ValueError where rods or surfaces are not among the points."""
    rods, total = len(curves.counts), int(np.sum(curves.counts))
    fits = (curves.counts >= 0).all() and len(curves.radius) == total <= point_count
    fits = fits and {len(curves.closed), len(curves.names), len(curves.batch)} == {rods}
    if surfaces is not None:
        triangles, first = surfaces.triangles, surfaces.first
        fits = fits and 0 <= triangles.min() and triangles.max() < point_count and len(first) == len(surfaces.names)
        fits = fits and 0 == first[0] and first[-1] <= len(triangles) == len(surfaces.thickness)
    if not fits:
        raise ValueError(f"rods and surfaces do not fit the {point_count} points of a frame")


def _array(dataset: h5py.Dataset) -> np.ndarray:
    """A dataset in memory; texts as str."""
    return dataset.asstr()[()].astype(str) if h5py.check_string_dtype(dataset.dtype) else dataset[()]


def _all_arrays(group: h5py.Group) -> dict[str, np.ndarray]:
    """Every dataset below a group, by its path from there."""
    arrays = {}
    group.visititems(lambda name, item: arrays.update({name: _array(item)} if isinstance(item, h5py.Dataset) else {}))
    return arrays


def _plain(value):
    """An attribute as a Python value; JSON is decoded where it is an object or a list."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, str) and value[:1] in {"{", "["}:
        return json.loads(value)
    return value

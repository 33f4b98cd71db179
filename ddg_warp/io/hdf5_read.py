"""Readers of HDF5 files: trajectories, and rods from trajectories or plain files."""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields as fields_of
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from ddg_warp import argument_checks
from ddg_warp.io.bodies import Bodies
from ddg_warp.io.contact_records import FIELDS as PAIR_FIELDS
from ddg_warp.io.contact_records import Contacts, ContactScales
from ddg_warp.io.curves import CurveSet, checked_curves
from ddg_warp.io.journal import TrajectoryError, open_to_read, stamp
from ddg_warp.io.obstacles import Obstacles
from ddg_warp.io.paths import CurveError, existing
from ddg_warp.io.shapes import Curves, Surfaces
from ddg_warp.typing import Array, Bools, FilePath, Floats, Integers

CURVE_FIELDS = ("counts", "closed", "radius", "names", "batch")
SURFACE_FIELDS = ("triangles", "first", "names", "thickness", "uv")
PLAIN = ("points", "counts", "closed", "radius")  # datasets of a plain file
COUNTS = "run"  # group of a checkpoint: counts of the run up to the frame
FRAMES = ("points", "velocities", "directors", "obstacle_points", "body_poses")


LIVE_TIMEOUT = 5.0  # [s] of attempts to read a file between two blocks of its writer
RATIO = 1024  # largest size of a dataset over the size of its file; only fill values compress better


T = TypeVar("T")


class MissingFrameError(TrajectoryError, IndexError):
    """A trajectory has no such frame."""


@contextmanager
def undamaged(path: Path) -> Iterator[None]:
    """Raise a TrajectoryError for the errors of many kinds of HDF5 in a damaged file; pass errors of the disk on."""
    try:
        yield
    except (TrajectoryError, CurveError):
        raise
    except (
        OSError,
        RuntimeError,
        ArithmeticError,
        AttributeError,
        LookupError,
        MemoryError,
        TypeError,
        ValueError,
    ) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise TrajectoryError(
            f"{path}: the file is cut short or damaged ({' '.join(str(error).split())}); take a copy of it, or record the run again"
        ) from error


class LiveFile:
    """HDF5 file open for reading that another process may be writing to.

    A block that is written meanwhile changes metadata of the file, and HDF5 then reads a mixture of old and new. A read that fails
    is repeated on the new content if the file has changed since it was opened.
    """

    def __init__(self, path: Path):
        self.path = path
        self._file: h5py.File | None = None
        self._stamp: tuple = ()
        self._closed = False

    def read(self, function: Callable[[h5py.File], T]) -> T:
        """Return the result of a function of the file.

        Raises:
            TrajectoryError: The file is damaged, or changes all the time.
        """
        if self._closed:
            raise TrajectoryError(f"{self.path}: the reader is closed; read before close()")
        end = time.monotonic() + LIVE_TIMEOUT
        while True:
            try:
                with undamaged(self.path):
                    if self._file is None:
                        self._stamp = stamp(self.path)
                        self._file = open_to_read(self.path)
                    return function(self._file)
            except (TrajectoryError, CurveError):
                if stamp(self.path) == self._stamp or time.monotonic() > end:
                    raise
                self._release()

    def close(self) -> None:
        """Close the file."""
        self._closed = True
        self._release()

    def _release(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


class Frames:
    """Field of all frames, read when indexed; `shape`, `ndim` and `len` as an array."""

    def __init__(self, file: h5py.File, name: str, live: LiveFile):
        dataset = file[name]
        self._name, self._live, self._path = name, live, live.path
        self.shape, self.ndim = dataset.shape, dataset.ndim

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, frames: int | slice | Sequence[int]) -> Array:
        if isinstance(frames, int | np.integer) and not -len(self) <= frames < len(self):
            raise MissingFrameError(f"{self._path}: there is no frame {frames}; it has {len(self)}, counted from 0")
        return self._live.read(lambda file: rows(file[self._name], self._path, frames))


def rows(dataset: h5py.Dataset, path: Path, chosen=slice(None)) -> np.ndarray:
    """Read rows of a dataset.

    Raises:
        TrajectoryError: The checksum shows that the file has changed; names the damaged and the readable rows. Or the index is
            invalid.
    """
    with undamaged(path):
        _check_size(dataset)
        try:
            return dataset[chosen]
        except (TypeError, ValueError, IndexError) as error:
            name = dataset.name.rpartition("/")[2]
            raise TrajectoryError(
                f"{path}: {name}[{chosen!r}]: {error}; choose frames by a number, a slice or increasing numbers of them"
            ) from error
        except OSError as error:
            if error.errno is not None or not dataset.chunks:
                raise
            raise _described(dataset, path) from error


def _described(dataset: h5py.Dataset, path: Path) -> TrajectoryError:
    """Return an error that names the damaged and the readable rows of a dataset."""
    count, size = len(dataset), dataset.chunks[0]
    lost = [first for first in range(0, count, size) if not _readable(dataset, first)]
    mask = np.zeros(count, bool)
    for first in lost:
        mask[first : first + size] = True
    intact = f"{_ranges(~mask)} can be read" if not mask.all() else "no others can be read"
    kind = "pairs" if "/contacts/" in dataset.name and not dataset.name.endswith("/ends") else "frames"
    return TrajectoryError(
        f"{path}: {dataset.name} is damaged: the checksum of {kind} {_ranges(mask)} differs from the one written; {intact}. Take a "
        "copy of the file, or record the run again"
    )


def _readable(dataset: h5py.Dataset, row: int) -> bool:
    try:
        dataset[row]
    except OSError:
        return False
    return True


def _ranges(chosen: np.ndarray) -> str:
    """Return the indices of a mask as text: "0 to 3, 8 to 9"."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(int), [0]])))
    return ", ".join(f"{first} to {stop - 1}" for first, stop in edges.reshape(-1, 2))


def checksum(arrays: Mapping[str, np.ndarray]) -> int:
    """Return the CRC-32 of the names, kinds and values of arrays."""
    crc = 0
    for name, value in sorted(arrays.items()):
        content = "\0".join(value.ravel()).encode() if value.dtype.kind == "U" else np.ascontiguousarray(value)
        crc = zlib.crc32(content, zlib.crc32(f"{name} {value.shape} {value.dtype.kind}".encode(), crc))
    return crc


def seal(group: h5py.Group, arrays: Mapping[str, np.ndarray]) -> None:
    """Store the checksum of `arrays`, the datasets below a group by path, with the group, for `check_seal`."""
    group.attrs["crc32"] = checksum(arrays)


def check_seal(group: h5py.Group, path: Path) -> None:
    """Refuse a group with datasets changed since `seal`; groups of older files have no seal."""
    if "crc32" in group.attrs and group.attrs["crc32"] != checksum(all_arrays(group)):
        raise TrajectoryError(
            f"{path}: {group.name} is damaged: its checksum differs from the one written; take a copy of the file, or record the "
            "run again"
        )


def _check_size(dataset: h5py.Dataset) -> None:
    """Refuse a dataset that is empty, or larger than its file can hold."""
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
        raise TypeError(
            f"{dataset.name} is {'empty' if isinstance(dataset, h5py.Dataset) else 'a group'}, not an array"
        )
    size = dataset.size * dataset.dtype.itemsize
    if size > RATIO * 2**20 and size > RATIO * dataset.file.id.get_filesize():
        raise MemoryError(
            f"{dataset.name} of shape {dataset.shape} has {size} bytes by its header, more than the file can hold"
        )


def refuse_links(file: h5py.File, path: Path) -> None:
    """Refuse a file with data in other, possibly foreign files.

    Raises:
        TrajectoryError: Names the first object with data in another file.
    """

    def elsewhere(name: str, link) -> str | None:
        if isinstance(link, h5py.ExternalLink):
            return f"{name} is a link to {link.filename}"
        item = file.get(name) if isinstance(link, h5py.HardLink) else None
        if isinstance(item, h5py.Dataset) and item.external:
            return f"the values of {name} are in {item.external[0][0]}"
        files = {each.file_name for each in item.virtual_sources()} - {"."} if _is_virtual(item) else ()
        return f"the values of {name} are in {min(files)}" if files else None

    if reference := file.visititems_links(elsewhere):
        raise TrajectoryError(
            f"{path}: {reference}: data of other files are not read; put them into this one, or read it with outside=True if you "
            "know where it comes from"
        )


def _is_virtual(item) -> bool:
    return isinstance(item, h5py.Dataset) and item.is_virtual


class NodeFrames:
    """Nodes of moving obstacles and of shapes of rigid bodies in all frames, placed when indexed; `shape` and `len` as an array."""

    def __init__(self, reader: TrajectoryReader):
        self._of_obstacles, self._poses = reader.obstacle_points, reader.body_poses
        self._bodies, self._obstacles = reader.rigid_bodies, reader.obstacles
        count = int(np.count_nonzero(reader.obstacles.moving))
        self.shape, self.ndim = (*self._poses.shape[:-3], count, 3), self._poses.ndim - 1

    def __len__(self) -> int:
        return len(self._poses)

    def __getitem__(self, index) -> np.ndarray:
        frames, *inner = index if isinstance(index, tuple) else (index,)
        nodes = self._bodies.nodes(self._obstacles, self._poses[frames])
        if self._of_obstacles is not None:
            nodes = np.concatenate([self._of_obstacles[frames], nodes], axis=-2)
        axes = (slice(None),) * (not isinstance(frames, int | np.integer))
        return nodes[(*axes, *inner)]


class ContactFrames:
    """`Contacts` of each frame, read when indexed by a number."""

    def __init__(self, file: h5py.File, names: list[str], live: LiveFile):
        self._names, self._live, self._path = names, live, live.path
        self._ends = np.concatenate([[0], rows(file["trajectory/contacts/ends"], self._path)])

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __getitem__(self, frame: int) -> Contacts:
        if not isinstance(frame, int | np.integer) or not -len(self) <= frame < len(self):
            raise MissingFrameError(
                f"{self._path}: there are no contacts of frame {frame!r}; choose one of {len(self)} by its number, from 0"
            )
        first, last = self._ends[range(len(self))[frame] :][:2]

        def pairs(file: h5py.File) -> dict[str, np.ndarray]:
            return {
                name: rows(file[f"trajectory/contacts/{name}"], self._path, slice(first, last)) for name in PAIR_FIELDS
            }

        return Contacts(names=self._names, **self._live.read(pairs))


class TrajectoryReader:
    """Reader of a trajectory file, also while it is being written or after its writer was killed.

    Args:
        path: The file.
        outside: Whether the file may refer to other files: by external links, external storage or virtual datasets.

    Attributes:
        time: Times of the frames [s], shape (F,).
        time_is: Meaning of `time`: "state", times of the states, or "frame", numbers of the frames; see `Recorder`.
        points: Positions [m], shape (F, P, 3) or (F, B, P, 3), read when indexed: `reader.points[f]`.
        velocities: Velocities [m/s], like `points`, or None.
        directors: First material directors, shape (F, E, 3) or (F, B, E, 3), read when indexed, or None.
        fields: Fields by name, read when indexed: of points (F, B P), of cells (F, B (R + T)), first the rods (without values).
        series: Observed values by name, each of shape (F,).
        curves: Rods among the points.
        surfaces: Triangles among the points, or None.
        obstacles: Obstacles as surfaces, or None.
        obstacle_points: Nodes of moving obstacles, then of shapes of rigid bodies [m], shape (F, M, 3) or (F, B, M, 3), read when
            indexed, or None.
        rigid_bodies: Rigid bodies, or None.
        body_poses: Poses of rigid bodies, see `State.body_poses`, shape (F, N, 3, 4) or (F, B, N, 3, 4), read when indexed, or None.
        contacts: `Contacts` of each frame, read when indexed by a number, or None if not recorded.
        contact_scales: Names and typical scales of contact, or None.
        parameters: The model's parameters by name.
        attributes: Values of each rod by name, from a groom.
        provenance: The attributes of the file.
        recorded: Names of the recorded fields.
    """

    def __init__(self, path: FilePath, *, outside: bool = False):
        self.path = existing(path)
        self._outside = argument_checks.flag("outside", outside)
        self._live = LiveFile(self.path)
        try:
            self._live.read(self._read)
        except BaseException:
            self._live.close()
            raise

    def _read(self, file: h5py.File) -> None:
        """Read everything but the fields of the frames."""
        if not self._outside:
            refuse_links(file, self.path)
        if "trajectory" not in file:
            raise TrajectoryError(f"{self.path}: there is no group /trajectory; is it a trajectory.h5?")
        trajectory, model = file["trajectory"], file["model"]
        check_seal(model, self.path)
        self.time: Floats = rows(trajectory["time"], self.path)
        self.time_is = str(trajectory.attrs.get("time", "state"))
        self.recorded = [name for name in FRAMES if name in trajectory]
        self.recorded += [f"{kind}/{name}" for kind in ("at_points", "at_cells") for name in trajectory.get(kind, ())]
        fields = {name: Frames(file, f"trajectory/{name}", self._live) for name in self.recorded}
        self.points, self.velocities = fields["points"], fields.get("velocities")
        self.directors = fields.get("directors")
        self.fields = {name.rpartition("/")[2]: frames for name, frames in fields.items() if "/" in name}
        self.series: dict[str, Floats] = {
            name: rows(values, self.path) for name, values in trajectory.get("series", {}).items()
        }
        self.curves = Curves(**{name: _array(model["curves"][name]) for name in CURVE_FIELDS})
        self.surfaces = None
        if "surfaces" in model:
            group = model["surfaces"]
            self.surfaces = Surfaces(
                **{name: _array(group[name]) for name in SURFACE_FIELDS if name != "uv" or "uv" in group}
            )
        self.obstacles, self.obstacle_points = None, fields.get("obstacle_points")
        self.rigid_bodies, self.body_poses = None, fields.get("body_poses")
        if "obstacles" in model:
            self.obstacles = _described_by(Obstacles, model["obstacles"])
        if "rigid_bodies" in model:
            self.rigid_bodies = _described_by(Bodies, model["rigid_bodies"])
            if self.rigid_bodies.shapes.any():
                self.obstacle_points = NodeFrames(self)
        self.contact_scales = self.contacts = None
        if "touching" in model:
            names, size, force = (_array(model["touching"][name]) for name in ("names", "size", "force"))
            self.contact_scales = ContactScales(names.tolist(), float(size), float(force))
        if "contacts" in trajectory:
            self.contacts = ContactFrames(file, self.contact_scales.names, self._live)
        _refuse_misfits(self.curves, self.surfaces, self.points.shape[-2])
        self.parameters: dict[str, Floats] = all_arrays(model["parameters"])
        self.attributes: dict[str, Array] = all_arrays(model["attributes"]) if "attributes" in model else {}
        self.provenance: dict[str, object] = {name: _plain(value) for name, value in file.attrs.items()}
        lengths = [len(values) for values in (*fields.values(), *self.series.values())]
        if any(length != len(self.time) for length in lengths):
            raise TrajectoryError(
                f"{self.path}: fields have {min(lengths)} to {max(lengths)} frames and times {len(self.time)}; take a copy of "
                "the file, or record the run again"
            )

    def __enter__(self) -> TrajectoryReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.time)

    @property
    def counts(self) -> Integers:
        """Points of each rod, shape (R,), int."""
        return self.curves.counts

    @property
    def closed(self) -> Bools:
        """Closed rods, shape (R,), bool."""
        return self.curves.closed

    @property
    def radius(self) -> Floats:
        """Radius at each point [m], shape (P,)."""
        return self.curves.radius

    @property
    def checkpoint_slot(self) -> str:
        """Name of the group of the last checkpoint, "a" or "b"."""
        return self._live.read(lambda file: self._checkpoint_group(file).name.rpartition("/")[2])

    @property
    def checkpoint_frame(self) -> int:
        """Number of frames up to and including the checkpoint."""
        return self._live.read(lambda file: int(self._checkpoint_group(file).attrs["frame"]))

    def checkpoint(self) -> dict[str, Array]:
        """Return the last complete state, for `model.restore`."""
        frame = self.checkpoint_frame
        if frame > len(self):
            raise TrajectoryError(f"{self.path}: the checkpoint is of frame {frame}, but there are {len(self)}")
        arrays = self._live.read(self._checkpoint)
        return {name: value for name, value in arrays.items() if not name.startswith(f"{COUNTS}/")}

    def run_counts(self) -> dict[str, Array]:
        """Return counts of the run up to the checkpoint, by name; empty if the file has none."""
        arrays = self._live.read(self._checkpoint).items()
        return {name.removeprefix(f"{COUNTS}/"): value for name, value in arrays if name.startswith(f"{COUNTS}/")}

    def _checkpoint_group(self, file: h5py.File) -> h5py.Group:
        if "checkpoint" not in file:
            raise TrajectoryError(f"{self.path}: the run ended before its first block was written; start it again")
        return file["checkpoint"][file["checkpoint"].attrs["current"]]

    def _checkpoint(self, file: h5py.File) -> dict[str, Array]:
        """Return all arrays of the last checkpoint, verified."""
        group = self._checkpoint_group(file)
        check_seal(group, self.path)
        return all_arrays(group)

    def close(self) -> None:
        """Close the file; arrays already read stay valid."""
        self._live.close()


def read_rods(path: FilePath, frame: int = -1, world: int = 0, *, outside: bool = False) -> list[CurveSet]:
    """Return rods of an HDF5 file, a trajectory or a plain file.

    A trajectory gives one set for each batch of rods, at one frame (by default the last) of one world.
    A plain file has at its root `points`, (R, n, 3), or (P, 3) with `counts`, (R,) [m]. Optional are `closed`, one flag or (R,),
    and `radius`, one value or (P,) [m].

    Args:
        path: The file.
        frame, world: Frame and world of a trajectory; plain files have one of each.
        outside: Whether the file may refer to other files; see `TrajectoryReader`.

    Raises:
        CurveError, TrajectoryError: The file holds no rods, or no such frame or world.
    """
    path, frame, world = existing(path), argument_checks.index("frame", frame), argument_checks.index("world", world)

    def plain(file: h5py.File) -> list[CurveSet]:
        if not outside:
            refuse_links(file, path)
        if "points" not in file:
            return []
        if frame not in (0, -1) or world not in (0, -1):
            raise CurveError(
                f"{path}: there are no frames or worlds to choose from; leave out frame = {frame}, world = {world}"
            )
        return [_read_plain(file, path)]

    live = LiveFile(path)
    try:
        if curves := live.read(plain):
            return curves
    finally:
        live.close()
    with TrajectoryReader(path, outside=outside) as reader:
        if not len(reader):
            raise CurveError(f"{path}: the trajectory has no frames; read a file of a run that wrote a block")
        points = reader.points[frame]
        worlds = len(points) if points.ndim == 3 else 1
        if not -worlds <= world < worlds:
            raise CurveError(f"{path}: there is no world {world}; it has {worlds}, counted from 0")
        unread = [f"{len(reader) - 1} other frames"] * (len(reader) > 1) + [f"{worlds - 1} other worlds"] * (worlds > 1)
        contents = {"surfaces": reader.surfaces, "obstacles": reader.obstacles, "rigid bodies": reader.rigid_bodies}
        unread += [name for name, content in contents.items() if content is not None]
        return _by_batch(reader.curves, points if points.ndim == 2 else points[world], path, tuple(unread))


def _read_plain(file: h5py.File, path: Path) -> CurveSet:
    points, *optional = (_array(file[name]) if name in file else None for name in PLAIN)
    counts, closed, radius = optional
    if counts is None and points.ndim != 3:
        raise CurveError(f"{path}: `points` has shape {points.shape} and there are no `counts`; add the points per rod")
    counts = np.full(points.shape[0], points.shape[1]) if counts is None else counts
    curves = checked_curves(points, counts, False if closed is None else closed, radius, "points", str(path))
    return replace(curves, unread=tuple(name for name in file if name not in PLAIN))


def _by_batch(curves: Curves, points: np.ndarray, path: Path, unread: tuple[str, ...]) -> list[CurveSet]:
    sets = []
    for batch in np.unique(curves.batch):
        rods = curves.batch == batch
        mine = np.flatnonzero(np.repeat(rods, curves.counts))
        name = str(curves.names[rods][0])
        radius = curves.radius[mine]
        checked = checked_curves(points[mine], curves.counts[rods], curves.closed[rods], radius, name, str(path))
        sets.append(replace(checked, unread=unread))
    return sets


def _refuse_misfits(curves: Curves, surfaces: Surfaces | None, point_count: int) -> None:
    """Raise a ValueError if rods or surfaces do not fit the points."""
    rods, total = len(curves.counts), int(np.sum(curves.counts))
    fits = (curves.counts >= 0).all() and len(curves.radius) == total <= point_count
    fits = fits and {len(curves.closed), len(curves.names), len(curves.batch)} == {rods}
    if surfaces is not None:
        triangles, first = surfaces.triangles, surfaces.first
        fits = fits and 0 <= triangles.min() and triangles.max() < point_count and len(first) == len(surfaces.names)
        fits = fits and 0 == first[0] and first[-1] <= len(triangles) == len(surfaces.thickness)
        fits = fits and (surfaces.uv is None or surfaces.uv.shape == (*triangles.shape, 2))
    if not fits:
        raise ValueError(f"rods and surfaces do not fit the {point_count} points of a frame")


def _described_by(kind: type, group: h5py.Group):
    """Return an object of a dataclass whose fields are the datasets of a group."""
    return kind(**{field.name: _array(group[field.name]) for field in fields_of(kind)})


def _array(dataset: h5py.Dataset) -> np.ndarray:
    """Read a dataset; texts as str."""
    _check_size(dataset)
    return dataset.asstr()[()].astype(str) if h5py.check_string_dtype(dataset.dtype) else dataset[()]


def paths_of(group: h5py.Group) -> set[str]:
    """Return the paths of all datasets below a group, relative to the group."""
    paths = set()
    group.visititems(lambda name, item: paths.update([name] if isinstance(item, h5py.Dataset) else []))
    return paths


def all_arrays(group: h5py.Group) -> dict[str, np.ndarray]:
    """Read all datasets below a group, by relative path."""
    arrays = {}
    group.visititems(lambda name, item: arrays.update({name: _array(item)} if isinstance(item, h5py.Dataset) else {}))
    return arrays


def _plain(value):
    """Return an attribute as a Python value; JSON objects and lists are decoded."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, str) and value[:1] in {"{", "["}:
        return json.loads(value)
    return value

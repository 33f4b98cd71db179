"""Torch data set of windows of recorded runs.

    data = Recordings("data/pulls", window=16, stride=8, split="train")
    loader = torch.utils.data.DataLoader(data, batch_size=32, shuffle=True, num_workers=4)

Every worker, forked or spawned, opens files itself at the first read; only paths and numbers are sent to workers.
"""

from __future__ import annotations

import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from numbers import Number
from pathlib import Path

import numpy as np

from ddg_warp.errors import DataError, MissingPackageError, SceneError

try:
    import torch
except ModuleNotFoundError as error:
    raise MissingPackageError("data sets need", error, "torch") from error

from ddg_warp import argument_checks
from ddg_warp.data.episodes import INDEX, Episodes, inside
from ddg_warp.data.splits import SPLITS
from ddg_warp.io.hdf5_read import TrajectoryReader
from ddg_warp.io.paths import as_path, is_file
from ddg_warp.run.run_directory import TRAJECTORY

DTYPES = {"float32": torch.float32, "float64": torch.float64}
OPEN_FILES = 64  # most recently used files that each worker keeps open
VECTORS = ("points", "velocities", "directors")


@dataclass(frozen=True)
class Source:
    """Recorded file, source of windows.

    Attributes:
        path: The file.
        frames: Number of frames.
        worlds: Worlds in every frame; each yields windows of its own.
        parameters: Parameters of the run by name.
    """

    path: Path
    frames: int
    worlds: int
    parameters: dict


class Recordings(torch.utils.data.Dataset):
    """Windows of frames of recorded runs, ordered by file, world and time.

    An item is a dict of tensors. `time` is (W,) [s]. Fields are as recorded: `points` (W, P, 3) [m], `velocities` (W, P, 3) [m/s],
    `directors` (W, E, 3), fields of points (W, P) or triangles (W, T), observed values (W,). `parameters` has each number () that
    all files have, `file` is the index in `sources`, and `world` that of the world. Items of files whose rods have different
    numbers of points do not stack: collate them yourself, or make a data set of each.

    Args:
        paths: A folder of episodes (`ddg_warp.data.episodes`), a run directory, a trajectory.h5, or several of these.
        window: Frames in an item, W.
        stride: Recorded frames from the start of a window to that of the next.
        every: Recorded frames from one frame of a window to the next.
        fields: Data to read besides times: "points", "velocities", "directors", names of fields or of observed values.
        split: "train", "validation" or "test" of folders of episodes; None for all.
        failed: True to read also episodes that ended early.
        short: Treatment of files with fewer frames than a window spans: "refuse" or "skip"; `skipped` has their paths.
        dtype: "float32" or "float64", the precision of all tensors.
        outside: True if index entries or links may lead to files outside of the folders.

    Attributes:
        sources: Files of the data set, a list of `Source`.
        skipped: Paths of files that are too short.

    Raises:
        SceneError: An option is invalid.
        DataError: There is nothing to read, a file is too short, or a field was not recorded.
        TrajectoryError: A file is damaged.
    """

    def __init__(
        self,
        paths,
        *,
        window: int,
        stride: int = 1,
        every: int = 1,
        fields: Sequence[str] = ("points",),
        split: str | None = None,
        failed: bool = False,
        short: str = "refuse",
        dtype: str = "float64",
        outside: bool = False,
    ):
        self.window, self.stride, self.every = (
            argument_checks.count(f"Recordings: {name}", value)
            for name, value in (("window", window), ("stride", stride), ("every", every))
        )
        names = [] if isinstance(fields, str | bytes) or not np.iterable(fields) else [*fields]
        if not names or not all(isinstance(name, str) for name in names):
            raise SceneError(f"Recordings: fields = {fields!r}; give a list of names, one at least")
        self.fields = tuple(dict.fromkeys(names))
        argument_checks.flag("Recordings: failed", failed)
        argument_checks.flag("Recordings: outside", outside)
        if split is not None:
            argument_checks.choice("Recordings: split", split, SPLITS)
        self._dtype = argument_checks.choice("Recordings: dtype", dtype, DTYPES)
        self._outside = outside
        argument_checks.choice("Recordings: short", short, ("refuse", "skip"))
        several = np.iterable(paths) and not isinstance(paths, str | bytes | os.PathLike)
        files = [as_path("Recordings: paths", path) for path in (paths if several else [paths])]
        if not files:
            raise DataError(
                "Recordings: paths are empty; give a folder of episodes, a directory of a run, or a trajectory.h5"
            )
        sources = [source for path in files for source in _sources(path, split, failed, outside)]
        span = (self.window - 1) * self.every + 1
        self.skipped = [source.path for source in sources if source.frames < span]
        if self.skipped and short == "refuse":
            first = next(source for source in sources if source.frames < span)
            raise DataError(
                f"{first.path} has {first.frames} frames, a window spans {span}: shorten the window, or leave out such files "
                f"({len(self.skipped)} of {len(sources)}) by short='skip'"
            )
        self.sources = [source for source in sources if source.frames >= span]
        if not self.sources:
            of_split = f"of the split {split!r} " if split else ""
            raise DataError(
                f"{paths}: there is no episode {of_split}with {span} frames to read; record some, or choose others"
            )
        self._per_world = [(source.frames - span) // self.stride + 1 for source in self.sources]
        counts = (n * source.worlds for n, source in zip(self._per_world, self.sources, strict=True))
        self._ends = list(accumulate(counts))
        shared = set.intersection(*({*source.parameters} for source in self.sources))
        self._parameters = sorted(
            name for name in shared if all(isinstance(source.parameters[name], Number) for source in self.sources)
        )
        self._readers: OrderedDict[int, TrajectoryReader] = OrderedDict()
        self._owner = os.getpid()
        self._reader(0)
        self.close()  # workers fork from this process

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, index: int) -> dict:
        """Return a window.

        Raises:
            SceneError: `index` is not an integer.
            IndexError: There is no such window.
        """
        file, world, start = self.place(index)
        source, reader = self.sources[file], self._reader(file)
        frames = slice(start, start + (self.window - 1) * self.every + 1, self.every)
        item = {"time": self._tensor(reader.time[frames])}
        for name in self.fields:
            item[name] = self._tensor(self._read(reader, source, name, frames, world))
        item["parameters"] = {name: self._tensor(source.parameters[name]) for name in self._parameters}
        return item | {"file": file, "world": world}

    def place(self, index: int) -> tuple[int, int, int]:
        """Return file index in `sources`, world and first frame of an item.

        Raises:
            SceneError: `index` is not an integer.
            IndexError: There is no such item.
        """
        index = argument_checks.index("Recordings: item", index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"item {index}: there are {len(self)} windows")
        index %= len(self)
        file = bisect_right(self._ends, index)
        index -= self._ends[file - 1] if file else 0
        world, window = divmod(index, self._per_world[file])
        return file, world, window * self.stride

    def __getstate__(self) -> dict:
        return vars(self) | {"_readers": OrderedDict()}

    def close(self) -> None:
        """Close the files that this process has open; the next read opens them again."""
        if self._owner == os.getpid():
            for reader in self._readers.values():
                reader.close()
        self._readers = OrderedDict()

    def _reader(self, file: int) -> TrajectoryReader:
        """Return the open file of a source in this process."""
        if self._owner != os.getpid():  # forked: the files of the parent are left to it
            self._readers, self._owner = OrderedDict(), os.getpid()
        if file not in self._readers:
            path = self.sources[file].path
            reader = self._readers[file] = TrajectoryReader(path, outside=self._outside)
            self._check_fields(reader, self.sources[file])
        self._readers.move_to_end(file)
        if len(self._readers) > OPEN_FILES:
            self._readers.popitem(last=False)[1].close()
        return self._readers[file]

    def _check_fields(self, reader: TrajectoryReader, source: Source) -> None:
        """Refuse a file that lacks fields, or whose frames or worlds differ from the index."""
        path, worlds = source.path, reader.points.shape[1] if reader.points.ndim == 4 else 1
        if len(reader) < source.frames or worlds != source.worlds:
            raise DataError(
                f"{path} has {len(reader)} frames of {worlds} worlds, its index says {source.frames} of {source.worlds}; take a copy "
                "of file and index, or record the run again"
            )
        recorded = {name for name in VECTORS if getattr(reader, name) is not None}
        recorded |= reader.fields.keys() | reader.series.keys()
        for name in self.fields:
            if name not in recorded:
                raise DataError(f"{path}: {name!r} was not recorded; there is {', '.join(sorted(recorded))}")

    def _read(self, reader: TrajectoryReader, source: Source, name: str, frames: slice, world: int) -> np.ndarray:
        """Return frames of a field in one world."""
        if name in VECTORS:
            values = getattr(reader, name)[frames]
            return values[:, world] if values.ndim == 4 else values
        if name in reader.series:
            return reader.series[name][frames]
        values = reader.fields[name][frames]
        if (
            f"at_cells/{name}" in reader.recorded
        ):  # triangles follow the rods of all worlds, which are cells without values
            values = values[:, source.worlds * len(reader.counts) :]
        return values.reshape(len(values), source.worlds, -1)[:, world]

    def _tensor(self, values) -> torch.Tensor:
        return torch.tensor(
            values, dtype=DTYPES[self._dtype], device="cpu"
        )  # on the CPU for data loaders, whatever the default device is


def _sources(path: Path, split: str | None, failed: bool, outside: bool) -> list[Source]:
    """Return the files of a path: the episodes of a folder, or the trajectory of one run."""
    if is_file(path / INDEX):
        episodes = Episodes(path, outside=outside)
        return [
            Source(episodes.path(episode), episode.frames, episode.worlds, episode.parameters)
            for episode in episodes.select(split, failed)
        ]
    if split is not None:
        raise DataError(
            f"{path} is no folder of episodes and has no split {split!r}; leave split out, or write it by EpisodeWriter"
        )
    file = path / TRAJECTORY if os.path.isdir(path) else path
    if not is_file(file):
        raise DataError(f"{file} does not exist; give a folder of episodes, a directory of a run, or a trajectory.h5")
    if file is not path:
        inside(path, file, outside)
    with TrajectoryReader(file, outside=outside) as reader:
        worlds = reader.points.shape[1] if reader.points.ndim == 4 else 1
        parameters = reader.provenance.get("parameters", {})
        return [Source(file, len(reader), worlds, parameters if isinstance(parameters, dict) else {})]

"""Episodes: recorded runs in one folder, each with parameters, seed, outcome and split.

    DIR/NAME.h5       recording of an episode, see `ddg_warp.io.hdf5`; may be missing if the episode failed early
    DIR/index.json    the fractions of the splits, and an entry for each episode

The split is a hash of the name of an episode and the seed of the folder, so that it does not change when episodes are added. Files
are written under a temporary name and renamed: a writer killed at any time leaves complete episodes, and an index that lacks at
most the last of them.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ddg_warp import argument_checks
from ddg_warp.data.parameter_ranges import storable
from ddg_warp.data.splits import FRACTIONS, SPLITS, checked_fractions, split_of
from ddg_warp.errors import DataError, SceneError, SolverError
from ddg_warp.io.paths import as_path, is_file
from ddg_warp.run.run_directory import LOCK, TRAJECTORY, lock_directory
from ddg_warp.run.summary import write_json
from ddg_warp.typing import FilePath

INDEX, SCRATCH = "index.json", ".partial"
DONE = "converged"  # outcome of an episode that ran to its end
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
FRACTION = 0.05  # largest fraction of a writer's time spent on saving the index


@dataclass(frozen=True)
class Episode:
    """One recorded run.

    Attributes:
        name: Name of the episode and of its file.
        split: "train", "validation" or "test".
        outcome: "converged", or the name of the outcome that ended it early.
        failure: Reason of an early end; else empty.
        seed: Seed of its random numbers; None if there were none.
        parameters: Parameters by name.
        seconds: Wall time [s].
        frames: Recorded frames.
        worlds: Worlds in every frame.
        file: Name of its file in the folder; empty if nothing was recorded.
    """

    name: str
    split: str
    outcome: str = DONE
    failure: str = ""
    seed: int | None = None
    parameters: dict[str, float | str] = field(default_factory=dict)
    seconds: float = 0.0
    frames: int = 0
    worlds: int = 1
    file: str = ""

    @property
    def failed(self) -> bool:
        """True if the episode ended early."""
        return self.outcome != DONE


class Episodes:
    """Episodes listed in the index of a folder, ordered by name.

    Args:
        directory: The folder.
        outside: True if index entries or links may lead to files outside of the folder.

    Raises:
        DataError: The folder has no index, or the index is damaged.
    """

    def __init__(self, directory: FilePath, *, outside: bool = False):
        self.directory = as_path("Episodes: directory", directory)
        self._outside = argument_checks.flag("Episodes: outside", outside)
        path = self.directory / INDEX
        if not is_file(path):
            raise DataError(f"{self.directory} holds no episodes: {path} is missing; `EpisodeWriter` writes it")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            self.fractions = checked_fractions(content["fractions"])
            self.seed = argument_checks.count("seed", content["seed"], 0)
            entries = [_checked(Episode(**entry)) for entry in content["episodes"]]
            self._episodes = {entry.name: entry for entry in entries}
            if len(self._episodes) < len(entries):
                raise ValueError("two episodes have one name")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise DataError(f"{path} is damaged ({error}); take a copy of it, or write the episodes again") from error

    def __len__(self) -> int:
        return len(self._episodes)

    def __iter__(self) -> Iterator[Episode]:
        return iter(self._episodes.values())

    def __contains__(self, name: str) -> bool:
        return isinstance(name, str) and name in self._episodes

    def __getitem__(self, name: str) -> Episode:
        if name not in self:
            raise DataError(f"{self.directory} has no episode {name!r}; give a name, which iteration over it shows")
        return self._episodes[name]

    def select(self, split: str | None = None, failed: bool = False) -> list[Episode]:
        """Return the episodes with frames to read.

        Args:
            split: "train", "validation" or "test"; None for all.
            failed: True to include recordings of episodes that ended early.
        """
        if split is not None:
            argument_checks.choice("split", split, SPLITS)
        argument_checks.flag("failed", failed)
        chosen = (episode for episode in self if split in (None, episode.split))
        return [episode for episode in chosen if episode.frames and (failed or not episode.failed)]

    def path(self, episode: Episode) -> Path:
        """Return the file of an episode.

        Raises:
            DataError: The argument is no episode, has no file, or its file lies outside of the folder.
        """
        if not isinstance(episode, Episode):
            raise DataError(f"{self.directory}: {episode!r} is no episode; give one of those that it holds")
        if not episode.file:
            raise DataError(f"{self.directory}: nothing was recorded of episode {episode.name!r}; select others")
        return inside(self.directory, self.directory / episode.file, self._outside)


class EpisodeWriter:
    """Writer that adds episodes to a folder, one process at a time.

        with EpisodeWriter("data/pulls") as writer:
            with writer.episode("pull_000", parameters={"force": 0.5}) as directory:
                with ddg.Recorder(model, directory, usd=False) as recorder: ...

    Args:
        directory: The folder; made if there is none.
        fractions: Fractions of train, validation and test; by default from the folder, or 0.8, 0.1 and 0.1.
        seed: Seed of the splits; by default that of the folder, or 0.

    Raises:
        DataError: The fractions do not sum to one, the folder has others, or it is no folder that can be made.
        FileExistsError: Another process writes to the folder.
    """

    def __init__(self, directory, *, fractions: tuple[float, float, float] | None = None, seed: int | None = None):
        self.directory = as_path("EpisodeWriter: directory", directory)
        options = {} if fractions is None else {"fractions": checked_fractions(fractions)}
        options |= {} if seed is None else {"seed": argument_checks.count("EpisodeWriter: seed", seed, 0)}
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise DataError(
                f"{error.filename or self.directory} is a file, no folder; choose another folder"
            ) from error
        except OSError as error:
            raise DataError(f"{self.directory} cannot be made ({error.strerror}); choose another folder") from error
        self._lock = lock_directory(self.directory)
        try:
            old = Episodes(self.directory) if (self.directory / INDEX).exists() else None
            for name, value in options.items() if old is not None else ():
                if getattr(old, name) != value:
                    kept = getattr(old, name)
                    raise DataError(
                        f"{self.directory} has {name} = {kept}, not {value}; leave {name} out, or take another folder"
                    )
            self.fractions = old.fractions if old is not None else options.get("fractions", FRACTIONS)
            self.seed = old.seed if old is not None else options.get("seed", 0)
            self._episodes = {episode.name: episode for episode in old or ()}
            shutil.rmtree(self.directory / SCRATCH, ignore_errors=True)  # left by a killed writer
            self._cost, self._saved = 0.0, 0.0
            self._save()
        except BaseException:
            self._let_go()
            raise

    def __enter__(self) -> EpisodeWriter:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._episodes)

    def __contains__(self, name: str) -> bool:
        return isinstance(name, str) and name in self._episodes

    @contextmanager
    def episode(self, name: str, *, parameters: Mapping | None = None, seed: int | None = None) -> Iterator[Path]:
        """Yield a directory to record a run in, such as that of a `Recorder`, and add the run when the block ends.

        A SolverError ends the episode with its outcome and is raised again. After any other error nothing is added.

        Args:
            name: The episode's name.
            parameters: Parameters by name: numbers, texts, lists of them.
            seed: Seed of its random numbers.
        """
        entry = _described(name, parameters, seed)
        directory, began = self.scratch(name), time.perf_counter()
        trajectory = directory / TRAJECTORY
        try:
            yield directory
        except SolverError as error:
            entry |= {"outcome": error.outcome or "failed", "failure": str(error)}
            self.add(name, trajectory, seconds=time.perf_counter() - began, **entry)
            raise
        else:
            self.add(name, trajectory, seconds=time.perf_counter() - began, **entry)
        finally:
            shutil.rmtree(directory, ignore_errors=True)

    def scratch(self, name: str) -> Path:
        """Return an empty directory next to the episodes to record one in; the next writer removes it."""
        self._check_new(name)
        directory = self.directory / SCRATCH / name
        shutil.rmtree(directory, ignore_errors=True)
        directory.mkdir(parents=True)
        return directory

    def add(
        self,
        name: str,
        trajectory=None,
        *,
        parameters: Mapping | None = None,
        seed: int | None = None,
        outcome: str = DONE,
        failure: str = "",
        seconds: float = 0.0,
    ) -> Episode:
        """Add an episode.

        Args:
            name: The episode's name.
            trajectory: The recorded file; it is moved into the folder. Failed episodes may have none.
            parameters, seed, outcome, failure, seconds: See `Episode`.

        Raises:
            DataError: The name exists, a converged episode has no frames, or the index cannot hold a value.
            SceneError: An option is invalid.
        """
        self._check_new(name)
        made = _described(name, parameters, seed)
        made["seconds"] = argument_checks.number(
            f"episode {name!r}: seconds", seconds, "a time [s]", lambda v: v >= 0.0
        )
        for attribute, text in (("outcome", outcome), ("failure", failure)):
            if not isinstance(text, str) or (attribute == "outcome" and not text):
                raise SceneError(f"episode {name!r}: {attribute} = {text!r}; give a text")
        if trajectory is not None:
            trajectory = as_path(f"episode {name!r}: trajectory", trajectory)
            if trajectory.is_symlink():
                raise DataError(f"episode {name!r}: {trajectory} is a link, which the folder would keep; give the file")
        frames, worlds = _size(trajectory)
        if not (frames or outcome != DONE):
            raise DataError(
                f"episode {name!r}: no frame was recorded in {trajectory}; record one, or say how it failed"
            )
        file = f"{name}.h5" if frames else ""
        if file:
            _move(Path(trajectory), self.directory / file)
        split = split_of(name, self.fractions, self.seed)
        episode = Episode(name, split, outcome, failure, **made, frames=frames, worlds=worlds, file=file)
        self._episodes[name] = episode
        # A large index is not saved after every episode; unsaved episodes are run again after a kill.
        if time.perf_counter() - self._saved > self._cost / FRACTION:
            self._save()
        return episode

    def close(self) -> None:
        """Write the index; a second call does nothing."""
        if self._lock is not None:
            try:
                self._save()
            finally:
                self._let_go()

    def _check_new(self, name: str) -> None:
        if self._lock is None:
            raise DataError(f"the writer of {self.directory} is closed: open another, which goes on with the folder")
        if not (isinstance(name, str) and NAME.fullmatch(name)):
            rule = "a name is made of letters, digits, and . _ - after the first, 200 at most"
            raise DataError(f"episode {name!r:.60}: {rule}")
        if name in self._episodes:
            raise DataError(f"{self.directory} has an episode {name!r} already; choose another name")

    def _save(self) -> None:
        began = time.perf_counter()
        entries = [
            vars(self._episodes[name]) for name in sorted(self._episodes)
        ]  # independent of the order of creation
        write_json(self.directory / INDEX, {"fractions": self.fractions, "seed": self.seed, "episodes": entries})
        self._saved = time.perf_counter()
        self._cost = self._saved - began

    def _let_go(self) -> None:
        shutil.rmtree(self.directory / SCRATCH, ignore_errors=True)
        (self.directory / LOCK).unlink(missing_ok=True)
        os.close(self._lock)
        self._lock = None


def inside(folder: Path, path: Path, outside: bool) -> Path:
    """Return a path, refused if it leads out of a folder.

    Args:
        folder: The folder.
        path: A path below it.
        outside: True if the path may lead out of the folder.

    Raises:
        DataError: The path leads out of the folder, by `..` or by a link, and may not.
    """
    if not outside and not path.resolve().is_relative_to(folder.resolve()):
        raise DataError(
            f"{path} leads out of {folder}, to {path.resolve()}; allow it by outside=True where you trust it"
        )
    return path


def _described(name: str, parameters: Mapping | None, seed: int | None) -> dict:
    """Return parameters and seed of an episode in index form."""
    if parameters is not None and not isinstance(parameters, Mapping):
        raise SceneError(f"episode {name!r}: parameters = {parameters!r:.60}; give a dict of values by name")
    if seed is not None:
        seed = argument_checks.count(f"episode {name!r}: seed", seed, 0)
    return {"parameters": storable(f"episode {name!r}: parameters", dict(parameters or {})), "seed": seed}


def _checked(episode: Episode) -> Episode:
    """Return an episode of an index after a check of types."""
    name, file = episode.name, episode.file
    if not (isinstance(name, str) and NAME.fullmatch(name)):
        raise ValueError(f"name {name!r:.60}")
    argument_checks.choice(f"episode {name!r}: split", episode.split, SPLITS)
    argument_checks.count(f"episode {name!r}: frames", episode.frames, 0)
    argument_checks.count(f"episode {name!r}: worlds", episode.worlds)
    texts = (episode.outcome, episode.failure, file)
    if not all(isinstance(text, str) for text in texts) or not isinstance(episode.parameters, dict):
        raise ValueError(f"episode {name!r}: outcome, failure and file are texts, parameters a dict")
    if "\0" in file or bool(file) != bool(episode.frames):
        raise ValueError(f"episode {name!r}: {episode.frames} frames in the file {file!r:.60}")
    return episode


def _size(trajectory) -> tuple[int, int]:
    """Return frames and worlds of a recorded file; (0, 1) without a file."""
    from ddg_warp.io.hdf5_read import TrajectoryReader

    if trajectory is None or not Path(trajectory).exists():
        return 0, 1
    with TrajectoryReader(trajectory) as reader:
        return len(reader), reader.points.shape[1] if reader.points.ndim == 4 else 1


def _move(source: Path, target: Path) -> None:
    """Rename a file; across disks copy it to a temporary name first."""
    try:
        os.replace(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        aside = target.with_name(f"{target.name}.partial")
        shutil.copyfile(source, aside)
        os.replace(aside, target)
        source.unlink()

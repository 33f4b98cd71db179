"""The directory of a run: who writes to it, and whether it holds frames that a new run would destroy."""

from __future__ import annotations

import errno
import fcntl
import os
from contextlib import suppress
from pathlib import Path

from ddg_warp.errors import DataError, SceneError

TRAJECTORY, SCENE, SUMMARY, LOCK = "trajectory.h5", "scene.usdc", "summary.json", "run.lock"
VIEW = "trajectory.vtkhdf"  # the trajectory by the name that ParaView knows
PICTURES = ("picture.png", "path.png", "learned.png")


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # what a disk may come to while a run writes to it


class RecordError(DataError, OSError):
    """A run could not be written to its disk; what was complete is kept."""


class TakenError(RecordError, FileExistsError):
    """A directory cannot be given to a run: there is a run, another process or a file."""


def told(path, error: OSError, kept: str = "") -> RecordError:
    """What is the matter with a place that cannot be written to, and what to do.

    Args:
        path: The place, as it was given.
        error: What the system says.
        kept: What is said between both.
    """
    reason = error.strerror or str(error)
    if error.errno in FULL:
        remedy = (
            "free some space and resume it, or write to another disk"
            if kept
            else "free some space, or write to another disk"
        )
    elif error.errno in (errno.ENOENT, errno.ESTALE) and not _is_somewhere():
        reason, remedy = "the working directory was removed", "change to one that exists, or give an absolute path"
    elif error.errno == errno.ENOENT:
        remedy = "the directory that it was in was removed, or cannot be made; give another place"
    elif error.errno in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR):
        remedy = "give another place, or move away what is there"
    elif error.errno == errno.ENAMETOOLONG:
        remedy = "give a shorter name"
    else:
        remedy = "give another place, which can be written to"
    result = RecordError(f"{path}: {reason}: {kept}{remedy}")
    result.errno = error.errno
    return result


def _is_somewhere() -> bool:
    try:
        return bool(os.getcwd())
    except OSError:
        return False


class RunDirectory(os.PathLike):
    """A directory that one process at a time writes runs to, for as long as the object is open.

    A process that ends, however it does, holds no directory. Whoever holds one may hand it on in the place of a path: a `Recorder`
    of a `RunDirectory` leaves it held when it closes.

    Args:
        path: The directory; made if there is none, and removed at the end of a `with` that has put nothing into it.

    Raises:
        SceneError: It is no path.
        TakenError: Another process, or another recorder of this one, holds the directory, or the path is a file.
        RecordError: It cannot be made or written to.
    """

    def __init__(self, path):
        if not isinstance(path, str | os.PathLike) or "\0" in os.fspath(path):
            raise SceneError(f"the directory of a run is {path!r}; give a path")
        self.path = Path(path)
        self._made = False
        try:
            self._made = not self.path.exists()
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = lock_directory(self.path)
        except TakenError:
            raise
        except (FileExistsError, NotADirectoryError) as error:
            files = [each for each in (self.path, *self.path.parents) if os.path.lexists(each) and not each.is_dir()]
            what = "a link that leads nowhere" if files[0].is_symlink() else "a file"
            raise TakenError(
                f"{self.path}: {files[0]} is {what}, and a run is recorded in a directory of its own; give another one (--out DIR), "
                "or move it away"
            ) from error
        except OSError as error:
            raise told(self.path, error, "no run can be recorded there; " * (error.errno not in FULL)) from error

    def __fspath__(self) -> str:
        return str(self.path)

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(self, *_) -> None:
        self.close()
        if self._made:
            with suppress(OSError):  # where there is something in it
                self.path.rmdir()

    def clear(self, *kept: str) -> None:
        """Removes what an earlier run has left, but for the files that the new one has begun already."""
        for name in {TRAJECTORY, VIEW, SCENE, SUMMARY, *PICTURES} - {*kept}:
            (self.path / name).unlink(missing_ok=True)

    def close(self) -> None:
        """Lets other processes in; a second call does nothing."""
        if self._lock is not None:
            (self.path / LOCK).unlink(missing_ok=True)
            os.close(self._lock)  # which unlocks it
            self._lock = None


def lock_directory(directory: Path) -> int:
    """Descriptor of the lock of a directory, held until it is closed: a process that ends, however it does, holds none.

    Raises:
        TakenError: Another process, or another recorder of this one, holds it, or its name is taken by something else.
    """
    path = directory / LOCK
    while True:
        try:
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.EISDIR):
                raise
            what = "a link" if error.errno == errno.ELOOP else "a directory"
            raise TakenError(f"{path} is {what}, and no lock of a run; remove it") from None
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(os.fstat(lock), os.lstat(path)):
                os.truncate(lock, 0)
                os.pwrite(lock, str(os.getpid()).encode(), 0)
                return lock
        except BlockingIOError:
            owner = os.pread(lock, 20, 0).decode(errors="replace") or "unknown"
            os.close(lock)
            raise TakenError(
                f"{directory}: process {owner} is recording a run there; wait for its end, or give another directory"
            ) from None
        except OSError:
            path.unlink(missing_ok=True)
            os.close(lock)
            raise
        os.close(lock)  # its owner has just removed the file that was opened


def refuse_to_replace(directory: Path) -> None:
    """Raises a TakenError where a directory holds frames of a run."""
    from ddg_warp.io.hdf5 import TrajectoryError, TrajectoryReader

    path = directory / TRAJECTORY
    if path.exists():
        try:
            with TrajectoryReader(path) as reader:
                frames = f"{len(reader)} frames up to {reader.time[-1]:g} s" if len(reader) else ""
        except TrajectoryError:
            frames = "a run that cannot be read"
    else:
        frames = SCENE if (directory / SCENE).exists() else ""
    if frames:
        raise TakenError(
            f"{directory} holds {frames}: force (--force) replaces them, another directory (--out DIR) keeps them, "
            "and resume (--resume DIR) goes on with them"
        )

"""Directory of a run: lock it for one writer, and protect recorded frames from a new run."""

from __future__ import annotations

import errno
import fcntl
import os
from contextlib import suppress
from pathlib import Path

from ddg_warp.errors import DataError, SceneError

TRAJECTORY, SCENE, SUMMARY, LOCK = "trajectory.h5", "scene.usdc", "summary.json", "run.lock"
VIEW = "trajectory.vtkhdf"  # name of the trajectory for ParaView
PICTURES = ("picture.png", "path.png", "learned.png")


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # errors of a full or failing disk during a run


class RecordError(DataError, OSError):
    """Failure to write a run to disk; complete blocks are kept."""


class TakenError(RecordError, FileExistsError):
    """Refusal of a directory: a run, another process or a file is in it."""


def system_error(path, error: OSError, kept: str = "") -> RecordError:
    """Return an error that names the path, the reason and a remedy.

    Args:
        path: The path as given by the user.
        error: The error of the system.
        kept: Text between reason and remedy, such as which data are kept.
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
        remedy = "the directory that it was in was removed, or cannot be made; give another path"
    elif error.errno in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR):
        remedy = "give another path, or move the existing file or folder"
    elif error.errno == errno.ENAMETOOLONG:
        remedy = "give a shorter name"
    else:
        remedy = "give another path, which can be written to"
    result = RecordError(f"{path}: {reason}: {kept}{remedy}")
    result.errno = error.errno
    return result


def _is_somewhere() -> bool:
    try:
        return bool(os.getcwd())
    except OSError:
        return False


class RunDirectory(os.PathLike):
    """Directory of runs, locked for one process as long as the object is open.

    The end of a process releases the lock in any case. A `RunDirectory` can be passed on instead of a path: a `Recorder` leaves it
    locked when it closes.

    Args:
        path: The directory; made if there is none, and removed at the end of a `with` if new and empty.

    Raises:
        SceneError: The argument is no path.
        TakenError: Another process, or another recorder of this one, has locked the directory, or the path is a file.
        RecordError: The directory cannot be made or written to.
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
            kind = "a link that leads nowhere" if files[0].is_symlink() else "a file"
            raise TakenError(
                f"{self.path}: {files[0]} is {kind}, and a run is recorded in a directory of its own; give another one (--out DIR), "
                "or move it away"
            ) from error
        except OSError as error:
            raise system_error(
                self.path, error, "no run can be recorded there; " * (error.errno not in FULL)
            ) from error

    def __fspath__(self) -> str:
        return str(self.path)

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(self, *_) -> None:
        self.close()
        if self._made:
            with suppress(OSError):  # not empty
                self.path.rmdir()

    def clear(self, *kept: str) -> None:
        """Remove the files of an earlier run, except names in `kept`."""
        for name in {TRAJECTORY, VIEW, SCENE, SUMMARY, *PICTURES} - {*kept}:
            (self.path / name).unlink(missing_ok=True)

    def close(self) -> None:
        """Release the lock; a second call does nothing."""
        if self._lock is not None:
            (self.path / LOCK).unlink(missing_ok=True)
            os.close(self._lock)  # which unlocks it
            self._lock = None


def lock_directory(directory: Path) -> int:
    """Lock a directory; return the descriptor of the lock.

    Closing the descriptor, also by the end of the process, releases the lock.

    Raises:
        TakenError: Another process, or another recorder of this one, has locked it, or the name of the lock is no file.
    """
    path = directory / LOCK
    while True:
        try:
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.EISDIR):
                raise
            kind = "a link" if error.errno == errno.ELOOP else "a directory"
            raise TakenError(f"{path} is {kind}, and no lock of a run; remove it") from None
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
    """Raise a TakenError if a directory has frames of a run."""
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

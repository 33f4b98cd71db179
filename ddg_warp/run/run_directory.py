"""The directory of a run: who writes to it, and whether it holds frames that a new run would destroy."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

TRAJECTORY, SCENE, LOCK = "trajectory.h5", "scene.usdc", "run.lock"


def lock_directory(directory: Path) -> int:
    """Descriptor of the lock of a directory, held until it is closed: a process that ends, however it does, holds none.

    Raises:
        FileExistsError: Another process, or another recorder of this one, holds it.
    """
    path = directory / LOCK
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(os.fstat(lock), os.stat(path)):
                os.truncate(lock, 0)
                os.pwrite(lock, str(os.getpid()).encode(), 0)
                return lock
        except BlockingIOError:
            owner = os.pread(lock, 20, 0).decode() or "unknown"
            os.close(lock)
            raise FileExistsError(
                f"{directory}: process {owner} is recording a run there; wait for its end, or give another directory"
            ) from None
        except OSError:
            path.unlink(missing_ok=True)
            os.close(lock)
            raise
        os.close(lock)  # its owner has just removed the file that was opened


def refuse_to_replace(directory: Path) -> None:
    """Raises a FileExistsError where a directory holds frames of a run."""
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
        raise FileExistsError(
            f"{directory} holds {frames}: force (--force) replaces them, another directory (--out DIR) keeps them, "
            "and resume (--resume DIR) goes on with them"
        )

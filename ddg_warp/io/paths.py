"""Paths of files to read, and errors of files that cannot be read."""

import os
from pathlib import Path

from ddg_warp.errors import DataError


class CurveError(ValueError):
    """A file holds no usable curves; the message names the file, the object, the index and the remedy."""


class MeshError(ValueError):
    """A file holds no usable mesh; the message names the file, the line or prim and the remedy."""


class MissingFileError(CurveError, MeshError, FileNotFoundError):
    """The file to read does not exist."""

    def __str__(self) -> str:
        return str(self.args[0])


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

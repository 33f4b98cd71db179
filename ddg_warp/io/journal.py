"""Atomic transactions on one file: all writes happen, or none, even if the process is killed.

HDF5 updates its metadata in place, so that a process killed while a file is open for writing can leave it unreadable.
Here HDF5 writes through a file object instead. Bytes beyond the old end go straight to the file, where nothing refers
to them yet. Changes to older bytes stay in memory as pages. At the end they are written to a journal next to the file,
with a checksum, and only then to the file. The content after a kill depends on the time:

    before the journal is complete    the old content (and a tail that nothing refers to),
    after                             the new content, which a reader or the next writer takes from the journal.

This is the redo log of databases; appended data are written once, only the few changed pages twice.

A journal belongs to one version of one file. Every transaction writes a new random token at a fixed offset of the file; the journal
stores the offset, both tokens and the previous size of the file. A journal of another file or version is ignored by readers and
refused by writers.

HDF5 does not survive a write that fails: closing objects that it could not flush crashes the process. A write without room on
the disk therefore goes to memory and reports success, and the transaction fails once HDF5 has closed the file.

A program that ignores journals sees an inconsistent file only while changed pages are being written.

Measured: some ten microseconds a transaction. Large data that are replaced, such as checkpoints, alternate between two groups to
keep it short: the group not in use is declared `scratch` and written straight to the file.
"""

from __future__ import annotations

import errno
import io
import os
import secrets
import struct
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import h5py

PAGE = 4096  # bytes
MAGIC = b"ddgwal02"
TOKEN = 16  # bytes of the token that names a version of a file
# magic; `Version` (sizes before and after, offset of the token, tokens before and after), number of pages
HEADER = struct.Struct(f"<8sQQQ{TOKEN}s{TOKEN}sQ")
CHECKSUM = struct.Struct("<I")
FORMAT = ("v110", "v110")  # of HDF5, with checksums of metadata; read by HDF5 1.10 and later
Pages = dict[int, bytearray]


class TrajectoryError(ValueError):
    """A trajectory cannot be read or continued; the message names the file, the fault and the remedy."""


class Version(NamedTuple):
    """File version that a journal belongs to, and the version after replaying the journal.

    Attributes:
        before, size: Length before, and with the pages of the journal [bytes].
        place: Offset of the token in the file [bytes]; 0 for a file without a token.
        token, next: The token before, and afterwards.
    """

    before: int
    size: int = 0
    place: int = 0
    token: bytes = bytes(TOKEN)
    next: bytes = bytes(TOKEN)


class PagedFile(io.RawIOBase):
    """File with copy-on-write of existing bytes: changes to them stay in memory, page by page.

    Args:
        path: The file; it must exist.
        mode: "rb" or "r+b".
        pages: Content by page number that replaces the file's own.
        size: Length of the file with `pages` [bytes]; by default its length on disk.
    """

    def __init__(self, path: Path, mode: str, pages: Pages | None = None, size: int | None = None):
        self._file = open(path, mode, buffering=0, opener=no_link if "+" in mode else None)
        self.size = os.fstat(self._file.fileno()).st_size if size is None else size
        self.pages: Pages = dict(pages or {})
        self._limit = -(-self.size // PAGE) * PAGE
        self._position = 0
        self.scratch: list[tuple[int, int]] = []
        """Ranges (start, stop) of old bytes with obsolete content: writes inside go straight to the file."""
        self.failure: OSError | None = None
        """First write that failed, for which bytes are missing in the file."""

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return self._file.writable()

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._position = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self.size}[whence]
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer) -> int:
        start, stop = self._position, min(self._position + len(buffer), max(self.size, self._position))
        content = bytearray(self._on_disk(start, stop - start))
        for page in range(start // PAGE, -(-min(stop, self._limit) // PAGE)):
            if page in self.pages:
                low, high = max(start, page * PAGE), min(stop, (page + 1) * PAGE)
                content[low - start : high - start] = self.pages[page][low - page * PAGE : high - page * PAGE]
        buffer[: len(content)] = content
        self._position = stop
        return len(content)

    def write(self, data) -> int:
        data = memoryview(data).cast("B")
        start, stop = self._position, self._position + len(data)
        straight = any(low <= start and stop <= high for low, high in self.scratch)
        inside = min(stop, self._limit)
        for page in range(start // PAGE, -(-inside // PAGE)):
            low, high = max(start, page * PAGE), min(stop, (page + 1) * PAGE)
            if page not in self.pages and not straight:
                self.pages[page] = bytearray(self._on_disk(page * PAGE, PAGE))
            if page in self.pages:
                self.pages[page][low - page * PAGE : high - page * PAGE] = data[low - start : high - start]
        position = start if straight else max(start, self._limit)
        try:
            while position < stop:
                position += os.pwrite(self._file.fileno(), data[position - start :], position)
        except OSError as error:
            self.failure = error
            self._limit, self.scratch = sys.maxsize, []  # all further writes go to memory
            self._position = position
            return position - start + self.write(data[position - start :])
        self._position = stop
        self.size = max(self.size, stop)
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file after the commit; bytes on disk stay until then."""
        self.size = self._position if size is None else size
        return self.size

    def sync(self) -> None:
        """Wait until the appended bytes are on the disk.

        Raises:
            OSError: Bytes are missing, because the disk is full or fails.
        """
        if self.failure is not None:
            raise self.failure
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()
        super().close()

    def _on_disk(self, start: int, length: int) -> bytes:
        """Return `length` bytes of the file from `start`; zeros beyond the end."""
        pieces, position = [], start
        while position < start + length:
            piece = os.pread(self._file.fileno(), start + length - position, position)
            if not piece:
                break
            pieces.append(piece)
            position += len(piece)
        return b"".join(pieces).ljust(length, b"\0")


@contextmanager
def transaction(path, scratch: str = "", new: bool = False) -> Iterator[h5py.File]:
    """Open an HDF5 file for changes that are committed together at the end, or not at all.

    Args:
        path: The file.
        scratch: A group with datasets that nobody reads before the commit; writes to them stay even if the transaction fails.
        new: Whether to begin with an empty file, replacing an existing one.

    Raises:
        OSError: The disk is full, or fails; the file is as it was.
        TrajectoryError: The file is a link, or its journal belongs to another file.
    """
    import h5py

    path = Path(path)
    if new:
        path.unlink(missing_ok=True)
        path.open("xb").close()
        _journal_of(path).unlink(missing_ok=True)
    recover(path)
    old_size = path.stat().st_size
    raw = PagedFile(path, "r+b")
    try:
        with h5py.File(raw, "w" if new else "r+", libver=FORMAT) as file:
            if scratch in file:
                raw.scratch = _offsets(file[scratch])
            version = _next_version(file, old_size)
            yield file
        raw.sync()
        _write_journal(_journal_of(path), version._replace(size=raw.size), raw.pages)
    except BaseException:
        raw.close()
        _journal_of(path).unlink(missing_ok=True)
        os.truncate(path, old_size)
        raise
    raw.close()
    recover(path)


def no_link(path, flags: int) -> int:
    """Open a file for writing and return the descriptor; refuse a link, which may lead to a foreign file."""
    try:
        return os.open(path, flags | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise TrajectoryError(
            f"{path} is a link to {os.readlink(path)}, and links are not written through: use the directory that the file lies "
            "in, or replace the link by the file itself"
        ) from None


def _next_version(file: h5py.File, size: int) -> Version:
    """Return the version of a file before a transaction, and write the token of the next version to the file."""
    token = secrets.token_bytes(TOKEN)
    values = np.frombuffer(token, np.uint8)
    if "version" not in file:
        file.create_dataset("version", data=values)
        return Version(size, next=token)
    dataset = file["version"]
    before = dataset[:].tobytes()
    dataset[...] = values
    return Version(size, place=dataset.id.get_offset(), token=before, next=token)


def _offsets(group: h5py.Group) -> list[tuple[int, int]]:
    """Return the byte ranges (start, stop) of the datasets below a group."""
    ranges = []

    def note(_, item) -> None:
        offset = item.id.get_offset() if hasattr(item, "shape") else None  # None: no values, or in chunks
        if offset is not None:
            ranges.append((offset, offset + item.id.get_storage_size()))

    group.visititems(note)
    return ranges


def open_to_read(path) -> h5py.File:
    """Open an HDF5 file for reading, with the changes of its complete journal, without writing to the disk."""
    import h5py

    path = Path(path)
    journal = _read_journal(_journal_of(path))
    if journal is None or not _belongs(path, journal[0]):
        return h5py.File(path, "r")
    version, pages = journal
    return h5py.File(PagedFile(path, "rb", pages, version.size), "r")


def stamp(path) -> tuple:
    """Return sizes, times and inodes of a file and its journal, which differ once the file has changed."""
    stamps = []
    for each in (Path(path), _journal_of(Path(path))):
        try:
            status = each.stat()
            stamps.append((status.st_ino, status.st_size, status.st_mtime_ns))
        except FileNotFoundError:
            stamps.append(None)
    return tuple(stamps)


def recover(path) -> None:
    """Replay a complete journal onto the file, and remove the journal.

    Raises:
        TrajectoryError: The journal belongs to another file, or to another version of it.
    """
    path = Path(path)
    journal = _read_journal(_journal_of(path))
    if journal is not None:
        version, pages = journal
        if not _belongs(path, version):
            raise TrajectoryError(
                f"{_journal_of(path)} belongs to another file, or to another version of {path.name}: move it back next to its own "
                f"file, or remove it to go on with {path.name} as it is"
            )
        with open(path, "r+b", buffering=0, opener=no_link) as file:
            for start, content in _runs(pages):
                file.seek(start)
                file.write(content)
            file.truncate(version.size)
            os.fsync(file.fileno())
    _journal_of(path).unlink(missing_ok=True)


def _belongs(path: Path, version: Version) -> bool:
    """Return True if a journal belongs to a file, even if its pages have been written already, all or some."""
    with open(path, "rb") as file:
        if os.fstat(file.fileno()).st_size < min(version.before, version.size):
            return False
        file.seek(version.place)
        token = file.read(TOKEN) if version.place else version.token
    return len(token) == TOKEN and all(a in pair for a, *pair in zip(token, version.token, version.next, strict=True))


def _runs(pages: Pages) -> list[tuple[int, bytearray]]:
    """Return (first byte, content) of runs of neighbouring pages, to write with few calls."""
    runs: list[tuple[int, bytearray]] = []
    for page in sorted(pages):
        if runs and runs[-1][0] + len(runs[-1][1]) == page * PAGE:
            runs[-1][1].extend(pages[page])
        else:
            runs.append((page * PAGE, bytearray(pages[page])))
    return runs


def _journal_of(path: Path) -> Path:
    return path.with_name(path.name + ".journal")


def _write_journal(path: Path, version: Version, pages: Pages) -> None:
    numbers = struct.pack(f"<{len(pages)}Q", *pages)
    header = HEADER.pack(MAGIC, *version, len(pages))
    content = b"".join([header, numbers, *pages.values()])
    path.unlink(missing_ok=True)
    with open(path, "xb") as file:
        file.write(content)
        file.write(CHECKSUM.pack(zlib.crc32(content)))
        file.flush()
        os.fsync(file.fileno())


def _read_journal(path: Path) -> tuple[Version, Pages] | None:
    """Return (version of the file, pages) of a journal, or None without a complete journal."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    if len(content) < HEADER.size + CHECKSUM.size:
        return None
    body, checksum = content[: -CHECKSUM.size], content[-CHECKSUM.size :]
    magic, *version, count = HEADER.unpack_from(body)
    if magic != MAGIC or CHECKSUM.unpack(checksum)[0] != zlib.crc32(body):
        return None
    numbers = struct.unpack_from(f"<{count}Q", body, HEADER.size)
    start = HEADER.size + 8 * count
    pages = {page: bytearray(body[start + k * PAGE : start + (k + 1) * PAGE]) for k, page in enumerate(numbers)}
    return Version(*version), pages

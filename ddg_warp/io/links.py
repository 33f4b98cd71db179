"""HDF5 files that take data from other files: by external links, external storage or virtual datasets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py

from ddg_warp.errors import DataError
from ddg_warp.io.hdf5_read import undamaged
from ddg_warp.io.journal import open_to_read


def refuse_links(path: Path) -> None:
    """Refuse an HDF5 file that would have other files opened; no recorder writes one.

    Raises:
        DataError: It takes data from another file; names both, and the link or dataset.
        TrajectoryError: It is damaged.
    """
    with undamaged(path), open_to_read(path) as file:
        found = next(_others(file, set()), None)
    if found:
        name, other = found
        raise DataError(
            f"{path}: {name} is kept in another file, {other}; copy its values into the file, or allow it by outside=True where you "
            "trust it"
        )


def _others(group: h5py.Group, seen: set) -> Iterator[tuple[str, str]]:
    """(path of a link or dataset, file that it names) of all below a group that other files hold."""
    for name in group:
        link, path = group.get(name, getlink=True), f"{group.name.rstrip('/')}/{name}"
        if isinstance(link, h5py.ExternalLink):
            yield path, link.filename
        if not isinstance(link, h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Dataset):
            yield from ((path, source[0]) for source in item.external or ())
            sources = item.virtual_sources() if item.is_virtual else ()
            yield from ((path, source.file_name) for source in sources if source.file_name != ".")
        elif isinstance(item, h5py.Group) and item.id not in seen:
            seen.add(item.id)
            yield from _others(item, seen)

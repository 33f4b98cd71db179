"""HDF5 files that take data from other files: by external links, external storage or virtual datasets."""

from __future__ import annotations

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
    found: list[tuple[str, str]] = []

    def look_at_link(name: str, link) -> None:
        if isinstance(link, h5py.ExternalLink):
            found.append((name, link.filename))

    def look_at_item(name: str, item) -> None:
        if isinstance(item, h5py.Dataset):
            found.extend((name, source[0]) for source in item.external or ())
            sources = item.virtual_sources() if item.is_virtual else ()
            found.extend((name, source.file_name) for source in sources if source.file_name != ".")

    with undamaged(path), open_to_read(path) as file:
        file.visititems_links(look_at_link)
        file.visititems(look_at_item)
    for name, other in found[:1]:
        raise DataError(
            f"{path}: /{name} is kept in another file, {other}; copy its values into the file, or allow it by outside=True where you "
            "trust it"
        )

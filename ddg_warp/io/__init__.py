"""Readers and writers of curves, meshes and trajectories; each format's library is loaded only by its own module.

`read` (curves in), `mesh_read` (meshes in), `usd` (BasisCurves in; curves or tubes, and meshes out), `hdf5` (trajectory.h5 in and
out).
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

from ddg_warp import argument_checks
from ddg_warp.io.axes import in_metres
from ddg_warp.io.curves import CurveSet
from ddg_warp.io.paths import CurveError, MeshError, MissingFileError, as_path, existing
from ddg_warp.io.shapes import Curves, Shapes, Surfaces
from ddg_warp.typing import FilePath

__all__ = ["CurveError", "CurveSet", "Curves", "MeshError", "MissingFileError", "Shapes", "Surfaces", "read"]


FORMATS = ".usd, .usda, .usdc, .usdz, .h5, .hdf5, .txt (DisMech), .hair, .bcc, .csv and .xml (MJCF)"


def read(
    path: FilePath, outside: bool = False, unit: float | None = None, up: Literal["y", "z"] | None = None
) -> list[CurveSet]:
    """Return the curves of a file, distinguished by suffix; `unread` of each lists other contents.

    Args:
        path: A .usd, .usda, .usdc, .usdz, .h5, .hdf5, .txt (DisMech), .hair, .bcc, .csv or .xml (MJCF with cables) file.
        outside: Whether other files that a USD or HDF5 file refers to may be opened: layers, references and payloads outside its
            folder, external links and virtual datasets.
        unit: Length of the unit of a .hair, .bcc, .csv or .txt file [m], such as 0.01; by default 1.
        up: Axis of a .hair, .csv or .txt file that points up, "y" or "z"; by default "z". BCC files state it.

    Raises:
        CurveError: The file holds no usable curves.
        MissingPackageError: An MJCF file needs the extra `mujoco`.
        TrajectoryError: An HDF5 file is damaged, or refers to another file without permission.
    """
    outside = argument_checks.flag("read: outside", outside)
    path = as_path("the file to read", path, MissingFileError)
    suffix = path.suffix.lower()
    if suffix in {".hair", ".bcc", ".csv", ".txt"}:
        curves, stated = _without_units(existing(path), suffix)
        if up is not None:
            argument_checks.choice("read: up", up, ("y", "z"))
        if up is not None and stated is not None:
            raise CurveError(f"{path}: up = {up!r}, but the file states its own; leave it out")
        return [_in_metres(curves, unit, up or stated)]
    if unit is not None or up is not None:
        raise CurveError(
            f"{path}: unit = {unit!r}, up = {up!r}, but {suffix or 'such'} files state their own; leave them out"
        )
    if suffix in {".usd", ".usda", ".usdc", ".usdz"}:
        from ddg_warp.io.usd import read_curves

        return read_curves(path, outside=outside)
    if suffix in {".h5", ".hdf5"}:
        from ddg_warp.io.hdf5 import read_rods

        return read_rods(path, outside=outside)
    if suffix == ".xml":
        from ddg_warp.io.mjcf_cables import read_cables

        return read_cables(existing(path))
    raise CurveError(f"{path}: curves are read from {FORMATS} files")


def _without_units(path: Path, suffix: str) -> tuple[CurveSet, str | None]:
    """Return (curves in units and axes of the file, axis that points up if the file states it)."""
    if suffix == ".bcc":
        from ddg_warp.io.hair_files import read_bcc

        return read_bcc(path)
    reader: Callable[[Path], CurveSet]
    if suffix == ".hair":
        from ddg_warp.io.hair_files import read_hair as reader
    elif suffix == ".csv":
        from ddg_warp.io.csv_curves import read_csv as reader
    else:
        from ddg_warp.io.dismech import read_rods as reader
    return reader(path), None


def _in_metres(curves: CurveSet, unit: float | None, up: str | None) -> CurveSet:
    """Return curves in metres with z up."""
    if unit is not None:
        argument_checks.positive("read: unit", unit, "m")
    radius = curves.radius if curves.radius is None or unit is None else unit * curves.radius
    return replace(curves, points=in_metres(curves.points, unit, up), radius=radius)

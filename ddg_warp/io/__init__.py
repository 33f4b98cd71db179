"""Readers and writers of curves, meshes and trajectories; each format's library is loaded only by its own module.

`usd` (BasisCurves in; curves or tubes, and meshes out), `mesh_read` (meshes in), `hdf5` (trajectory.h5 in and out), `dismech`
(text in).
"""

from ddg_warp import argument_checks
from ddg_warp.io.curves import CurveSet
from ddg_warp.io.paths import CurveError, MeshError, MissingFileError, as_path
from ddg_warp.io.shapes import Curves, Shapes, Surfaces
from ddg_warp.typing import FilePath

__all__ = ["CurveError", "CurveSet", "Curves", "MeshError", "MissingFileError", "Shapes", "Surfaces", "read"]


def read(path: FilePath, outside: bool = False) -> list[CurveSet]:
    """Return the curves of a USD, HDF5 or DisMech text file, distinguished by suffix.

    Args:
        path: The file.
        outside: Whether other files that a USD or HDF5 file refers to may be opened: layers, references and payloads outside its
            folder, external links and virtual datasets.

    Raises:
        CurveError: The file holds no usable curves.
        TrajectoryError: An HDF5 file is damaged, or refers to another file without permission.
    """
    outside = argument_checks.flag("read: outside", outside)
    suffix = as_path("the file to read", path, MissingFileError).suffix.lower()
    if suffix in {".usd", ".usda", ".usdc", ".usdz"}:
        from ddg_warp.io.usd import read_curves

        return read_curves(path, outside=outside)
    if suffix in {".h5", ".hdf5"}:
        from ddg_warp.io.hdf5 import read_rods

        return read_rods(path, outside=outside)
    if suffix == ".txt":
        from ddg_warp.io.dismech import read_rods as read_text

        return [read_text(path)]
    raise CurveError(f"{path}: curves are read from .usd, .usda, .usdc, .usdz, .h5, .hdf5 and .txt (DisMech) files")

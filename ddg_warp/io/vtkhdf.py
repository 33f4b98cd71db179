"""View of a trajectory for ParaView: the group /VTKHDF, a transient PolyData of polylines and triangles (VTKHDF 2.0).

Points and velocities are virtual datasets over /trajectory, and times a link to it, so that nothing is stored twice.
The topology is stored once: every step refers to the same piece at offset 0.
Source: the VTKHDF specification, docs.vtk.org, "Poly data" and "Temporal Data".
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import h5py

    from ddg_warp.io.shapes import Shapes

VERSION = (2, 0)
CELL_KINDS = ("Vertices", "Lines", "Polygons", "Strips")
DATA = {"PointData": "at_points", "CellData": "at_cells"}
STEP_CHUNK = 64
STATIC_OFFSETS = {"PartOffsets": (), "CellOffsets": (len(CELL_KINDS),), "ConnectivityIdOffsets": (len(CELL_KINDS),)}


def write_view(file: h5py.File, shapes: Shapes) -> None:
    """Update /VTKHDF to show all frames of /trajectory.

    Args:
        file: Open for writing.
        shapes: The rods and surfaces of one frame.
    """
    if "VTKHDF" not in file:
        _write_topology(file.create_group("VTKHDF"), shapes)
    view, trajectory = file["VTKHDF"], file["trajectory"]
    _write_steps(view, trajectory, shapes.worlds * shapes.point_count)
    _flatten(view, "Points", trajectory["points"])
    if "velocities" in trajectory:
        _flatten(view["PointData"], "velocity", trajectory["velocities"])
    for data, source in DATA.items():
        for name in trajectory.get(source, ()):
            _flatten(view.require_group(data), name, trajectory[source][name])


def _write_topology(view: h5py.Group, shapes: Shapes) -> None:
    """Write the topology and other data that all steps have in common."""
    view.attrs["Version"] = np.array(VERSION)
    view.attrs.create("Type", np.bytes_("PolyData"))  # VTK reads fixed-length ASCII only
    view["NumberOfPoints"] = [shapes.worlds * shapes.point_count]
    cells = {"Lines": _polylines(shapes)}
    if shapes.surfaces is not None:
        triangles = shapes.surfaces.triangles
        cells["Polygons"] = (triangles.ravel(), 3 * np.arange(len(triangles) + 1))
    for kind in CELL_KINDS:
        _write_cells(view.create_group(kind), *cells.get(kind, ([], [0])))
    radius = np.zeros(shapes.worlds * shapes.point_count)  # zero at points of surfaces
    radius[shapes.rows] = shapes.curves.radius
    view.create_group("PointData")["radius"] = radius
    steps = view.create_group("Steps")
    steps["Values"] = view.file["trajectory/time"]
    steps.create_group("PointDataOffsets")


def _write_cells(group: h5py.Group, connectivity, offsets) -> None:
    group["Connectivity"] = np.asarray(connectivity, dtype=np.int64)
    group["Offsets"] = np.asarray(offsets, dtype=np.int64)
    group["NumberOfConnectivityIds"] = [len(connectivity)]
    group["NumberOfCells"] = [len(offsets) - 1]


def _polylines(shapes: Shapes) -> tuple[np.ndarray, np.ndarray]:
    """Return (connectivity, offsets) of one polyline a rod; closed rods return to the first point."""
    curves = shapes.curves
    ends = np.cumsum(curves.counts)
    starts = ends - curves.counts
    connectivity = np.insert(shapes.rows, ends[curves.closed], shapes.rows[starts[curves.closed]])
    return connectivity, np.concatenate([[0], np.cumsum(curves.counts + curves.closed)])


def _write_steps(view: h5py.Group, trajectory: h5py.Group, point_count: int) -> None:
    """Write the offsets of each step in every array."""
    frame_count, steps = len(trajectory["time"]), view["Steps"]
    steps.attrs["NSteps"] = frame_count
    _resize(steps, "NumberOfParts", frame_count, fill=1)
    for name, shape in STATIC_OFFSETS.items():
        _resize(steps, name, frame_count, shape)
    _resize(steps["PointDataOffsets"], "radius", frame_count)
    moving = [_resize(steps, "PointOffsets", frame_count)]
    if "velocities" in trajectory:
        moving.append(_resize(steps["PointDataOffsets"], "velocity", frame_count))
    for dataset, written in moving:
        dataset[written:] = point_count * np.arange(written, frame_count)
    for data, source in DATA.items():
        for name in trajectory.get(source, ()):
            dataset, written = _resize(steps.require_group(f"{data}Offsets"), name, frame_count)
            dataset[written:] = trajectory[source][name].shape[1] * np.arange(written, frame_count)


def _resize(group: h5py.Group, name: str, length: int, shape: tuple[int, ...] = (), fill: int = 0):
    """Resize a dataset; return (dataset, length before). Unwritten values are `fill` and take no space."""
    dataset = group.get(name)
    if dataset is None:
        options = {"maxshape": (None, *shape), "chunks": (STEP_CHUNK, *shape), "fillvalue": fill}
        dataset = group.create_dataset(name, shape=(0, *shape), dtype=np.int64, **options)
    written = min(len(dataset), length)
    dataset.resize(length, axis=0)
    return dataset, written


def _flatten(group: h5py.Group, name: str, source: h5py.Dataset) -> None:
    """Create a virtual dataset over `source`: vectors (F, ..., 3) as (points of all frames, 3), numbers (F, n) as (F n,)."""
    import h5py

    if name in group:
        del group[name]
    shape = (source.size // 3, 3) if source.shape[-1] == 3 and source.ndim > 2 else (source.size,)
    layout = h5py.VirtualLayout(shape, dtype=source.dtype)
    layout[...] = h5py.VirtualSource(".", source.name, shape=source.shape, dtype=source.dtype)
    group.create_virtual_dataset(name, layout)

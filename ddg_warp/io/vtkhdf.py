"""A view of a trajectory that ParaView opens: the group /VTKHDF, a transient PolyData (VTKHDF 2.0): rods as polylines, surfaces
as triangles.

Points and velocities are virtual datasets over /trajectory, and the times a link to it, so that nothing is stored
twice. The topology is stored once: every step points to the same part, which begins at offset 0.
Source: the VTKHDF specification, docs.vtk.org, "Poly data" and "Temporal Data".
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import h5py

    from ddg_warp.io import Shapes

VERSION = (2, 0)
CELL_KINDS = ("Vertices", "Lines", "Polygons", "Strips")
DATA = {"PointData": "at_points", "CellData": "at_cells"}
STEP_CHUNK = 64
STATIC_OFFSETS = {"PartOffsets": (), "CellOffsets": (len(CELL_KINDS),), "ConnectivityIdOffsets": (len(CELL_KINDS),)}


def write_view(file: h5py.File, shapes: Shapes) -> None:
    """Makes /VTKHDF show all frames of /trajectory.

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
    """What does not change from step to step."""
    view.attrs["Version"] = np.array(VERSION)
    view.attrs.create("Type", np.bytes_("PolyData"))  # VTK reads fixed-length ASCII only
    view["NumberOfPoints"] = [shapes.worlds * shapes.point_count]
    cells = {"Lines": _polylines(shapes)}
    if shapes.surfaces is not None:
        triangles = shapes.surfaces.triangles
        cells["Polygons"] = (triangles.ravel(), 3 * np.arange(len(triangles) + 1))
    for kind in CELL_KINDS:
        _write_cells(view.create_group(kind), *cells.get(kind, ([], [0])))
    radius = np.zeros(shapes.worlds * shapes.point_count)  # points of surfaces have none
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
    """(connectivity, offsets) of one polyline a rod; a closed one returns to its first point."""
    curves = shapes.curves
    ends = np.cumsum(curves.counts)
    starts = ends - curves.counts
    connectivity = np.insert(shapes.rows, ends[curves.closed], shapes.rows[starts[curves.closed]])
    return connectivity, np.concatenate([[0], np.cumsum(curves.counts + curves.closed)])


def _write_steps(view: h5py.Group, trajectory: h5py.Group, point_count: int) -> None:
    """Where each step begins in every array."""
    frame_count, steps = len(trajectory["time"]), view["Steps"]
    steps.attrs["NSteps"] = frame_count
    _resize(steps, "NumberOfParts", frame_count, fill=1)
    for name, shape in STATIC_OFFSETS.items():
        _resize(steps, name, frame_count, shape)
    _resize(steps["PointDataOffsets"], "radius", frame_count)
    moving = [_resize(steps, "PointOffsets", frame_count)]
    if "velocities" in trajectory:
        moving.append(_resize(steps["PointDataOffsets"], "velocity", frame_count))
    for dataset, known in moving:
        dataset[known:] = point_count * np.arange(known, frame_count)
    for data, source in DATA.items():
        for name in trajectory.get(source, ()):
            dataset, known = _resize(steps.require_group(f"{data}Offsets"), name, frame_count)
            dataset[known:] = trajectory[source][name].shape[1] * np.arange(known, frame_count)


def _resize(group: h5py.Group, name: str, length: int, shape: tuple[int, ...] = (), fill: int = 0):
    """(dataset of that length, its length before); what is not written has the value `fill` and takes no space."""
    dataset = group.get(name)
    if dataset is None:
        options = {"maxshape": (None, *shape), "chunks": (STEP_CHUNK, *shape), "fillvalue": fill}
        dataset = group.create_dataset(name, shape=(0, *shape), dtype=np.int64, **options)
    known = min(len(dataset), length)
    dataset.resize(length, axis=0)
    return dataset, known


def _flatten(group: h5py.Group, name: str, source: h5py.Dataset) -> None:
    """Shows `source` as a virtual dataset: vectors (F, ..., 3) as (all points of all frames, 3), numbers (F, n) as (F n,)."""
    import h5py

    if name in group:
        del group[name]
    shape = (source.size // 3, 3) if source.shape[-1] == 3 and source.ndim > 2 else (source.size,)
    layout = h5py.VirtualLayout(shape, dtype=source.dtype)
    layout[...] = h5py.VirtualSource(".", source.name, shape=source.shape, dtype=source.dtype)
    group.create_virtual_dataset(name, layout)

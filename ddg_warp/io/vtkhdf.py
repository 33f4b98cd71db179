"""View of a trajectory for ParaView: the group /VTKHDF, transient PolyData (VTKHDF 2.1).

    elastic      polylines of rods and triangles of shells, with radius, velocity, director and recorded fields
    obstacles    triangles of fixed obstacles, with the index of the obstacle
    moving       likewise of moving obstacles and of shapes of rigid bodies, of the first worlds if there are many
    contacts     a vertex for each pair in contact, with force, friction and gap

A run without obstacles and recorded contacts has the first block alone, as /VTKHDF itself. Others are a collection of blocks.
Points, velocities, fields and contacts are virtual datasets over /trajectory, and times a link to it, so that nothing is stored
twice. Surfaces of moving obstacles and directors at points, which /trajectory does not have, are stored in single precision.
The topology is stored once: every step refers to the same piece at offset 0.
Source: the VTKHDF specification, docs.vtk.org, "Poly data", "Temporal Data" and "Partitioned dataset collection".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from ddg_warp.io.shapes import directors_at_points

if TYPE_CHECKING:
    import h5py

    from ddg_warp.io.bodies import Bodies
    from ddg_warp.io.obstacles import Obstacles
    from ddg_warp.io.shapes import Shapes

VERSION = (2, 1)
CELL_KINDS = ("Vertices", "Lines", "Polygons", "Strips")
DATA = {"PointData": "at_points", "CellData": "at_cells"}
STEP_CHUNK = 64
ROW_CHUNK = 1024
MOST_POINTS = 20_000  # of moving obstacles in a frame; the first world is always complete
STATIC_OFFSETS = {"CellOffsets": (len(CELL_KINDS),), "ConnectivityIdOffsets": (len(CELL_KINDS),)}
SHOWN = ("force", "friction", "gap")  # of pairs in contact


def write_view(
    file: h5py.File, shapes: Shapes, obstacles: Obstacles | None = None, bodies: Bodies | None = None
) -> None:
    """Update /VTKHDF to show all frames of /trajectory.

    Args:
        file: Open for writing.
        shapes: The rods and surfaces of one frame.
        obstacles: Obstacles and shapes of rigid bodies, or None.
        bodies: Rigid bodies, whose shapes are the last obstacles, or None.
    """
    trajectory = file["trajectory"]
    moved = np.zeros(0, bool) if obstacles is None else obstacles.moved
    names = ["elastic", *["obstacles"] * bool((~moved).any()), *["moving"] * bool(moved.any())]
    names += ["contacts"] * ("contacts" in trajectory)
    blocks = _blocks(file, names)
    _write_elastic(blocks["elastic"], trajectory, shapes)
    if "obstacles" in blocks:
        _write_fixed(blocks["obstacles"], trajectory, obstacles)
    if "moving" in blocks:
        _write_moving(blocks["moving"], trajectory, obstacles, bodies, shapes.worlds)
    if "contacts" in trajectory:
        _write_contacts(blocks["contacts"], trajectory)


def _blocks(file: h5py.File, names: list[str]) -> dict[str, h5py.Group]:
    """Return the groups of blocks by name, new ones empty; a view with other blocks is replaced."""
    import h5py

    if "VTKHDF" in file and {"elastic", *file["VTKHDF"].get("Assembly", ())} != set(names):
        del file["VTKHDF"]
    if "VTKHDF" in file:
        return {name: file["VTKHDF"] if len(names) == 1 else file["VTKHDF"][name] for name in names}
    if len(names) == 1:
        return {names[0]: _group(file, "VTKHDF", "PolyData")}
    view = _group(file, "VTKHDF", "PartitionedDataSetCollection")
    assembly = view.create_group("Assembly", track_order=True)
    blocks = {}
    for index, name in enumerate(names):
        blocks[name] = _group(view, name, "PolyData")
        blocks[name].attrs["Index"] = index
        assembly[name] = h5py.SoftLink(blocks[name].name)
    return blocks


def _group(parent: h5py.Group, name: str, kind: str) -> h5py.Group:
    view = parent.create_group(name, track_order=True)  # VTK lists groups by order of creation
    view.attrs["Version"] = np.array(VERSION)
    view.attrs.create("Type", np.bytes_(kind))  # VTK reads fixed-length ASCII only
    return view


def _describe_elastic(view: h5py.Group, trajectory: h5py.Group, shapes: Shapes) -> None:
    """Write the topology and other data that all steps have in common."""
    cells = {"Lines": _polylines(shapes)}
    if shapes.surfaces is not None:
        triangles = shapes.surfaces.triangles
        cells["Polygons"] = (triangles.ravel(), 3 * np.arange(len(triangles) + 1))
    _write_topology(view, trajectory, [shapes.worlds * shapes.point_count], cells)
    radius = np.zeros(shapes.worlds * shapes.point_count)  # zero at points of surfaces
    radius[shapes.rows] = shapes.curves.radius
    view.create_group("PointData")["radius"] = radius


def _write_elastic(view: h5py.Group, trajectory: h5py.Group, shapes: Shapes) -> None:
    if not len(view):
        _describe_elastic(view, trajectory, shapes)
    point_count = shapes.worlds * shapes.point_count
    frames = np.arange(len(trajectory["time"]))
    offsets = {"PointOffsets": point_count * frames, "PointDataOffsets/radius": 0 * frames}
    _flatten(view, "Points", trajectory["points"], vectors=True)
    if "velocities" in trajectory:
        _flatten(view["PointData"], "velocity", trajectory["velocities"], vectors=True)
        offsets["PointDataOffsets/velocity"] = point_count * frames
    if "directors" in trajectory:
        curves, shape = shapes.curves_of_a_world, (shapes.worlds, shapes.point_count)
        _append(
            view["PointData"],
            "director",
            point_count,
            len(frames),
            lambda frame: directors_at_points(curves, trajectory["directors"][frame], shape),
        )
        offsets["PointDataOffsets/director"] = point_count * frames
    for data, source in DATA.items():
        for name in trajectory.get(source, ()):
            _flatten(view.require_group(data), name, trajectory[source][name], vectors=False)
            offsets[f"{data}Offsets/{name}"] = trajectory[source][name].shape[1] * frames
    _write_steps(view, offsets)


def _write_fixed(view: h5py.Group, trajectory: h5py.Group, obstacles: Obstacles) -> None:
    """Write surfaces of fixed obstacles, once."""
    chosen = np.flatnonzero(~obstacles.moved)
    if not len(view):
        view["Points"] = np.concatenate([obstacles.points(k) for k in chosen])
        _describe_obstacles(view, trajectory, obstacles, chosen)
    none = np.zeros(len(trajectory["time"]), int)
    _write_steps(view, {"PointOffsets": none, "CellDataOffsets/obstacle": none})


def _write_moving(
    view: h5py.Group, trajectory: h5py.Group, obstacles: Obstacles, bodies: Bodies | None, worlds: int
) -> None:
    """Write surfaces of moving obstacles for every frame, of the first worlds if there are many."""
    moving = np.flatnonzero(obstacles.moved)
    of_a_world = sum(len(obstacles.points(k)) for k in moving)
    shown = max(1, min(worlds, MOST_POINTS // of_a_world))
    if not len(view):
        _describe_obstacles(view, trajectory, obstacles, np.tile(moving, shown))

    def points(frame: int) -> np.ndarray:
        nodes = _moved_nodes(trajectory, frame, obstacles, bodies).reshape(worlds, -1, 3)[:shown]
        return np.concatenate([obstacles.points(k, each[obstacles.rows(k)]) for each in nodes for k in moving])

    frames = np.arange(len(trajectory["time"]))
    _append(view, "Points", shown * of_a_world, len(frames), points)
    _write_steps(view, {"PointOffsets": shown * of_a_world * frames, "CellDataOffsets/obstacle": 0 * frames})


def _describe_obstacles(view: h5py.Group, trajectory: h5py.Group, obstacles: Obstacles, shown: np.ndarray) -> None:
    """Write triangles of obstacles in the order shown, with the index of the obstacle."""
    sizes = np.array([len(obstacles.points(k)) for k in shown])
    cells = [obstacles.cells(k) + first for k, first in zip(shown, np.cumsum(sizes) - sizes, strict=True)]
    triangles = np.concatenate(cells)
    polygons = (triangles.ravel(), 3 * np.arange(len(triangles) + 1))
    _write_topology(view, trajectory, [sizes.sum()], {"Polygons": polygons})
    view.create_group("CellData")["obstacle"] = np.repeat(shown, [len(each) for each in cells])


def _moved_nodes(trajectory: h5py.Group, frame: int, obstacles: Obstacles, bodies: Bodies | None) -> np.ndarray:
    """Return nodes of moving obstacles, then of shapes of rigid bodies, in one frame, shape (..., M, 3)."""
    nodes = [trajectory["obstacle_points"][frame]] if "obstacle_points" in trajectory else []
    if bodies is not None:
        nodes.append(bodies.nodes(obstacles, trajectory["body_poses"][frame]))
    return np.concatenate(nodes, axis=-2)


def _write_contacts(view: h5py.Group, trajectory: h5py.Group) -> None:
    """Write pairs in contact as vertices; the number of them differs between frames."""
    contacts = trajectory["contacts"]
    ends = contacts["ends"][:]
    counts = np.diff(ends, prepend=0)
    if not len(view):
        _write_topology(view, trajectory, [], {})
        view.create_group("PointData")
    _flatten(view, "Points", contacts["point"], vectors=True)
    for name in SHOWN:
        _flatten(view["PointData"], name, contacts[name], vectors=contacts[name].ndim == 2)
    vertices = view["Vertices"]
    most = int(counts.max(initial=0))
    for group, name, length in ((vertices, "Connectivity", most), (vertices, "Offsets", most + 1)):
        dataset, written = _resize(group, name, max(length, len(group.get(name, ()))))
        dataset[written:] = np.arange(written, len(dataset))  # vertex k is point k in every frame
    for kind in CELL_KINDS:
        for name in ("NumberOfCells", "NumberOfConnectivityIds"):
            _write_numbers(view[kind], name, counts if kind == "Vertices" else 0 * counts)
    _write_numbers(view, "NumberOfPoints", counts)
    starts = ends - counts
    offsets = {"PointOffsets": starts, **{f"PointDataOffsets/{name}": starts for name in SHOWN}}
    _write_steps(view, {"PartOffsets": np.arange(len(counts)), **offsets})


def _write_topology(view: h5py.Group, trajectory: h5py.Group, counts: list[int], cells: Mapping[str, tuple]) -> None:
    """Write the cells by kind, each (connectivity, offsets), and the number of points; none without `counts`."""
    if counts:
        view["NumberOfPoints"] = np.asarray(counts, dtype=np.int64)
    for kind in CELL_KINDS:
        group = view.create_group(kind)
        if not counts and kind == "Vertices":
            continue
        connectivity, offsets = cells.get(kind, ([], [0]))
        group["Connectivity"] = np.asarray(connectivity, dtype=np.int64)
        group["Offsets"] = np.asarray(offsets, dtype=np.int64)
        if counts:
            group["NumberOfConnectivityIds"] = [len(connectivity)]
            group["NumberOfCells"] = [len(offsets) - 1]
    steps = view.create_group("Steps")
    steps["Values"] = trajectory["time"]
    for data in DATA:
        steps.create_group(f"{data}Offsets")


def _polylines(shapes: Shapes) -> tuple[np.ndarray, np.ndarray]:
    """Return (connectivity, offsets) of one polyline a rod; closed rods return to the first point."""
    curves = shapes.curves
    ends = np.cumsum(curves.counts)
    starts = ends - curves.counts
    connectivity = np.insert(shapes.rows, ends[curves.closed], shapes.rows[starts[curves.closed]])
    return connectivity, np.concatenate([[0], np.cumsum(curves.counts + curves.closed)])


def _write_steps(view: h5py.Group, offsets: Mapping[str, np.ndarray]) -> None:
    """Write the offset of each step in every array, by path below Steps; partitions are at offset 0 by default."""
    steps, frame_count = view["Steps"], len(offsets["PointOffsets"])
    steps.attrs["NSteps"] = frame_count
    _resize(steps, "NumberOfParts", frame_count, fill=1)
    for name, shape in STATIC_OFFSETS.items():
        _resize(steps, name, frame_count, shape)
    for path, values in {"PartOffsets": np.zeros(frame_count, int), **offsets}.items():
        group, _, name = path.rpartition("/")
        _write_numbers(steps[group] if group else steps, name, values)


def _write_numbers(group: h5py.Group, name: str, values: np.ndarray) -> None:
    """Write whole numbers of each step; zeros take no space."""
    dataset, written = _resize(group, name, len(values))
    if values[written:].any():
        dataset[written:] = values[written:]


def _resize(group: h5py.Group, name: str, length: int, shape: tuple[int, ...] = (), fill: int = 0):
    """Resize a dataset; return (dataset, length before). Unwritten values are `fill` and take no space."""
    dataset = group.get(name)
    if dataset is None:
        options = {"maxshape": (None, *shape), "chunks": (STEP_CHUNK, *shape), "fillvalue": fill}
        dataset = group.create_dataset(name, shape=(0, *shape), dtype=np.int64, **options)
    written = min(len(dataset), length)
    dataset.resize(length, axis=0)
    return dataset, written


def _append(group: h5py.Group, name: str, rows: int, frames: int, values: Callable[[int], np.ndarray]) -> None:
    """Append vectors (rows, 3) of the frames that a dataset lacks, or drop frames beyond the last."""
    if name not in group:
        options = {"maxshape": (None, 3), "chunks": (min(max(rows, 1), ROW_CHUNK), 3)}
        group.create_dataset(name, shape=(0, 3), dtype=np.float32, **options)
    dataset = group[name]
    written = len(dataset) // max(rows, 1)
    dataset.resize(rows * frames, axis=0)
    for frame in range(written, frames):
        dataset[rows * frame : rows * (frame + 1)] = values(frame)


def _flatten(group: h5py.Group, name: str, source: h5py.Dataset, vectors: bool) -> None:
    """Create a virtual dataset over `source`: vectors (F, ..., 3) as (points of all frames, 3), numbers (F, n) as (F n,)."""
    import h5py

    if name in group:
        del group[name]
    shape = (source.size // 3, 3) if vectors else (source.size,)
    layout = h5py.VirtualLayout(shape, dtype=source.dtype)
    layout[...] = h5py.VirtualSource(".", source.name, shape=source.shape, dtype=source.dtype)
    group.create_virtual_dataset(name, layout)

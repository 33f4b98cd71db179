"""Writer of trajectory.h5: recorded frames of a run, its model, and checkpoints to resume from.

    /trajectory   time (F,) [s], points (F, P, 3) [m], velocities (F, P, 3) [m/s] and directors (F, E, 3) if wanted,
                  series/NAME (F,); with several worlds (F, B, P, 3) and (F, B, E, 3);
                  at_points/NAME (F, B P) and at_cells/NAME (F, B (R + T)) if wanted: fields of all worlds, cells are the rods
                  (without values), then the triangles; obstacle_points (F, M, 3) or (F, B, M, 3) [m], nodes of moving
                  obstacles; body_poses (F, N, 3, 4) or (F, B, N, 3, 4), see
                  `State.body_poses`; contacts/{world, objects, point, gap, force, friction} (n, ...) if wanted, pairs of all frames
                  one after the other, up to contacts/ends[f] for frame f
    /model        curves/{counts, closed, radius, names, batch}, surfaces/{triangles, first, names, thickness, uv} if there are
                  any, obstacles/{...}, see `Obstacles`, rigid_bodies/{names, mass, ...}, see `Bodies`,
                  touching/{names, size, force}, see `ContactScales`, parameters/NAME, attributes/NAME of rods
    /control      options of the run
    /checkpoint   a and b, alternately the state at the last frame, at full precision; the attribute current names the last;
                  below each, run/NAME are counts of the run up to that frame, see `Counts`
    /VTKHDF       the same points for ParaView, see `vtkhdf`
    attributes    provenance: version, date, machine and attributes of the caller

Frames are appended in blocks, each with its checkpoint in one transaction (see `journal`). A process killed at any time leaves a
file that ends with a complete block, from which the run resumes. Every block of a field has a checksum (HDF5's
Fletcher32), model and checkpoints have a CRC-32 each, and readers verify all of them.

ParaView and VTK recognise the format by the suffix .vtkhdf: the writer adds a link with that suffix.
"""

from __future__ import annotations

import datetime
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields as fields_of
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import h5py
import numpy as np

from ddg_warp.io.contact_records import Contacts
from ddg_warp.io.hdf5_read import (
    COUNTS,
    CURVE_FIELDS,
    TrajectoryError,
    TrajectoryReader,
    all_arrays,
    paths_of,
    read_rods,
    seal,
    undamaged,
)
from ddg_warp.io.hdf5_write import (
    cut_contacts,
    extend,
    extend_contacts,
    overwrite,
    write_attributes,
    write_control,
    write_model,
)
from ddg_warp.io.journal import recover, transaction
from ddg_warp.io.observed import checked_observed
from ddg_warp.io.paths import existing
from ddg_warp.io.shapes import Shapes
from ddg_warp.io.vtkhdf import write_view

__all__ = ["TrajectoryError", "TrajectoryReader", "TrajectoryWriter", "read_rods"]

BLOCK_BYTES = 2**27  # frames buffered in memory at most
PAIR_BYTES = 80  # bytes of a pair in contact
OTHER_SLOT = {"a": "b", "b": "a"}


class TrajectoryWriter:
    """Writer that appends frames to a trajectory file.

    Args:
        path: The file; an existing one is replaced. `resume` continues one instead.
        model: The model whose states are recorded.
        block: Frames written together; fewer if they exceed 128 MiB.
        velocities: Whether to record velocities.
        directors: Whether to record the first material director of every edge.
        provenance: Attributes of the file; values other than text and numbers are stored as JSON.
        control: Options of the run, stored in /control: names and numbers, texts or arrays.
        at_points: Names of fields at the points.
        at_cells: Names of fields of the triangles.
        attributes: Values of each rod by name, shape (R,), stored in /model/attributes.
        contacts: Whether frames come with contacts.
        time: Meaning of frame times, "state" or "frame", stored with them; see `Recorder`.

    Attributes:
        checkpoint: State that a resumed file continues from, see `State.snapshot`; None without a checkpoint.
    """

    checkpoint: dict[str, np.ndarray] | None = None

    def __init__(
        self,
        path,
        model,
        *,
        block: int = 64,
        velocities: bool = False,
        directors: bool = False,
        provenance: Mapping | None = None,
        control: Mapping | None = None,
        at_points: Sequence[str] = (),
        at_cells: Sequence[str] = (),
        attributes: Mapping[str, np.ndarray] | None = None,
        contacts: bool = False,
        time: str = "state",
    ):
        names = ["points"] + ["velocities"] * velocities + ["directors"] * directors
        names += ["obstacle_points"] * bool(_obstacle_nodes(model))
        names += ["body_poses"] * bool(model.bodies)
        names += [f"at_points/{name}" for name in at_points] + [f"at_cells/{name}" for name in at_cells]
        self._prepare(path, model, block, names, contacts)
        partial = self.path.with_name(self.path.name + ".partial")
        with _removed_on_failure(partial), transaction(partial, new=True) as file:
            write_attributes(file, _origin() | dict(provenance or {}))
            write_model(file.create_group("model"), model)
            for name, values in (attributes or {}).items():
                overwrite(file.require_group("model/attributes"), name, np.asarray(values))
            seal(file["model"], all_arrays(file["model"]))
            write_control(file.create_group("control"), control or {})
            trajectory = file.create_group("trajectory")
            trajectory.attrs["time"] = time
            extend(trajectory, "time", np.zeros(0), block)
            for name in names:
                extend(trajectory, name, np.zeros((0, *self._shape(name))), block)
            if contacts:
                extend_contacts(trajectory.create_group("contacts"), [], block)
        self.path.with_name(self.path.name + ".journal").unlink(missing_ok=True)
        os.replace(partial, self.path)
        _link(self.path)

    @classmethod
    def resume(cls, path, model, *, block: int = 64, provenance: Mapping | None = None) -> TrajectoryWriter:
        """Continue a trajectory after the checkpoint; later frames are dropped.

        Args:
            path, model, block: See the class.
            provenance: Attributes of the file that have changed, such as a later end.
        """
        path = existing(path)
        with undamaged(path):
            return cls._resumed(path, model, block, provenance or {})

    @classmethod
    def _resumed(cls, path: Path, model, block: int, provenance: Mapping) -> TrajectoryWriter:
        recover(path)
        with TrajectoryReader(path) as reader:
            frame, slot, names = reader.checkpoint_frame, reader.checkpoint_slot, reader.recorded
            contacts, checkpoint = reader.contacts is not None, reader.checkpoint()
            if difference := _other(reader, model):
                kind, field = difference
                also = ", and parameters as they were when its recording began" if kind == "parameters" else ""
                raise TrajectoryError(
                    f"{path}: the file holds other {kind} than the model; resume with its own scene{also}"
                    f"{field and f' ({field} differs)'}"
                )
        writer = cls.__new__(cls)
        writer._prepare(path, model, block, names, contacts)
        if frame and reader.points.shape[1:] != writer._shape("points"):
            raise TrajectoryError(
                f"{path}: frames of the file have shape {reader.points.shape[1:]}, those of the model {writer._shape('points')}; "
                "resume with its own scene and as many worlds"
            )
        writer._slot, writer.checkpoint = OTHER_SLOT[slot], checkpoint
        writer._cut(frame, provenance)
        return writer

    def __enter__(self) -> TrajectoryWriter:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    @property
    def frame_count(self) -> int:
        """Complete frames in the file."""
        with TrajectoryReader(self.path) as reader:
            return len(reader)

    @property
    def fields(self) -> list[str]:
        """Names of the fields of a frame."""
        return [name.rpartition("/")[2] for name in self._names if "/" in name]

    def append(
        self,
        state,
        observed: Mapping[str, float] | None = None,
        fields: Mapping | None = None,
        contacts: Contacts | None = None,
        counts: Mapping[str, np.ndarray] | None = None,
        time: float | None = None,
    ) -> None:
        """Append the frame of a state with observed numbers; every frame observes the same names.

        Args:
            state: The state.
            observed: Numbers by name.
            fields: Fields by name: of points (worlds, P), of triangles (worlds, T).
            contacts: Contacts of the state, if recorded.
            counts: Counts of the run up to this state, by name.
            time: Time of the frame [s]; by default the time of the state.
        """
        observed = checked_observed(observed)
        if self._frames and observed.keys() != self._frames[0]["series"].keys():
            raise TrajectoryError(f"observed {sorted(observed)}, before {sorted(self._frames[0]['series'])}")
        frame = {name: np.array(getattr(state, name)()) for name in self._names if "/" not in name}
        if "obstacle_points" in frame:
            frame["obstacle_points"] = frame["obstacle_points"][..., : _obstacle_nodes(self._model), :]
        for name in (name for name in self._names if "/" in name):
            values = np.ravel((fields or {})[name.rpartition("/")[2]])
            frame[name] = np.concatenate([np.full(self._shape(name)[0] - len(values), np.nan), values])
        self._frames.append(
            {"time": state.time if time is None else time, "series": observed, "contacts": contacts, **frame}
        )
        self._pairs += len(contacts) if self.contacts else 0
        # The solver may reuse the state's buffers before the block is written: keep a copy now.
        self._snapshot = {name: np.array(value) for name, value in state.snapshot().items()}
        self._snapshot |= {f"{COUNTS}/{name}": np.array(value) for name, value in (counts or {}).items()}
        if len(self._frames) == self._block or PAIR_BYTES * self._pairs > BLOCK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the buffered frames with the checkpoint of the last one as one transaction.

        Raises:
            OSError: The disk is full, or fails; the file stays as it was.
        """
        if not self._frames:
            return
        slot = self._slot
        with transaction(self.path, scratch=f"checkpoint/{slot}") as file:
            trajectory = file["trajectory"]
            for name in ("time", *self._names):
                extend(trajectory, name, np.stack([frame[name] for frame in self._frames]), self._block)
            if self.contacts:
                extend_contacts(trajectory["contacts"], [frame["contacts"] for frame in self._frames], self._block)
            self._extend_series(trajectory)
            write_view(file, self._shapes, self._model.obstacles, self._model.rigid_bodies)
            checkpoint = file.require_group(f"checkpoint/{slot}")
            checkpoint.attrs["frame"] = len(trajectory["time"])
            for name in paths_of(checkpoint) - self._snapshot.keys():
                del checkpoint[name]
            for name, value in self._snapshot.items():
                overwrite(checkpoint, name, value)
            seal(checkpoint, self._snapshot)
            file["checkpoint"].attrs["current"] = slot
        self._slot = OTHER_SLOT[slot]
        self._frames.clear()
        self._pairs = 0

    def close(self) -> None:
        """Write the buffered frames."""
        self.flush()

    def _prepare(self, path, model, block: int, names: list[str], contacts: bool) -> None:
        self.path = Path(path)
        self.contacts, self._pairs = contacts, 0
        self._model = model
        self._names = names
        self._slot = "a"
        self._shapes = Shapes.of(model.curves, model.surfaces, model.worlds)
        self._frames: list[dict] = []
        self._snapshot: dict[str, np.ndarray] = {}
        frame_bytes = sum(8 * int(np.prod(self._shape(name))) for name in names)
        self._block = max(1, min(block, BLOCK_BYTES // frame_bytes))

    def _shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of one frame of a field."""
        curves, worlds, rows = self._model.curves, self._model.worlds, self._shapes.point_count
        if "/" in name:
            of_a_world = (
                rows if name.startswith("at_points") else len(curves.counts) + len(_triangles(self._model.surfaces))
            )
            return (worlds * of_a_world,)
        if name == "obstacle_points":
            rows = _obstacle_nodes(self._model)
        if name == "body_poses":
            shape = len(self._model.bodies), 3, 4
            return shape if worlds == 1 else (worlds, *shape)
        if name == "directors":
            rows = int(np.sum(curves.counts)) - np.count_nonzero(~np.asarray(curves.closed))
        return (rows, 3) if worlds == 1 else (worlds, rows, 3)

    def _extend_series(self, trajectory: h5py.Group) -> None:
        names, group = self._frames[0]["series"].keys(), trajectory.require_group("series")
        if len(trajectory["time"]) > len(self._frames) and set(group) != set(names):
            raise TrajectoryError(f"{self.path}: observed {sorted(names)}, but the file holds {sorted(group)}")
        for name in names:
            values = np.array([frame["series"][name] for frame in self._frames], dtype=np.float64)
            extend(group, name, values, self._block)

    def _cut(self, frame: int, provenance: Mapping) -> None:
        """Drop the frames from `frame` on, and update the attributes."""
        with transaction(self.path) as file:
            write_attributes(file, provenance)
            trajectory = file["trajectory"]
            if len(trajectory["time"]) == frame:
                return
            for name in ("time", *self._names, *(f"series/{name}" for name in trajectory.get("series", ()))):
                trajectory[name].resize(frame, axis=0)
            if self.contacts:
                cut_contacts(trajectory["contacts"], frame)
            write_view(file, self._shapes, self._model.obstacles, self._model.rigid_bodies)


@contextmanager
def _removed_on_failure(path: Path) -> Iterator[None]:
    """Remove a file if writing fails."""
    try:
        yield
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _link(path: Path) -> None:
    """Link a file under the suffix .vtkhdf, by which ParaView knows its format, if the disk has links."""
    name = path.with_suffix(".vtkhdf")
    with suppress(OSError, NotImplementedError):
        name.unlink(missing_ok=True)
        name.symlink_to(path.name)


def _origin() -> dict[str, str]:
    """Return program, version, date and machine of a file."""
    try:
        ours = version("ddg_warp")
    except PackageNotFoundError:
        ours = "unknown"
    date = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    return {"program": "ddg_warp", "version": ours, "date": date, "machine": platform.platform()}


def _other(reader: TrajectoryReader, model) -> tuple[str, str] | None:
    """Return (kind, field) of the first content of a file that differs from the model, or None."""
    for name in CURVE_FIELDS:
        if not _equal(getattr(reader.curves, name), getattr(model.curves, name)):
            return "rods", name
    for kind in ("surfaces", "obstacles", "rigid_bodies", "contact_scales"):
        recorded, wanted = getattr(reader, kind), getattr(model, kind)
        kind = "contact" if kind == "contact_scales" else kind.replace("_", " ")
        if recorded is None or wanted is None:
            if recorded is not wanted:
                return kind, ""
            continue
        for each in fields_of(recorded):
            if not _equal(getattr(recorded, each.name), getattr(wanted, each.name)):
                return kind, each.name
    parameters = model.parameters()
    for name in sorted(reader.parameters.keys() | parameters.keys()):
        if not (name in parameters and _equal(reader.parameters.get(name), parameters[name])):
            return "parameters", name
    return None


def _equal(recorded, wanted) -> bool:
    recorded, wanted = np.asarray(recorded), np.asarray(wanted)
    return np.array_equal(recorded, wanted, equal_nan=recorded.dtype.kind == wanted.dtype.kind == "f")


def _obstacle_nodes(model) -> int:
    """Return the number of nodes of moving obstacles without shapes of rigid bodies."""
    if model.obstacles is None:
        return 0
    shapes = 0 if model.rigid_bodies is None else int(model.rigid_bodies.shapes.sum())
    moved = model.obstacles.moved[: len(model.obstacles) - shapes]
    return int(model.obstacles.counts[: len(moved)][moved].sum())


def _triangles(surfaces) -> np.ndarray:
    return np.zeros((0, 3), int) if surfaces is None else surfaces.triangles

"""Records the states of a run: trajectory.h5 to read and resume from, scene.usdc to look at. It only reads states."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ddg_warp import arguments
from ddg_warp.ask.fields import CELL_FIELDS, POINT_FIELDS, check_fields, directors_at_points
from ddg_warp.errors import SceneError
from ddg_warp.io import Shapes
from ddg_warp.io.contacts import Contacts
from ddg_warp.run.run_directory import LOCK, SCENE, TRAJECTORY, lock_directory, refuse_to_replace

DEFAULT_FPS = 24.0
COLORS = ("strain", "curvature", "energy")


class RecordError(OSError):
    """A run could not be written to its disk; what was complete is kept."""

    def __str__(self) -> str:
        return str(self.args[0])


class Recorder:
    """Writes DIR/trajectory.h5 and DIR/scene.usdc, a block of frames at a time.

    A process killed at any time, or a disk that is full, leaves both files readable, up to a complete block.

    Args:
        model: The model whose states are recorded.
        directory: DIR; made if there is none.
        usd: Whether to write the scene.
        hdf5: Whether to write the trajectory; without it a run cannot be resumed.
        every: Record every so many calls, the first included.
        block: Frames written together.
        fps: Time codes per second of the scene; by default one time code a recorded frame, where the scene has a dt.
        tube: Whether the scene shows tubes instead of curves.
        color_by: What surfaces of the scene are colored by, "strain", "curvature" or "energy" (see `inquiry.triangle_fields`),
            and its values at the two ends of the scale. Frames replayed from a trajectory, at a resume, stay plain.
        velocities: Whether to record velocities.
        directors: Whether to record the first material directors.
        fields: Names of numbers along rods and over surfaces to record, see `ddg_warp.ask.fields`; a resumed run goes on with its own.
        contacts: Whether to record what touches, see `Model.contacts`: pairs, places, gaps and forces; in the scene as points, as
            wide as forces say. A resumed run goes on with or without as it began.
        attributes: Values of each rod by name, shape (R,), such as the `attributes` of curves that were read: ids, groups.
        provenance: Attributes of the trajectory, beside version, date and machine.
        control: How the run is driven, stored in the trajectory.
        resume: Whether to go on after the last complete block of DIR/trajectory.h5; the scene is written anew from it.
        force: Whether to replace a run that DIR holds already.

    Raises:
        ValueError: An option is no such option.
        FileExistsError: DIR holds a run, or another process writes to it.
        RecordError: The disk is full, or fails; also from `record` and `close`.
    """

    def __init__(
        self,
        model,
        directory,
        *,
        usd: bool = True,
        hdf5: bool = True,
        every: int = 1,
        block: int = 64,
        fps: float | None = None,
        tube: bool = False,
        color_by: tuple[str, float, float] | None = None,
        velocities: bool = False,
        directors: bool = False,
        fields: Sequence[str] = (),
        contacts: bool = False,
        attributes: Mapping[str, np.ndarray] | None = None,
        provenance: Mapping | None = None,
        control: Mapping | None = None,
        resume: bool = False,
        force: bool = False,
    ):
        if not hasattr(model, "curves"):
            raise SceneError(f"Recorder: the model is {type(model).__name__}; give what scene.build() returns")
        every, block = arguments.count("Recorder: every", every), arguments.count("Recorder: block", block)
        if fps is not None:
            arguments.positive("Recorder: fps", fps, "1/s")
        if resume and not hdf5:
            raise ValueError("a run resumes from its trajectory.h5: leave hdf5=True, or start again with resume=False")
        self.directory = Path(directory)
        self._model, self._every = model, every
        self._calls, self._last = 0, None
        self._velocities, self._directors, self._color_by = velocities, directors, color_by
        self._wanted = check_fields(fields)
        if set(self._wanted) & set(CELL_FIELDS) and model.surfaces is None:
            raise ValueError(f"fields = {fields!r}: the model has no surfaces; leave out {', '.join(CELL_FIELDS)}")
        if contacts and model.touching is None:
            raise ValueError("contacts: the model has no contact; add scene.contact(), or leave contacts out")
        self._contacts = contacts
        if color_by is not None and (not isinstance(color_by, tuple | list) or len(color_by) != 3):
            raise ValueError(f"color_by is {color_by!r}; give (name, value at the low end, value at the high end)")
        if color_by is not None and (color_by[0] not in COLORS or model.surfaces is None):
            raise ValueError(
                f"color_by {color_by[0]!r}: surfaces, if there are any, are colored by {', '.join(COLORS)}"
            )
        self._trajectory = self._scene = self._lock = None
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._lock = lock_directory(self.directory)
            if not (resume or force):
                refuse_to_replace(self.directory)
            wanted = {"velocities": velocities, "directors": directors, "provenance": provenance, "control": control}
            wanted |= {"attributes": attributes, "contacts": contacts}
            wanted["at_points"] = [name for name in self._wanted if name in POINT_FIELDS]
            wanted["at_cells"] = [name for name in self._wanted if name in CELL_FIELDS]
            self._open(model, hdf5, usd, resume, block, fps or _fps_of(model, every), tube, wanted)
        except BaseException as error:
            self._abandon()
            raise self._told(error) from error

    def _open(self, model, hdf5: bool, usd: bool, resume: bool, block: int, fps: float, tube: bool, wanted) -> None:
        """Begins both files, or goes on with them."""
        if hdf5:
            from ddg_warp.io.hdf5 import TrajectoryReader, TrajectoryWriter

            path = self.directory / TRAJECTORY
            if resume:
                self._trajectory = TrajectoryWriter.resume(path, model, block=block, provenance=wanted["provenance"])
                self._wanted, self._contacts = tuple(self._trajectory.fields), self._trajectory.contacts
                with TrajectoryReader(path) as reader:
                    wanted["attributes"] = reader.attributes
            else:
                self._trajectory = TrajectoryWriter(path, model, block=block, **wanted)
        if usd:
            from ddg_warp.io.usd import CurvesWriter

            shapes = Shapes.of(model.curves, model.surfaces, model.worlds)
            self._scene = CurvesWriter(
                self.directory / SCENE,
                shapes,
                fps=fps,
                tube=tube,
                block=block,
                color_by=self._color_by,
                attributes=wanted["attributes"],
                obstacles=model.obstacles,
                touching=model.touching if self._contacts else None,
            )
        if resume:
            self._replay()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind, error, _) -> None:
        if isinstance(error, RecordError):
            return  # closed already
        self.close()

    def record(self, state, observed: Mapping[str, float] | None = None) -> None:
        """Takes note of a state, to be called once for the first state and once after every step.

        A state no later than the last recorded one, as the first of a resumed run is, is passed over.

        Args:
            state: The state; it is only read.
            observed: Numbers measured of it, by name; the same names at every call.

        Raises:
            ValueError: The recorder is closed, or the state is of another model.
            RecordError: The disk is full, or fails; the recorder is closed then.
        """
        if self._lock is None:
            raise ValueError(
                f"the recorder of {self.directory} is closed: record before close(), or open another with resume=True"
            )
        if not hasattr(state, "points") or getattr(state, "model", self._model) is not self._model:
            raise SceneError(
                f"record: {state!r} is no state of the recorded model; give one that this model made, or make a Recorder for "
                "its model, in a directory of its own"
            )
        if self._last is not None and state.time <= self._last:
            return
        due = self._calls % self._every == 0
        self._calls += 1
        if not due:
            return
        self._last = state.time
        try:
            fields = self._fields_of(state)
            contacts = self._model.contacts(state) if self._contacts else None
            if self._trajectory is not None:
                self._trajectory.append(state, observed, fields, contacts)
            if self._scene is not None:
                velocities = state.velocities() if self._velocities else None
                if self._directors:
                    shape = (self._model.worlds, np.shape(state.points())[-2])
                    fields = fields | {"director": directors_at_points(self._model.curves, state.directors(), shape)}
                others = (state.obstacle_points(), contacts)
                self._show(state.time, state.points(), velocities, fields | self._colors(state), *others)
        except OSError as error:
            self._abandon()
            raise self._told(error) from error

    def close(self) -> None:
        """Writes what is left and closes the files; a second call does nothing."""
        try:
            for writer in (self._trajectory, self._scene):
                if writer is not None:
                    writer.close()
        except OSError as error:
            raise self._told(error) from error
        finally:
            self._abandon()

    def _abandon(self) -> None:
        """Lets go of the files as they are."""
        if self._scene is not None:
            self._scene.abandon()
        self._trajectory = self._scene = None
        if self._lock is not None:
            (self.directory / LOCK).unlink(missing_ok=True)
            os.close(self._lock)  # which unlocks it
            self._lock = None

    def _told(self, error: BaseException) -> BaseException:
        """The error, or for one of the disk what is lost, what is kept and what to do."""
        if not isinstance(error, OSError) or isinstance(error, FileExistsError | RecordError) or error.errno is None:
            return error
        told = RecordError(
            f"{self.directory}: {error.strerror}: the run cannot be recorded any further. Its complete blocks of frames are "
            "kept: free some space and resume it, or write to another disk"
        )
        told.errno = error.errno
        return told

    def _replay(self) -> None:
        """Brings scene and counters to where the trajectory ends."""
        from ddg_warp.io.hdf5 import TrajectoryReader

        with TrajectoryReader(self.directory / TRAJECTORY) as reader:
            self._calls, self._last = 1, reader.time[-1]  # the checkpoint's state was the first call of a period
            for frame in range(len(reader) if self._scene is not None else 0):
                velocities = reader.velocities[frame] if self._velocities and reader.velocities is not None else None
                fields = {name: values[frame] for name, values in reader.fields.items()}
                fields |= {
                    name: fields[name][len(reader.counts) * self._model.worlds :]
                    for name in fields.keys() & CELL_FIELDS
                }
                if self._directors and reader.directors is not None:
                    shape = (self._model.worlds, reader.points.shape[-2])
                    fields["director"] = directors_at_points(reader.curves, reader.directors[frame], shape)
                self._show(reader.time[frame], reader.points[frame], velocities, fields, *_others(reader, frame))

    def _fields_of(self, state) -> dict[str, np.ndarray]:
        """The fields of a state by name, (worlds, points) or (worlds, triangles)."""
        if not self._wanted:
            return {}
        from ddg_warp.ask.fields import cell_fields, point_fields

        return point_fields(state.model, state, [name for name in self._wanted if name in POINT_FIELDS]) | cell_fields(
            state.model, state, [name for name in self._wanted if name in CELL_FIELDS]
        )

    def _colors(self, state) -> dict[str, np.ndarray]:
        """What surfaces are colored by, world after world."""
        if self._color_by is None:
            return {}
        from ddg_warp.ask.inquiry import triangle_fields

        name = self._color_by[0]
        return {name: triangle_fields(state.model, state)[name].ravel()}

    def _show(
        self,
        time: float,
        points: np.ndarray,
        velocities: np.ndarray | None,
        fields: Mapping | None = None,
        obstacles: np.ndarray | None = None,
        contacts: Contacts | None = None,
    ) -> None:
        """Adds a frame of all worlds to the scene; fields that a point has not are 0 there."""
        velocities = None if velocities is None else np.reshape(velocities, (-1, 3))
        fields = dict(fields or {})
        directors = {"director": fields.pop("director")} if "director" in fields else {}
        fields = {name: np.nan_to_num(np.ravel(values)) for name, values in fields.items()}
        at_points = {name: fields.pop(name) for name in POINT_FIELDS if name in fields} | directors
        self._scene.write(
            time,
            np.reshape(points, (-1, 3)),
            velocities=velocities,
            scalars=at_points,
            triangle_scalars=fields,
            obstacles=None if obstacles is None else np.reshape(obstacles, (-1, 3)),
            contacts=contacts,
        )


def _others(reader, frame: int) -> tuple[np.ndarray | None, Contacts | None]:
    """Of a frame of a trajectory the nodes of obstacles that something moves, and what touches, where it has them."""
    return tuple(each if each is None else each[frame] for each in (reader.obstacle_points, reader.contacts))


def export_usd(trajectory, path, *, fps: float | None = None, tube: bool = False, revolve: int = 0) -> None:
    """Writes the frames of a trajectory.h5 as USD.

    Args:
        trajectory: The file to read.
        path: The .usdc or .usda file to write.
        fps: Time codes per second; by default one time code a frame.
        tube: Whether to write tubes instead of curves.
        revolve: Sides of the surfaces that the curves of the first world, meridians, sweep around z; 0 for none.
    """
    from ddg_warp.io.hdf5 import TrajectoryReader
    from ddg_warp.io.revolve import Revolution
    from ddg_warp.io.usd import CurvesWriter

    with TrajectoryReader(trajectory) as reader:
        worlds = int(np.prod(reader.points.shape[1:-2]))
        spacing = np.median(np.diff(reader.time)) if len(reader) > 1 else 1.0 / DEFAULT_FPS
        shapes = Shapes.of(reader.curves, reader.surfaces, worlds)
        count = int(np.sum(reader.curves.counts))
        first = reader.points[0].reshape(-1, 3)[:count]
        turned = Revolution(reader.curves, first, revolve) if revolve else None
        shapes = turned.shapes if turned else shapes
        given = {"obstacles": reader.obstacles, "touching": reader.touching if reader.contacts is not None else None}
        given = {} if turned else given | {"attributes": reader.attributes}
        with CurvesWriter(path, shapes, fps=fps or round(1.0 / spacing, 6), tube=tube, **given) as writer:
            shape = (worlds, reader.points.shape[-2])
            for frame, time in enumerate(reader.time):
                points = reader.points[frame].reshape(-1, 3)
                if turned:
                    writer.write(time, turned.points(points[:count]))
                    continue
                velocities = None if reader.velocities is None else reader.velocities[frame].reshape(-1, 3)
                directors = (
                    {}
                    if reader.directors is None
                    else {"director": directors_at_points(reader.curves, reader.directors[frame], shape)}
                )
                nodes, contacts = _others(reader, frame)
                nodes = None if nodes is None else nodes.reshape(-1, 3)
                writer.write(time, points, velocities=velocities, scalars=directors, obstacles=nodes, contacts=contacts)


def _fps_of(model, every: int) -> float:
    """One time code a frame where the scene's analysis has a time step."""
    dt = getattr(getattr(model.scene, "analysis", None), "dt", None)
    return round(1.0 / (every * dt), 6) if dt else DEFAULT_FPS

"""Recording of a run: trajectory.h5 to read and resume from, scene.usdc for display. States are only read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.io.contact_records import Contacts
from ddg_warp.io.observed import checked_attributes, checked_notes, checked_observed
from ddg_warp.io.shapes import Shapes, directors_at_points
from ddg_warp.postprocess.fields import CELL_FIELDS, POINT_FIELDS, check_fields
from ddg_warp.run.run_directory import (
    FULL,
    SCENE,
    TRAJECTORY,
    VIEW,
    RecordError,
    RunDirectory,
    refuse_to_replace,
    system_error,
)
from ddg_warp.typing import Array, FilePath, Numbers

if TYPE_CHECKING:
    from ddg_warp.model.model import Model
    from ddg_warp.model.state import State

DEFAULT_FPS = 24.0
LEAST_DT = 1e-300  # [s], with a finite inverse
COLORS = ("strain", "curvature", "energy")
TIMES = ("state", "frame")

__all__ = ["RecordError", "Recorder", "export_usd"]


class Recorder:
    """Recorder of DIR/trajectory.h5 and DIR/scene.usdc, written in blocks of frames.

    A process killed at any time, or a full disk, leaves both files readable up to a complete block.

    Args:
        model: The model of the recorded states.
        directory: DIR; made if there is none. A `RunDirectory` stays locked when the recorder closes.
        usd: Whether to write the scene.
        hdf5: Whether to write the trajectory; without it a run cannot be resumed.
        every: Interval of recorded calls; the first is recorded.
        block: Number of frames written together.
        fps: Time codes per second of the scene; by default one time code a recorded frame, if the scene has a dt.
        tube: Whether the scene shows tubes instead of curves.
        physics: Whether curves and shells of the scene are deformable bodies with materials, see `io.usd_physics`; not with tubes.
        time: Time of a frame: "state", the increasing time of states; or "frame", its number from 0 on, for a sequence of equilibria
            or designs. A resumed run keeps its choice.
        color_by: Field that colors surfaces of the scene, "strain", "curvature" or "energy" (see `quantities.triangle_fields`), and its
            values at the two ends of the scale. Frames replayed from a trajectory, at a resume, stay plain.
        velocities: Whether to record velocities.
        directors: Whether to record the first material directors.
        fields: Names of fields along rods and over surfaces to record, see `ddg_warp.postprocess.fields`.
        contacts: Whether to record contacts, see `Model.contacts`: pairs, points, gaps and forces; in the scene as points with a
            width by force.
        attributes: Values of each rod by name, shape (R,), such as the `attributes` of curves that were read: ids, groups.
        provenance: Attributes of the trajectory, in addition to version, date and machine.
        control: Description of the controls of the run, stored in the trajectory.
        resume: Whether to continue after the last complete block of DIR/trajectory.h5, with its fields; the scene is rewritten from
            it.
        force: Whether to replace a run in DIR: trajectory, scene, summary and pictures.
        counts: Function called with every recorded state; returns the counters of the run, arrays by name, kept with the
            checkpoint. See `TrajectoryReader.run_counts`.

    Raises:
        ValueError: An option is invalid, or the run to resume is of another model or lacks a requested field.
        TakenError: DIR has a run, or another process writes to it; a FileExistsError.
        RecordError: The disk is full, or fails; also from `record` and `close`.
    """

    def __init__(
        self,
        model: Model,
        directory: FilePath | RunDirectory,
        *,
        usd: bool = True,
        hdf5: bool = True,
        every: int = 1,
        block: int = 64,
        fps: float | None = None,
        tube: bool = False,
        physics: bool = False,
        time: str | None = None,
        color_by: tuple[str, float, float] | None = None,
        velocities: bool = False,
        directors: bool = False,
        fields: Sequence[str] = (),
        contacts: bool = False,
        attributes: Mapping[str, Array] | None = None,
        provenance: Mapping[str, object] | None = None,
        control: Mapping[str, object] | None = None,
        resume: bool = False,
        force: bool = False,
        counts: Callable[[], Mapping[str, Array]] | None = None,
    ):
        if not hasattr(model, "curves"):
            raise SceneError(f"Recorder: the model is {type(model).__name__}; give what scene.build() returns")
        every, block = argument_checks.count("Recorder: every", every), argument_checks.count("Recorder: block", block)
        flags = {"usd": usd, "hdf5": hdf5, "tube": tube, "physics": physics, "resume": resume, "force": force}
        for name, value in flags.items():
            argument_checks.flag(f"Recorder: {name}", value)
        if physics and tube:
            raise SceneError("Recorder: physics needs curves, and tubes are meshes; leave out one of tube and physics")
        for name, value in {"velocities": velocities, "directors": directors, "contacts": contacts}.items():
            argument_checks.flag(f"Recorder: {name}", value)
        if counts is not None and not callable(counts):
            raise SceneError(
                f"Recorder: counts is {counts!r}; give a function that returns arrays by name, or leave it out"
            )
        if fps is not None:
            argument_checks.positive("Recorder: fps", fps, "1/s")
        if time is not None:
            argument_checks.choice("Recorder: time", time, TIMES)
        if resume and not hdf5:
            raise ValueError("a run resumes from its trajectory.h5: leave hdf5=True, or start again with resume=False")
        self._model, self._every, self._given_fps = model, every, fps
        self._calls, self._frame, self._last, self._names, self._checkpoint = 0, 0, None, None, None
        self._velocities, self._directors, self._color_by = velocities, directors, color_by
        self._time, self._counts = time or "state", counts
        self._wanted = check_fields(fields)
        if set(self._wanted) & set(CELL_FIELDS) and model.surfaces is None:
            raise ValueError(f"fields = {fields!r}: the model has no surfaces; leave out {', '.join(CELL_FIELDS)}")
        if contacts and model.contact_scales is None:
            raise ValueError("contacts: the model has no contact; add scene.contact(), or leave contacts out")
        self._contacts = contacts
        if color_by is not None and (not isinstance(color_by, tuple | list) or len(color_by) != 3):
            raise ValueError(f"color_by is {color_by!r}; give (name, value at the low end, value at the high end)")
        if color_by is not None and (color_by[0] not in COLORS or model.surfaces is None):
            raise ValueError(
                f"color_by {color_by[0]!r}: surfaces, if there are any, are colored by {', '.join(COLORS)}"
            )
        for end in color_by[1:] if color_by is not None else ():
            argument_checks.number("Recorder: an end of color_by", end)
        wanted = {"velocities": velocities, "directors": directors, "contacts": contacts}
        wanted |= {"attributes": checked_attributes(attributes, len(model.curves.counts))}
        wanted |= {"provenance": checked_notes("provenance", provenance), "control": checked_notes("control", control)}
        wanted["at_points"] = [name for name in self._wanted if name in POINT_FIELDS]
        wanted["at_cells"] = [name for name in self._wanted if name in CELL_FIELDS]
        self._trajectory = self._scene = self._held = None
        self._handed = isinstance(directory, RunDirectory)
        self._held = directory if self._handed else RunDirectory(directory)
        self.directory = self._held.path
        try:
            if not (resume or force):
                refuse_to_replace(self.directory)
            if hdf5:
                self._open_trajectory(resume, block, wanted, time)
            if usd:
                self._open_scene(block, tube, wanted["attributes"], physics)
            if resume:
                self._replay()
            elif force:
                self._held.clear(*((TRAJECTORY, VIEW) if hdf5 else ()), *((SCENE,) if usd else ()))
        except BaseException as error:
            self._abandon()
            raise self._described(error) from error

    def _open_trajectory(self, resume: bool, block: int, wanted: dict, time: str | None) -> None:
        """Begin the trajectory, or continue it with its fields."""
        from ddg_warp.io.hdf5 import TrajectoryReader, TrajectoryWriter

        path = self.directory / TRAJECTORY
        if not resume:
            self._trajectory = TrajectoryWriter(path, self._model, block=block, time=self._time, **wanted)
            return
        with TrajectoryReader(path) as reader:
            self._refuse_more(reader, wanted, time)
            wanted["attributes"], self._names = reader.attributes, reader.series.keys()
        self._trajectory = TrajectoryWriter.resume(path, self._model, block=block, provenance=wanted["provenance"])
        self._wanted, self._contacts = tuple(self._trajectory.fields), self._trajectory.contacts
        self._velocities, self._directors = (name in reader.recorded for name in ("velocities", "directors"))
        self._time, self._checkpoint = reader.time_is, self._trajectory.checkpoint

    def _refuse_more(self, reader, wanted: dict, time: str | None) -> None:
        """Raise a ValueError if requested options differ from a run to resume."""
        requested = [name for name in ("velocities", "directors", "contacts") if wanted[name]] + list(self._wanted)
        available = {*reader.recorded, *reader.fields, *(["contacts"] if reader.contacts is not None else [])}
        if missing := [name for name in requested if name not in available]:
            raise ValueError(
                f"{reader.path} has no {missing[0]}, and a resumed run continues with the recorded fields: leave {missing[0]} out, or "
                "record the run again"
            )
        if time not in (None, reader.time_is):
            raise ValueError(
                f"{reader.path} has time={reader.time_is!r}, not {time!r}: leave it out, or record the run again"
            )
        if wanted["attributes"] and not _same_attributes(wanted["attributes"], reader.attributes):
            raise ValueError(f"{reader.path} has other attributes: leave them out, or record the run again")

    def _open_scene(self, block: int, tube: bool, attributes: Mapping, physics: bool) -> None:
        from ddg_warp.io.usd import CurvesWriter
        from ddg_warp.io.usd_physics import Physics

        model = self._model
        self._scene = CurvesWriter(
            self.directory / SCENE,
            Shapes.of(model.curves, model.surfaces, model.worlds),
            fps=self._given_fps or (_fps_of(model, self._every) if self._time == "state" else 1.0),
            tube=tube,
            block=block,
            color_by=self._color_by,
            attributes=attributes,
            obstacles=model.obstacles,
            contact_scales=model.contact_scales if self._contacts else None,
            bodies=model.rigid_bodies,
            physics=Physics.of(model.scene, len(model.curves.counts)) if physics else None,
        )

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if isinstance(error, RecordError):
            return  # already closed
        self.close()

    def record(self, state: State, observed: Mapping[str, Numbers] | None = None) -> None:
        """Record a state; call it for the first state and after every step.

        The first state of a resumed run may be its checkpoint, which is skipped.

        Args:
            state: The state; it is only read.
            observed: Finite numbers measured at the state, by name; the same names at every call.

        Raises:
            ValueError: The recorder is closed, the state is of another model or not later than the one before. Or an observed value
                is no finite number, or the names differ from the last call. The call records nothing then.
            RecordError: The disk is full, or fails; the recorder is closed then.
        """
        if self._held is None:
            raise ValueError(
                f"the recorder of {self.directory} is closed: record before close(), or open another with resume=True"
            )
        if not hasattr(state, "points") or getattr(state, "model", self._model) is not self._model:
            raise SceneError(
                f"record: {state!r} is no state of the recorded model; give one that this model made, or make a Recorder for "
                "its model, in a directory of its own"
            )
        observed = checked_observed(observed, self._names)
        if self._passes_over(state):
            return
        self._names = observed.keys()
        due = self._calls % self._every == 0
        self._calls += 1
        if not due:
            return
        time = state.time if self._time == "state" else float(self._frame)
        self._frame += 1
        try:
            fields = self._fields_of(state)
            contacts = self._model.contacts(state) if self._contacts else None
            if self._trajectory is not None:
                self._trajectory.append(state, observed, fields, contacts, self._counts and self._counts(), time)
            if self._scene is not None:
                velocities = state.velocities() if self._velocities else None
                if self._directors:
                    shape = (self._model.worlds, np.shape(state.points())[-2])
                    fields = fields | {"director": directors_at_points(self._model.curves, state.directors(), shape)}
                poses = state.body_poses() if self._model.bodies else None
                fields = fields | self._colors(state)
                self._show(time, state.points(), velocities, fields, state.obstacle_points(), contacts, poses)
        except OSError as error:
            self._abandon()
            raise self._described(error) from error

    def _passes_over(self, state) -> bool:
        """Return True if a state is the checkpoint of a resumed run.

        Raises:
            SceneError: The state is not later than the last.
        """
        if self._time == "frame":
            return False
        checkpoint, self._checkpoint = self._checkpoint, None
        time = argument_checks.number("record: the time of the state", state.time)
        if self._last is None or time > self._last:
            self._last = time
            return False
        if checkpoint is not None and time == self._last:
            if _is(state, checkpoint):
                return True
            raise SceneError(
                f"record: a state at {time:g} s, where {self.directory} was recorded up to, but not the state of its checkpoint: go on "
                "from model.restore(reader.checkpoint()), of a TrajectoryReader"
            )
        raise SceneError(
            f"record: a state at {time:g} s follows one at {self._last:g} s; record states in the order of their times, each once, or "
            'number them with Recorder(..., time="frame") where they are no motion'
        )

    def close(self) -> None:
        """Write the last block and close the files; a second call does nothing."""
        try:
            for writer in (self._trajectory, self._scene):
                if writer is not None:
                    writer.close()
        except OSError as error:
            raise self._described(error) from error
        finally:
            self._abandon()

    def _abandon(self) -> None:
        """Close the files without further writes."""
        if self._scene is not None:
            self._scene.abandon()
        self._trajectory = self._scene = None
        if self._held is not None and not self._handed:
            self._held.close()
        self._held = None

    def _described(self, error: BaseException) -> BaseException:
        """Return the error, or for one of the disk a RecordError with losses and remedy."""
        if not isinstance(error, OSError) or isinstance(error, RecordError) or error.errno is None:
            return error
        kept = "the run cannot be recorded any further. "
        kept += "Its complete blocks of frames are kept: " if error.errno in FULL else "Complete frames are kept; "
        return system_error(self.directory, error, kept)

    def _replay(self) -> None:
        """Write the frames of the trajectory to the scene, and set counters to the end."""
        from ddg_warp.io.hdf5 import TrajectoryReader

        with TrajectoryReader(self.directory / TRAJECTORY) as reader:
            self._calls, self._frame, self._last = (
                1,
                len(reader),
                reader.time[-1],
            )  # the last state was the first of a period
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
                self._show(reader.time[frame], reader.points[frame], velocities, fields, **_others(reader, frame))

    def _fields_of(self, state) -> dict[str, np.ndarray]:
        """Return the fields of a state by name, (worlds, points) or (worlds, triangles)."""
        if not self._wanted:
            return {}
        from ddg_warp.postprocess.fields import cell_fields, point_fields

        return point_fields(state.model, state, [name for name in self._wanted if name in POINT_FIELDS]) | cell_fields(
            state.model, state, [name for name in self._wanted if name in CELL_FIELDS]
        )

    def _colors(self, state) -> dict[str, np.ndarray]:
        """Return the field that colors surfaces, world after world."""
        if self._color_by is None:
            return {}
        from ddg_warp.postprocess.quantities import triangle_fields

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
        body_poses: np.ndarray | None = None,
    ) -> None:
        """Add a frame of all worlds to the scene; undefined fields are 0."""
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
            obstacles=obstacles,
            contacts=contacts,
            body_poses=body_poses,
        )


def _is(state, checkpoint: Mapping[str, np.ndarray]) -> bool:
    """Return True if a state equals a checkpoint bit by bit."""
    values = {name: np.asarray(value) for name, value in state.snapshot().items()}
    return values.keys() == checkpoint.keys() and all(
        values[name].shape == value.shape and values[name].tobytes() == value.tobytes()
        for name, value in checkpoint.items()
    )


def _same_attributes(first: Mapping, second: Mapping) -> bool:
    return first.keys() == second.keys() and all(np.array_equal(first[name], second[name]) for name in first)


def _others(reader, frame: int) -> dict[str, np.ndarray | Contacts]:
    """Return recorded nodes of moving obstacles, contacts and poses of rigid bodies in a frame."""
    fields = {"obstacles": reader.obstacle_points, "contacts": reader.contacts, "body_poses": reader.body_poses}
    return {name: frames[frame] for name, frames in fields.items() if frames is not None}


def export_usd(
    trajectory, path, *, fps: float | None = None, tube: bool = False, revolve: int = 0, every: int = 1
) -> None:
    """Write the frames of a trajectory.h5 as USD.

    Args:
        trajectory: The file to read.
        path: The .usdc or .usda file to write.
        fps: Time codes per second; by default one time code a frame.
        tube: Whether to write tubes instead of curves.
        revolve: Sides of the surfaces of revolution around z of the curves (meridians) of the first world; 0 for none.
        every: Frames of the trajectory from one written frame to the next; the first is written.

    Raises:
        ValueError: The trajectory cannot be read or has no frames, or an option is invalid.
        RecordError: The file cannot be written.
    """
    if fps is not None:
        argument_checks.positive("export_usd: fps", fps, "1/s")
    if argument_checks.count("export_usd: revolve", revolve, 0) in (1, 2):
        raise SceneError(
            f"export_usd: revolve = {revolve}; a surface of revolution has 3 sides at least, or 0 for none"
        )
    argument_checks.flag("export_usd: tube", tube)
    every = argument_checks.count("export_usd: every", every)
    try:
        _export(trajectory, path, fps, tube, revolve, every)
    except OSError as error:
        if isinstance(error, ValueError) or error.errno is None:
            raise
        raise system_error(path, error) from error


def _export(trajectory, path, fps: float | None, tube: bool, revolve: int, every: int) -> None:
    from ddg_warp.io.hdf5 import TrajectoryReader
    from ddg_warp.io.surface_of_revolution import Revolution
    from ddg_warp.io.usd import CurvesWriter

    with TrajectoryReader(trajectory) as reader:
        worlds = int(np.prod(reader.points.shape[1:-2]))
        if not len(reader):
            raise SceneError(f"{trajectory} has no frames; export a run that wrote a block")
        times = reader.time[::every]
        spacing = np.median(np.diff(times)) if len(times) > 1 else 1.0 / DEFAULT_FPS
        shapes = Shapes.of(reader.curves, reader.surfaces, worlds)
        count = int(np.sum(reader.curves.counts))
        first = reader.points[0].reshape(-1, 3)[:count]
        revolved = Revolution(reader.curves, first, revolve) if revolve else None
        shapes = revolved.shapes if revolved else shapes
        options = {
            "obstacles": reader.obstacles,
            "contact_scales": reader.contact_scales if reader.contacts is not None else None,
            "bodies": reader.rigid_bodies,
        }
        options = {} if revolved else options | {"attributes": reader.attributes}
        with CurvesWriter(path, shapes, fps=fps or frame_rate(spacing), tube=tube, **options) as writer:
            shape = (worlds, reader.points.shape[-2])
            for frame, time in zip(range(0, len(reader), every), times, strict=True):
                points = reader.points[frame].reshape(-1, 3)
                if revolved:
                    writer.write(time, revolved.points(points[:count]))
                    continue
                velocities = None if reader.velocities is None else reader.velocities[frame].reshape(-1, 3)
                directors = (
                    {}
                    if reader.directors is None
                    else {"director": directors_at_points(reader.curves, reader.directors[frame], shape)}
                )
                writer.write(time, points, velocities=velocities, scalars=directors, **_others(reader, frame))


def frame_rate(dt: float) -> float:
    """Return time codes per second, one a frame of dt [s], to nine digits for integer time codes."""
    return float(f"{1.0 / max(dt, LEAST_DT):.9g}")


def _fps_of(model, every: int) -> float:
    """Return the frame rate of the scene's time step, or the default."""
    dt = getattr(getattr(model.scene, "analysis", None), "dt", None)
    return frame_rate(every * dt) if dt else DEFAULT_FPS

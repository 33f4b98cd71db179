"""Records the states of a run: trajectory.h5 to read and resume from, scene.usdc to look at. It only reads states."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.io import Shapes

TRAJECTORY, SCENE = "trajectory.h5", "scene.usdc"
DEFAULT_FPS = 24.0
COLORS = ("strain", "curvature", "energy")


class Recorder:
    """Writes DIR/trajectory.h5 and DIR/scene.usdc, a block of frames at a time.

    A process killed at any time leaves both files readable, up to a complete block.

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
        provenance: Attributes of the trajectory, beside version, date and machine.
        control: How the run is driven, stored in the trajectory.
        resume: Whether to go on after the last complete block of DIR/trajectory.h5; the scene is written anew from it.
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
        provenance: Mapping | None = None,
        control: Mapping | None = None,
        resume: bool = False,
    ):
        if not hasattr(model, "curves"):
            raise SceneError(f"Recorder: the model is {type(model).__name__}; give what scene.build() returns")
        every, block = arguments.count("Recorder: every", every), arguments.count("Recorder: block", block)
        if fps is not None:
            arguments.positive("Recorder: fps", fps, "1/s")
        if resume and not hdf5:
            raise ValueError("a run resumes from its trajectory.h5: leave hdf5=True, or start again with resume=False")
        self.directory = Path(directory)
        self.directory.mkdir(parents=True, exist_ok=True)
        self._model, self._every = model, every
        self._calls, self._last = 0, None
        self._velocities, self._color_by = velocities, color_by
        if color_by is not None and (not isinstance(color_by, tuple | list) or len(color_by) != 3):
            raise ValueError(f"color_by is {color_by!r}; give (name, value at the low end, value at the high end)")
        if color_by is not None and (color_by[0] not in COLORS or model.surfaces is None):
            raise ValueError(
                f"color_by {color_by[0]!r}: surfaces, if there are any, are colored by {', '.join(COLORS)}"
            )
        self._trajectory = self._scene = None
        if hdf5:
            from ddg_warp.io.hdf5 import TrajectoryWriter

            if resume:
                self._trajectory = TrajectoryWriter.resume(self.directory / TRAJECTORY, model, block=block)
            else:
                wanted = {"velocities": velocities, "directors": directors}
                self._trajectory = TrajectoryWriter(
                    self.directory / TRAJECTORY, model, block=block, provenance=provenance, control=control, **wanted
                )
        if usd:
            from ddg_warp.io.usd import CurvesWriter

            shapes = Shapes.of(model.curves, model.surfaces, model.worlds)
            fps = fps or _fps_of(model, every)
            self._scene = CurvesWriter(
                self.directory / SCENE, shapes, fps=fps, tube=tube, block=block, color_by=color_by
            )
        if resume:
            self._replay()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def record(self, state, observed: Mapping[str, float] | None = None) -> None:
        """Takes note of a state, to be called once for the first state and once after every step.

        A state no later than the last recorded one, as the first of a resumed run is, is passed over.

        Args:
            state: The state; it is only read.
            observed: Numbers measured of it, by name; the same names at every call.
        """
        if not hasattr(state, "points") or getattr(state, "model", self._model) is not self._model:
            raise SceneError(f"record: {state!r} is no state of the recorded model; give one that this model made")
        if self._last is not None and state.time <= self._last:
            return
        due = self._calls % self._every == 0
        self._calls += 1
        if not due:
            return
        self._last = state.time
        if self._trajectory is not None:
            self._trajectory.append(state, observed)
        if self._scene is not None:
            self._show(
                state.time, state.points(), state.velocities() if self._velocities else None, self._fields(state)
            )

    def close(self) -> None:
        """Writes what is left and closes the files."""
        for writer in (self._trajectory, self._scene):
            if writer is not None:
                writer.close()

    def _replay(self) -> None:
        """Brings scene and counters to where the trajectory ends."""
        from ddg_warp.io.hdf5 import TrajectoryReader

        with TrajectoryReader(self.directory / TRAJECTORY) as reader:
            self._calls, self._last = 1, reader.time[-1]  # the checkpoint's state was the first call of a period
            for frame in range(len(reader) if self._scene is not None else 0):
                show_velocities = self._velocities and reader.velocities is not None
                self._show(
                    reader.time[frame], reader.points[frame], reader.velocities[frame] if show_velocities else None
                )

    def _fields(self, state) -> dict[str, np.ndarray] | None:
        """What surfaces are colored by, world after world."""
        if self._color_by is None:
            return None
        from ddg_warp.inquiry import triangle_fields

        name = self._color_by[0]
        return {name: triangle_fields(state.model, state)[name].ravel()}

    def _show(self, time: float, points: np.ndarray, velocities: np.ndarray | None, fields=None) -> None:
        """Adds a frame of all worlds to the scene."""
        velocities = None if velocities is None else np.reshape(velocities, (-1, 3))
        self._scene.write(time, np.reshape(points, (-1, 3)), velocities=velocities, triangle_scalars=fields)


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
        with CurvesWriter(path, shapes, fps=fps or round(1.0 / spacing, 6), tube=tube) as writer:
            for time, points in zip(reader.time, reader.points, strict=True):
                points = points.reshape(-1, 3)
                writer.write(time, turned.points(points[:count]) if turned else points)


def _fps_of(model, every: int) -> float:
    """One time code a frame where the scene's analysis has a time step."""
    dt = getattr(getattr(model.scene, "analysis", None), "dt", None)
    return round(1.0 / (every * dt), 6) if dt else DEFAULT_FPS

"""Frames of a recorded run, also of a run that still goes on."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np

from ddg_warp.errors import DataError
from ddg_warp.io.hdf5 import TrajectoryError, TrajectoryReader
from ddg_warp.postprocess.fields import CELL_FIELDS, POINT_FIELDS
from ddg_warp.view.drawing import Drawing, Frame, largest_force, value_range

TRIES, WAIT = 20, 0.05  # attempts to open a file that is written to, and the time between two [s]
SAMPLES = 16  # frames that give ranges of fields and forces
SPEED = "speed [m/s]"
NO_FIELD = "none"


class Frames:
    """Frames in the order of time; a subclass has `__len__` and `frame`."""

    def frame(self, k: int, field: str = NO_FIELD) -> Frame:
        """Return frame k with the values of a field, given by its label."""
        raise NotImplementedError

    def range(self, field: str) -> tuple[float, float]:
        """Return the least and largest value of a field, over SAMPLES frames of the run."""
        return value_range(self.frame(k, field).values for k in self.sample(SAMPLES))

    def typical_force(self) -> float:
        """Return the median over SAMPLES frames of the largest contact force [N]; 0 without contacts."""
        sample = [largest_force(self.frame(k).contacts) for k in self.sample(SAMPLES)]
        return float(np.median([force for force in sample if force > 0.0] or [0.0]))

    def sample(self, count: int) -> list[int]:
        """Return at most `count` frame numbers at equal distances, first and last included."""
        return sorted({round(k) for k in np.linspace(0, len(self) - 1, min(count, len(self)))})


class Recording(Frames):
    """Frames of DIR/trajectory.h5.

    Args:
        directory: DIR, or the file.

    Attributes:
        drawing: `Drawing` of the scene; None while there is no frame.
        fields: Names of the fields to color by, with units.

    Raises:
        TrajectoryError: The file cannot be read.
        DataError: There is no run in the directory.
    """

    def __init__(self, directory):
        path = Path(directory)
        self.path = path if path.suffix == ".h5" else path / "trajectory.h5"
        if not self.path.is_file():
            raise DataError(
                f"there is no run in {directory}: {self.path} is missing; give the folder of `ddg-warp run`"
            )
        self._reader: TrajectoryReader | None = None
        self.drawing: Drawing | None = None
        self.refresh()

    def refresh(self) -> bool:
        """Read frames that were added to the file; return True if there are any."""
        status = os.stat(self.path)
        version = status.st_mtime_ns, status.st_size
        if self._reader is not None and version == self._version:
            return False
        count = 0 if self._reader is None else len(self._reader)
        self.close()  # first: HDF5 gives two readers of a file in a process the content as the first found it
        self._version = None
        self._reader = reader = self._open()
        self._version = version
        if self.drawing is None and len(reader):
            worlds = int(np.prod(reader.points.shape[1:-2]))
            self.drawing = Drawing(reader.curves, reader.surfaces, worlds, reader.points[0], reader.obstacles)
        return len(reader) != count

    def _open(self) -> TrajectoryReader:
        """Open the file; wait while its writer is in the middle of a transaction."""
        for _ in range(TRIES):
            try:
                return TrajectoryReader(self.path)
            except TrajectoryError:
                time.sleep(WAIT)
        return TrajectoryReader(self.path)

    def __len__(self) -> int:
        return len(self._reader)

    @property
    def times(self) -> np.ndarray:
        """Times of the frames [s]; the numbers of states without a time."""
        return self._reader.time

    @property
    def moving(self) -> bool:
        """True if times are seconds of a motion, not numbers of equilibria or load parameters."""
        return self._reader.time_is == "state" and "load" not in self._reader.series

    @property
    def fields(self) -> dict[str, str]:
        """Names of the fields in the file, by label."""
        named = {label(name): name for name in self._reader.fields}
        return ({SPEED: SPEED} if self._reader.velocities is not None else {}) | named

    def frame(self, k: int, field: str = NO_FIELD) -> Frame:
        """Return frame k with the values of a field, given by its label."""
        reader = self._reader
        return Frame(
            float(reader.time[k]),
            reader.points[k].reshape(-1, 3),
            None if field == NO_FIELD else self._values(k, field),
            None if reader.obstacle_points is None else first_world(reader.obstacle_points[k]),
            None if reader.contacts is None else reader.contacts[k],
        )

    def close(self) -> None:
        """Close the file."""
        if self._reader is not None:
            self._reader.close()

    def _values(self, k: int, field: str) -> np.ndarray:
        if field not in self.fields:
            raise TrajectoryError(f"{self.path}: there is no field {field!r}; recorded are {', '.join(self.fields)}")
        name = self.fields[field]
        if name == SPEED:
            return np.linalg.norm(self._reader.velocities[k].reshape(-1, 3), axis=1)
        values = self._reader.fields[name][k]
        if name in CELL_FIELDS:
            return self.drawing.at_points(values[len(self.drawing.shapes.curves.counts) :])
        return values


def label(name: str) -> str:
    """Return the label of a recorded field: name and unit."""
    text = (POINT_FIELDS | CELL_FIELDS).get(name, "")
    return f"{name} [{text.rpartition('[')[2]}" if text.endswith("]") else name


def first_world(values: np.ndarray) -> np.ndarray:
    """Return the values of the first world (M, 3), of (M, 3) or (worlds, M, 3)."""
    return values.reshape(-1, *values.shape[-2:])[0]

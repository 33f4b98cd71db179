"""Motion-capture recordings of real cables, read from the user's own clone of a public repository.

Cameras record markers along a cable that two robots hold and move, 100 times a second. In the DER recordings [1] a file
data_set/DLO1/train/101.pkl has frames, each of (3, M) coordinates with z up, of 13 markers (12 on other cables). The grips hold the
first two and the last two. Recordings of branched cables [2] have coordinates first, with y up:
`read(path, axes="cfm", markers=20, up="y")`.

    for path in recordings("data_set/DLO1/train"):  # below the folder that DDG_WARP_RECORDINGS names
        recording = read(path)

Files are pickles, and are read as arrays of numbers only (`ddg_warp.data.safe_pickle`).

[1] Chen, Zhang, Brei, Zhang, Chen, Wu, Vasudevan, *Differentiable Discrete Elastic Rods for Real-Time Modeling of Deformable Linear
Objects*, 2024, arXiv 2406.05931.
[2] Chen et al., *DEFT*, 2025, arXiv 2502.15037.
"""

from __future__ import annotations

import numbers
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.data import safe_pickle
from ddg_warp.data.episodes import inside
from ddg_warp.errors import DataError, SceneError
from ddg_warp.geometry.polyline import cross, directors, length, unit
from ddg_warp.io.paths import as_path, is_file

VARIABLE = "DDG_WARP_RECORDINGS"
RATE = 100.0  # frames per second
HELD = (0, 1, -2, -1)  # markers of the two grips
# Permutations of file axes that put the up axis last and keep the frame right-handed.
UP = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}


@dataclass(frozen=True)
class Grip:
    """One grip over time.

    Attributes:
        position: Of the outermost marker of the grip [m], shape (F, 3).
        frame: Rotations, shape (F, 3, 3), with columns tangent, from the first marker of the cable to the last, and two
            directors. Markers do not determine the rotation about the tangent: directors are transported in time without twist.
    """

    position: np.ndarray
    frame: np.ndarray


@dataclass(frozen=True)
class Recording:
    """Markers of a cable over time, with z up.

    Attributes:
        name: File, relative to the folder of recordings.
        times: Times of the frames [s], shape (F,), from 0.
        markers: Positions [m], shape (F, M, 3), NaN where the cameras lost one.
        held: Markers of both grips, two each, outermost markers first and last; empty without grips.
    """

    name: str
    times: np.ndarray
    markers: np.ndarray
    held: tuple[int, ...] = HELD

    @property
    def complete(self) -> bool:
        """True if every marker is visible in every frame."""
        return bool(np.isfinite(self.markers).all())

    def grips(self) -> tuple[Grip, Grip]:
        """Return the first grip and the last.

        Raises:
            DataError: No markers are gripped, or a marker of a grip is lost, or two coincide.
        """
        if not self.held:
            raise DataError(f"{self.name}: no markers are held; read it with held=(first, second, last but one, last)")
        first, second, third, last = self.held
        return self._grip(first, first, second), self._grip(last, third, last)

    def _grip(self, outermost: int, start: int, end: int) -> Grip:
        edges = self.markers[:, end] - self.markers[:, start]
        lost = ~(length(edges) > 0.0)
        if lost.any():
            raise DataError(
                f"{self.name}: frame {np.argmax(lost)}: markers {start} and {end} of a grip are lost, or coincide; "
                "take other frames, or other markers as held"
            )
        tangents = unit(edges)
        first = directors(tangents[None], None)[0]  # a curve of tangents over time
        frame = np.stack([tangents, first, cross(tangents, first)], axis=-1)
        return Grip(self.markers[:, outermost].copy(), frame)

    def resampled(self, times, degree: int = 3) -> Recording:
        """Return the recording at other times, by spline interpolation.

        Args:
            times: Times [s], shape (n,), increasing, within the recording.
            degree: 1 for linear interpolation, 3 for a cubic spline.

        Raises:
            SceneError: There is no such degree.
            DataError: Times are outside of the recording, there are too few frames, or markers are lost.
        """
        from scipy.interpolate import make_interp_spline

        if isinstance(degree, bool) or not isinstance(degree, numbers.Integral) or degree not in (1, 3):
            raise SceneError(f"resampled: degree = {degree!r}; it is 1 or 3")
        times = np.atleast_1d(argument_checks.floats(times))
        inside = times.ndim == 1 and times.size and times[0] >= self.times[0] and times[-1] <= self.times[-1]
        if not (inside and (np.diff(times) > 0.0).all()):
            reach = f"{self.times[0]:g} to {self.times[-1]:g} s"
            raise DataError(f"{self.name} has frames from {reach}; give increasing times within")
        if len(self.times) <= degree:
            raise DataError(f"{self.name} has {len(self.times)} frames, fewer than a spline of degree {degree} needs")
        if not self.complete:
            frame, marker = np.argwhere(~np.isfinite(self.markers).all(axis=2))[0]
            raise DataError(
                f"{self.name}: frame {frame}: marker {marker} is lost; fill short gaps (`filled`), or resample frames where all are "
                "seen (`between`)"
            )
        return replace(self, times=times, markers=make_interp_spline(self.times, self.markers, k=degree)(times))

    def filled(self, longest: float) -> Recording:
        """Return the recording with short gaps of lost markers filled by linear interpolation.

        Args:
            longest: Longest time between frames with the marker visible [s]; longer gaps, and gaps at either end, stay.

        Raises:
            SceneError: `longest` is not positive.
        """
        longest = argument_checks.positive("filled: longest", longest, "s")
        markers = self.markers.copy()
        for marker_axis in np.ndindex(markers.shape[1:]):
            visible = np.flatnonzero(np.isfinite(self.markers[(slice(None), *marker_axis)]))
            if not len(visible):
                continue
            before, after = (
                np.searchsorted(visible, np.arange(len(markers)), "right") - 1,
                np.searchsorted(visible, np.arange(len(markers))),
            )
            inside = (before >= 0) & (after < len(visible))
            before, after = visible[np.maximum(before, 0)], visible[np.minimum(after, len(visible) - 1)]
            inside &= self.times[after] - self.times[before] <= longest * (1.0 + 1e-9)
            interpolated = np.interp(self.times, self.times[visible], self.markers[(visible, *marker_axis)])
            markers[(inside, *marker_axis)] = interpolated[inside]
        return replace(self, markers=markers)

    def between(self, first: int, last: int) -> Recording:
        """Return the frames from `first` up to, but without, `last`; times start from 0.

        Args:
            first, last: Integers; negative ones count from the end.

        Raises:
            SceneError: The arguments are not integers.
            DataError: There are no such frames.
        """
        first, last = (argument_checks.index(f"between: {name}", k) for name, k in (("first", first), ("last", last)))
        times = self.times[first:last]
        if not len(times):
            raise DataError(f"{self.name}: there are no frames from {first} to {last}; there are {len(self.times)}")
        return replace(self, times=times - times[0], markers=self.markers[first:last])


def recordings(folder: str = "", *, root=None, outside: bool = False) -> list[Path]:
    """Return the pickles below a folder of recordings, ordered by the numbers in file names.

    Args:
        folder: Folder below the root, such as "data_set/DLO1/train".
        root: The clone; by default the folder that the environment variable DDG_WARP_RECORDINGS names.
        outside: True if paths or links may lead outside of the clone.

    Raises:
        DataError: There is no such folder, no recording in it, or one lies outside of the clone.
    """
    root, outside = _root(root), argument_checks.flag("recordings: outside", outside)
    path = inside(
        root, root / as_path("recordings: folder", "." if isinstance(folder, str) and not folder else folder), outside
    )
    paths = [each for each in path.rglob("*") if each.suffix in (".pkl", ".pickle")]
    if not paths:
        raise DataError(f"{path} holds no recordings (*.pkl); name a folder of them, of a clone that is complete")
    for each in paths:
        inside(root, each, outside)
    return sorted(
        paths, key=lambda each: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", str(each))]
    )


def read(
    path,
    *,
    root=None,
    axes: str = "fcm",
    markers: int | None = None,
    rate: float = RATE,
    up: str = "z",
    held: tuple[int, ...] = HELD,
    outside: bool = False,
) -> Recording:
    """Read a recording.

    Args:
        path: The file, as returned by `recordings`, or relative to the root.
        root: See `recordings`.
        axes: Axes of the array: frames, coordinates and markers, by initial letters.
        markers: Number of markers. A file with axes "cfm" may have frames and markers on one axis, frame after frame: (3, F M).
        rate: Frames per second.
        up: Axis of the file that points up, "x", "y" or "z"; the recording has z up.
        held: Markers of both grips, from the first of the cable to the last; empty without grips.
        outside: True if a relative path, or one given with a root, may lead out of the root, by `..` or by links.

    Raises:
        SceneError: An option is invalid.
        DataError: The file does not exist, or has no markers over time.
        UnsafePickleError: The pickle needs more than arrays of numbers.
    """
    path, outside = as_path("read: path", path), argument_checks.flag("read: outside", outside)
    if root is not None or not path.is_absolute():
        root = _root(root)
        path = inside(root, root / path, outside)
    if not is_file(path):
        raise DataError(f"the recording {path} does not exist; `recordings()` lists what there is")
    if not isinstance(axes, str) or sorted(axes) != ["c", "f", "m"]:
        raise SceneError(
            f"read: axes = {axes!r}; they are the letters f, c, m of frames, coordinates, markers, in their order"
        )
    argument_checks.choice("read: up", up, UP)
    rate = argument_checks.positive("read: rate", rate, "1/s")
    if markers is not None:
        markers = argument_checks.count("read: markers", markers)
    values = _array(safe_pickle.load(path), path)
    if markers is not None and values.ndim == 2 and axes == "cfm":
        if values.shape[1] % markers:
            raise DataError(f"{path} has an array {values.shape}, not of {markers} markers a frame; correct markers")
        values = values.reshape(len(values), -1, markers)
    if values.ndim != 3 or values.shape[axes.index("c")] != 3 or not values.size:
        raise DataError(
            f"{path} has an array {values.shape}, with three coordinates nowhere in axes = {axes!r}; give its axes"
        )
    values = values.transpose([axes.index(letter) for letter in "fmc"])[..., UP[up]]
    if markers not in (None, values.shape[1]):
        raise DataError(f"{path} has {values.shape[1]} markers by axes = {axes!r}, not {markers}; correct either")
    if np.isinf(values).any():
        frame, marker = np.argwhere(np.isinf(values).any(axis=2))[0]
        raise DataError(f"{path}: frame {frame}: marker {marker} is at infinity; correct the file, or leave it out")
    held = _checked_held(held, values.shape[1], path)
    name = "/".join(path.parts[-3:])
    return Recording(name, np.arange(len(values)) / rate, np.ascontiguousarray(values), held)


def _root(root) -> Path:
    """Return the folder of recordings."""
    folder = root if root is not None else os.environ.get(VARIABLE)
    if folder is None or (isinstance(folder, str) and not folder):
        raise DataError(
            f"where are the recordings? Give root, or set {VARIABLE} to your clone of them; none come with ddg_warp"
        )
    root = as_path("the folder of recordings", folder)
    if not root.is_dir():
        raise DataError(f"the folder of recordings {root} does not exist; clone them, and give root or set {VARIABLE}")
    return root


def _array(content, path: Path) -> np.ndarray:
    """Return the content of a file as one array of real numbers."""
    try:
        values = np.asarray(content)
    except (ValueError, OverflowError):  # frames of different shapes
        values = np.zeros(0, object)
    if values.dtype.kind not in "iuf":
        raise DataError(
            f"{path} holds {type(content).__name__}, no array of markers over time; frames are of one shape"
        )
    return values.astype(np.float64)


def _checked_held(markers, count: int, path: Path) -> tuple[int, ...]:
    """Return four markers of the grips, or none.

    Raises:
        DataError: The argument is neither, or a marker does not exist.
    """
    original = markers
    markers = tuple(markers) if np.iterable(markers) and not isinstance(markers, str | bytes | dict | set) else (None,)
    fits = all(
        isinstance(marker, numbers.Integral) and not isinstance(marker, bool) and -count <= marker < count
        for marker in markers
    )
    if markers and not (fits and len({int(marker) % count for marker in markers}) == len(markers) == 4):
        raise DataError(
            f"{path} has {count} markers; held = {original!r} is not four of them, two of each grip; give four whole numbers, or "
            "() without grips"
        )
    return tuple(int(marker) % count for marker in markers)

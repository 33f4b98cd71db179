"""Shared pieces of scenes of recorded cables: windows of recordings, and cables whose ends follow markers."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import ddg_warp as ddg
from ddg_warp.errors import DataError
from ddg_warp.geometry import polyline

KNOWN = 9  # frames around or up to the start of a window that determine its initial state
GAP = 0.08  # s, longest loss of a marker that linear interpolation fills
EA, ROTARY, RADIUS = 1.0e3, 1e-6, 4e-3  # N, kg m, m; of nearly inextensible cables
ENDS = 2  # markers of each grip


@dataclass(frozen=True)
class Window:
    """Window of a recording, with its initial state.

    Attributes:
        name: name of the recording.
        times: times of the frames (F,) [s]; the first is 0.
        seen: markers (F, M, 3) [m], NaN where one is lost.
        markers: `seen` with short gaps filled, so that markers of grips are known.
        points, velocities: initial state of the markers (M, 3) [m, m/s], from frames around or up to the start.
        twist: twist of the last grip against the first at the start [rad], zero where the recording begins.
        gaps: lengths of the cable between markers (M - 1,) [m].
    """

    name: str
    times: np.ndarray
    seen: np.ndarray
    markers: np.ndarray
    points: np.ndarray
    velocities: np.ndarray
    twist: float
    gaps: np.ndarray

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.times[-1])


def windows(recordings: list, frames: int, ahead: bool) -> list[Window]:
    """Cut recordings of one cable into consecutive windows, without windows that start while markers are lost.

    Args:
        recordings: recordings whose two first and two last markers are gripped.
        frames: number of frame intervals of a window.
        ahead: estimate the initial state from frames on both sides of the start, instead of earlier frames alone.

    Raises:
        DataError: cables differ in their number of markers, ends are not gripped at two markers, or no window is left.
    """
    results, filled = [], [recording.filled(GAP) for recording in recordings]
    for recording in recordings:
        count = recording.markers.shape[1]
        if count != recordings[0].markers.shape[1]:
            raise DataError(f"{recording.name} has {count} markers, others more or fewer; give recordings of one cable")
        if recording.held != (0, 1, count - 2, count - 1):
            raise DataError(
                f"{recording.name}: grips hold markers {recording.held}; they hold the first and last two here"
            )
    gaps = lengths(np.concatenate([whole.markers for whole in filled]))
    for recording, whole in zip(recordings, filled, strict=True):
        complete = np.isfinite(whole.markers[:, [0, 1, -2, -1]]).all((1, 2))
        last = len(complete) if complete.all() else int(np.argmin(complete))
        whole = whole.between(0, last) if last else whole
        for first in range(KNOWN - 1, last - frames, frames):
            start = first - (KNOWN // 2 if ahead else KNOWN - 1)
            around = slice(start, start + KNOWN)
            if not np.isfinite(whole.markers[around]).all():
                continue
            # Slope and value of a cubic through frames on both sides; of a parabola on one side, where a cubic follows
            # the noise.
            times = whole.times[around] - whole.times[first]
            (*_, slope, value) = np.polyfit(times, whole.markers[around].reshape(KNOWN, -1), 3 if ahead else 2)
            points, velocities = (values.reshape(-1, 3) for values in (value, slope))
            span = slice(first, first + frames + 1)
            fields = recording.markers[span], whole.markers[span], points, velocities
            times = whole.times[span] - whole.times[first]
            results.append(Window(recording.name, times, *fields, twist_at(whole, first), gaps))
    if not results:
        names = ", ".join(recording.name for recording in recordings)
        raise DataError(
            f"{names}: no window of {frames} frames in which all markers are seen at first; take shorter ones"
        )
    return results


def lengths(markers: np.ndarray) -> np.ndarray:
    """Return lengths of a cable between markers (M - 1,) [m]: medians over complete frames (F, M, 3), along splines."""
    markers = markers[np.isfinite(markers).all((1, 2))]
    parts = 8
    edges = np.linalg.norm(np.diff(along(markers, parts), axis=1), axis=2)
    return np.median(edges.reshape(len(markers), -1, parts).sum(2), axis=0)


def along(markers: np.ndarray, parts: int) -> np.ndarray:
    """Return nodes (..., (M - 1) parts + 1, 3) of cables through markers (..., M, 3), with `parts` edges between two.

    Grips are straight. A cubic spline between grips continues the direction of each.
    """
    from scipy.interpolate import make_interp_spline

    count = markers.shape[-2]
    free, last = np.moveaxis(markers[..., 1:-1, :], -2, 0), count - 2
    ends = [[(1, np.moveaxis(markers, -2, 0)[k + 1] - np.moveaxis(markers, -2, 0)[k])] for k in (0, last)]
    parameter = np.arange((count - 1) * parts + 1) / parts
    nodes = make_interp_spline(np.arange(1, count - 1), free, k=3, bc_type=tuple(ends))(np.clip(parameter, 1, last))
    nodes = np.moveaxis(nodes, 0, -2)
    for start in (0, last):
        weight = np.linspace(0.0, 1.0, parts + 1)[:, None]
        straight = markers[..., start : start + 1, :] * (1.0 - weight) + markers[..., start + 1 : start + 2, :] * weight
        nodes[..., start * parts : (start + 1) * parts + 1, :] = straight
    return nodes


def twist_at(recording, frame: int) -> float:
    """Return the twist of the last grip against the first [rad], zero in the first frame, by parallel transport in time."""
    tangents_by_frame = []
    for k in (0, frame):
        tangents = polyline.unit(np.diff(along(recording.markers[k], 4), axis=0))
        if not tangents_by_frame:
            directors = polyline.directors(tangents[None], None)[0]
            begun = directors[0], directors[-1]
        tangents_by_frame.append(tangents)
    current = []
    for start, pair in zip(begun, ((0, 1), (-2, -1)), strict=True):
        edges = recording.markers[: frame + 1, pair[1]] - recording.markers[: frame + 1, pair[0]]
        current.append(polyline.directors(polyline.unit(edges)[None], start[None])[0, -1])
    carried = polyline.directors(tangents_by_frame[1][None], current[0][None])[0, -1]
    return float(polyline.signed_angle(carried, current[1], tangents_by_frame[1][-1]))


def section(values: dict[str, float], mass: float, count: int, parts: int) -> ddg.Stiffness:
    """Return the section of a cable of `count` markers with EI, GJ, viscosity and mass per length [kg/m].

    Gripped edges are three times as stiff. The vertex at the end of a grip takes the mean, twice the stiffness: half of its
    cell bends, and the cable is clamped at the marker.
    """
    edges = np.ones((count - 1) * parts)
    edges[held(count, parts)[1]] = 3.0
    stiffness = {"EI1": values["EI"] * edges, "GJ": values["GJ"] * edges, "viscosity": values["viscosity"]}
    return ddg.Stiffness(EA=EA, mass_per_length=mass, rotary_inertia=ROTARY, radius=RADIUS, **stiffness)


def held(count: int, parts: int) -> tuple[list[int], list[int]]:
    """Return the nodes and edges of both grips of a cable of `count` markers."""
    nodes, ends = (count - 1) * parts + 1, list(range(parts + 1))
    return [*ends, *(nodes - 1 - k for k in reversed(ends))], [
        *ends[:-1],
        *(nodes - 2 - k for k in reversed(ends[:-1])),
    ]


def cable(points: np.ndarray, count: int, values: dict, mass: float, hold: Callable, **options) -> ddg.Scene:
    """Return a scene of a naturally straight cable through nodes (n, 3) with fixed twist at grips; `hold` prescribes gripped nodes."""
    scene, parts = ddg.Scene(**options), (len(points) - 1) // (count - 1)
    rod = scene.add_rod(points, section=section(values, mass, count, parts), natural="straight", name="cable")
    nodes, edges = held(count, parts)
    scene.fix_twist(rod, edges)
    hold(scene, rod, nodes)
    return scene


def gripped(window: Window, parts: int, values: dict, mass: float) -> ddg.Scene:
    """Return a scene of a straight cable with the lengths of a window, and a kinematic support at each gripped node."""
    s = np.concatenate([[0.0], np.cumsum(np.repeat(window.gaps / parts, parts))])
    direction = polyline.unit(window.points[-1] - window.points[0])

    def hold(scene, rod, nodes):
        for node in nodes:
            scene.fix(rod, [node], motion=ddg.Grip())

    return cable(window.points[0] + s[:, None] * direction, len(window.points), values, mass, hold)


def moved(window: Window, parts: int, values: dict, mass: float, dt: float) -> ddg.Scene:
    """Return a scene of a cable with the initial state and grip motion of a window."""
    points, velocities = (along(values, parts) for values in (window.points, window.velocities))
    paths = held_paths(window, parts)

    def hold(scene, rod, nodes):
        def shift(t: float) -> np.ndarray:
            inside = np.array(
                [[np.interp(t, window.times, component) for component in path] for path in paths.transpose(1, 2, 0)]
            )
            return inside - paths[0]

        scene.fix(rod, nodes, motion=ddg.Motion(translation=shift))

    def start(model):
        return model.state(velocities=velocities, angles=window.twist * shares(len(points) - 1, parts))

    options = {"initial": start, "analysis": ddg.Dynamics(dt=dt, duration=window.duration)}
    return cable(points, len(window.points), values, mass, hold, **options)


def held_paths(window: Window, parts: int) -> np.ndarray:
    """Return positions of gripped nodes in every frame (F, nodes, 3) [m]; the first frame is the estimated initial state."""
    nodes, _ = held(len(window.points), parts)
    # markers of grips are finite, and straight lines join them
    markers = np.where(np.isfinite(window.markers), window.markers, 0.0)
    paths = along(markers, parts)[:, nodes]
    paths[0] = along(window.points, parts)[nodes]
    return paths


def shares(edges: int, parts: int) -> np.ndarray:
    """Return the fraction of the twist of each edge (edges,): 0 in the first grip, 1 in the last."""
    return np.clip((np.arange(edges) - parts + 1) / (edges - 2 * parts + 1), 0.0, 1.0)


def poses(recorded: list[Window], parts: int, rest: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return poses (times, windows, grips, 6) of nodal grips at times [s], relative to rest positions (nodes, 3)."""
    result = np.zeros((len(times), len(recorded), len(rest), 6))
    for world, window in enumerate(recorded):
        paths = held_paths(window, parts).reshape(len(window.times), -1)
        values = np.stack([np.interp(times, window.times, path) for path in paths.T], 1)
        result[:, world, :, :3] = values.reshape(len(times), -1, 3) - rest
    return result


def starts(model, recorded: list[Window], parts: int):
    """Return the initial state of a model with one world a window."""
    points, velocities = (
        along(np.stack([getattr(window, name) for window in recorded]), parts) for name in ("points", "velocities")
    )
    rest = model.state()
    edges = polyline.unit(np.diff(points, axis=1))
    straight = polyline.unit(np.diff(rest.points().reshape(len(recorded), -1, 3), axis=1))
    reference = polyline.transport(rest.directors().reshape(straight.shape), straight, edges)
    carried = np.cumsum(polyline.reference_twist(edges, reference, False), axis=1)
    wanted = shares(edges.shape[1], parts) * np.array([window.twist for window in recorded])[:, None]
    angles = wanted - np.pad(carried, ((0, 0), (1, 0)))
    state = model.state(points, velocities, angles=angles)
    nodes, _ = held(len(recorded[0].points), parts)
    begin = poses(recorded, parts, rest.points().reshape(len(recorded), -1, 3)[0, nodes], np.zeros(1))
    state.grips.pose.assign(np.ascontiguousarray(begin.reshape(-1, 6).T))
    return state

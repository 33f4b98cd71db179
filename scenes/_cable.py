"""What scenes of recorded cables share: windows of recordings, and cables whose ends move as markers did."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import ddg_warp as ddg
from ddg_warp.errors import DataError
from ddg_warp.geometry import polyline

KNOWN = 9  # frames around or up to the start of a window, from which its start is known
GAP = 0.08  # s, without a marker, that straight lines fill
EA, ROTARY, RADIUS = 1.0e3, 1e-6, 4e-3  # N, kg m, m; of cables, which hardly stretch
ENDS = 2  # markers of each grip


@dataclass(frozen=True)
class Window:
    """A part of a recording, and how it starts.

    Attributes:
        name: of the recording.
        times: of the frames [s], the first is 0 (F,).
        seen: markers (F, M, 3) [m], NaN where one is lost; markers: with short gaps filled, so that those of grips are known.
        points, velocities: of the markers at the start, from frames around it or up to it (M, 3) [m, m/s].
        twist: of the last grip against the first at the start [rad], where the recording began without.
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
        """[s]"""
        return float(self.times[-1])


def windows(recordings: list, frames: int, ahead: bool) -> list[Window]:
    """Windows of so many frames, one behind the other, of recordings of one cable; without those that start where markers are lost.

    Args:
        recordings: read, with the two first and last markers held.
        frames: between the first and the last of a window.
        ahead: whether how a window starts is known from as many frames of its own as from those before it, or from these alone.

    Raises:
        DataError: cables have different numbers of markers, no two markers at both ends are held, or there is no window.
    """
    found, filled = [], [recording.filled(GAP) for recording in recordings]
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
        known = np.isfinite(whole.markers[:, [0, 1, -2, -1]]).all((1, 2))
        last = len(known) if known.all() else int(np.argmin(known))
        whole = whole.between(0, last) if last else whole
        for first in range(KNOWN - 1, last - frames, frames):
            start = first - (KNOWN // 2 if ahead else KNOWN - 1)
            around = slice(start, start + KNOWN)
            if not np.isfinite(whole.markers[around]).all():
                continue
            # value and slope of cubics through frames on both sides; of parabolas on one, of which cubics would follow the noise
            times = whole.times[around] - whole.times[first]
            (*_, slope, value) = np.polyfit(times, whole.markers[around].reshape(KNOWN, -1), 3 if ahead else 2)
            points, velocities = (values.reshape(-1, 3) for values in (value, slope))
            part = slice(first, first + frames + 1)
            own = recording.markers[part], whole.markers[part], points, velocities
            times = whole.times[part] - whole.times[first]
            found.append(Window(recording.name, times, *own, twist_at(whole, first), gaps))
    if not found:
        names = ", ".join(recording.name for recording in recordings)
        raise DataError(
            f"{names}: no window of {frames} frames in which all markers are seen at first; take shorter ones"
        )
    return found


def lengths(markers: np.ndarray) -> np.ndarray:
    """Lengths of a cable between its markers (M - 1,) [m]: medians over the frames (F, M, 3) in which all are seen, along splines."""
    markers = markers[np.isfinite(markers).all((1, 2))]
    parts = 8
    edges = np.linalg.norm(np.diff(along(markers, parts), axis=1), axis=2)
    return np.median(edges.reshape(len(markers), -1, parts).sum(2), axis=0)


def along(markers: np.ndarray, parts: int) -> np.ndarray:
    """Nodes (..., (M - 1) parts + 1, 3) of cables through markers (..., M, 3), so many edges between two.

    Grips are straight; between them runs a cubic spline that leaves each in its direction.
    """
    from scipy.interpolate import make_interp_spline

    count = markers.shape[-2]
    free, last = np.moveaxis(markers[..., 1:-1, :], -2, 0), count - 2
    ends = [[(1, np.moveaxis(markers, -2, 0)[k + 1] - np.moveaxis(markers, -2, 0)[k])] for k in (0, last)]
    at = np.arange((count - 1) * parts + 1) / parts
    nodes = make_interp_spline(np.arange(1, count - 1), free, k=3, bc_type=tuple(ends))(np.clip(at, 1, last))
    nodes = np.moveaxis(nodes, 0, -2)
    for start in (0, last):
        share = np.linspace(0.0, 1.0, parts + 1)[:, None]
        straight = markers[..., start : start + 1, :] * (1.0 - share) + markers[..., start + 1 : start + 2, :] * share
        nodes[..., start * parts : (start + 1) * parts + 1, :] = straight
    return nodes


def twist_at(recording, frame: int) -> float:
    """Twist of the last grip against the first [rad], had it none in the first frame, with frames that are carried along in time."""
    turns = []
    for at in (0, frame):
        tangents = polyline.unit(np.diff(along(recording.markers[at], 4), axis=0))
        if not turns:
            directors = polyline.directors(tangents[None], None)[0]
            begun = directors[0], directors[-1]
        turns.append(tangents)
    now = []
    for start, pair in zip(begun, ((0, 1), (-2, -1)), strict=True):
        edges = recording.markers[: frame + 1, pair[1]] - recording.markers[: frame + 1, pair[0]]
        now.append(polyline.directors(polyline.unit(edges)[None], start[None])[0, -1])
    carried = polyline.directors(turns[1][None], now[0][None])[0, -1]
    return float(polyline.signed_angle(carried, now[1], turns[1][-1]))


def section(values: dict[str, float], mass: float, count: int, parts: int) -> ddg.Stiffness:
    """Of a cable with EI, GJ and viscosity, and a mass per length [kg/m], of so many markers and edges between two.

    Edges that grips hold are three times as stiff, so that the vertex where a grip ends, which takes the mean, is twice: the cell of
    that bends over half of its length, and the cable is clamped where the marker is.
    """
    edges = np.ones((count - 1) * parts)
    edges[held(count, parts)[1]] = 3.0
    own = {"EI1": values["EI"] * edges, "GJ": values["GJ"] * edges, "viscosity": values["viscosity"]}
    return ddg.Stiffness(EA=EA, mass_per_length=mass, rotary_inertia=ROTARY, radius=RADIUS, **own)


def held(count: int, parts: int) -> tuple[list[int], list[int]]:
    """Nodes and edges that both grips hold of a cable of so many markers."""
    nodes, ends = (count - 1) * parts + 1, list(range(parts + 1))
    return [*ends, *(nodes - 1 - k for k in reversed(ends))], [
        *ends[:-1],
        *(nodes - 2 - k for k in reversed(ends[:-1])),
    ]


def cable(points: np.ndarray, count: int, values: dict, mass: float, hold: Callable, **options) -> ddg.Scene:
    """A cable through nodes (n, 3), naturally straight, whose grips hold their edges from turning; `hold` moves the nodes they hold."""
    scene, parts = ddg.Scene(**options), (len(points) - 1) // (count - 1)
    rod = scene.add_rod(points, section=section(values, mass, count, parts), natural="straight", name="cable")
    nodes, edges = held(count, parts)
    scene.fix_twist(rod, edges)
    hold(scene, rod, nodes)
    return scene


def gripped(window: Window, parts: int, values: dict, mass: float) -> ddg.Scene:
    """A cable that lies straight as the one in a window runs, so many edges between markers; each node that is held has a grip."""
    s = np.concatenate([[0.0], np.cumsum(np.repeat(window.gaps / parts, parts))])
    direction = polyline.unit(window.points[-1] - window.points[0])

    def hold(scene, rod, nodes):
        for node in nodes:
            scene.fix(rod, [node], motion=ddg.Grip())

    return cable(window.points[0] + s[:, None] * direction, len(window.points), values, mass, hold)


def moved(window: Window, parts: int, values: dict, mass: float, dt: float) -> ddg.Scene:
    """A cable that starts as the one in a window, and is held as that."""
    points, velocities = (along(values, parts) for values in (window.points, window.velocities))
    paths = held_paths(window, parts)

    def hold(scene, rod, nodes):
        def shift(t: float) -> np.ndarray:
            inside = np.array([[np.interp(t, window.times, own) for own in path] for path in paths.transpose(1, 2, 0)])
            return inside - paths[0]

        scene.fix(rod, nodes, motion=ddg.Motion(translation=shift))

    def start(model):
        return model.state(velocities=velocities, angles=window.twist * shares(len(points) - 1, parts))

    options = {"initial": start, "analysis": ddg.Dynamics(dt=dt, duration=window.duration)}
    return cable(points, len(window.points), values, mass, hold, **options)


def held_paths(window: Window, parts: int) -> np.ndarray:
    """Where nodes that are held are in every frame (F, nodes, 3) [m]; at the start where the frames before have them."""
    nodes, _ = held(len(window.points), parts)
    markers = np.where(
        np.isfinite(window.markers), window.markers, 0.0
    )  # which those of grips, with straight lines between, do not see
    paths = along(markers, parts)[:, nodes]
    paths[0] = along(window.points, parts)[nodes]
    return paths


def shares(edges: int, parts: int) -> np.ndarray:
    """Part of the twist that edges have (edges,): none in the first grip, all in the last."""
    return np.clip((np.arange(edges) - parts + 1) / (edges - 2 * parts + 1), 0.0, 1.0)


def poses(own: list[Window], parts: int, rest: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Poses (times, windows, grips, 6) of grips of nodes, from where they rest (nodes, 3), at times [s] within the windows."""
    found = np.zeros((len(times), len(own), len(rest), 6))
    for world, window in enumerate(own):
        paths = held_paths(window, parts).reshape(len(window.times), -1)
        at = np.stack([np.interp(times, window.times, path) for path in paths.T], 1)
        found[:, world, :, :3] = at.reshape(len(times), -1, 3) - rest
    return found


def starts(model, own: list[Window], parts: int):
    """The state of a model with a world for each window, at its start."""
    points, velocities = (
        along(np.stack([getattr(window, name) for window in own]), parts) for name in ("points", "velocities")
    )
    rest = model.state()
    edges = polyline.unit(np.diff(points, axis=1))
    straight = polyline.unit(np.diff(rest.points().reshape(len(own), -1, 3), axis=1))
    reference = polyline.transport(rest.directors().reshape(straight.shape), straight, edges)
    carried = np.cumsum(polyline.reference_twist(edges, reference, False), axis=1)
    wanted = shares(edges.shape[1], parts) * np.array([window.twist for window in own])[:, None]
    angles = wanted - np.pad(carried, ((0, 0), (1, 0)))
    state = model.state(points, velocities, angles=angles)
    nodes, _ = held(len(own[0].points), parts)
    begin = poses(own, parts, rest.points().reshape(len(own), -1, 3)[0, nodes], np.zeros(1))
    state.grips.pose.assign(np.ascontiguousarray(begin.reshape(-1, 6).T))
    return state

"""Pictures with matplotlib: rods and surfaces at a few times, and errors in a double logarithmic diagram."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from ddg_warp.io import Shapes
from ddg_warp.io.colors import SCALE

DPI = 160
FLAT = 1e-3  # thickness over size below which rods are drawn in their plane
ELEVATION, AZIMUTH = 18.0, -58.0  # of the eye on solid scenes [degrees]
MARGIN = 0.06  # of the size, around the rods
GREY = "0.35"
LIGHT = np.array([-0.37, -0.56, 0.74])  # unit vector from the surfaces to the light
DARKEST = 0.55  # brightness of what the light grazes
TIME_COLORS = LinearSegmentedColormap.from_list("time", SCALE)
MARKERS = "osD^vP"


def rods_picture(
    rods, points_by_time: Mapping[float, np.ndarray] | Iterable[tuple[float, np.ndarray]], path, title: str = ""
) -> None:
    """Draws rods and surfaces at a few times, the latest on top; flat where they stay in a coordinate plane.

    Args:
        rods: A model, a `TrajectoryReader`, the curves of either, or a `CurveSet`.
        points_by_time: Time [s] and positions [m], (P, 3) or (worlds, P, 3), of each shape to draw.
        path: The picture to write; its suffix is the format.
        title: A line above.
    """
    curves = getattr(rods, "curves", rods)
    frames = sorted(dict(points_by_time).items())
    if not frames:
        raise ValueError("there is no shape to draw: give the points of at least one time")
    times = np.array([time for time, _ in frames])
    points = np.array([np.reshape(shape, (-1, 3)) for _, shape in frames], dtype=np.float64)
    surfaces = getattr(rods, "surfaces", None)
    worlds = points.shape[1] // Shapes.of(curves, surfaces).point_count
    shapes = Shapes.of(curves, surfaces, worlds)
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    flat = np.flatnonzero(high - low <= FLAT * np.max(high - low))
    axes = [k for k in range(3) if k != (flat[0] if len(flat) else None)]
    norm = Normalize(times[0], times[-1] if len(times) > 1 else times[0] + 1.0)
    figure = Figure(figsize=(7.0, 5.2), layout="constrained")
    plot = _flat_axes(figure, axes, low, high) if len(flat) else _solid_axes(figure, low, high)
    for time, shape in zip(times, points, strict=True):
        latest = time == times[-1]
        color = TIME_COLORS(norm(time)) if len(times) > 1 else TIME_COLORS(0.5)
        if surfaces is not None:
            _draw_triangles(plot, shape[shapes.surfaces.triangles][..., axes], color)
        if len(curves.counts):
            _draw_rods(plot, shape[shapes.rows][:, axes], shapes.curves, color, latest)
    _explain_times(figure, plot, times, norm)
    plot.figure.suptitle(textwrap.fill(title, 80), x=0.03, ha="left", fontsize=11)
    _save(figure, path)


def error_plot(
    path, rows: Iterable[Mapping], x: str, y: str, series: str, title: str = "", marked: Iterable[Mapping] = ()
) -> None:
    """Draws a table with logarithmic axes, one line for each value of a column.

    Args:
        path: The picture to write; its suffix is the format.
        rows: Rows of the table; those in which `x` or `y` is not positive are left out.
        x: Column along the horizontal axis, and its label.
        y: Column along the vertical axis, and its label.
        series: Column that tells the lines apart.
        title: A line above.
        marked: Rows of the scene's defaults, which a cross marks.
    """
    rows = [row for row in rows if (row[x] or 0.0) > 0.0 and (row[y] or 0.0) > 0.0]
    names = list(dict.fromkeys(row[series] for row in rows))
    figure = Figure(figsize=(6.0, 4.4), layout="constrained")
    plot = figure.add_subplot()
    for k, name in enumerate(names):
        line = sorted((row[x], row[y]) for row in rows if row[series] == name)
        color = TIME_COLORS(0.3 + 0.7 * k / max(1, len(names) - 1))
        marker = MARKERS[k % len(MARKERS)]
        plot.loglog(*zip(*line, strict=True), marker=marker, markersize=5, linewidth=1.4, color=color, label=str(name))
    for k, row in enumerate(row for row in marked if (row[y] or 0.0) > 0.0):
        plot.loglog(row[x], row[y], "x", color="k", markersize=9, markeredgewidth=1.8, label="" if k else "defaults")
    plot.set(xlabel=x, ylabel=y)
    plot.set_title(textwrap.fill(title, 80), loc="left", fontsize=11)
    plot.grid(which="major", color="0.85", linewidth=0.7)
    plot.grid(which="minor", color="0.94", linewidth=0.4)
    plot.spines[["top", "right"]].set_visible(False)
    if names:
        plot.legend(frameon=False, fontsize=9, title=series, title_fontsize=9)
    _save(figure, path)


def levels_plot(path, names: list[str], marks: Mapping[str, list], usual: list[float], errors: list[float]) -> None:
    """Draws times on a logarithmic axis, a line a name: a marker for each level reached, a cross for the defaults with its error.

    Args:
        path: The picture to write; its suffix is the format.
        names: One a line, the first on top.
        marks: Level -> time [s] of every name; None where it is not reached.
        usual: Times of the defaults [s].
        errors: Their relative errors.
    """
    figure = Figure(figsize=(7.5, 1.0 + 0.24 * len(names)), layout="constrained")
    plot, place = figure.add_subplot(), -np.arange(len(names))
    for k, (level, times) in enumerate(marks.items()):
        values = np.array([np.nan if time is None else time for time in times])
        color = TIME_COLORS(0.3 + 0.7 * k / max(1, len(marks) - 1))
        plot.semilogx(values, place, MARKERS[k], color=color, markersize=6 - k, label=level, alpha=0.85)
    plot.semilogx(usual, place, "x", color="k", markersize=6, label="defaults")
    for x, y, error in zip(usual, place, errors, strict=True):
        plot.annotate(f"{error:.0e}", (x, y), xytext=(5, -3), textcoords="offset points", fontsize=7, color=GREY)
    plot.set_yticks(place, names, fontsize=8)
    plot.set_xlabel("time [s]")
    plot.grid(color="0.92", linewidth=0.6)
    plot.spines[["top", "right"]].set_visible(False)
    plot.legend(frameon=False, fontsize=8, ncols=len(marks) + 1, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    _save(figure, path)


def path_plot(path, file, title: str = "") -> None:
    """Draws the load parameter over every watched displacement: full where stable, broken where not, special points marked.

    Args:
        path: A `ddg_warp.integrate.path.Path`.
        file: The picture to write; its suffix is the format.
        title: A line above.
    """
    figure = Figure(figsize=(6.0, 4.4), layout="constrained")
    plot = figure.add_subplot()
    names, load = list(path.points[0].values), path.load
    unstable = (path.negative[:-1] > 0) & (path.negative[1:] > 0)
    for k, name in enumerate(names):
        color, values = TIME_COLORS(0.3 + 0.7 * k / max(1, len(names))), path.values(name)
        for broken, style in ((False, "-"), (True, "--")):
            kept = np.flatnonzero(unstable == broken)
            runs = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1) if len(kept) else []
            segments = [np.column_stack([a[i[0] : i[-1] + 2] for a in (values, load)]) for i in runs]
            plot.add_collection(LineCollection(segments, colors=[color], linestyles=style, linewidths=1.4))
        plot.plot([], [], color=color, label=name)
        for kind, marker in (("limit point", "o"), ("bifurcation", "D")):
            special = path.of_kind(kind)
            plot.plot([p.values[name] for p in special], [p.load for p in special], marker, color=color, markersize=5)
    plot.autoscale()
    plot.set(xlabel="displacement [m]", ylabel="load parameter")
    plot.set_title(textwrap.fill(title, 80), loc="left", fontsize=11)
    plot.grid(color="0.9", linewidth=0.6)
    plot.spines[["top", "right"]].set_visible(False)
    if names:
        plot.legend(frameon=False, fontsize=9)
    _save(figure, file)


def _draw_rods(plot, points: np.ndarray, curves, color, latest: bool) -> None:
    """Adds polylines, in two or three dimensions."""
    kind = LineCollection if points.shape[-1] == 2 else Line3DCollection
    polylines = _polylines(points, curves.counts, curves.closed)
    lines = kind(polylines, colors=[color], linewidths=_line_width(len(curves.counts), latest))
    lines.set(capstyle="round", joinstyle="round")
    plot.add_collection(lines)


def _draw_triangles(plot, corners: np.ndarray, color) -> None:
    """Adds triangles, corners (T, 3, 2), or shaded ones, corners (T, 3, 3); thin lines close the gaps between them."""
    if corners.shape[-1] == 2:
        plot.add_collection(PolyCollection(corners, facecolors=[color], edgecolors=[color], linewidths=0.2))
        return
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.abs(vectors @ LIGHT) / np.maximum(np.linalg.norm(vectors, axis=1), np.finfo(float).tiny)
    shaded = np.tile(color, (len(corners), 1))
    shaded[:, :3] *= (DARKEST + (1.0 - DARKEST) * facing)[:, None]  # both sides alike
    plot.add_collection(Poly3DCollection(corners, facecolors=shaded, edgecolors=shaded, linewidths=0.2))


def _polylines(points: np.ndarray, counts: np.ndarray, closed: np.ndarray) -> list[np.ndarray]:
    """The polyline of each rod; a closed one returns to its first point."""
    lines = np.split(points, np.cumsum(counts)[:-1])
    return [np.vstack([line, line[:1]]) if shut else line for line, shut in zip(lines, closed, strict=True)]


def _line_width(rod_count: int, latest: bool) -> float:
    """Line width in points: thin for many rods, and for shapes of the past."""
    few = np.interp(np.log10(rod_count), [0.0, 1.0, 3.0], [2.2, 1.4, 0.45])
    return few if latest else 0.7 * few


def _flat_axes(figure: Figure, axes: list[int], low: np.ndarray, high: np.ndarray):
    plot = figure.add_subplot(aspect="equal")
    margin = MARGIN * np.max(high - low)
    limits = [(low[k] - margin, high[k] + margin) for k in axes]
    names = [f"{'xyz'[k]} [m]" for k in axes]
    plot.set(xlim=limits[0], ylim=limits[1], xlabel=names[0], ylabel=names[1])
    plot.grid(color="0.92", linewidth=0.6)
    plot.set_axisbelow(True)
    plot.spines[["top", "right"]].set_visible(False)
    return plot


def _solid_axes(figure: Figure, low: np.ndarray, high: np.ndarray):
    plot = figure.add_subplot(projection="3d", computed_zorder=False)
    plot.set_proj_type("ortho")
    plot.view_init(elev=ELEVATION, azim=AZIMUTH)
    margin = MARGIN * np.max(high - low)
    limits = np.stack([low - margin, high + margin], axis=1)
    plot.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    sides = limits[:, 1] - limits[:, 0]
    plot.set_box_aspect(sides, zoom=min(1.0, _seen_height(np.ones(3)) / _seen_height(sides)))
    for axis, name in zip((plot.xaxis, plot.yaxis, plot.zaxis), "xyz", strict=True):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.set_label_text(f"{name} [m]", fontsize=9)
        axis.set_major_locator(_few_ticks())
        axis._axinfo["grid"].update(color="0.9", linewidth=0.5)
    plot.tick_params(labelsize=8, colors=GREY)
    return plot


def _seen_height(sides: np.ndarray) -> float:
    """Height at which a box is seen, over its diagonal, which is what matplotlib keeps."""
    elevation, azimuth = np.radians([ELEVATION, AZIMUTH])
    seen = np.abs([np.cos(azimuth) * np.sin(elevation), np.sin(azimuth) * np.sin(elevation), np.cos(elevation)])
    return float(seen @ sides / np.linalg.norm(sides))


def _few_ticks():
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=4)


def _explain_times(figure: Figure, plot, times: np.ndarray, norm: Normalize) -> None:
    """A color bar with a tick at each time drawn."""
    if len(times) == 1:
        return
    gap = 0.10 if plot.name == "3d" else 0.03  # room for the label of the z axis
    bar = figure.colorbar(ScalarMappable(norm, TIME_COLORS), ax=plot, shrink=0.6, aspect=28, pad=gap)
    bar.set_label("time [s]", fontsize=9)
    bar.set_ticks(times, labels=[f"{time:.3g}" for time in times])
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)


def _save(figure: Figure, path) -> None:
    """Writes a figure without touching pyplot, whose state belongs to the user."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=DPI)

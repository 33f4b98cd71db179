"""Pictures with matplotlib: rods and surfaces at a few times, and errors in a double logarithmic diagram."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from ddg_warp.io.colors import SCALE
from ddg_warp.io.shapes import Shapes

DPI = 160
FLAT = 1e-3  # largest thickness over size of flat shapes
ELEVATION, AZIMUTH = 18.0, -58.0  # of the eye [degrees]
WIDEST = 0.72  # largest visible width over diagonal of a box in a panel
MARGIN = 0.06  # of the size, around the rods
FIELD_COLOR = "#c9bfd6"
ARROWS = {2: 9, 3: 4}  # of a field along the longest side of a picture, by its dimension
GREY = "0.35"
LIGHT_GREY = (0.78, 0.78, 0.78, 1.0)
CLOSE = 1.45  # zoom of a solid scene without axes
TITLE = 11  # letters of a title in an inch
STABILITY = {"stable": (False, "-"), "unstable": (True, "--")}
SPECIAL = {"limit point": "o", "bifurcation": "D"}
LIGHT = np.array([-0.37, -0.56, 0.74])  # unit vector from the surfaces to the light
DARKEST = 0.55  # brightness at grazing light
TIME_COLORS = LinearSegmentedColormap.from_list("time", SCALE)
MARKERS = "osD^vP"


def rods_picture(
    rods,
    points_by_time: Mapping[float, np.ndarray] | Iterable[tuple[float, np.ndarray]],
    path,
    title: str = "",
    *,
    label: str = "time [s]",
    names: list[str] | None = None,
    unit: str = "m",
    values: np.ndarray | None = None,
    colors: np.ndarray | None = None,
    bodies: Mapping[float, tuple[np.ndarray, ...]] | None = None,
    lines: bool = True,
    side_by_side: bool = False,
    field: Callable[[np.ndarray], np.ndarray] | None = None,
) -> None:
    """Draw rods and surfaces at a few times, the last on top; flat if all lie in a coordinate plane.

    Args:
        rods: A model, a `TrajectoryReader`, the curves of either, or a `CurveSet`.
        points_by_time: Time [s], or the quantity of `label`, and positions, (P, 3) or (worlds, P, 3), of each shape. A mapping is
            drawn in the order of time, pairs in the given order.
        path: The picture to write; its suffix is the format.
        title: A line above.
        label: Name and unit of the quantity that distinguishes the shapes.
        names: Names of the shapes, in order, shown instead of times.
        unit: Unit of lengths.
        values: A number at each point, shape (P,) of all worlds, to color the latest shape; `label` is then its name.
        colors: RGB of each rod, shape (R, 3), instead of a color a time.
        bodies: Other surfaces at each time: points (n, 3) and triangles (t, 3), grey, or with RGB of each (t, 3).
        lines: Whether rods are drawn as lines; False where bodies show them with their thickness.
        side_by_side: Whether every shape has a panel.
        field: Vectors (n, 3) at points (n, 3), drawn as arrows behind the latest shape; the largest is as long as the grid spacing.
    """
    curves = getattr(rods, "curves", rods)
    frames = sorted(points_by_time.items()) if isinstance(points_by_time, Mapping) else list(points_by_time)
    if not frames:
        raise ValueError("there is no shape to draw: give the points of at least one time")
    times = np.array([time for time, _ in frames])
    points = np.array([np.reshape(shape, (-1, 3)) for _, shape in frames], dtype=np.float64)
    surfaces = getattr(rods, "surfaces", None)
    worlds = points.shape[1] // Shapes.of(curves, surfaces).point_count
    shapes = Shapes.of(curves, surfaces, worlds)
    extents = np.concatenate([points.reshape(-1, 3), *(body for body, *_ in (bodies or {}).values())])
    low, high = extents.min(axis=0), extents.max(axis=0)
    flat = np.flatnonzero(high - low <= FLAT * np.max(high - low))
    axes = [k for k in range(3) if k != (flat[0] if len(flat) else None)]
    norm = Normalize(times.min(), times.max() if np.ptp(times) > 0.0 else times[0] + 1.0)
    if values is not None:
        norm = Normalize(np.nanmin(values), np.nanmax(values))
    panels = len(times) if side_by_side else 1
    figure = Figure(figsize=(7.0 if panels == 1 else 3.2 * panels, 5.2 if panels == 1 else 3.6), layout="constrained")
    plots = [
        (_flat_axes if len(flat) else _solid_axes)(figure, axes, low, high, unit, (1, panels, k + 1))
        for k in range(panels)
    ]
    for number, (time, shape) in enumerate(zip(times, points, strict=True)):
        plot, latest = plots[number % panels], side_by_side or number == len(times) - 1
        if field is not None and latest:
            _draw_field(plot, axes, low, high, field)
        color = TIME_COLORS(norm(time)) if len(times) > 1 else TIME_COLORS(0.5)
        if values is not None:
            color = TIME_COLORS(norm(values)) if latest else LIGHT_GREY
        if time in (bodies or {}):
            body, triangles, *shades = bodies[time]
            shade = to_rgba_array(shades[0]) if shades else LIGHT_GREY
            _draw_triangles(plot, body[triangles][..., axes], shade)
        if surfaces is not None:
            faces = shapes.surfaces.triangles
            shade = color[faces].mean(axis=1) if np.ndim(color) == 2 else color
            _draw_triangles(plot, shape[faces][..., axes], shade)
        if lines and len(curves.counts):
            shade = color[shapes.rows] if np.ndim(color) == 2 else color
            _draw_rods(plot, shape[shapes.rows][:, axes], shapes.curves, shade if colors is None else colors, latest)
        if side_by_side:
            plot.set_axis_off()
            if not len(flat):
                sides = np.ptp([plot.get_xlim(), plot.get_ylim(), plot.get_zlim()], axis=1)
                plot.set_box_aspect(sides, zoom=CLOSE * min(_to_fit(sides), WIDEST / _seen(sides)[0]))
            text = f"{label.partition(' [')[0]} {time:.3g} {label.partition('[')[2].rstrip(']')}"
            plot.set_title(text if names is None else names[number], fontsize=9, color=GREY)
    if not side_by_side:
        _explain_times(figure, plots[0], times, norm, label, values, names)
    figure.suptitle(textwrap.fill(title, round(TITLE * figure.get_figwidth())), x=0.03, ha="left", fontsize=11)
    _save(figure, path)


def error_plot(
    path, rows: Iterable[Mapping], x: str, y: str, series: str, title: str = "", marked: Iterable[Mapping] = ()
) -> None:
    """Draw a table with logarithmic axes, one line for each value of a column.

    Args:
        path: The picture to write; its suffix is the format.
        rows: Rows of the table; rows without positive `x` and `y` are left out.
        x: Column along the horizontal axis, and its label.
        y: Column along the vertical axis, and its label.
        series: Column that distinguishes the lines.
        title: A line above.
        marked: Rows of the scene's defaults, marked by a cross.
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
    """Draw times on a logarithmic axis, a row a name: markers for levels, crosses for defaults.

    Args:
        path: The picture to write; its suffix is the format.
        names: Names of the rows, the first on top.
        marks: Level -> time [s] of every name, None if the level is not reached.
        usual: Times of the defaults [s].
        errors: Relative errors of the defaults.
    """
    figure = Figure(figsize=(7.5, 1.0 + 0.24 * len(names)), layout="constrained")
    plot, height = figure.add_subplot(), -np.arange(len(names))
    for k, (level, times) in enumerate(marks.items()):
        values = np.array([np.nan if time is None else time for time in times])
        color = TIME_COLORS(0.3 + 0.7 * k / max(1, len(marks) - 1))
        plot.semilogx(values, height, MARKERS[k], color=color, markersize=6 - k, label=level, alpha=0.85)
    plot.semilogx(usual, height, "x", color="k", markersize=6, label="defaults")
    for x, y, error in zip(usual, height, errors, strict=True):
        plot.annotate(f"{error:.0e}", (x, y), xytext=(5, -3), textcoords="offset points", fontsize=7, color=GREY)
    plot.set_yticks(height, names, fontsize=8)
    plot.set_xlabel("time [s]")
    plot.grid(color="0.92", linewidth=0.6)
    plot.spines[["top", "right"]].set_visible(False)
    plot.legend(frameon=False, fontsize=8, ncols=len(marks) + 1, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    _save(figure, path)


def lines_plot(path, lines: Iterable[tuple], x: str, y: str, title: str = "", log: bool = False) -> None:
    """Draw lines over one axis, equal labels in one color.

    Args:
        path: The picture to write; its suffix is the format.
        lines: Label, x values, y values and style of each: one of matplotlib's lines ("-") or markers ("o").
        x, y: Labels of the axes, with units.
        title: A line above.
        log: Whether the vertical axis is logarithmic.
    """
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    plot, lines = figure.add_subplot(), list(lines)
    labels = list(dict.fromkeys(label for label, *_ in lines))
    shown = set()
    for label, along, values, style in lines:
        color = TIME_COLORS(0.25 + 0.7 * labels.index(label) / max(1, len(labels) - 1))
        legend = label if label not in shown else None
        plot.plot(along, values, style, color=color, markersize=3.5, linewidth=1.5, alpha=0.9, label=legend)
        shown.add(label)
    plot.set(xlabel=x, ylabel=y, yscale="log" if log else "linear")
    plot.set_title(textwrap.fill(title, 80), loc="left", fontsize=11)
    plot.grid(color="0.92", linewidth=0.6)
    plot.spines[["top", "right"]].set_visible(False)
    plot.legend(frameon=False, fontsize=9)
    _save(figure, path)


def path_plot(path, file, title: str = "", unit: str = "m") -> None:
    """Draw the load parameter over watched displacements: full lines stable, broken ones unstable, special points marked.

    Args:
        path: A `ddg_warp.scene.equilibrium_path.Path`.
        file: The picture to write; its suffix is the format.
        title: A line above.
        unit: Unit of displacements.
    """
    figure = Figure(figsize=(6.0, 4.4), layout="constrained")
    plot = figure.add_subplot()
    names, load = list(path.points[0].values), path.load
    unstable = _unstable(path)
    kinds = {kind: marker for kind, marker in SPECIAL.items() if path.of_kind(kind)}
    for k, name in enumerate(names):
        color, values = TIME_COLORS(0.3 + 0.7 * k / max(1, len(names))), path.values(name)
        for broken, style in STABILITY.values():
            kept = np.flatnonzero(unstable == broken)
            runs = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1) if len(kept) else []
            segments = [np.column_stack([a[i[0] : i[-1] + 2] for a in (values, load)]) for i in runs]
            plot.add_collection(LineCollection(segments, colors=[color], linestyles=style, linewidths=1.6))
        plot.plot([], [], color=color, label=name)
        for kind, marker in kinds.items():
            special = path.of_kind(kind)
            plot.plot([p.values[name] for p in special], [p.load for p in special], marker, color=color, markersize=5)
    for text, (broken, style) in STABILITY.items():
        if (unstable == broken).any():
            plot.plot([], [], color=GREY, linestyle=style, label=text)
    for kind, marker in kinds.items():
        plot.plot([], [], marker, color=GREY, markersize=5, label=kind)
    plot.autoscale()
    plot.ticklabel_format(useOffset=False)
    plot.set(xlabel=f"displacement [{unit}]", ylabel="load parameter")
    plot.set_title(textwrap.fill(title, round(TITLE * figure.get_figwidth())), loc="left", fontsize=11)
    plot.grid(color="0.9", linewidth=0.6)
    plot.spines[["top", "right"]].set_visible(False)
    plot.legend(frameon=False, fontsize=9)
    _save(figure, file)


def _unstable(path) -> np.ndarray:
    """Return the mask of unstable segments of a path; special points, where stability changes, do not count."""
    regular = np.array([point.kind not in SPECIAL for point in path.points])
    negative = np.asarray(path.negative) > 0
    either = (negative & regular)[:-1] | (negative & regular)[1:]
    return np.where(regular[:-1] | regular[1:], either, negative[:-1] & negative[1:])


def _draw_rods(plot, points: np.ndarray, curves, color, latest: bool) -> None:
    """Add polylines in two or three dimensions."""
    kind = LineCollection if points.shape[-1] == 2 else Line3DCollection
    polylines = _polylines(points, curves.counts, curves.closed)
    if len(color) == len(points) and np.ndim(color) == 2:  # a color at every point: draw edge by edge
        shades = _polylines(np.asarray(color), curves.counts, curves.closed)
        color = np.concatenate([0.5 * (shade[1:] + shade[:-1]) for shade in shades])
        polylines = [edge for line in polylines for edge in np.stack([line[:-1], line[1:]], axis=1)]
    lines = kind(
        polylines, colors=color if np.ndim(color) == 2 else [color], linewidths=_line_width(len(curves.counts), latest)
    )
    lines.set(capstyle="round", joinstyle="round")
    plot.add_collection(lines)


def _draw_field(plot, axes: list[int], low: np.ndarray, high: np.ndarray, field) -> None:
    """Add arrows on a grid that fills the box."""
    size = np.max(high - low)
    step = (1.0 + 2.0 * MARGIN) * size / ARROWS[len(axes)]
    middle = 0.5 * (low + high)
    grid = list(middle[:, None])
    for k in axes:
        count = max(1, round((high[k] - low[k] + 2.0 * MARGIN * size) / step))
        grid[k] = middle[k] + step * (np.arange(count) - 0.5 * (count - 1))
    points = np.stack(np.meshgrid(*grid, indexing="ij"), -1).reshape(-1, 3)
    vectors = np.asarray(field(points), float)
    longest = np.linalg.norm(vectors[:, axes], axis=1).max()
    if longest == 0.0:
        return
    vectors = 0.8 * step / longest * vectors
    starts = (points - 0.5 * vectors)[:, axes]
    style = {"color": FIELD_COLOR, "zorder": 0}
    if len(axes) == 2:
        plot.quiver(*starts.T, *vectors[:, axes].T, angles="xy", scale_units="xy", scale=1.0, width=0.004, **style)
    else:
        plot.quiver(*starts.T, *vectors.T, linewidth=0.8, arrow_length_ratio=0.25, **style)


def _draw_triangles(plot, corners: np.ndarray, color) -> None:
    """Add triangles, corners (T, 3, 2), or shaded ones, corners (T, 3, 3); thin edges close gaps."""
    if corners.shape[-1] == 2:
        each = color if np.ndim(color) == 2 else [color]
        plot.add_collection(PolyCollection(corners, facecolors=each, edgecolors=each, linewidths=0.2))
        return
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.abs(vectors @ LIGHT) / np.maximum(np.linalg.norm(vectors, axis=1), np.finfo(float).tiny)
    shaded = np.array(np.broadcast_to(color, (len(corners), 4)))
    shaded[:, :3] *= (DARKEST + (1.0 - DARKEST) * facing)[:, None]  # both sides alike
    plot.add_collection(Poly3DCollection(corners, facecolors=shaded, edgecolors=shaded, linewidths=0.2))


def _polylines(points: np.ndarray, counts: np.ndarray, closed: np.ndarray) -> list[np.ndarray]:
    """Return the polyline of each rod; a closed one ends at its first point."""
    lines = np.split(points, np.cumsum(counts)[:-1])
    return [np.vstack([line, line[:1]]) if shut else line for line, shut in zip(lines, closed, strict=True)]


def _line_width(rod_count: int, latest: bool) -> float:
    """Return the line width in points: thin for many rods and for earlier shapes."""
    few = np.interp(np.log10(rod_count), [0.0, 1.0, 3.0], [2.2, 1.4, 0.45])
    return few if latest else 0.7 * few


def _flat_axes(figure: Figure, axes: list[int], low: np.ndarray, high: np.ndarray, unit: str, place):
    plot = figure.add_subplot(*place, aspect="equal")
    margin = MARGIN * np.max(high - low)
    limits = [(low[k] - margin, high[k] + margin) for k in axes]
    names = [f"{'xyz'[k]} [{unit}]" for k in axes]
    plot.set(xlim=limits[0], ylim=limits[1], xlabel=names[0], ylabel=names[1])
    plot.ticklabel_format(useOffset=False)
    plot.grid(color="0.92", linewidth=0.6)
    plot.set_axisbelow(True)
    plot.spines[["top", "right"]].set_visible(False)
    return plot


def _solid_axes(figure: Figure, axes: list[int], low: np.ndarray, high: np.ndarray, unit: str, place):
    plot = figure.add_subplot(*place, projection="3d", computed_zorder=False)
    plot.set_proj_type("ortho")
    plot.view_init(elev=ELEVATION, azim=AZIMUTH)
    margin = MARGIN * np.max(high - low)
    limits = np.stack([low - margin, high + margin], axis=1)
    plot.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    sides = limits[:, 1] - limits[:, 0]
    plot.set_box_aspect(sides, zoom=_to_fit(sides))
    lengths = sides / sides.max()
    for axis, name, relative in zip((plot.xaxis, plot.yaxis, plot.zaxis), "xyz", lengths, strict=True):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.set_label_text(f"{name} [{unit}]", fontsize=9)
        axis.get_major_formatter().set_useOffset(False)
        axis.set_major_locator(MaxNLocator(nbins=max(2, round(4.0 * relative))))  # labels of short axes do not overlap
        axis._axinfo["grid"].update(color="0.9", linewidth=0.5)
    plot.tick_params(labelsize=8, colors=GREY)
    return plot


def _to_fit(sides: np.ndarray) -> float:
    """Return the zoom that fits a box into the height of matplotlib's cube, at most 1."""
    return min(1.0, _seen(np.ones(3))[1] / _seen(sides)[1])


def _seen(sides: np.ndarray) -> np.ndarray:
    """Return visible width and height of a box over the diagonal, the length that matplotlib normalises."""
    elevation, azimuth = np.radians([ELEVATION, AZIMUTH])
    wide = [np.sin(azimuth), np.cos(azimuth), 0.0]
    high = [np.cos(azimuth) * np.sin(elevation), np.sin(azimuth) * np.sin(elevation), np.cos(elevation)]
    return np.abs([wide, high]) @ sides / np.linalg.norm(sides)


def _explain_times(figure: Figure, plot, times: np.ndarray, norm: Normalize, label: str, values, names) -> None:
    """Add a color bar with a tick at each drawn time, or of the values of the latest shape."""
    if len(times) == 1 and values is None:
        return
    gap = 0.10 if plot.name == "3d" else 0.03  # room for the label of the z axis
    bar = figure.colorbar(ScalarMappable(norm, TIME_COLORS), ax=plot, shrink=0.6, aspect=28, pad=gap)
    if names is None or values is not None:
        bar.set_label(label, fontsize=9)
    if values is None:
        bar.set_ticks(times, labels=names or [f"{time:.3g}" for time in times])
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)


def _save(figure: Figure, path) -> None:
    """Write a figure without pyplot, which has global state."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=DPI)

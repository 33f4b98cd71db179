"""Pictures with matplotlib: rods and surfaces at a few times, and errors in a double logarithmic diagram."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ddg_warp.io.colors import CONTACT
from ddg_warp.io.contact_records import Contacts
from ddg_warp.io.shapes import Shapes
from ddg_warp.run.panel import DPI, GREY, LOAD, MARGIN, TIME_COLORS, Panel, RenderedPanel
from ddg_warp.run.render import View, available
from ddg_warp.view.drawing import Drawing, directions, largest_force
from ddg_warp.view.drawing import arrows as contact_arrows

FLAT = 1e-3  # largest thickness over size of flat shapes
ELEVATION, AZIMUTH = 18.0, -58.0  # of the eye [degrees]
WIDTH, TALLEST = 7.0, 6.0  # of a picture and of its shapes [inches]
LETTERS = 34  # of the labels of a legend with two columns at most
NAME, LINE = 26, 0.17  # letters in a line of the name of a panel, and the height of a line [inches]
PLOT, BAR, HEADER = 2.5, 0.6, 0.75  # heights of a chart, of a color bar below shapes, and the title [inches]
SHARE = 0.58  # width of shapes left of a chart over the width of the picture
STACKED = 1.9  # width over height of shapes above which a chart is below
NARROWEST_AND_WIDEST = (0.5, 3.5)  # width over height of shapes
RULER = 0.5  # height of the strip for scale bar and triad [inches]
CENTERED = 1.15  # gain in scale from which panels are centered each on its shape
ARROW = 0.15  # length of the longest arrow over the size
TICKS = (0.05, 0.16)  # least distance of ticks over the range, upright and level
ARROWS = {2: 9, 3: 4}  # of a field along the longest side of a picture, by its dimension
LIGHT_GREY = (0.78, 0.78, 0.78, 1.0)
TITLE = 11  # letters of a title in an inch
STABILITY = {"stable": (False, "-"), "unstable": (True, "--")}
SPECIAL = {"limit point": "o", "bifurcation": "D"}
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
    obstacles: Mapping[float, tuple[np.ndarray, np.ndarray]] | None = None,
    thick: bool = False,
    side_by_side: bool = False,
    field: Callable[[np.ndarray], np.ndarray] | None = None,
    fixed: np.ndarray | None = None,
    loads: tuple[np.ndarray, np.ndarray] | None = None,
    contacts: Contacts | None = None,
    angles: tuple[float, float] = (ELEVATION, AZIMUTH),
    note: str = "",
    chart=None,
) -> None:
    """Draw rods and surfaces at a few times, the last on top; flat if all lie in a coordinate plane.

    Solid scenes are shaded with true depth if pyvista is installed, else drawn with matplotlib.

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
        obstacles: Closed surfaces and planes at each time, points and triangles; pyvista leaves out their inside.
        thick: Whether rods of flat scenes and of matplotlib have their thickness, too; pyvista shows it anyway.
        side_by_side: Whether every shape has a panel.
        field: Vectors (n, 3) at points (n, 3), drawn as arrows behind the latest shape; the largest is as long as the grid spacing.
        fixed: Rows of points of the latest shape to mark as fixed.
        loads: Rows of points (n,) and forces there (n, 3), drawn at the latest shape.
        contacts: Pairs in contact, whose forces are drawn.
        angles: Elevation and azimuth of the eye [degrees].
        note: A small line below.
        chart: Arguments of `lines_plot`, such as force against displacement, or a followed path, drawn on the right or below.
    """
    curves = getattr(rods, "curves", rods)
    if curves.radius is None:
        curves = replace(curves, radius=np.zeros(np.sum(curves.counts)))
    frames = sorted(points_by_time.items()) if isinstance(points_by_time, Mapping) else list(points_by_time)
    if not frames:
        raise ValueError("there is no shape to draw: give the points of at least one time")
    times = np.array([time for time, _ in frames])
    points = np.array([np.reshape(shape, (-1, 3)) for _, shape in frames], dtype=np.float64)
    surfaces = getattr(rods, "surfaces", None)
    worlds = points.shape[1] // max(1, Shapes.of(curves, surfaces).point_count)
    shapes = Shapes.of(curves, surfaces, worlds)
    shown = [(time, body, body is obstacles) for body in (bodies, obstacles) for time in (body or {}) if time in times]
    shown = [(time, *each[time], closed) for time, each, closed in shown]
    extents = np.concatenate([points.reshape(-1, 3), *(body for _, body, *_ in shown)])
    low, high = extents.min(axis=0), extents.max(axis=0)
    size = float(np.max(high - low))
    flat = np.flatnonzero(high - low <= FLAT * size)
    axes = [k for k in range(3) if k != (flat[0] if len(flat) else None)]
    arrows = _force_arrows(points[-1], shapes, ARROW * size, loads, contacts)
    norm = Normalize(times.min(), times.max() if np.ptp(times) > 0.0 else times[0] + 1.0)
    if values is not None:
        norm = Normalize(np.nanmin(values), np.nanmax(values))
    rendered = len(axes) == 3 and available()
    tips = [ends.reshape(-1, 3) for ends in arrows.values()]
    count = len(times) if side_by_side else 1
    contents = [np.concatenate([extents, *tips])]
    if side_by_side:
        contents = [
            np.concatenate([shape, *(body for when, body, *_ in shown if when == time)])
            for time, shape in zip(times, points, strict=True)
        ]
    low, high = (bound(np.concatenate(contents), axis=0) for bound in (np.min, np.max))
    thickest = float(np.max(curves.radius, initial=0.0))
    views = _views(contents, thickest, np.radians(angles), chart is not None) if rendered else None
    figure, cells, chart_cell, across = _layout(count, views and views[0], axes, low, high, chart, names)
    if rendered:
        drawing = Drawing(curves, surfaces, worlds, points[0])
        width = round(DPI * across)
        panels = [
            RenderedPanel(figure, cell, view, drawing, unit, (width, across))
            for cell, view in zip(cells, views, strict=True)
        ]
    else:
        panels = [Panel(figure, cell, axes, low, high, unit, angles) for cell in cells]
    for number, (time, shape) in enumerate(zip(times, points, strict=True)):
        panel, latest = panels[number % count], side_by_side or number == len(times) - 1
        if field is not None and latest:
            panel.field(_field_arrows(axes, low, high, field))
        color = TIME_COLORS(norm(time)) if len(times) > 1 else TIME_COLORS(0.5)
        if values is not None:
            color = TIME_COLORS(norm(values)) if latest else LIGHT_GREY
        for _, body, triangles, *shades, closed in (each for each in shown if each[0] == time):
            panel.triangles(body, triangles, shades[0] if shades else LIGHT_GREY, closed=closed)
        if surfaces is not None:
            panel.surfaces(shape, shapes, color, latest)
        if len(curves.counts):
            shade = color[shapes.rows] if np.ndim(color) == 2 else color
            panel.rods(shape, shapes, shade if colors is None else colors, latest, thick)
        if latest and fixed is not None and len(fixed):
            panel.marks(shape[fixed])
        if side_by_side:
            panel.bare()
            text = f"{label.partition(' [')[0]} {time:.3g} {label.partition('[')[2].rstrip(']')}"
            panel.plot.set_title(text if names is None else textwrap.fill(names[number], NAME), fontsize=9, color=GREY)
    for color, ends in arrows.items():
        panels[-1].arrows(ends, color)
    for number, panel in enumerate(panels):
        panel.finish(ruler=number == 0)
    if not side_by_side or values is not None:
        _explain_times(figure, panels, times, norm, label, values, names, across < WIDTH / count)
    if isinstance(chart, Mapping):
        _draw_lines(figure.add_subplot(chart_cell), **{"title": "", "log": False, **chart})
    elif chart is not None:
        _draw_path(figure.add_subplot(chart_cell), chart, unit)
    notes = {
        note: bool(note),
        "dark dots: fixed nodes": fixed is not None and len(fixed),
        "green arrows: applied forces": LOAD in arrows,
        f"red arrows: contact forces of pairs, largest {largest_force(contacts):.3g} N": CONTACT in arrows,
    }
    if any(notes.values()):
        text = "; ".join(text for text, applies in notes.items() if applies)
        figure.supxlabel(text, fontsize=8, color=GREY, x=0.03, ha="left")
    figure.suptitle(textwrap.fill(title, round(TITLE * figure.get_figwidth())), x=0.03, ha="left", fontsize=11)
    _save(figure, path)


def _force_arrows(points: np.ndarray, shapes: Shapes, longest: float, loads, contacts) -> dict[tuple, np.ndarray]:
    """Return arrows (n, 2, 3) of applied and of contact forces by color, the largest as long as `longest` [m]."""
    arrows = {}
    if loads is not None and len(loads[0]):
        rows, forces = loads
        pushed = np.isin(rows, shapes.rows, invert=True)[:, None]  # arrows onto surfaces end there
        vectors = longest / np.linalg.norm(forces, axis=1).max() * forces
        arrows[LOAD] = np.stack([-vectors * pushed, vectors * ~pushed], 1) + points[rows, None]
    if largest := largest_force(contacts):
        arrows[CONTACT] = contact_arrows(contacts, longest / largest)
    return arrows


def _views(contents: list[np.ndarray], radius: float, angles, charted: bool) -> list[View]:
    """Return a view of each content, points (n, 3) with a radius [m], of one scale, with a strip for the ruler.

    Views are the same, unless views each centered on its content are much larger.
    """
    room = WIDTH * (SHARE if charted else 1.0) / len(contents)
    bounds = (max(NARROWEST_AND_WIDEST[0], min(1.0, room / TALLEST)), NARROWEST_AND_WIDEST[1])
    views = [View.fitted(points, directions(*angles), bounds, radius) for points in contents]
    half = 0.5 * np.max([view.size for view in views], axis=0)
    whole = View.fitted(np.concatenate(contents), directions(*angles), bounds, radius)
    if whole.size[0] < CENTERED * 2.0 * half[0]:
        views, half = [whole] * len(views), 0.5 * whole.size
    centers = [0.5 * (view.low + view.high) for view in views]
    strip = [0.0, RULER / room * 2.0 * half[0]]
    return [
        replace(view, low=center - half - strip, high=center + half)
        for view, center in zip(views, centers, strict=True)
    ]


def _layout(count: int, view: View | None, axes: list[int], low, high, chart, names):
    """Return a figure, grid cells of its panels and of the chart right of or below them, and a panel's width [inches]."""
    aspect = view.aspect if view else 1.3
    if len(axes) == 2:
        sides = (high - low)[axes] + 2.0 * MARGIN * np.max(high - low)
        aspect = float(np.clip(sides[0] / sides[1], *NARROWEST_AND_WIDEST))
    wide = chart is not None and (aspect > STACKED or (view is None and len(axes) == 3))  # labels at the right, too
    across = WIDTH * (1.0 if chart is None or wide else SHARE) / count
    height = float(np.clip(across / aspect, 1.3, TALLEST)) + (0.5 if view is None else 0.0)
    total = (max(height + BAR, PLOT) if chart is not None and not wide else height + PLOT * wide) + HEADER
    total += LINE * max((len(textwrap.wrap(name, NAME)) for name in names or []), default=0) * (count > 1)
    figure = Figure(figsize=(WIDTH, total), layout="constrained")
    if chart is None:
        return figure, list(figure.add_gridspec(1, count)), None, across
    if wide:
        outer = figure.add_gridspec(2, 1, height_ratios=[height, PLOT])
    else:
        outer = figure.add_gridspec(1, 2, width_ratios=[SHARE, 1.0 - SHARE])
    return figure, list(outer[0].subgridspec(1, count)), outer[1], across


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
    """Draw errors of defaults, and times of defaults and to each level, on logarithmic axes side by side, a row a name.

    Args:
        path: The picture to write; its suffix is the format.
        names: Names of the rows, the first on top.
        marks: Level -> time [s] of every name, None if the level is not reached.
        usual: Times of the defaults [s].
        errors: Relative errors of the defaults, NaN where unknown.
    """
    figure = Figure(figsize=(8.0, 1.0 + 0.2 * len(names)), layout="constrained")
    (error_axes, time_axes), height = figure.subplots(1, 2, sharey=True), -np.arange(len(names))
    error_axes.semilogx(errors, height, "x", color="k", markersize=5)
    for k, (level, times) in enumerate(marks.items()):
        values = np.array([np.nan if time is None else time for time in times])
        color = TIME_COLORS(0.3 + 0.7 * k / max(1, len(marks) - 1))
        time_axes.semilogx(values, height, MARKERS[k], color=color, markersize=6 - k, label=f"to {level}", alpha=0.85)
    time_axes.semilogx(usual, height, "x", color="k", markersize=5, label="defaults")
    error_axes.set_yticks(height, names, fontsize=7.5)
    error_axes.set_ylim(height[-1] - 0.8, 0.8)
    error_axes.set_xlabel("relative error of the defaults")
    time_axes.set_xlabel("time [s]")
    for plot in (error_axes, time_axes):
        low, high = np.log10(plot.get_xlim())
        plot.set_xlim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))
        plot.xaxis.set_minor_formatter(NullFormatter())
        plot.grid(color="0.92", linewidth=0.6)
        plot.set_axisbelow(True)
        plot.tick_params(axis="y", length=0, labelleft=plot is error_axes)
        plot.spines[["top", "right", "left"]].set_visible(False)
    figure.legend(frameon=False, fontsize=8, ncols=len(marks) + 1, loc="outside upper right")
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
    _draw_lines(figure.add_subplot(), lines, x, y, title, log)
    _save(figure, path)


def _draw_lines(plot, lines: Iterable[tuple], x: str, y: str, title: str, log: bool) -> None:
    """Draw lines into axes; see `lines_plot`."""
    lines = list(lines)
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
    if labels != [""]:
        _legend(plot)


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
    _draw_path(plot, path, unit)
    plot.set_title(textwrap.fill(title, round(TITLE * figure.get_figwidth())), loc="left", fontsize=11)
    _save(figure, file)


def _draw_path(plot, path, unit: str) -> None:
    """Draw a path into axes; see `path_plot`."""
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
    plot.ticklabel_format(useOffset=False, scilimits=(-2, 5))
    plot.locator_params(axis="x", nbins=5)
    plot.set(xlabel=f"displacement [{unit}]", ylabel="load parameter")
    plot.grid(color="0.9", linewidth=0.6)
    plot.spines[["top", "right"]].set_visible(False)
    _legend(plot)


def _legend(plot) -> None:
    """Add a legend above axes, where it covers nothing."""
    columns = 2 if sum(map(len, plot.get_legend_handles_labels()[1])) <= LETTERS else 1
    position = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2}
    plot.legend(frameon=False, fontsize=8, ncols=columns, columnspacing=1.0, **position)


def _unstable(path) -> np.ndarray:
    """Return the mask of unstable segments of a path; special points, where stability changes, do not count."""
    regular = np.array([point.kind not in SPECIAL for point in path.points])
    negative = np.asarray(path.negative) > 0
    either = (negative & regular)[:-1] | (negative & regular)[1:]
    return np.where(regular[:-1] | regular[1:], either, negative[:-1] & negative[1:])


def _field_arrows(axes: list[int], low: np.ndarray, high: np.ndarray, field) -> np.ndarray:
    """Return arrows (n, 2, 3) of a field on a grid that fills the box."""
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
        return np.zeros((0, 2, 3))
    vectors = 0.8 * step / longest * vectors
    return np.stack([points - 0.5 * vectors, points + 0.5 * vectors], 1)


def _explain_times(
    figure: Figure, panels: list, times, norm: Normalize, label: str, values, names, below: bool
) -> None:
    """Add a color bar, `below` the panels or at their right: a tick at each drawn time that has room, or of `values`."""
    if len(times) == 1 and values is None:
        return
    gap = 0.10 if panels[0].plot.name == "3d" else 0.03  # room for the label of the z axis
    plots, side = [panel.plot for panel in panels], "bottom" if below else "right"
    bar = figure.colorbar(ScalarMappable(norm, TIME_COLORS), ax=plots, location=side, shrink=0.7, aspect=24, pad=gap)
    if names is None or values is not None:
        bar.set_label(label, fontsize=9)
    if values is None:
        ticks = apart(times, TICKS[below]) if names is None else times
        bar.set_ticks(ticks, labels=names or [f"{time:.3g}" for time in ticks])
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)


def apart(times: np.ndarray, least: float) -> np.ndarray:
    """Return the first and last of numbers, and the ones between at least a fraction of the range from others."""
    low, high = np.min(times), np.max(times)
    kept = [low]
    for time in np.unique(times):
        if min(time - kept[-1], high - time) >= least * (high - low):
            kept.append(time)
    return np.array(kept if high == low else [*kept, high])


def _save(figure: Figure, path) -> None:
    """Write a figure without pyplot, which has global state."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=DPI)

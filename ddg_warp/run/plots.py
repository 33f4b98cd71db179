"""Diagrams with matplotlib: errors against cost, lines, and equilibrium paths."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ddg_warp.run.panel import DPI, GREY, TIME_COLORS

LETTERS = 34  # of the labels of a legend with two columns at most
TITLE = 11  # letters of a title in an inch
STABILITY = {"stable": (False, "-"), "unstable": (True, "--")}
SPECIAL = {"limit point": "o", "bifurcation": "D"}
MARKERS = "osD^vP"


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
    save(figure, path)


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
    save(figure, path)


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
    draw_lines(figure.add_subplot(), lines, x, y, title, log)
    save(figure, path)


def draw_lines(plot, lines: Iterable[tuple], x: str, y: str, title: str, log: bool) -> None:
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
    draw_path(plot, path, unit)
    plot.set_title(textwrap.fill(title, round(TITLE * figure.get_figwidth())), loc="left", fontsize=11)
    save(figure, file)


def draw_path(plot, path, unit: str) -> None:
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


def save(figure: Figure, path) -> None:
    """Write a figure without pyplot, which has global state."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=DPI)

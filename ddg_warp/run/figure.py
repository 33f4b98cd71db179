"""Pictures with matplotlib: rods and surfaces at a few times."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from ddg_warp.io.colors import CONTACT
from ddg_warp.io.contact_records import Contacts
from ddg_warp.io.shapes import Shapes
from ddg_warp.run.panel import DPI, GREY, LOAD, MARGIN, TIME_COLORS, Panel, RenderedPanel
from ddg_warp.run.plots import TITLE, draw_lines, draw_path, save
from ddg_warp.run.render import View, available
from ddg_warp.view.drawing import Drawing, directions, largest_force
from ddg_warp.view.drawing import arrows as contact_arrows

FLAT = 1e-3  # largest thickness over size of flat shapes
ELEVATION, AZIMUTH = 18.0, -58.0  # of the eye [degrees]
WIDTH, TALLEST = 7.0, 6.0  # of a picture and of its shapes [inches]
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
        draw_lines(figure.add_subplot(chart_cell), **{"title": "", "log": False, **chart})
    elif chart is not None:
        draw_path(figure.add_subplot(chart_cell), chart, unit)
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
    save(figure, path)


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

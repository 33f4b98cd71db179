"""Panels of a picture: rods, surfaces, arrows and marks in axes of matplotlib, flat or solid, or rendered with pyvista."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from ddg_warp.io.colors import SCALE
from ddg_warp.io.rod_tubes import SIDES, tube_points, tube_triangles
from ddg_warp.io.shapes import Shapes
from ddg_warp.run.render import Canvas, View
from ddg_warp.view.drawing import Drawing

DPI = 160
WIDEST = 0.72  # largest visible width over diagonal of a box in a panel
MARGIN = 0.06  # of the size, around the rods
FIELD_COLOR = "#c9bfd6"
GREY = "0.35"
TIME_COLORS = LinearSegmentedColormap.from_list("time", SCALE)
MARK, LOAD = (0.15, 0.15, 0.15), (0.1, 0.55, 0.3)  # RGB of fixed nodes and of applied forces
MARK_SIZE = 0.011  # radius of a mark over the size of the panel
CLOSE = 1.45  # zoom of a solid scene without axes
LIGHT = np.array([-0.37, -0.56, 0.74])  # unit vector from the surfaces to the light
DARKEST = 0.55  # brightness at grazing light
EARLIER = 0.4  # opacity of surfaces before the latest
BARS = (1.0, 2.0, 5.0)  # lengths of scale bars, times a power of ten
TRIAD = 0.25  # length of the axes of coordinates [inches]


class Panel:
    """Axes of matplotlib with rods and surfaces, flat or solid.

    Args:
        figure: The figure.
        spec: Cell of its grid.
        axes: The drawn coordinates: two of a flat scene, or all three.
        low, high: Corners of the box around the content [m], shape (3,).
        unit: Unit of lengths.
        angles: Elevation and azimuth of the eye [degrees].
    """

    solid = False

    def __init__(self, figure: Figure, spec, axes: list[int], low, high, unit: str, angles: tuple[float, float]):
        self.axes, self.low, self.high = axes, low, high
        if len(axes) == 2:
            self.plot = _flat_axes(figure, axes, low, high, unit, spec)
        else:
            self.plot = _solid_axes(figure, low, high, unit, angles, spec)

    def triangles(
        self, points: np.ndarray, faces: np.ndarray, color, opacity: float = 1.0, closed: bool = False
    ) -> None:
        """Add triangles (t, 3) of vertices (n, 3), of one color, or one a vertex or triangle; thin edges close gaps."""
        if np.ndim(color) == 2 and len(color) == len(points) != len(faces):
            color = np.asarray(color)[faces].mean(axis=1)
        shaded = np.array(np.broadcast_to(to_rgba_array(color), (len(faces), 4)))
        shaded[:, 3] *= opacity
        corners = points[faces]
        if len(self.axes) == 2:
            self.plot.add_collection(
                PolyCollection(corners[..., self.axes], facecolors=shaded, edgecolors=shaded, linewidths=0.2)
            )
            return
        vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = np.abs(vectors @ LIGHT) / np.maximum(np.linalg.norm(vectors, axis=1), np.finfo(float).tiny)
        shaded[:, :3] *= (DARKEST + (1.0 - DARKEST) * facing)[:, None]  # both sides alike
        self.plot.add_collection(Poly3DCollection(corners, facecolors=shaded, edgecolors=shaded, linewidths=0.2))

    def surfaces(self, points: np.ndarray, shapes: Shapes, color, latest: bool) -> None:
        """Add the surfaces of a scene."""
        self.triangles(points, shapes.surfaces.triangles, color, 1.0 if latest else EARLIER)

    def rods(self, points: np.ndarray, shapes: Shapes, color, latest: bool, thick: bool) -> None:
        """Add rods as lines, or as tubes of their thickness, of one color, or one a rod or node."""
        curves, points = shapes.curves, points[shapes.rows]
        if thick:
            return self.triangles(*tubes(points, curves), np.repeat(per_node(color, curves), SIDES, axis=0))
        kind = LineCollection if len(self.axes) == 2 else Line3DCollection
        polylines = _polylines(points[:, self.axes], curves.counts, curves.closed)
        if len(color) == len(points) and np.ndim(color) == 2:  # a color at every point: draw edge by edge
            shades = _polylines(np.asarray(color), curves.counts, curves.closed)
            color = np.concatenate([0.5 * (shade[1:] + shade[:-1]) for shade in shades])
            polylines = [edge for line in polylines for edge in np.stack([line[:-1], line[1:]], axis=1)]
        width = line_width(len(curves.counts), latest)
        lines = kind(polylines, colors=color if np.ndim(color) == 2 else [color], linewidths=width)
        lines.set(capstyle="round", joinstyle="round")
        self.plot.add_collection(lines)

    def arrows(self, ends: np.ndarray, color) -> None:
        """Add arrows with start and end (n, 2, 3)."""
        if not len(ends):
            return
        start, vector = ends[:, 0, self.axes], (ends[:, 1] - ends[:, 0])[:, self.axes]
        if len(self.axes) == 2:
            style = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.005, "zorder": 4}
            self.plot.quiver(*start.T, *vector.T, color=color, **style)
        else:
            self.plot.quiver(*start.T, *vector.T, color=color, linewidth=1.4, arrow_length_ratio=0.25)

    def marks(self, points: np.ndarray) -> None:
        """Mark points (n, 3)."""
        self.plot.plot(*points[:, self.axes].T, "o", color=MARK, markersize=4.5, zorder=5)

    def field(self, ends: np.ndarray) -> None:
        """Add arrows (n, 2, 3) behind everything else."""
        start, vector = ends[:, 0, self.axes], (ends[:, 1] - ends[:, 0])[:, self.axes]
        style = {"color": FIELD_COLOR, "zorder": 0}
        if len(self.axes) == 2:
            style |= {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.004}
            self.plot.quiver(*start.T, *vector.T, **style)
        else:
            self.plot.quiver(*start.T, *vector.T, linewidth=0.8, arrow_length_ratio=0.25, **style)

    def bare(self) -> None:
        """Leave out the axes, and draw larger."""
        self.plot.set_axis_off()
        if len(self.axes) == 3:
            sides = np.ptp([self.plot.get_xlim(), self.plot.get_ylim(), self.plot.get_zlim()], axis=1)
            angles = self.plot.elev, self.plot.azim
            self.plot.set_box_aspect(sides, zoom=CLOSE * min(_to_fit(sides, angles), WIDEST / _seen(sides, angles)[0]))

    def finish(self, ruler: bool) -> None:
        """Complete the panel."""


class RenderedPanel:
    """Axes with an image rendered by pyvista, a triad of coordinates and a scale bar.

    Args:
        figure, spec: As of a `Panel`.
        view: The `View`.
        drawing: `Drawing` of the scene.
        unit: Unit of lengths.
        width: Width of the image [pixels], and of the panel [inches].
    """

    solid = True

    def __init__(self, figure: Figure, spec, view: View, drawing: Drawing, unit: str, width):
        self.plot = figure.add_subplot(spec, aspect="equal")
        self.plot.set_axis_off()
        self.drawing, self.unit, self.view = drawing, unit, view
        self.canvas, self._count, self._inch = Canvas(view, width[0]), 0, float(view.size[0] / width[1])

    def triangles(
        self, points: np.ndarray, faces: np.ndarray, color, opacity: float = 1.0, closed: bool = False
    ) -> None:
        """Add triangles (t, 3) of vertices (n, 3), of one color, or one a vertex or triangle; of `closed` ones the outside."""
        color = np.asarray(color)[..., :3]
        self.canvas.mesh(self._name(), points, faces, color, opacity=opacity, closed=closed)

    def surfaces(self, points: np.ndarray, shapes: Shapes, color, latest: bool) -> None:
        """Add the surfaces of a scene."""
        for skin in self.drawing.skins:
            shade = np.asarray(color)[skin.rows] if np.ndim(color) == 2 else color
            self.triangles(points[skin.rows], skin.triangles, shade, 1.0 if latest else EARLIER)

    def rods(self, points: np.ndarray, shapes: Shapes, color, latest: bool, thick: bool) -> None:
        """Add rods as tubes of one color, or one a rod or node."""
        nodes, curves = self.drawing.tubes()
        shade = per_node(color, shapes.curves)[nodes, :3]
        thinnest = line_width(len(shapes.curves.counts), latest) * DPI / 72.0
        self.canvas.tubes(self._name(), points[shapes.rows[nodes]], curves, shade, thinnest)

    def arrows(self, ends: np.ndarray, color) -> None:
        """Add arrows with start and end (n, 2, 3)."""
        self.canvas.arrows(self._name(), ends, color)

    def marks(self, points: np.ndarray) -> None:
        """Mark points (n, 3)."""
        self.canvas.balls(self._name(), points, MARK_SIZE * float(self.view.size.mean()), MARK)

    def field(self, ends: np.ndarray) -> None:
        """Add arrows (n, 2, 3) of a field."""
        self.canvas.arrows(self._name(), ends, to_rgba_array(FIELD_COLOR)[0, :3])

    def bare(self) -> None:
        """Leave out the axes: there are none."""

    def finish(self, ruler: bool) -> None:
        """Show the image, with a scale bar and a triad if `ruler`."""
        low, high = self.view.low, self.view.high
        self.plot.imshow(self.canvas.image(), extent=(low[0], high[0], low[1], high[1]), interpolation="lanczos")
        self.canvas.close()
        self.plot.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        if ruler:
            ruled(self.plot, self.view, self.unit, self._inch)

    def _name(self) -> str:
        self._count += 1
        return str(self._count)


def ruled(plot, view: View, unit: str, inch: float) -> None:
    """Add a scale bar at the lower right and a triad of coordinates at the lower left of a view.

    Args:
        plot: Axes of matplotlib with the coordinates of the view.
        view: The view.
        unit: Unit of lengths.
        inch: An inch of the picture [m].
    """
    power = 10.0 ** np.floor(np.log10(0.25 * view.size[0]))
    length = power * max(bar for bar in BARS if bar * power <= 0.25 * view.size[0])
    right, bottom = view.high[0] - 0.05 * inch, view.low[1] + 0.08 * inch
    plot.plot([right - length, right], [bottom, bottom], color=GREY, linewidth=2.0, solid_capstyle="butt")
    text = {"fontsize": 8, "color": GREY, "ha": "center"}
    plot.text(right - 0.5 * length, bottom + 0.05 * inch, f"{length:g} {unit}", va="bottom", **text)
    corner = view.low + 0.15 * inch
    for name, direction in zip("xyz", view.axes[:2].T, strict=True):
        if (size := np.linalg.norm(direction)) > 0.1:
            arrow = {"arrowstyle": "-|>", "color": GREY, "lw": 1.0, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7}
            plot.annotate("", corner + TRIAD * inch * direction, corner, arrowprops=arrow)
            plot.text(*(corner + inch * (TRIAD + 0.09 / size) * direction), name, va="center", **text)


def tubes(points: np.ndarray, curves) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and triangles (t, 3) of open tubes around rods with nodes (P, 3)."""
    counts, closed = np.asarray(curves.counts), np.asarray(curves.closed, bool)
    return tube_points(points, counts, closed, np.asarray(curves.radius)), tube_triangles(counts, closed)


def per_node(color, curves) -> np.ndarray:
    """Return a color at each node of rods, from one color, or one a rod or node."""
    color, count = np.asarray(color), int(np.sum(curves.counts))
    if color.ndim == 1:
        return np.tile(color, (count, 1))
    return color if len(color) == count else np.repeat(color, curves.counts, axis=0)


def line_width(rod_count: int, latest: bool) -> float:
    """Return the line width in points: thin for many rods and for earlier shapes."""
    few = np.interp(np.log10(rod_count), [0.0, 1.0, 3.0], [2.2, 1.4, 0.45])
    return few if latest else 0.7 * few


def _polylines(points: np.ndarray, counts: np.ndarray, closed: np.ndarray) -> list[np.ndarray]:
    """Return the polyline of each rod; a closed one ends at its first point."""
    lines = np.split(points, np.cumsum(counts)[:-1])
    return [np.vstack([line, line[:1]]) if shut else line for line, shut in zip(lines, closed, strict=True)]


def _flat_axes(figure: Figure, axes: list[int], low: np.ndarray, high: np.ndarray, unit: str, spec):
    plot = figure.add_subplot(spec, aspect="equal")
    margin = MARGIN * np.max(high - low)
    limits = [(low[k] - margin, high[k] + margin) for k in axes]
    names = [f"{'xyz'[k]} [{unit}]" for k in axes]
    plot.set(xlim=limits[0], ylim=limits[1], xlabel=names[0], ylabel=names[1])
    plot.ticklabel_format(useOffset=False)
    sides = np.ptp(limits, axis=1) / np.ptp(limits, axis=1).max()
    for axis, relative in zip((plot.xaxis, plot.yaxis), sides, strict=True):
        axis.set_major_locator(MaxNLocator(nbins=max(2, round(7.0 * relative))))  # labels of short axes do not overlap
    plot.grid(color="0.92", linewidth=0.6)
    plot.set_axisbelow(True)
    plot.spines[["top", "right"]].set_visible(False)
    return plot


def _solid_axes(figure: Figure, low: np.ndarray, high: np.ndarray, unit: str, angles: tuple[float, float], spec):
    plot = figure.add_subplot(spec, projection="3d", computed_zorder=False)
    plot.set_proj_type("ortho")
    plot.view_init(elev=angles[0], azim=angles[1])
    margin = MARGIN * np.max(high - low)
    limits = np.stack([low - margin, high + margin], axis=1)
    plot.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    sides = limits[:, 1] - limits[:, 0]
    plot.set_box_aspect(sides, zoom=_to_fit(sides, angles))
    lengths = sides / sides.max()
    for axis, name, relative in zip((plot.xaxis, plot.yaxis, plot.zaxis), "xyz", lengths, strict=True):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.set_label_text(f"{name} [{unit}]", fontsize=9)
        axis.get_major_formatter().set_useOffset(False)
        axis.set_major_locator(MaxNLocator(nbins=max(2, round(4.0 * relative))))  # labels of short axes do not overlap
        axis._axinfo["grid"].update(color="0.9", linewidth=0.5)
    plot.tick_params(labelsize=8, colors=GREY)
    return plot


def _to_fit(sides: np.ndarray, angles: tuple[float, float]) -> float:
    """Return the zoom that fits a box into the height of matplotlib's cube, at most 1."""
    return min(1.0, _seen(np.ones(3), angles)[1] / _seen(sides, angles)[1])


def _seen(sides: np.ndarray, angles: tuple[float, float]) -> np.ndarray:
    """Return visible width and height of a box over the diagonal, the length that matplotlib normalises."""
    elevation, azimuth = np.radians(angles)
    wide = [np.sin(azimuth), np.cos(azimuth), 0.0]
    high = [np.cos(azimuth) * np.sin(elevation), np.sin(azimuth) * np.sin(elevation), np.cos(elevation)]
    return np.abs([wide, high]) @ sides / np.linalg.norm(sides)

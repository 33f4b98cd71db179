"""Drawing of a scene: the nodes, edges and triangles that a viewer shows, colors by a field, arrows by forces, and a camera.

Large scenes are decimated, by one rule for rods and one for surfaces. Drawn points are always nodes of the model, never means.

- Rods with more than EDGES edges in all: of R rods every k-th is drawn, k = edges / EDGES rounded up. If fewer than RODS rods
  would remain, every rod is drawn, with every k-th node and the last.
- Surfaces with more than TRIANGLES triangles in all: vertices in a cube are represented by the vertex nearest to its center.
  Triangles of three different cubes remain. Cubes are enlarged until at most TRIANGLES remain.
- Contacts: the ARROWS largest forces are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ddg_warp.io.colors import PALETTE, SCALE, on_scale
from ddg_warp.io.contact_records import Contacts
from ddg_warp.io.shapes import Curves, Shapes, Surfaces
from ddg_warp.scene.obstacles import PLANE

EDGES, TRIANGLES, ARROWS = 30_000, 30_000, 1_000  # drawn at most
RODS = 500  # left at least where rods are left out
WIDTHS = 8  # different thicknesses of rods at most
THINNEST = 4e-3  # thickness over the size of the scene below which rods are lines of PIXELS
PIXELS = 2.0
UNDEFINED = (0.72, 0.72, 0.72)  # RGB where a field has no value
FIELD_OF_VIEW = np.radians(45.0)
MARGIN = 1.15  # around the points in a view
ELEVATION, AZIMUTH = np.radians((18.0, -58.0))  # of the eye
ARROW_LENGTH = 0.15  # of the arrow of a typical force, over the size of the scene
SIZE_STEPS = 2**14  # steps of rounded coordinates along the size of a scene


@dataclass(frozen=True)
class Frame:
    """State of a scene at one time, ready to draw.

    Attributes:
        time: Time [s], or load parameter.
        points: Positions of all worlds [m], shape (N, 3).
        values: Value of the shown field at each point, shape (N,), NaN where undefined; None without a field.
        obstacles: Nodes of moving obstacles in the first world [m], shape (M, 3); None without.
        contacts: Pairs in contact; None if unknown.
    """

    time: float
    points: np.ndarray
    values: np.ndarray | None = None
    obstacles: np.ndarray | None = None
    contacts: Contacts | None = None


@dataclass(frozen=True)
class Lines:
    """Edges of rods of one thickness.

    Attributes:
        ends: Rows of both nodes of each edge, shape (n, 2), int.
        color: RGB of each edge, shape (n, 3).
        width: Thickness [m]; 0 for lines of PIXELS.
    """

    ends: np.ndarray
    color: np.ndarray
    width: float


@dataclass(frozen=True)
class Skin:
    """Drawn triangles of one surface.

    Attributes:
        rows: Rows of the vertices among all points, shape (v,), int.
        triangles: Corners among `rows`, shape (t, 3), int.
        color: RGB without a field.
    """

    rows: np.ndarray
    triangles: np.ndarray
    color: tuple[float, float, float]


class Drawing:
    """Drawn edges and triangles of a scene; of a decimated scene only some.

    Args:
        curves, surfaces: Rods and surfaces of one world, of a model or a `TrajectoryReader`.
        worlds: Number of worlds.
        points: Positions at the first time [m], shape (N, 3), of all worlds.
        obstacles: `io.obstacles.Obstacles`, or None.

    Attributes:
        lines: `Lines` by thickness.
        skins: `Skin` of each surface.
        shapes: The full scene.
        chosen: Drawn rods (r,), and k of every k-th node of each that is drawn.
        size: Diagonal of the box around rods and surfaces [m].
        note: Text of the drawn and the total numbers, and of the rules of decimation that apply.
    """

    def __init__(self, curves: Curves, surfaces: Surfaces | None, worlds: int, points: np.ndarray, obstacles=None):
        self.shapes, self.obstacles = Shapes.of(curves, surfaces, worlds), obstacles
        points = np.reshape(points, (-1, 3))
        self.size = (float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0) or 1.0
        self.chosen = np.zeros(0, int), 1
        notes: list[str] = []
        self.lines = self._rods(notes)
        self.skins = self._surfaces(points, notes)
        self.note = "; ".join(notes)
        self._corners = _corner_counts(self.shapes)

    def _rods(self, notes: list[str]) -> list[Lines]:
        """Return the drawn edges of all rods by thickness."""
        curves = self.shapes.curves
        rods, edges = len(curves.counts), int(np.sum(curves.counts - ~np.asarray(curves.closed, bool)))
        if not edges:
            return []
        stride = -(-edges // EDGES)
        by_rods = stride > 1 and rods // stride >= RODS
        chosen = np.arange(rods)[:: stride if by_rods else 1]
        self.chosen = chosen, 1 if by_rods else stride
        ends, owner = self.edges(*self.chosen)
        text = f"{len(chosen)} of {rods} rods" if by_rods else f"{rods} rod{'s' * (rods > 1)}"
        notes.append(f"{text} with {len(ends)} of {edges} edges" if stride > 1 else f"{text} with {edges} edges")
        if stride > 1:
            each = f"every {stride}th {'rod' if by_rods else 'node of each rod and the last'}"
            notes.append(f"above {EDGES} edges {each} is drawn")
        radius = np.asarray(curves.radius)[np.cumsum(curves.counts) - curves.counts][owner]
        widths = 2.0 * np.array([float(f"{r:.2g}") for r in radius])
        if len(np.unique(widths)) > WIDTHS:
            widths = np.full(len(owner), np.median(widths))
        colors = np.array(PALETTE)[np.asarray(curves.batch)[owner] % len(PALETTE)]
        widths[widths < THINNEST * self.size] = 0.0
        return [Lines(ends[widths == width], colors[widths == width], width) for width in np.unique(widths)]

    def edges(self, rods: np.ndarray, stride: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Return rows of both ends of the edges between every `stride`-th node of rods (n, 2), and their rods (n,)."""
        nodes, owner = self._nodes(rods, stride)
        closed = np.asarray(self.shapes.curves.closed, bool)
        starts = np.cumsum(self.shapes.curves.counts) - self.shapes.curves.counts
        following = np.roll(nodes, -1)
        same = owner[nodes] == owner[following]
        same[-1] = False
        first, second = nodes[same], following[same]
        at_end = nodes[~same]
        back = at_end[closed[owner[at_end]]]
        first, second = np.concatenate([first, back]), np.concatenate([second, starts[owner[back]]])
        return self.shapes.rows[np.stack([first, second], 1)], owner[first]

    def tubes(self) -> tuple[np.ndarray, Curves]:
        """Return the drawn nodes (n,) of the drawn rods among all rod points, and these rods as curves."""
        curves, (rods, stride) = self.shapes.curves, self.chosen
        nodes, owner = self._nodes(rods, stride)
        counts = np.bincount(owner[nodes], minlength=len(curves.counts))[rods]
        named = {name: np.asarray(getattr(curves, name))[rods] for name in ("closed", "names", "batch")}
        return nodes, Curves(counts=counts, radius=np.asarray(curves.radius)[nodes], **named)

    def _nodes(self, rods: np.ndarray, stride: int) -> tuple[np.ndarray, np.ndarray]:
        """Return every `stride`-th node and the last of rods among all rod points, and the rod of every rod point."""
        counts, closed = np.asarray(self.shapes.curves.counts), np.asarray(self.shapes.curves.closed, bool)
        owner = np.repeat(np.arange(len(counts)), counts)
        along = np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]
        last = ~closed[owner] & (along == counts[owner] - 1)
        return np.flatnonzero(np.isin(owner, rods) & ((along % stride == 0) | last)), owner

    def _surfaces(self, points: np.ndarray, notes: list[str]) -> list[Skin]:
        """Return the drawn triangles of each surface."""
        surfaces = self.shapes.surfaces
        if surfaces is None:
            return []
        total, skins = len(surfaces.triangles), []
        for k, part in enumerate(surfaces.parts()):
            triangles = surfaces.triangles[part]
            limit = TRIANGLES * len(triangles) // total if total > TRIANGLES else len(triangles)
            rows, faces = simplified(points, triangles, limit)
            skins.append(Skin(rows, faces, PALETTE[k % len(PALETTE)]))
        drawn = sum(len(skin.triangles) for skin in skins)
        text = f"{len(skins)} surface{'s' * (len(skins) > 1)}"
        notes.append(f"{text} with {drawn} of {total} triangles" if drawn < total else f"{text} with {total} triangles")
        if total > TRIANGLES:
            notes.append(f"above {TRIANGLES} triangles the vertices in a cube are represented by one of them")
        return skins

    def at_points(self, values: np.ndarray) -> np.ndarray:
        """Return values of triangles of all worlds (T,) as means at the points (N,), NaN off the surfaces."""
        corners = self.shapes.surfaces.triangles.ravel()
        with np.errstate(invalid="ignore"):
            return np.bincount(corners, np.repeat(values, 3), len(self._corners)) / self._corners

    def extent(self, *frames: Frame) -> tuple[np.ndarray, np.ndarray]:
        """Return all points and bounded obstacles of some frames [m], (n, 3), and the `directions` of their view.

        A scene in the plane y = const. is seen along y.
        """
        points = np.concatenate([frame.points for frame in frames])
        if self.obstacles is not None:
            bounded = self.obstacles.kinds != PLANE
            bodies = [self.obstacles.surface(frame.obstacles, bounded)[0] for frame in frames]
            points = np.concatenate([points, *bodies])
        flat = np.ptp(points[:, 1]) <= 1e-6 * self.size
        return points, directions(*((0.0, -0.5 * np.pi) if flat else (ELEVATION, AZIMUTH)))

    def camera(self, *frames: Frame) -> dict[str, np.ndarray]:
        """Return eye position and target of a camera that sees the `extent` of some frames [m]."""
        points, (right, up, toward) = self.extent(*frames)
        center = 0.5 * (points.min(0) + points.max(0))
        offset = points - center
        aside = np.maximum(np.abs(offset @ right), np.abs(offset @ up))
        distance = float(np.max(offset @ toward + MARGIN * aside / np.tan(0.5 * FIELD_OF_VIEW))) or self.size
        return {"position": center + distance * toward, "look_at": center}


def directions(elevation: float, azimuth: float) -> np.ndarray:
    """Return unit vectors (3, 3) to the right, upwards, and to the eye of a view, by the angles of the eye [rad]."""
    right = [-np.sin(azimuth), np.cos(azimuth), 0.0]
    toward = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return np.array([right, np.cross(toward, right), toward])


def _corner_counts(shapes: Shapes) -> np.ndarray:
    """Return the number of triangles at each point, shape (N,); NaN for none."""
    count = shapes.point_count * shapes.worlds
    if shapes.surfaces is None:
        return np.full(count, np.nan)
    counts = np.bincount(shapes.surfaces.triangles.ravel(), minlength=count).astype(float)
    counts[counts == 0] = np.nan
    return counts


def simplified(points: np.ndarray, triangles: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most `limit` triangles of a surface, by clusters of vertices in cubes.

    Args:
        points: Positions [m], shape (N, 3).
        triangles: Rows of the corners, shape (t, 3).
        limit: Number of triangles; with fewer the surface stays as it is.

    Returns:
        Rows (v,) of the vertices and triangles (t, 3) among these.
    """
    rows, corners = np.unique(triangles, return_inverse=True)
    corners = corners.reshape(-1, 3)
    if len(triangles) <= limit:
        return rows, corners
    x = points[rows]
    low = x.min(0)
    a, b, c = (x[corners[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    side = np.sqrt(2.0 * area / limit)
    while True:
        cell = np.floor((x - low) / side).astype(np.int64)
        _, cube = np.unique(_key(cell), return_inverse=True)
        off_center = np.linalg.norm(x - low - (cell + 0.5) * side, axis=1)
        order = np.lexsort((off_center, cube))
        first = np.concatenate([[True], np.diff(cube[order]) > 0])
        faces = cube[corners]
        p, q, r = faces.T
        faces = faces[(p != q) & (q != r) & (r != p)]
        _, once = np.unique(_key(np.sort(faces, axis=1)), return_index=True)
        if len(once) <= limit:
            return rows[order[first]], faces[np.sort(once)]
        side *= 1.1


def _key(rows: np.ndarray) -> np.ndarray:
    """Return one number for each row of three non-negative integers (n, 3)."""
    a, b, c = rows.T
    return (a * (b.max(initial=0) + 1) + b) * (c.max(initial=0) + 1) + c


def colored(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return RGB in 0..255 (n, 3), uint8, of values (n,) on a scale; grey where undefined."""
    colors = on_scale(np.nan_to_num(values), low, high)
    colors[np.isnan(values)] = UNDEFINED
    return as_bytes(colors)


def as_bytes(colors) -> np.ndarray:
    """Return RGB of 0..1 as uint8."""
    return np.round(255.0 * np.asarray(colors)).astype(np.uint8)


def value_range(frames_values) -> tuple[float, float]:
    """Return the least and largest defined value of arrays; the ends differ."""
    parts = [values[np.isfinite(values)] for values in frames_values]
    values = np.concatenate([np.zeros(0), *parts])
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    return (low, high) if high > low else (low, low + max(1e-12, 1e-6 * abs(low)))


def arrows(contacts: Contacts | None, length_per_force: float) -> np.ndarray:
    """Return start and end of arrows (n, 2, 3) [m], the force of each pair on its first object, friction included.

    Args:
        contacts: Pairs in contact, or None.
        length_per_force: Scale [m/N].
    """
    if contacts is None or not len(contacts):
        return np.zeros((0, 2, 3))
    force = contacts.force + contacts.friction
    size = np.linalg.norm(force, axis=1)
    largest = np.sort(np.argsort(-size, kind="stable")[:ARROWS])
    largest = largest[size[largest] > 0.0]
    start = contacts.point[largest]
    return np.stack([start, start + length_per_force * force[largest]], 1)


def largest_force(contacts: Contacts | None) -> float:
    """Return the largest force of pairs in contact [N], friction included; 0 without pairs."""
    if contacts is None or not len(contacts):
        return 0.0
    return float(np.linalg.norm(contacts.force + contacts.friction, axis=1).max())


def rounded(points: np.ndarray, size: float) -> np.ndarray:
    """Return coordinates in float32 to a power of two below `size` / 8192, which files compress well."""
    step = 2.0 ** np.floor(np.log2(size / SIZE_STEPS))
    return (np.round(points / step) * step).astype(np.float32)


def legend(title: str, low: float, high: float) -> str:
    """Return the HTML of a color scale with the values at both ends."""
    return (
        f'<div style="margin:0.4em 0.8em;font-size:0.8em"><div>{title}</div>'
        f'<div style="height:0.8em;background:linear-gradient(to right,{",".join(SCALE)})"></div>'
        f'<div style="display:flex;justify-content:space-between"><span>{low:.4g}</span><span>{high:.4g}</span></div></div>'
    )

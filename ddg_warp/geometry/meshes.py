"""Triangle meshes of simple shapes, for scenes and tests: functions that return points (P, 3) [m] and triangles (T, 3).

Plane shapes lie in z = 0 and face +z, round ones face outwards: triangles run counter-clockwise as seen from there.
The vertex (i, j) of a grid with m vertices in a row is i + m j.
"""

from typing import Literal, TypeAlias

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError
from ddg_warp.typing import Bools, Floats, Integers, Numbers

Mesh: TypeAlias = tuple[Floats, Integers]


def rectangle(
    nx: int, ny: int, size: tuple[float, float] = (1.0, 1.0), pattern: Literal["right", "alternating"] = "right"
) -> Mesh:
    """Return a rectangle [0, size[0]] x [0, size[1]] of nx x ny cells.

    Args:
        nx, ny: number of cells along x and y.
        size: lengths along x and y [m].
        pattern: how cells become triangles.
            `right`: two a cell, along the diagonal from (i, j) to (i + 1, j + 1).
            `alternating`: two a cell, along either diagonal like a checkerboard.
            `crossed`: four a cell. The centre of cell (i, j) is vertex (nx + 1)(ny + 1) + i + nx j.
            `equilateral`: rows of triangles that stand on the cells, with half ones at the ends; equilateral where
                size[1] / ny = sqrt(3)/2 size[0] / nx.

    Vertex (i, j) is i + (nx + 1) j. With `equilateral`, row j starts at vertex (nx + 1) j + j // 2; odd rows have nx + 2
    vertices, at x = 0, 1/2, 3/2, ..., nx - 1/2, nx cells.
    """
    _check_counts(nx=nx, ny=ny)
    size = _size(size)
    argument_checks.choice("pattern", pattern, ("right", "alternating", "crossed", "equilateral"))
    scale = np.array([size[0] / nx, size[1] / ny])
    if pattern == "equilateral":
        flat, triangles = _equilateral(nx, ny)
    elif pattern == "crossed":
        flat, triangles = _crossed(nx, ny)
    else:
        flat, triangles = _lattice(nx, ny), _grid(nx, ny, pattern)
    return _spatial(flat * scale), triangles


def jittered_rectangle(
    nx: int, ny: int, size: tuple[float, float] = (1.0, 1.0), jitter: float = 0.3, seed: int = 0
) -> Mesh:
    """Return a rectangle [0, size[0]] x [0, size[1]] with an unstructured Delaunay mesh; the vertices are numbered as in `rectangle`.

    Args:
        nx, ny: number of cells along x and y that the vertices are taken from.
        size: lengths along x and y [m].
        jitter: how far a vertex inside moves at most, in cells along x and y; less than a half.
        seed: of the random numbers.
    """
    from scipy.spatial import Delaunay

    _check_counts(nx=nx, ny=ny)
    size = _size(size)
    argument_checks.number("jitter", jitter, "a fraction of a cell, from 0 to less than 0.5", lambda v: 0.0 <= v < 0.5)
    argument_checks.count("seed", seed, 0)
    flat = _lattice(nx, ny)
    inside = ((flat > 0) & (flat < [nx, ny])).all(axis=1)
    flat[inside] += np.random.default_rng(seed).uniform(-jitter, jitter, (np.count_nonzero(inside), 2))
    flat *= np.array([size[0] / nx, size[1] / ny])
    return _spatial(flat), Delaunay(flat).simplices.astype(np.int64)


def disc(rings: int, radius: float = 1.0) -> Mesh:
    """Return a disc around the origin of 6 rings^2 triangles of nearly equal size.

    Vertex 0 is the centre; ring k has 6 k vertices from 1 + 3 k (k - 1) on, at angles from +x towards +y.
    """
    distance, angle, triangles = _rings(rings)
    _check_lengths(radius=radius)
    return radius * _polar(distance, angle), triangles


def annulus(
    n_radial: int,
    n_around: int,
    inner: float,
    outer: float,
    slit: bool = False,
    pattern: Literal["right", "alternating"] = "right",
) -> Mesh:
    """Return a ring between two circles around the origin.

    Args:
        n_radial, n_around: number of cells along the radius and around.
        inner, outer: radii [m].
        slit: whether the ring is cut along +x, with doubled vertices on the cut: j = n_around is the angle 2 pi.
        pattern: `right` or `alternating`, as in `rectangle`.

    Vertex (i, j) is i + (n_radial + 1) j, with i from the inner circle outwards and j around, from +x towards +y.
    """
    _check_counts(n_radial=n_radial)
    _check_around("n_around", n_around, 1 if argument_checks.flag("slit", slit) else 3)
    _check_lengths(inner=inner, outer=outer)
    if inner >= outer:
        raise SceneError(f"inner = {inner}, outer = {outer}; the inner radius is less than the outer one")
    columns = n_around + 1 if slit else n_around
    i, j = _lattice(n_radial, columns - 1).T
    points = _polar(inner + (outer - inner) * i / n_radial, 2.0 * np.pi * j / n_around)
    return points, _grid(n_radial, n_around, pattern, wrap_y=not slit)


def cylinder_panel(
    n_around: int,
    n_along: int,
    radius: float,
    length: float,
    angle: float,
    pattern: Literal["right", "alternating"] = "right",
) -> Mesh:
    """Return a sector of a cylinder about the z axis, 0 <= z <= length, symmetric to the x axis, facing outwards.

    Args:
        n_around, n_along: number of cells around and along the axis.
        radius, length: [m].
        angle: how far the panel reaches around [rad]; less than 2 pi.
        pattern: `right` or `alternating`, as in `rectangle`.

    Vertex (i, j) is i + (n_around + 1) j, with i around from -angle/2 to angle/2 and j along the axis.
    """
    _check_counts(n_around=n_around, n_along=n_along)
    _check_lengths(radius=radius, length=length)
    rule = "an angle in radians, more than 0 and less than 2 pi"
    argument_checks.number("angle", angle, rule, lambda v: 0.0 < v < 2.0 * np.pi)
    i, j = _lattice(n_around, n_along).T
    points = radius * _polar(np.ones(len(i)), angle * (i / n_around - 0.5))
    points[:, 2] = length * j / n_along
    return points, _grid(n_around, n_along, pattern)


def cylinder(
    n_around: int, n_along: int, radius: float, length: float, pattern: Literal["right", "alternating"] = "right"
) -> Mesh:
    """Return a whole cylinder about the z axis without ends, 0 <= z <= length, facing outwards.

    Vertex (i, j) is i + n_around j, with i around from +x towards +y and j along the axis; arguments as in `cylinder_panel`.
    """
    _check_counts(n_along=n_along)
    _check_around("n_around", n_around, 3)
    _check_lengths(radius=radius, length=length)
    i, j = _lattice(n_around - 1, n_along).T
    points = radius * _polar(np.ones(len(i)), 2.0 * np.pi * i / n_around)
    points[:, 2] = length * j / n_along
    return points, _grid(n_around, n_along, pattern, wrap_x=True)


def sphere(subdivisions: int, radius: float = 1.0) -> Mesh:
    """Return an icosphere of 20 x 4^subdivisions triangles around the origin: an icosahedron, each triangle halved along its sides.

    The 12 vertices of the icosahedron come first, with 5 triangles each; all others have 6.
    """
    from ddg_warp.geometry.surface import Surface

    argument_checks.count("subdivisions", subdivisions, 0)
    _check_lengths(radius=radius)
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    points = np.array([[0.0, s, t * golden] for s in (-1, 1) for t in (-1, 1)])
    points = np.concatenate([points, np.roll(points, 1, axis=1), np.roll(points, 2, axis=1)])
    near = np.linalg.norm(points[:, None] - points, axis=-1) < 2.1  # the edges have the length 2
    triples = [(a, b, c) for a in range(12) for b in range(a) for c in range(b) if near[a, b] & near[b, c] & near[c, a]]
    triangles = np.array([t if np.linalg.det(points[list(t)]) > 0.0 else t[::-1] for t in triples])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for _ in range(subdivisions):
        surface = Surface(points, triangles)
        a, b, c = triangles.T
        opposite_a, opposite_b, opposite_c = (len(points) + surface.triangle_edges).T
        corners = [(a, opposite_c, opposite_b), (opposite_c, b, opposite_a), (opposite_b, opposite_a, c)]
        triangles = np.concatenate([np.stack(t, axis=1) for t in [*corners, (opposite_a, opposite_b, opposite_c)]])
        points = np.concatenate([points, points[surface.edges].mean(axis=1)])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return radius * points, triangles


def spherical_cap(rings: int, radius: float = 1.0, angle: float = 0.5 * np.pi) -> Mesh:
    """Return the cap of a sphere around the origin within an angle of +z [rad], facing outwards; by default z >= 0.

    The vertices are numbered as in `disc`: 0 is the pole, ring k is at the angle k / rings of `angle`.
    """
    distance, around, triangles = _rings(rings)
    _check_lengths(radius=radius)
    argument_checks.number(
        "angle", angle, "an angle in radians, more than 0 and less than pi", lambda v: 0.0 < v < np.pi
    )
    points = _polar(np.sin(angle * distance), around)
    points[:, 2] = np.cos(angle * distance)
    return radius * points, triangles


def torus(
    n_around: int, n_tube: int, major: float, minor: float, pattern: Literal["right", "alternating"] = "right"
) -> Mesh:
    """Return a torus about the z axis, facing outwards.

    Args:
        n_around, n_tube: number of cells around the axis and around the tube.
        major, minor: radius of the tube's centreline, and of the tube [m].
        pattern: `right` or `alternating`, as in `rectangle`.

    Vertex (i, j) is i + n_around j, with i around the axis from +x towards +y, and j around the tube from outside towards +z.
    """
    _check_around("n_around", n_around, 3)
    _check_around("n_tube", n_tube, 3)
    _check_lengths(major=major, minor=minor)
    if minor >= major:
        raise SceneError(f"major = {major}, minor = {minor}; a tube that does not meet itself is thinner than its ring")
    i, j = _lattice(n_around - 1, n_tube - 1).T
    tube = 2.0 * np.pi * j / n_tube
    points = _polar(major + minor * np.cos(tube), 2.0 * np.pi * i / n_around)
    points[:, 2] = minor * np.sin(tube)
    return points, _grid(n_around, n_tube, pattern, wrap_x=True, wrap_y=True)


def drop_unused(points: Numbers, triangles: Numbers) -> Mesh:
    """Return a mesh without the vertices that no triangle uses; the others keep their order.

    Raises:
        SceneError: points or triangles are no mesh.
    """
    points, triangles = np.asarray(points), np.asarray(triangles)
    if points.ndim != 2 or triangles.ndim != 2 or triangles.dtype.kind not in "iu":
        raise SceneError("drop_unused: give points (P, 3) and triangles (T, 3) of whole numbers")
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
        raise SceneError(
            f"drop_unused: triangles name vertices that do not exist, there are {len(points)}; correct them"
        )
    used, renumbered = np.unique(triangles, return_inverse=True)
    return points[used], renumbered.reshape(triangles.shape)


def weld(points: Numbers, triangles: Numbers, tolerance: float) -> Mesh:
    """Return a mesh with vertices within a tolerance [m] of each other merged, and triangles that collapse left out.

    Raises:
        SceneError: no positive tolerance, or one that leaves no triangle.
    """
    kept, numbers, remaining = merge(points, triangles, tolerance)
    return np.asarray(points, float)[kept], numbers[np.asarray(triangles)[remaining]]


def merge(points: Numbers, triangles: Numbers, tolerance: float) -> tuple[Integers, Integers, Bools]:
    """Return (vertices that `weld` keeps (p,), new index of each vertex (P,), triangles that remain (T,) bool)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    argument_checks.positive("weld: tolerance", tolerance, "m")
    points, triangles = (
        argument_checks.array("weld: points", points),
        argument_checks.triangles("weld: triangles", triangles),
    )
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise SceneError(f"weld: points have shape {points.shape}; give finite numbers (P, 3)")
    for t in np.flatnonzero(((triangles < 0) | (triangles >= len(points))).any(1))[:1]:
        raise SceneError(f"weld: triangle {t} has the vertices {triangles[t].tolist()}, but there are {len(points)}")
    pairs = cKDTree(points).query_pairs(tolerance, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    count, group = connected_components(graph, directed=False)
    first = np.full(count, len(points))
    np.minimum.at(first, group, np.arange(len(points)))
    kept, numbers = np.unique(first[group], return_inverse=True)  # the first vertex of each group gives its position
    numbers = numbers.reshape(-1)
    welded = numbers[triangles]
    remaining = (welded != np.roll(welded, 1, axis=1)).all(axis=1)
    if not remaining.any():
        raise SceneError(f"weld: a tolerance of {tolerance} m leaves no triangle; give less than the lengths of edges")
    return kept, numbers, remaining


def _check_counts(**counts: int) -> None:
    for name, value in counts.items():
        argument_checks.count(name, value)


def _check_around(name: str, value: int, least: int) -> None:
    argument_checks.count(f"{name} (cells around)", value, least)


def _check_lengths(**lengths: float) -> None:
    for name, value in lengths.items():
        argument_checks.positive(name, value, "m")


def _size(size) -> np.ndarray:
    size = argument_checks.broadcast("size", size, (2,))
    if np.any(size <= 0.0):
        raise SceneError(f"size = {tuple(size.tolist())}; give two positive lengths [m]")
    return size


def _lattice(nx: int, ny: int) -> np.ndarray:
    """Return (i, j) of every vertex i + (nx + 1) j, shape ((nx + 1)(ny + 1), 2), float64."""
    j, i = np.divmod(np.arange((nx + 1) * (ny + 1)), nx + 1)
    return np.stack([i, j], axis=1).astype(np.float64)


def _spatial(flat: np.ndarray) -> np.ndarray:
    return np.column_stack([flat, np.zeros(len(flat))])


def _polar(distance: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the points of the plane z = 0, shape (P, 3)."""
    return np.stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros(len(angle))], axis=1)


def _grid(nx: int, ny: int, pattern: str, wrap_x: bool = False, wrap_y: bool = False) -> np.ndarray:
    """Return the triangles of nx x ny cells; a wrapped grid has its first row or column of vertices as its last."""
    argument_checks.choice("pattern", pattern, ("right", "alternating"))
    mx, my = nx if wrap_x else nx + 1, ny if wrap_y else ny + 1
    j, i = np.divmod(np.arange(nx * ny), nx)
    a, b = i + mx * j, (i + 1) % mx + mx * j
    c, d = (i + 1) % mx + mx * ((j + 1) % my), i + mx * ((j + 1) % my)
    rising = np.stack([a, b, c, a, c, d], axis=1)
    if pattern == "right":
        return rising.reshape(-1, 3)
    if (wrap_x and nx % 2) or (wrap_y and ny % 2):
        raise SceneError(f"{nx} x {ny} cells of pattern 'alternating': give an even number of cells around")
    falling = np.stack([a, b, d, b, c, d], axis=1)
    return np.where(((i + j) % 2 == 0)[:, None], rising, falling).reshape(-1, 3)


def _crossed(nx: int, ny: int) -> Mesh:
    j, i = np.divmod(np.arange(nx * ny), nx)
    a = i + (nx + 1) * j
    ring = np.stack([a, a + 1, a + nx + 2, a + nx + 1], axis=1)
    centre = np.broadcast_to(((nx + 1) * (ny + 1) + np.arange(nx * ny))[:, None], ring.shape)
    triangles = np.stack([ring, np.roll(ring, -1, axis=1), centre], axis=2).reshape(-1, 3)
    return np.concatenate([_lattice(nx, ny), np.stack([i, j], axis=1) + 0.5]), triangles


def _equilateral(nx: int, ny: int) -> Mesh:
    even, odd = np.arange(nx + 1.0), np.concatenate([[0.0], np.arange(nx) + 0.5, [nx]])
    rows = [odd if j % 2 else even for j in range(ny + 1)]
    points = np.concatenate([np.stack([x, np.full(len(x), float(j))], axis=1) for j, x in enumerate(rows)])
    k, triangles = np.arange(nx + 1), []
    for j in range(ny):
        # row of nx + 1 vertices (short), and row of nx + 2 (long) on its upper or lower side
        short, long = ((nx + 1) * r + r // 2 for r in (j + j % 2, j + 1 - j % 2))
        on_long = np.stack([long + k, short + k, long + k + 1], axis=1)
        on_short = np.stack([short + k[:-1], short + k[1:], long + k[1:]], axis=1)
        triangles += [on_long[:, ::-1], on_short[:, ::-1]] if j % 2 else [on_long, on_short]
    return points, np.concatenate(triangles)


def _rings(rings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (distance from the centre as a fraction (P,), angle (P,) [rad], triangles) of the mesh of `disc`."""
    _check_counts(rings=rings)
    distance, angle, triangles = [np.zeros(1)], [np.zeros(1)], []
    for k in range(1, rings + 1):
        distance.append(np.full(6 * k, k / rings))
        angle.append(2.0 * np.pi * np.arange(6 * k) / (6 * k))
        inside, outside = (1 + 3 * r * (r - 1) if r else 0 for r in (k - 1, k))
        sector, i = np.divmod(np.arange(6 * k), k)
        inner = inside + (sector * (k - 1) + i) % max(1, 6 * (k - 1))
        outer, outer_next = outside + np.arange(6 * k), outside + (np.arange(6 * k) + 1) % (6 * k)
        triangles.append(np.stack([inner, outer, outer_next], axis=1))
        between = i < k - 1
        inner_next = inside + (sector * (k - 1) + i + 1) % max(1, 6 * (k - 1))
        triangles.append(np.stack([inner, outer_next, inner_next], axis=1)[between])
    return np.concatenate(distance), np.concatenate(angle), np.concatenate(triangles)

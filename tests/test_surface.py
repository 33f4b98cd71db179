"""Triangle meshes: neighbour tables of `Surface`, refused meshes, and geometry of mesh generators."""

import numpy as np
import pytest

from ddg_warp.errors import SceneError
from ddg_warp.geometry import meshes
from ddg_warp.geometry.surface import Surface

# Shape, its volume under the surface (divergence theorem: sum of det(a, b, c) / 6) in the fine limit, Euler
# characteristic.
CLOSED = {
    "sphere": (meshes.sphere(4), 4.0 / 3.0 * np.pi, 2),
    "torus": (meshes.torus(48, 40, 2.0, 0.5), 2.0 * np.pi**2 * 2.0 * 0.5**2, 0),
}
# Shape, area in the fine limit, Euler characteristic, lengths of the boundary loops, normal direction at vertex 0
OPEN = {
    "right": (meshes.rectangle(6, 4, (3.0, 1.0)), 3.0, 1, [20], (0, 0, 1)),
    "alternating": (meshes.rectangle(6, 4, (3.0, 1.0), "alternating"), 3.0, 1, [20], (0, 0, 1)),
    "crossed": (meshes.rectangle(6, 4, (3.0, 1.0), "crossed"), 3.0, 1, [20], (0, 0, 1)),
    "equilateral": (meshes.rectangle(6, 5, (3.0, 1.0), "equilateral"), 3.0, 1, [6 + 7 + 10], (0, 0, 1)),
    "jittered": (meshes.jittered_rectangle(9, 5, (3.0, 1.0)), 3.0, 1, [28], (0, 0, 1)),
    "disc": (meshes.disc(24, 2.0), 4.0 * np.pi, 1, [144], (0, 0, 1)),
    "annulus": (meshes.annulus(3, 96, 1.0, 2.0), 3.0 * np.pi, 0, [96, 96], (0, 0, 1)),
    "slit": (meshes.annulus(3, 96, 1.0, 2.0, slit=True), 3.0 * np.pi, 1, [2 * 96 + 6], (0, 0, 1)),
    "panel": (meshes.cylinder_panel(40, 3, 2.0, 5.0, np.pi), 10.0 * np.pi, 1, [86], (0, -1, 0)),
    "cylinder": (meshes.cylinder(96, 4, 2.0, 5.0, "alternating"), 20.0 * np.pi, 0, [96, 96], (1, 0, 0)),
    "cap": (meshes.spherical_cap(24, 2.0), 8.0 * np.pi, 1, [144], (0, 0, 1)),
}
SHAPES = {name: case[0] for name, case in (CLOSED | OPEN).items()}


def vector_areas(points, triangles):
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return 0.5 * np.cross(b - a, c - a)


@pytest.mark.parametrize("name", SHAPES)
def test_neighbour_tables(name):
    surface = Surface(*SHAPES[name])
    triangles, edges = surface.triangles, surface.edges
    assert (edges[:, 0] < edges[:, 1]).all()
    assert np.array_equal(edges, np.unique(edges, axis=0))
    for i in range(3):
        start, end = triangles[:, (i + 1) % 3], triangles[:, (i + 2) % 3]
        edge, sign = surface.triangle_edges[:, i], surface.triangle_signs[:, i]
        # a triangle of sign +1 is the first of its edge, one of sign -1 the second; corner i is opposite
        assert np.array_equal(edges[edge], np.where(sign[:, None] > 0, [*zip(start, end)], [*zip(end, start)]))  # noqa: B905
        side = np.where(sign > 0, 0, 1)
        assert np.array_equal(surface.edge_triangles[edge, side], np.arange(len(triangles)))
        assert np.array_equal(surface.edge_opposite[edge, side], triangles[:, i])
    missing = surface.edge_triangles < 0
    assert np.array_equal(missing, surface.edge_opposite < 0)
    assert np.array_equal(missing.any(axis=1), surface.boundary)
    assert not missing.all(axis=1).any()
    assert np.count_nonzero(~missing) == 3 * len(triangles)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_shapes(name):
    (points, triangles), volume, characteristic = CLOSED[name]
    surface = Surface(points, triangles)
    assert surface.euler_characteristic == characteristic
    assert not surface.boundary.any() and surface.boundary_loops() == []
    assert np.linalg.det(points[triangles]).sum() / 6.0 == pytest.approx(volume, rel=0.01)


@pytest.mark.parametrize("name", OPEN)
def test_open_shapes(name):
    (points, triangles), area, characteristic, loops, facing = OPEN[name]
    surface = Surface(points, triangles)
    areas = vector_areas(points, triangles)
    plane = np.ptp(points[:, 2]) == 0.0 and name not in {"disc", "annulus", "slit"}
    assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(area, rel=1e-12 if plane else 2e-3)
    assert surface.euler_characteristic == characteristic
    assert [len(loop) for loop in surface.boundary_loops()] == loops
    at_first = areas[(triangles == 0).any(axis=1)].sum(axis=0)
    assert at_first @ facing > 0.99 * np.linalg.norm(at_first)


@pytest.mark.parametrize("name", OPEN)
def test_boundary_loops_run_with_the_surface_to_the_left(name):
    surface = Surface(*SHAPES[name])
    loops = surface.boundary_loops()
    pairs = np.concatenate([np.stack([loop, np.roll(loop, -1)], axis=1) for loop in loops])
    directed = {(t[i], t[(i + 1) % 3]) for t in surface.triangles.tolist() for i in range(3)}
    assert set(map(tuple, pairs.tolist())) == {(a, b) for a, b in directed if (b, a) not in directed}
    assert np.array_equal(np.sort(np.concatenate(loops)), np.flatnonzero(surface.boundary_vertices))
    assert [loop[0] for loop in loops] == sorted(loop.min() for loop in loops)


def test_edges_are_found():
    surface = Surface(*meshes.rectangle(3, 2, (3.0, 2.0)))  # vertex (i, j) is i + 4 j
    left = surface.edges_on(lambda x: x[:, 0] == 0.0)
    assert surface.edges[left].tolist() == [[0, 4], [4, 8]]
    assert np.array_equal(surface.edges_on(np.array([0, 4, 8])), left)
    assert np.array_equal(surface.edges_on(surface.points[:, 0] == 0.0), left)
    assert set(left) < set(surface.boundary_edges)
    for wrong in ([0, 12], [True, False], [0.5]):
        with pytest.raises(SceneError, match=r"no edges on these vertices .* give \(P,\) bool or indices"):
            surface.edges_on(wrong)
    edges = surface.edge_between([0, 8, 5], [4, 4, 0])
    assert surface.edges[edges].tolist() == [[0, 4], [4, 8], [0, 5]]
    assert surface.boundary[edges].tolist() == [True, True, False]
    for a, b in ((1, 4), (0, 12), (-1, 3), (2, 2)):
        with pytest.raises(SceneError, match=f"surface 'surface': there is no edge between the vertices {a} and {b}"):
            surface.edge_between([0, a], [1, b])


def test_grids_are_numbered_as_documented():
    points, _ = meshes.rectangle(4, 3, (2.0, 6.0))
    np.testing.assert_allclose(points[3 + 5 * 2], [1.5, 4.0, 0.0])
    points, _ = meshes.rectangle(4, 3, (2.0, 6.0), "crossed")
    np.testing.assert_allclose(points[5 * 4 + 3 + 4 * 2], [1.75, 5.0, 0.0])
    points, triangles = meshes.rectangle(4, 3, (4.0, 3.0 * np.sqrt(0.75)), "equilateral")
    np.testing.assert_allclose(points[5 * 3 + 1 + np.arange(6), 0], [0.0, 0.5, 1.5, 2.5, 3.5, 4.0])  # row 3
    sides = np.linalg.norm(points[triangles] - points[np.roll(triangles, 1, axis=1)], axis=-1)
    full = np.ptp(sides, axis=1) < 1e-12
    assert np.count_nonzero(~full) == 2 * 3  # a half triangle at each end of a row
    np.testing.assert_allclose(sides[full], 1.0)
    points, _ = meshes.annulus(2, 8, 1.0, 2.0)
    np.testing.assert_allclose(points[1 + 3 * 2], [0.0, 1.5, 0.0], atol=1e-15)
    points, _ = meshes.annulus(2, 8, 1.0, 2.0, slit=True)
    np.testing.assert_allclose(points[2 + 3 * 8], points[2], atol=1e-15)
    points, _ = meshes.cylinder_panel(4, 2, 2.0, 6.0, np.pi)
    np.testing.assert_allclose(points[3 + 5 * 1], [np.sqrt(2.0), np.sqrt(2.0), 3.0])
    points, _ = meshes.cylinder(4, 2, 2.0, 6.0)
    np.testing.assert_allclose(points[1 + 4 * 1], [0.0, 2.0, 3.0], atol=1e-15)
    points, _ = meshes.torus(4, 8, 3.0, 1.0)
    np.testing.assert_allclose(points[1 + 4 * 2], [0.0, 3.0, 1.0], atol=1e-15)
    points, _ = meshes.disc(3, 6.0)
    np.testing.assert_allclose(points[1 + 3 * 2 * 1 + 3], [0.0, 4.0, 0.0], atol=1e-15)  # ring 2, a quarter around
    points, _ = meshes.spherical_cap(3, 2.0, np.pi / 2)
    np.testing.assert_allclose(points[1 + 3 * 2 * 1 + 3], [0.0, np.sqrt(3.0), 1.0], atol=1e-15)
    np.testing.assert_allclose(points[0], [0.0, 0.0, 2.0])


@pytest.mark.parametrize("seed", range(8))
def test_jittered_rectangles_are_whole_and_repeat(seed):
    """Boundary vertices stay, no triangle lies on the boundary: 2 V - 2 - B = 2 nx ny triangles (Euler)."""
    nx, ny = 37, 11
    points, triangles = meshes.jittered_rectangle(nx, ny, (1.0, 2.0), 0.45, seed)
    surface = Surface(points, triangles)
    assert len(triangles) == 2 * nx * ny
    assert np.count_nonzero(surface.boundary) == 2 * (nx + ny)
    inside = ~surface.boundary_vertices
    moved = (points - meshes.rectangle(nx, ny, (1.0, 2.0))[0])[:, :2] * [nx, ny / 2.0]
    assert np.abs(moved[inside]).max() == pytest.approx(0.45, rel=0.01) and np.abs(moved[~inside]).max() < 1e-12
    assert np.bincount(triangles.ravel())[inside].max() >= 8  # unstructured
    again = meshes.jittered_rectangle(nx, ny, (1.0, 2.0), 0.45, seed)
    assert np.array_equal(points, again[0]) and np.array_equal(triangles, again[1])


SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
TENT = [*SQUARE, [0.5, 0.5, 1.0]]
BOW = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]]
TETRAHEDRON = [[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]]
TWO_TETRAHEDRA = [*TETRAHEDRON, *([t if t == 0 else t + 3 for t in f] for f in TETRAHEDRON)]
CORNERS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1], [0, -1, 0]]

REFUSED = {
    "index too large": (SQUARE, [[0, 1, 2], [0, 2, 4]], "triangle 1", "[0, 2, 4]", "there are 4", "0 to 3"),
    "index negative": (SQUARE, [[0, 1, 2], [0, 2, -1]], "triangle 1", "-1"),
    "no whole number": (SQUARE, [[0.0, 1.0, 2.0]], "float64", "whole numbers"),
    "quads": (SQUARE, [[0, 1, 2, 3]], "(1, 4)", "(T, 3)"),
    "polygons": (SQUARE, [[0, 1, 2], [0, 1, 2, 3]], "not of three", "(T, 3)"),
    "no points": ([[0, 0, "a"]], [[0, 1, 2]], "no array of numbers", "(P, 3)"),
    "nothing": (SQUARE, np.zeros((0, 3), int), "one at least"),
    "points in the plane": (np.array(SQUARE)[:, :2], [[0, 1, 2]], "(4, 2)", "(P, 3)"),
    "not finite": ([*SQUARE[:3], [0, np.nan, 0]], [[0, 1, 2], [0, 2, 3]], "vertex 3", "non-finite"),
    "corner twice": (SQUARE, [[0, 1, 2], [0, 3, 0]], "triangle 1", "a vertex twice", "remove"),
    "on a line": ([*SQUARE, [0.5, 0.5, 0]], [[0, 1, 4], [0, 4, 2], [0, 2, 3]], "triangle 1", "degenerate", "move"),
    "unused vertex": (SQUARE, [[0, 1, 2]], "vertex 3", "no triangle", "remove"),
    "three at an edge": (
        *(TENT, [[0, 1, 2], [0, 2, 3], [2, 0, 4]]),
        *("vertices 0 and 2", "3 triangles", "0 and 1 and 2", "several surfaces"),
    ),
    "orientation": (SQUARE, [[0, 1, 2], [0, 3, 2]], "triangles 0 and 1", "vertices 0 and 2", "same direction", "swap"),
    "triangle twice": (SQUARE[:3], [[0, 1, 2], [1, 2, 0]], "triangles 0 and 1", "same direction"),
    "back to back": (SQUARE[:3], [[0, 1, 2], [0, 2, 1]], "triangles 0 and 1", "same three vertices", "remove"),
    "bow tie": (BOW, [[0, 1, 2], [0, 3, 4]], "vertex 0", "meet", "a separate vertex"),
    "two closed fans": (CORNERS, TWO_TETRAHEDRA, "vertex 0", "meet", "a separate vertex"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_meshes_are_refused(name):
    points, triangles, *phrases = REFUSED[name]
    with pytest.raises(SceneError) as caught:
        Surface(points, triangles, name="sail")
    missing = [word for word in ["'sail'", *phrases] if word not in str(caught.value)]
    assert not missing, f"{missing} not in: {caught.value}"


def test_a_moebius_band_is_refused():
    """A band joined with half a twist has no consistent orientation."""
    n, angle = 12, 2.0 * np.pi * np.arange(12) / 12
    side = np.array([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)]).T
    centre = 3.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    k = np.arange(n - 1)
    lower, upper = np.append(k + 1, n), np.append(n + k + 1, 0)  # the last cell meets the first upside down
    triangles = [
        *np.stack([np.arange(n), lower, upper], axis=1),
        *np.stack([np.arange(n), upper, n + np.arange(n)], axis=1),
    ]
    with pytest.raises(SceneError, match=r"same direction.* or cut a surface that has one side only"):
        Surface(np.concatenate([centre - side, centre + side]), triangles)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: meshes.rectangle(3, 3, pattern="hexagonal"), "pattern is 'hexagonal'"),
        (lambda: meshes.rectangle(0, 3), "nx = 0"),
        (lambda: meshes.torus(5, 4, 2.0, 1.0, "alternating"), "even number"),
        (lambda: meshes.cylinder(2, 4, 1.0, 1.0), "at least 3"),
        (lambda: meshes.jittered_rectangle(3, 3, jitter=0.5), "jitter is 0.5"),
        (lambda: meshes.disc(0), "rings = 0"),
    ],
)
def test_bad_sizes_are_refused(make, message):
    with pytest.raises(SceneError, match=message):
        make()

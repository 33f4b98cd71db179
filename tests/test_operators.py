"""Differential geometry of meshes: exact identities, and convergence of integrals and curvatures with order 2."""

import numpy as np
import pytest

from ddg_warp.geometry import meshes, operators
from ddg_warp.geometry.surface import Surface

WARP = np.array([[1.0, 0.3, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 1.2]])


def wavy(points):
    """Return a shape without symmetry: doubly curved, sheared, with 10 % waves."""
    return points @ WARP + 0.1 * np.sin(3.0 * points @ WARP.T + [0.0, 1.0, 2.0])


SURFACES = {
    "sphere": Surface(*meshes.sphere(2)),
    "torus": Surface(*meshes.torus(16, 12, 2.0, 1.0)),
    "disc": Surface(*meshes.disc(6)),
    "annulus": Surface(*meshes.annulus(3, 18, 1.0, 2.0)),
    "jittered": Surface(*meshes.jittered_rectangle(9, 7, (2.0, 1.0), 0.45)),
}
CHARACTERISTIC = {"sphere": 2, "torus": 0, "disc": 1, "annulus": 0, "jittered": 1}


@pytest.fixture(params=SURFACES)
def case(request):
    """Return a surface and other positions of the vertices."""
    surface = SURFACES[request.param]
    return surface, wavy(surface.points)


def test_d1_of_d0_is_zero(case):
    """d1 d0 = 0, exactly; both have as many entries as the surface has corners and edge ends."""
    surface, _ = case
    assert np.count_nonzero((operators.d1(surface) @ operators.d0(surface)).toarray()) == 0
    assert operators.d0(surface).nnz == 2 * len(surface.edges)
    assert operators.d1(surface).nnz == 3 * len(surface.triangles)


def test_stokes(case):
    """The sum of d1 of a 1-form over all triangles equals the sum of the form along the boundary."""
    surface, _ = case
    form = np.cos(np.arange(len(surface.edges)))
    along = sum(
        np.sum(form[surface.edge_between(loop, after)] * np.where(loop < after, 1.0, -1.0))
        for loop in surface.boundary_loops()
        for after in [np.roll(loop, -1)]
    )
    assert (operators.d1(surface) @ form).sum() == pytest.approx(along, abs=1e-11)


@pytest.mark.parametrize("name", SURFACES)
def test_gauss_bonnet(name):
    """Angle defects, the boundary's included, sum to 2 pi chi for any shape."""
    surface = SURFACES[name]
    for points in (surface.points, wavy(surface.points)):
        defects = operators.angle_defects(surface, points)
        assert defects.sum() == pytest.approx(2.0 * np.pi * CHARACTERISTIC[name], abs=1e-10)
        assert np.abs(defects).max() > 0.01
    np.testing.assert_allclose(operators.corner_angles(surface).sum(axis=1), np.pi, rtol=1e-14)


def test_geodesic_curvature_of_the_boundary():
    """Boundary circles of a plane annulus rotate by 2 pi, the outer one left, the inner one right; the interior is flat."""
    surface = SURFACES["annulus"]
    defects = operators.angle_defects(surface)
    inner, outer = surface.boundary_loops()
    assert defects[outer].sum() == pytest.approx(2.0 * np.pi, abs=1e-12)
    assert defects[inner].sum() == pytest.approx(-2.0 * np.pi, abs=1e-12)
    assert np.abs(defects[~surface.boundary_vertices]).max() < 1e-13
    assert np.abs(operators.gaussian_curvature(surface)).max() < 1e-12


def test_dual_areas_fill_the_surface(case):
    surface, points = case
    area = operators.face_areas(surface, points).sum()
    for dual in (operators.barycentric_areas(surface, points), operators.mixed_areas(surface, points)):
        assert dual.sum() == pytest.approx(area, rel=1e-13)
        assert dual.min() > 0.0
    mass = operators.mass_matrix(surface, points)
    assert mass.shape == (len(points),) * 2 and mass.sum() == pytest.approx(area, rel=1e-13)
    np.testing.assert_allclose((operators.star2(surface, points) @ operators.face_areas(surface, points)), 1.0)


def test_mixed_areas_of_single_triangles():
    """Meyer et al. 2003: Voronoi cells in an acute triangle; halves and quarters in an obtuse one."""
    acute = Surface([[0, 0, 0], [2, 0, 0], [1, np.sqrt(3.0), 0]], [[0, 1, 2]])
    np.testing.assert_allclose(operators.mixed_areas(acute), np.sqrt(3.0) / 3.0)
    right = Surface([[0, 0, 0], [3, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    np.testing.assert_allclose(operators.mixed_areas(right), [0.75, 0.375, 0.375])
    obtuse = Surface([[0, 0, 0], [2, 0, 0], [-1, 1, 0]], [[0, 1, 2]])
    np.testing.assert_allclose(operators.mixed_areas(obtuse), [0.5, 0.25, 0.25])
    # isosceles, apex at height 2: its circumcentre (1, 0.75) is |1.25| from all; the cell at the apex is a kite of two
    # right triangles with legs sqrt(5)/2 and sqrt(1.25^2 - 5/4)
    isosceles = Surface([[0, 0, 0], [2, 0, 0], [1, 2, 0]], [[0, 1, 2]])
    kite = np.sqrt(5.0) / 2.0 * np.sqrt(1.25**2 - 1.25)
    np.testing.assert_allclose(operators.mixed_areas(isosceles), [1.0 - 0.5 * kite, 1.0 - 0.5 * kite, kite])


def test_laplacian_is_exterior_calculus(case):
    """L = d0^T star1 d0 is symmetric with constants in the kernel; u^T L u = integral of |grad u|^2 > 0."""
    surface, points = case
    matrix, difference = operators.laplacian(surface, points), operators.d0(surface)
    product = difference.T @ operators.star1(surface, points) @ difference
    scale = np.abs(matrix.toarray()).max()
    assert np.abs((matrix - product).toarray()).max() < 1e-13 * scale
    assert np.abs((matrix - matrix.T).toarray()).max() < 1e-15 * scale
    assert np.abs(matrix @ np.ones(len(points))).max() < 1e-12 * scale
    u = np.sin(5.0 * points[:, 0]) + points[:, 1]
    slopes = operators.gradient(surface, u, points)
    energy = np.sum(operators.face_areas(surface, points) * np.einsum("ij,ij->i", slopes, slopes))
    assert u @ matrix @ u == pytest.approx(energy, rel=1e-12) and energy > 0.1
    np.testing.assert_allclose(operators.divergence(surface, slopes, points), -matrix @ u, atol=1e-12 * scale)


def test_divergence_is_minus_the_adjoint_of_the_gradient(case):
    surface, points = case
    field = np.cos(np.arange(3.0 * len(surface.triangles))).reshape(-1, 3)
    u = np.sin(7.0 * points[:, 2]) + points[:, 0]
    slopes = operators.gradient(surface, u, points)
    expected = -np.sum(operators.face_areas(surface, points) * np.einsum("ij,ij->i", field, slopes))
    divergence = operators.divergence(surface, field, points)
    assert u @ divergence == pytest.approx(expected, rel=1e-11) and abs(expected) > 1e-3
    assert abs(divergence.sum()) < 1e-12 * np.abs(divergence).sum()


@pytest.mark.parametrize("name", ["disc", "annulus", "jittered"])
def test_linear_functions_are_exact_in_the_plane(name):
    """grad (a . x + b) = a; the Laplacian is 0 at all interior vertices."""
    surface = SURFACES[name]
    u = surface.points @ [2.0, -3.0, 0.0] + 5.0
    np.testing.assert_allclose(
        operators.gradient(surface, u), np.tile([2.0, -3.0, 0.0], (len(surface.triangles), 1)), atol=1e-12
    )
    inside = ~surface.boundary_vertices
    assert np.abs((operators.laplacian(surface) @ u)[inside]).max() < 1e-12
    assert np.abs((operators.laplacian(surface) @ u)[~inside]).max() > 0.1
    assert np.abs(operators.mean_curvature_vectors(surface)).max() < 1e-13
    np.testing.assert_array_equal(
        operators.face_normals(surface), np.tile([0.0, 0.0, 1.0], (len(surface.triangles), 1))
    )
    assert np.abs(operators.dihedral_angles(surface)).max() == 0.0


def test_mean_curvature_is_half_the_gradient_of_the_area(case):
    """2 H n = d area / d x, by central differences of order h^2 = 1e-10."""
    surface, points = case
    vectors, h = operators.mean_curvature_vectors(surface, points), 1e-5
    for vertex in np.flatnonzero(~surface.boundary_vertices)[::7]:
        for k in range(3):
            move = np.zeros_like(points)
            move[vertex, k] = h
            areas = [operators.face_areas(surface, points + sign * move).sum() for sign in (1, -1)]
            assert (areas[0] - areas[1]) / (4.0 * h) == pytest.approx(vectors[vertex, k], abs=1e-8)
    assert np.abs(vectors).max() > 1e-3


def test_dihedral_angles_of_a_roof():
    """Two triangles folded about a common edge: the angle is positive for a ridge above, also beyond 90 degrees."""
    for fold in (-2.5, -0.3, 0.0, 0.3, 2.5):
        points = [[0, 0, 0], [0, 2, 0], [-1, 1, 0], [np.cos(fold), 1, -np.sin(fold)]]
        for triangles in ([[0, 1, 2], [1, 0, 3]], [[1, 0, 3], [2, 0, 1]]):
            roof = Surface(points, triangles)
            angles = operators.dihedral_angles(roof)
            ridge = roof.edge_between(0, 1)
            assert angles[ridge] == pytest.approx(fold, abs=1e-14)
            assert np.abs(np.delete(angles, ridge)).max() == 0.0
            assert operators.edge_mean_curvatures(roof)[ridge] == pytest.approx(fold, abs=1e-14)  # |e| / 2 = 1


# Integrals on smooth surfaces (closed forms). Sphere of radius R: H = 1/R, K = 1/R^2, int H = 4 pi R, int H^2 = 4 pi. Torus of
# radii R, r: area 4 pi^2 R r, int H = 2 pi^2 R, int H^2 = pi^2 c^2 / sqrt(c^2 - 1) with c = R/r (Willmore 1965).
INTEGRALS = {
    "sphere R=1": ([meshes.sphere(k) for k in (3, 4)], 12.566370614, 12.566370614, 12.566370614),
    "sphere R=2": ([meshes.sphere(k, 2.0) for k in (3, 4)], 50.265482457, 25.132741229, 12.566370614),
    "torus R=2": ([meshes.torus(3 * n, 2 * n, 2.0, 1.0) for n in (16, 32)], 78.9568, 39.4784, 22.7929),
    "torus Clifford": ([meshes.torus(3 * n, 2 * n, 2**0.5, 1.0) for n in (16, 32)], 55.8309, 27.9155, 19.7392),
}


@pytest.mark.parametrize("name", INTEGRALS)
def test_integrals_converge_with_order_two(name):
    shapes, *references = INTEGRALS[name]
    errors = []
    for shape in shapes:
        surface = Surface(*shape)
        by_vertices = operators.mean_curvature(surface) @ operators.mixed_areas(surface)
        by_edges = operators.edge_mean_curvatures(surface).sum()
        area, willmore = operators.face_areas(surface).sum(), operators.willmore_energy(surface)
        exact = [references[0], references[1], references[1], references[2]]
        errors.append(np.abs(np.array([area, by_vertices, by_edges, willmore]) / exact - 1.0))
    orders = np.log2(errors[0] / errors[1])
    assert (np.abs(orders - 2.0) < 0.05).all(), orders
    assert errors[1].max() < 5e-3


def test_pointwise_curvatures_converge_with_order_two_on_a_regular_torus():
    """H = (R + 2 r cos t) / (2 r (R + r cos t)), K = cos t / (r (R + r cos t)), t around the tube."""
    major, minor, errors = 2.0, 1.0, []
    for n in (16, 32):
        surface = Surface(*meshes.torus(3 * n, 2 * n, major, minor))
        cosine = (np.hypot(surface.points[:, 0], surface.points[:, 1]) - major) / minor
        mean = (major + 2.0 * minor * cosine) / (2.0 * minor * (major + minor * cosine))
        gauss = cosine / (minor * (major + minor * cosine))
        curvatures = operators.mean_curvature(surface), operators.gaussian_curvature(surface)
        errors.append([np.abs(curvatures[0] - mean).max(), np.abs(curvatures[1] - gauss).max()])
    orders = np.log2(np.divide(*errors))
    assert (np.abs(orders - 2.0) < 0.1).all(), orders
    assert np.max(errors[1]) < 0.01


def test_a_cylinder_is_bent_one_way():
    """H = 1 / (2 R), K = 0; an inward orientation changes the sign of H."""
    points, triangles = meshes.cylinder(96, 24, 2.0, 3.0)
    for order, sign in (([0, 1, 2], 1.0), ([0, 2, 1], -1.0)):
        surface = Surface(points, triangles[:, order])
        inside = ~surface.boundary_vertices
        np.testing.assert_allclose(operators.mean_curvature(surface)[inside], sign / 4.0, rtol=1e-3)
        assert np.abs(operators.gaussian_curvature(surface)).max() < 1e-10
        # dihedral angles along the cylinder sum as in a polygon: the sum of |e| theta / 2 is pi L
        assert operators.edge_mean_curvatures(surface).sum() == pytest.approx(sign * np.pi * 3.0, rel=1e-12)


def test_vertex_normals():
    """Angle weights are independent of the triangulation of a face: a cube corner's normal is the diagonal."""
    corner = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1]]
    quads = ([0, 3, 2, 1], [0, 5, 4, 3], [0, 1, 6, 5])
    triangles = [[q[0], q[1], q[2]] for q in quads] + [[q[0], q[2], q[3]] for q in quads]
    triangles = [*triangles[:2], [0, 1, 5], *triangles[3:5], [1, 6, 5]]  # the third quad has the other diagonal
    normal = operators.vertex_normals(Surface(corner, triangles))[0]
    np.testing.assert_allclose(normal, -np.ones(3) / np.sqrt(3.0), rtol=1e-14)
    sphere = SURFACES["sphere"]
    assert np.einsum("ij,ij->i", operators.vertex_normals(sphere), sphere.points).min() > 0.9995

"""Discrete differential geometry of triangle meshes: normals, areas, curvatures, Laplacian, exterior calculus.

Every function takes a `Surface` and the current positions of its vertices (P, 3), by default the surface's own.
Curvatures of a sphere that faces outwards are positive, H = 1/R.
Integrated quantities are integrals over the dual cell of a vertex or edge; divided by its area they are pointwise.

Sources:

    [M] Meyer, Desbrun, Schroeder, Barr: Discrete differential-geometry operators for triangulated 2-manifolds, 2003.
    [C] Crane: Discrete differential geometry: an applied introduction, 2023.
    [B] Baerentzen, Aanaes: Signed distance computation using the angle weighted pseudonormal, 2005.
"""

import numpy as np
from scipy import sparse

from ddg_warp.geometry.surface import AFTER, BEFORE, Surface


def face_normals(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the unit normals (T, 3); 0 for a triangle that has collapsed."""
    return _unit_or_zero(_double_area_vectors(_corners(surface, points)))


def face_areas(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the areas of the triangles (T,) [m^2]."""
    return 0.5 * np.linalg.norm(_double_area_vectors(_corners(surface, points)), axis=-1)


def corner_angles(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the inner angles (T, 3) [rad]."""
    return np.arctan2(*_sines_cosines(_corners(surface, points)))


def cotangents(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the cotangents of the inner angles (T, 3)."""
    sines, cosines = _sines_cosines(_corners(surface, points))
    return cosines / sines


def vertex_normals(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return unit vertex normals (P, 3): means of triangle normals weighted with the corner angles [B].

    Only `triangles` of the surface is read, so that the points may belong to several surfaces. A vertex that no triangle
    uses, or whose triangles cancel, has the normal 0.
    """
    points = surface.points if points is None else points
    weighted = face_normals(surface, points)[:, None] * corner_angles(surface, points)[..., None]
    normals = np.stack([_at_vertices(surface, weighted[..., k], len(points)) for k in range(3)], axis=1)
    return _unit_or_zero(normals)


def barycentric_areas(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return dual areas of the vertices (P,) [m^2]: a third of each adjacent triangle."""
    thirds = np.repeat(face_areas(surface, points)[:, None] / 3.0, 3, axis=1)
    return _at_vertices(surface, thirds, len(surface.points))


def mixed_areas(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the dual areas of the vertices (P,) [m^2] as in [M, figure 4]: Voronoi cells, cut off in obtuse triangles.

    An obtuse triangle gives half of its area to the obtuse corner and a quarter to each other corner.
    """
    corners = _corners(surface, points)
    sines, cosines = _sines_cosines(corners)
    areas = 0.5 * sines[:, :1]
    sides = corners[:, BEFORE] - corners[:, AFTER]
    weight = np.einsum("tij,tij->ti", sides, sides) * cosines / sines / 8.0  # [M, equation 7]
    voronoi = weight[:, AFTER] + weight[:, BEFORE]
    obtuse = cosines < 0.0
    cut = np.where(obtuse, 0.5, 0.25) * areas
    return _at_vertices(surface, np.where(obtuse.any(axis=1, keepdims=True), cut, voronoi), len(surface.points))


def edge_weights(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return (cot a + cot b) / 2 of the angles opposite to each edge (E,): length of the dual edge over the edge [C].

    Negative where a + b > pi, which no edge of a Delaunay mesh has.
    """
    weights = 0.5 * cotangents(surface, points)
    return np.bincount(surface.triangle_edges.ravel(), weights.ravel(), minlength=len(surface.edges))


def dihedral_angles(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the angles between the normals of the two triangles at each edge (E,) [rad], in (-pi, pi], positive where convex.

    At the boundary the angle is 0.
    """
    points = surface.points if points is None else points
    normals = face_normals(surface, points)
    inner = ~surface.boundary
    before, after = (normals[surface.edge_triangles[inner, side]] for side in (0, 1))
    along = points[surface.edges[inner, 1]] - points[surface.edges[inner, 0]]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    angles = np.zeros(len(surface.edges))
    sine = np.einsum("ij,ij->i", np.cross(before, after), along)
    angles[inner] = np.arctan2(sine, np.einsum("ij,ij->i", before, after))
    return angles


def edge_mean_curvatures(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the mean curvature integrated around each edge (E,) [m]: |e| theta / 2, by the formula of Steiner [C]."""
    points = surface.points if points is None else points
    lengths = np.linalg.norm(points[surface.edges[:, 1]] - points[surface.edges[:, 0]], axis=-1)
    return 0.5 * lengths * dihedral_angles(surface, points)


def mean_curvature_vectors(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the mean curvature times normal, integrated over the dual cells (P, 3) [m]: L x / 2, [M, equation 8].

    This is half of the gradient of the area. It is 0 at boundary vertices, where L x holds the boundary's conormal too.
    """
    points = surface.points if points is None else points
    vectors = 0.5 * (laplacian(surface, points) @ points)
    vectors[surface.boundary_vertices] = 0.0
    return vectors


def mean_curvature(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the mean curvature H = (k1 + k2) / 2 at the vertices (P,) [1/m]; 0 at boundary vertices, which do not have one."""
    along_normal = np.einsum("ij,ij->i", mean_curvature_vectors(surface, points), vertex_normals(surface, points))
    return along_normal / mixed_areas(surface, points)


def willmore_energy(surface: Surface, points: np.ndarray | None = None) -> float:
    """Return the integral of H^2 over the dual cells of all interior vertices."""
    vectors = mean_curvature_vectors(surface, points)
    return float(np.sum(np.einsum("ij,ij->i", vectors, vectors) / mixed_areas(surface, points)))


def angle_defects(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return integrated curvatures of the vertices (P,) [rad], whose sum is 2 pi times the Euler characteristic (Gauss-Bonnet).

    Inside: 2 pi less the angles of the triangles, which is the integrated Gaussian curvature [M, equation 9]. On the boundary:
    pi less the angles, which is the integrated geodesic curvature of the boundary, positive where it is convex.
    """
    around = _at_vertices(surface, corner_angles(surface, points), len(surface.points))
    return np.where(surface.boundary_vertices, np.pi, 2.0 * np.pi) - around


def gaussian_curvature(surface: Surface, points: np.ndarray | None = None) -> np.ndarray:
    """Return the Gaussian curvature K = k1 k2 at the vertices (P,) [1/m^2]; 0 at boundary vertices, which do not have one.

    It converges only where the mesh is regular; its integrals, the `angle_defects`, always do.
    """
    defects = np.where(surface.boundary_vertices, 0.0, angle_defects(surface, points))
    return defects / mixed_areas(surface, points)


def laplacian(surface: Surface, points: np.ndarray | None = None) -> sparse.csr_matrix:
    """Return the cotangent Laplacian L (P, P), symmetric positive semidefinite: u^T L u is twice the Dirichlet energy of u.

    (L u)_i is minus the Laplacian of u, integrated over the dual cell of vertex i; `laplacian = d0^T star1 d0`.
    """
    weights = 0.5 * cotangents(surface, points).ravel()
    a, b = surface.triangles[:, AFTER].ravel(), surface.triangles[:, BEFORE].ravel()
    rows, columns = np.concatenate([a, b, a, b]), np.concatenate([b, a, a, b])
    values = np.concatenate([-weights, -weights, weights, weights])
    return sparse.csr_matrix((values, (rows, columns)), shape=(len(surface.points),) * 2)


def mass_matrix(surface: Surface, points: np.ndarray | None = None) -> sparse.dia_matrix:
    """Return the lumped mass matrix (P, P) of unit density: barycentric dual areas, the row sums of the consistent matrix."""
    return sparse.diags(barycentric_areas(surface, points))


def d0(surface: Surface) -> sparse.csr_matrix:
    """Return the exterior derivative of 0-forms (E, P): the difference along each edge, from edges[:, 0] to edges[:, 1]."""
    rows = np.repeat(np.arange(len(surface.edges)), 2)
    signs = np.tile([-1.0, 1.0], len(surface.edges))
    return sparse.csr_matrix((signs, (rows, surface.edges.ravel())), shape=(len(surface.edges), len(surface.points)))


def d1(surface: Surface) -> sparse.csr_matrix:
    """Return the exterior derivative of 1-forms (T, E): the sum around each triangle; d1 d0 = 0."""
    rows = np.repeat(np.arange(len(surface.triangles)), 3)
    signs = surface.triangle_signs.ravel().astype(np.float64)
    shape = (len(surface.triangles), len(surface.edges))
    return sparse.csr_matrix((signs, (rows, surface.triangle_edges.ravel())), shape=shape)


def star0(surface: Surface, points: np.ndarray | None = None) -> sparse.dia_matrix:
    """Return the Hodge star of 0-forms (P, P), diagonal: mixed dual areas [m^2]."""
    return sparse.diags(mixed_areas(surface, points))


def star1(surface: Surface, points: np.ndarray | None = None) -> sparse.dia_matrix:
    """Return the Hodge star of 1-forms (E, E), diagonal: lengths of dual edges over lengths of edges, see `edge_weights`."""
    return sparse.diags(edge_weights(surface, points))


def star2(surface: Surface, points: np.ndarray | None = None) -> sparse.dia_matrix:
    """Return the Hodge star of 2-forms (T, T), diagonal: one over the area [1/m^2]."""
    return sparse.diags(1.0 / face_areas(surface, points))


def gradient(surface: Surface, values: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
    """Return the gradient on each triangle (T, 3) of a piecewise linear function from vertex values (P,)."""
    return np.einsum("tij,ti->tj", _hat_gradients(_corners(surface, points)), np.asarray(values)[surface.triangles])


def divergence(surface: Surface, field: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
    """Return the divergence, integrated over dual cells (P,), of a piecewise constant field (T, 3).

    Minus the adjoint of the gradient: sum_t area_t field_t . gradient(u)_t = -sum_i u_i divergence_i. No flux leaves through
    the boundary, and divergence(gradient(u)) = -L u.
    """
    corners = _corners(surface, points)
    areas = 0.5 * np.linalg.norm(_double_area_vectors(corners), axis=-1)
    outflow = -areas[:, None] * np.einsum("tij,tj->ti", _hat_gradients(corners), field)
    return _at_vertices(surface, outflow, len(surface.points))


def _corners(surface: Surface, points: np.ndarray | None) -> np.ndarray:
    """Return the positions of the corners (T, 3, 3)."""
    return (surface.points if points is None else points)[surface.triangles]


def _double_area_vectors(corners: np.ndarray) -> np.ndarray:
    """Return normals (T, 3) scaled by twice the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _sines_cosines(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sine and cosine of the inner angles times both adjacent sides, (T, 3) each; the sines are twice the area."""
    to_after, to_before = corners[:, AFTER] - corners, corners[:, BEFORE] - corners
    double_areas = np.linalg.norm(_double_area_vectors(corners), axis=-1)
    return np.repeat(double_areas[:, None], 3, axis=1), np.einsum("tij,tij->ti", to_after, to_before)


def _unit_or_zero(vectors: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.0)


def _hat_gradients(corners: np.ndarray) -> np.ndarray:
    """Return gradients (T, 3, 3) of the linear hat functions of the corners: n x e_i / (2 area)."""
    vectors = _double_area_vectors(corners)
    opposite = corners[:, BEFORE] - corners[:, AFTER]
    return np.cross(vectors[:, None], opposite) / np.einsum("tj,tj->t", vectors, vectors)[:, None, None]


def _at_vertices(surface: Surface, values: np.ndarray, count: int) -> np.ndarray:
    """Sum of values at the corners (T, 3) over each of the `count` vertices."""
    return np.bincount(surface.triangles.ravel(), values.ravel(), minlength=count)

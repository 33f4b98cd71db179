"""Triangulation of polygons in files: exact cover from any first corner, or refusal by face number."""

import numpy as np
import pytest

from ddg_warp.geometry import polygons
from ddg_warp.geometry.operators import face_areas
from ddg_warp.geometry.surface import Surface
from ddg_warp.io import MeshError
from ddg_warp.io.faces import triangulated
from ddg_warp.io.mesh_read import read_mesh

L_SHAPE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
ARROW = [(0, 0), (2, -1), (0.5, 0), (2, 1)]  # a concave quad
COMB = [(0, 0), (5, 0), (5, 3), (4, 3), (4, 1), (3, 1), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
MIDDLES = [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)]  # a square with the middles of its edges
SPIRAL = [(0, 0), (4, 0), (4, 4), (1, 4), (1, 2), (2, 2), (2, 3), (3, 3), (3, 1), (0, 1)]
KEYHOLE = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1)]  # a square hole, by a bridge


def in_space(corners, inclined: bool = True) -> np.ndarray:
    """Return the corners of a plane polygon in an inclined plane in space."""
    flat = np.column_stack([np.array(corners, float), np.zeros(len(corners))])
    axes = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return flat @ axes * np.linalg.det(axes) + [1.0, -2.0, 3.0] if inclined else flat


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e5])
@pytest.mark.parametrize(
    "corners", [L_SHAPE, ARROW, COMB, MIDDLES, SPIRAL, KEYHOLE], ids="L arrow comb middles spiral hole".split()
)
def test_triangles_cover_the_polygon(corners, scale):
    """Triangles have the polygon's orientation, and their areas sum to sum (x_i y_{i+1} - x_{i+1} y_i) / 2."""
    x, y = np.array(corners, float).T
    area = 0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
    for first in range(len(corners)):
        points = scale * in_space(corners[first:] + corners[:first])
        triangles, fault = polygons.triangulate(points)
        assert fault == "" and triangles.shape == (len(corners) - 2, 3)
        vectors = polygons.area_vectors(points[triangles])
        normal = polygons.area_vectors(points)
        assert (vectors @ normal > 0.0).all()
        assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(area * scale**2, rel=1e-9)


@pytest.mark.parametrize("corners", [L_SHAPE, ARROW, SPIRAL], ids=["L", "arrow", "spiral"])
def test_triangles_of_obj_files_keep_polygon_areas(tmp_path, corners):
    for first in range(len(corners)):
        lines = [f"v {x} {y} 0" for x, y in corners[first:] + corners[:first]]
        path = tmp_path / "one.obj"
        path.write_text("\n".join([*lines, "f " + " ".join(str(k + 1) for k in range(len(corners)))]))
        points, triangles, _ = read_mesh(path)
        x, y = np.array(corners, float).T
        area = 0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
        assert face_areas(Surface(points, triangles)).sum() == pytest.approx(area)


def test_convex_faces_become_fans_in_order():
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0.5, 0), (3, 0, 0), (1.5, 3, 0.0)])
    triangles, face = triangulated(points, np.array([4, 3, 4]), np.array([0, 1, 2, 3, 1, 4, 2, 1, 5, 4, 6]), "a")
    assert face.tolist() == [0, 0, 1, 2, 2]
    assert triangles[:3].tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
    assert (np.linalg.norm(polygons.area_vectors(points[triangles]), axis=1) > 0.0).all()


@pytest.mark.parametrize(
    "corners, fault",
    [
        ([(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1.5, 0)], "crosses itself"),
        ([(np.cos(a), np.sin(a), 0) for a in 4 * np.pi / 5 * np.arange(5)], "crosses itself"),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)], "has no area"),
        ([(0, 0, 0), (1, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], "has an edge without length"),
        ([(0, 0, 0), (1, 0, 2), (1, 1, 0), (0, 1, 2)], "is far from a plane"),
        ([(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1, 0)], "has no area"),
    ],
)
def test_invalid_faces_are_refused_by_number(tmp_path, corners, fault):
    good = "v 0 0 9\nv 1 0 9\nv 0 1 9\n"
    lines = "\n".join(f"v {x} {y} {z}" for x, y, z in corners)
    path = tmp_path / "bad.obj"
    path.write_text(f"{good}{lines}\nf 1 2 3\nf " + " ".join(str(k + 4) for k in range(len(corners))))
    with pytest.raises(MeshError, match=rf"bad\.obj:{5 + len(corners)}: face 1 with {len(corners)} corners {fault}"):
        read_mesh(path)

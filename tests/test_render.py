"""Shaded pictures: positions, sizes and depth order in the image; skipped without pyvista."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.io.curves import CurveSet
from ddg_warp.io.shapes import Curves
from ddg_warp.run import figure
from ddg_warp.run.render import Canvas, View
from ddg_warp.view.drawing import directions

pytest.importorskip("pyvista", reason="needs pyvista: pip install -e .[render]")

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)
RADIUS = 0.05  # m


def beam(points, radius=RADIUS) -> Curves:
    """Return the curves of one rod."""
    n = len(points)
    return Curves(np.array([n]), np.array([False]), np.full(n, radius), np.array(["rod"]), np.zeros(1, int))


def pixel_of(view: View, canvas: Canvas, point) -> tuple[int, int]:
    """Return row and column of the pixel that shows a point."""
    x, y = (view.project(np.asarray(point, float)) - [view.low[0], view.high[1]]) / canvas.pixel
    return int(-y), int(x)


@pytest.fixture
def crossing():
    """Return an image of a red rod along x in front of a blue one along z, its view and canvas; y points away from the eye."""
    red = np.linspace((-1.0, -0.5, 0.0), (1.0, -0.5, 0.0), 9)
    blue = np.linspace((0.0, 0.5, -1.0), (0.0, 0.5, 1.0), 9)
    view = View.fitted(np.concatenate([red, blue]), directions(0.0, -0.5 * np.pi), (0.5, 2.0))
    canvas = Canvas(view, 400)
    canvas.tubes("red", red, beam(red), RED)
    canvas.tubes("blue", blue, beam(blue), BLUE)
    yield canvas.image(), view, canvas
    canvas.close()


def hue(pixel) -> str:
    """Return the name of a pixel's color."""
    if (np.asarray(pixel) == 255).all():
        return "white"
    return "red" if pixel[0] > 1.5 * pixel[2] else "blue" if pixel[2] > 1.5 * pixel[0] else "grey"


def test_rods_are_where_they_project_and_the_near_one_hides_the_far_one(crossing):
    image, view, canvas = crossing
    assert image.shape == (400, 400, 3)
    hues = {name: hue(image[pixel_of(view, canvas, point)]) for name, point in PLACES.items()}
    assert hues == {"middle": "red", "left": "red", "above": "blue", "beside": "white"}


PLACES = {"middle": (0, 0, 0), "left": (-0.7, -0.5, 0), "above": (0, 0.5, 0.7), "beside": (0.5, 0, 0.5)}


def test_rods_have_their_radius(crossing):
    image, _, canvas = crossing
    column = image[:, pixel_of(*crossing[1:], (-0.7, -0.5, 0.0))[1]]
    width = (column != 255).any(1).sum() * canvas.pixel
    assert width == pytest.approx(2.0 * RADIUS, abs=2.0 * canvas.pixel)


def test_thin_rods_have_some_pixels():
    line = np.linspace((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5)
    canvas = Canvas(View.fitted(line, directions(0.0, -0.5 * np.pi), (1.0, 1.0)), 200)
    canvas.tubes("thin", line, beam(line, 1e-6), RED, thinnest=4.0)
    assert 3 <= (canvas.image()[:, 100] != 255).any(1).sum() <= 6
    canvas.close()


def test_a_closed_surface_is_open_towards_its_inside():
    """A wall is invisible from behind, a sheet is not."""
    points, triangles = meshes.rectangle(1, 1)  # normals along z
    for closed, upside, expected in ((True, 1, "grey"), (True, -1, "white"), (False, -1, "grey")):
        faces = triangles[:, ::upside]
        canvas = Canvas(View.fitted(points, directions(0.5 * np.pi, 0.0), (1.0, 1.0)), 100)
        canvas.mesh("wall", points, faces, (0.5, 0.5, 0.5), closed=closed)
        assert hue(canvas.image()[50, 50]) == expected
        canvas.close()


def test_solid_pictures_are_rendered_with_a_ruler_and_marks(monkeypatch):
    figures = []
    monkeypatch.setattr(figure, "save", lambda figure, path: figures.append(figure))
    scene = ddg.Scene()
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 9)
    scene.add_rod(points, section=ddg.Circle(RADIUS), material=ddg.Material(1e6))
    model = scene.build("cpu")
    loads = np.array([8]), np.array([[0.0, 0.0, -2.0]])
    shapes = {0.0: points, 1.0: points + [0.0, 0.0, 0.2]}
    figure.rods_picture(model, shapes, "unused.png", "A rod.", fixed=np.array([0]), loads=loads)
    plot = figures[0].axes[0]
    (image,) = plot.get_images()
    texts = {text.get_text() for text in plot.texts}
    assert {"x", "y", "z", "0.2 m"} <= texts
    assert "fixed nodes; green arrows" in figures[0].get_supxlabel()
    shown = image.get_array()[..., :3].astype(int)
    green = (shown[..., 1] > shown[..., 0] + 30) & (shown[..., 1] > shown[..., 2] + 30)
    dark = (shown < 60).all(-1)
    assert green.sum() > 50 and dark.sum() > 50


def test_curves_of_a_file_without_radii_are_rendered(monkeypatch):
    figures = []
    monkeypatch.setattr(figure, "save", lambda figure, path: figures.append(figure))
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 9)
    curves = CurveSet(points, np.array([9]), np.array([False]), None, "/hair")
    figure.rods_picture(curves, {0.0: points}, "unused.png")
    (image,) = figures[0].axes[0].get_images()
    assert (image.get_array() != 255).any(-1).mean() > 1e-3

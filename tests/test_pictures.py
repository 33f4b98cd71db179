"""Pictures with labels of modes, units, load parameter and stability, and with titles that fit."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.io.rod_tubes import SIDES
from ddg_warp.run import figure, plots
from ddg_warp.run.cli import main
from ddg_warp.run.panel import tubes
from ddg_warp.run.scene_registry import load_scene, one_liner, scene_files
from ddg_warp.run.simulate import simulate


@pytest.fixture
def drawn(monkeypatch) -> list:
    """Return figures that are drawn instead of written."""
    figures = []
    for module in (figure, plots):
        monkeypatch.setattr(module, "save", lambda figure, path: figures.append(figure))
    return figures


@pytest.fixture
def plain(monkeypatch) -> None:
    """Draw as without pyvista."""
    monkeypatch.setattr(figure, "available", lambda: False)


def labels(figure) -> list[str]:
    """Return all labels of all axes."""
    return [text for plot in figure.axes for text in (plot.get_xlabel(), plot.get_ylabel()) if text]


# Scene, parameters, drawn amplitude of the mode, and its direction.
MODES = {
    "greenhill": ({"n": 24}, 0.1, (0.0, 1.0, 1.0)),
    "michell_ring": ({"n": 24}, 0.3, (1.0, 1.0, 1.0)),
    "right_angle_frame": ({"n": 6}, 60.0, (0.0, 1.0, 0.0)),
    "plate_buckling": ({"cells": 4}, 0.15, (0.0, 0.0, 1.0)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name != "greenhill" else pytest.mark.slow) for name in MODES]
)
def test_scenes_that_buckle_show_the_mode(name):
    """The lowest mode leaves the straight rod, the plane of ring and frame, or the plate, by the given amplitude."""
    parameters, size, across = MODES[name]
    module = load_scene(name)
    result = simulate(module.build(**parameters), device="cpu", progress=False)
    options = module.picture(result, {})
    shown = options["points_by_time"]
    start = shown.get(0.0, result.state.points())
    moved = np.linalg.norm((shown[1.0] - start) * across, axis=1)
    assert moved.max() == pytest.approx(size, rel=1e-3)
    aside = np.linalg.norm((shown[1.0] - start) * (1.0 - np.array(across)), axis=1)
    assert aside.max() < 1e-3 * size
    if name == "michell_ring":  # out of the plane in two waves around: cos 2 phi
        waves = np.abs(np.fft.rfft(shown[1.0][:, 2]))
        assert waves[2:].argmax() == 0
    if "values" in options:
        assert np.abs(options["values"]).max() == pytest.approx(1.0, rel=1e-3)


def test_the_plate_shows_its_deflection():
    module = load_scene("plate_square")
    result = simulate(module.build(cells=4), device="cpu", progress=False)
    options = module.picture(result, {})
    deflection = result.state.points()[:, 2]
    np.testing.assert_allclose(options["values"], 1e6 * deflection)
    shown = options["points_by_time"][1.0]
    np.testing.assert_allclose(
        shown[:, 2] / np.abs(shown[:, 2]).max(), deflection / np.abs(deflection).max(), rtol=1e-12
    )
    assert np.abs(shown[:, 2]).max() == pytest.approx(0.15)


def test_paths_and_statics_have_a_load_and_their_units(drawn, plain, tmp_path):
    """The frame is in millimetres, the legend separates branches, and no axis is a time."""
    assert main(["run", "right_angle_frame", "--n", "4", "--device", "cpu", "--out", str(tmp_path)]) == 0
    picture, path = drawn
    assert labels(picture)[0] == "x [mm]" and "amplitude of the buckling mode" in labels(picture)
    assert labels(path) == ["displacement [mm]", "load parameter"]
    legend = [text.get_text() for text in path.axes[0].get_legend().get_texts()]
    assert legend == ["deflection", "stable", "unstable", "bifurcation"]
    styles = {tuple(map(str, each.get_linestyle())) for each in path.axes[0].collections if len(each.get_segments())}
    assert len(styles) == 2
    assert main(["run", "tip_load", "--n", "10", "--device", "cpu", "--out", str(tmp_path / "b")]) == 0
    assert "load parameter" in labels(drawn[-1]) and "time [s]" not in labels(drawn[-1])


def test_axes_are_equal_and_without_offsets(drawn):
    """A rod far from the origin has axes with full numbers and one scale."""
    points = np.array([[1e4, 0.0, 0.0], [1e4 + 1e-3, 0.0, 0.0], [1e4 + 2e-3, 0.0, 1e-3]])
    scene = ddg.Scene()
    scene.add_rod(points, section=ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0, mass_per_length=1.0, radius=1e-4))
    figure.rods_picture(scene.build("cpu"), {0.0: points}, "unused.png")
    (plot,) = drawn[0].axes
    assert plot.get_aspect() == 1.0
    FigureCanvasAgg(drawn[0]).draw()
    assert plot.xaxis.get_offset_text().get_text() == plot.yaxis.get_offset_text().get_text() == ""


def test_shapes_of_a_path_keep_their_order(drawn, plain):
    """The last point of a path is on top even if the load is not the largest, and equal loads are all drawn."""
    points = np.eye(3)
    scene = ddg.Scene()
    scene.add_rod(points, section=ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0, mass_per_length=1.0, radius=1e-4))
    figure.rods_picture(scene.build("cpu"), [(0.0, points), (2.0, points + 1.0), (0.0, points + 2.0)], "unused.png")
    widths = [each.get_linewidth()[0] for each in drawn[0].axes[0].collections]
    assert len(widths) == 3 and widths[2] > widths[0] == widths[1]


def test_hair_is_shown_with_its_head_side_by_side(drawn):
    module = load_scene("strands")
    scene = module.build(count=8)
    result = simulate(scene, device="cpu", duration=1.0 / 60.0, observe=module.observe, progress=False)
    points = result.state.points()
    options = module.picture(result, {0.0: points, 0.5: points, 1.0: points})
    assert options["colors"].shape == (8, 3) and len(options["bodies"]) == 3
    head, _ = options["bodies"][0.0]
    roots = scene.batches[0].points[:, 0]
    centre = 0.5 * (head.min(axis=0) + head.max(axis=0))
    radius = 0.5 * np.ptp(head, axis=0).max() / module._strands.HEAD
    np.testing.assert_allclose(np.linalg.norm(roots - centre, axis=1), radius, rtol=0.05)
    figure.rods_picture(result.model, path="unused.png", **options)
    assert len(drawn[0].axes) == 3


def test_rods_have_their_thickness(drawn, plain):
    """Tubes of open and closed rods have correct surface areas and colors, and obstacles are drawn too."""
    angle = 2.0 * np.pi * np.arange(60) / 60
    scene = ddg.Scene()
    section = {"section": ddg.Circle(0.05), "material": ddg.Material(1e6)}
    scene.add_rod(np.linspace((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5), **section)
    scene.add_rod(np.stack([np.cos(angle), np.sin(angle), 0.0 * angle + 1.0], axis=1), closed=True, **section)
    model = scene.build("cpu")
    points, triangles = tubes(model.state().points(), model.curves)
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    mine = triangles[:, 0] < 5 * SIDES
    perimeter = 2.0 * SIDES * 0.05 * np.sin(np.pi / SIDES)
    ring = 120.0 * np.sin(np.pi / 60)
    assert [area[mine].sum(), area[~mine].sum()] == pytest.approx([2.0 * perimeter, ring * perimeter], rel=1e-3)
    ball = {0.0: meshes.sphere(1)}
    colors = np.eye(3)[:2]
    shapes = {0.0: model.state().points()}
    figure.rods_picture(model, shapes, "unused.png", obstacles=ball, thick=True, colors=colors)
    obstacle, rods = drawn[0].axes[0].collections
    assert len(obstacle.get_facecolor()) == len(ball[0.0][1]) and len(rods.get_facecolor()) == len(triangles)
    assert (rods.get_facecolor()[:, :2] > 0.0).sum(0).tolist() == [mine.sum(), (~mine).sum()]  # sorted by depth


def test_learned_lines_and_named_shapes_are_labelled(drawn):
    """Lines of one label have one color and one legend entry; named shapes are labelled by name."""
    x = np.arange(3.0)
    lines = [("seen", x, x, "o"), ("learned", x, 2.0 * x, "-"), ("learned", x, 3.0 * x, "-")]
    plots.lines_plot("unused.png", lines, "time [s]", "height [m]")
    (plot,) = drawn[0].axes
    assert [text.get_text() for text in plot.get_legend().get_texts()] == ["seen", "learned"]
    assert plot.lines[1].get_color() == plot.lines[2].get_color() != plot.lines[0].get_color()
    points, scene = np.eye(3), ddg.Scene()
    scene.add_rod(points, section=ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0, mass_per_length=1.0, radius=1e-4))
    model, names = scene.build("cpu"), ["sags", "hangs"]
    for side_by_side in (True, False):
        shapes = [(0.0, points), (1.0, 2.0 * points)]
        figure.rods_picture(model, shapes, "unused.png", names=names, side_by_side=side_by_side)
    assert [plot.get_title() for plot in drawn[1].axes] == names
    assert [text.get_text() for text in drawn[2].axes[1].get_yticklabels()] == names


def test_slim_shapes_fit_their_panels(drawn, plain):
    """Hanging strands are drawn whole, in their proportions."""
    module = load_scene("hair")
    result = simulate(module.build(strands=4), device="cpu", duration=1.0 / 60.0, progress=False)
    figure.rods_picture(result.model, path="unused.png", **module.picture(result, {0.0: result.state.points()}))
    FigureCanvasAgg(drawn[0]).draw()
    (plot,) = drawn[0].axes
    limits = np.array([plot.get_xlim(), plot.get_ylim(), plot.get_zlim()])
    matrix = plot.get_proj()
    scales = np.linalg.norm(
        (matrix @ (np.eye(4)[:, :3]))[:3], axis=0
    )  # of the picture plane and its depth, along x, y and z
    np.testing.assert_allclose(scales, scales[0], rtol=1e-6)
    assert limits[2, 1] - limits[2, 0] > 3.0 * (limits[0, 1] - limits[0, 0])
    homogeneous = np.column_stack([result.state.points(), np.ones(len(result.state.points()))]) @ matrix.T
    pixels = plot.transData.transform(homogeneous[:, :2] / homogeneous[:, 3:])
    assert (pixels > plot.bbox.min).all() and (pixels < plot.bbox.max).all()


def test_titles_fit(drawn, plain):
    """Titles of all scenes fit, in both kinds of pictures."""
    points = np.eye(3)
    scene = ddg.Scene()
    scene.add_rod(points, section=ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0, mass_per_length=1.0, radius=1e-4))
    model = scene.build("cpu")
    for path in scene_files().values():
        figure.rods_picture(model, {0.0: points}, "unused.png", one_liner(path))
        canvas = FigureCanvasAgg(drawn[-1])
        title = drawn[-1].get_suptitle() and drawn[-1]._suptitle.get_window_extent(canvas.get_renderer())
        assert title.x1 < drawn[-1].bbox.x1, path


# Scenes whose pictures are computed, at a small size, and whether every day; two steps of a motion are enough.
COMPUTED = {
    "axisymmetric_dome": ({"n": 20}, False),
    "bilayer_strip": ({"cells": 2}, True),
    "cable_on_table": ({"n": 40}, False),
    "capstan": ({"n": 20}, False),
    "cloth_on_sphere": ({"cells": 4}, False),
    "cloth_twist": ({"around": 12, "along": 6}, False),
    "crossed_beams": ({"n": 10}, False),
    "drawn_rod": ({"n": 10, "load_steps": 10}, False),
    "flagellum": ({"n": 10}, True),
    "gridshell_dome": ({"rods": 3, "segments": 2}, True),
    "hanging_chain": ({"n": 10}, False),
    "helical_spring": ({"n": 200}, True),
    "hinged_roof": ({"n": 4, "steps": 4, "thickness": 10.0}, False),
    "localized_helix": ({"n": 100}, False),
    "parachute": ({"rings": 3, "lines": 6}, True),
    "pinched_cylinder": ({"n": 4, "steps": 1, "load": 1e-3}, False),
    "pullout_cylinder": ({"n": 4}, False),
    "ribbon_helix": ({"n": 25}, True),
    "sphere_indentation": ({"rings": 6}, True),
    "vibration": ({"n": 10}, False),
    "whirling": ({"n": 10}, True),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if daily else pytest.mark.slow) for name, (_, daily) in COMPUTED.items()]
)
def test_computed_pictures_are_drawn_for_small_and_short_runs(name, tmp_path):
    module = load_scene(name)
    scene = module.build(**COMPUTED[name][0])
    dt = getattr(scene.analysis, "dt", None)
    observed = SimpleNamespace(**{key: value for key, value in vars(module).items() if key != "check"})
    options = {"dt": dt, "duration": 2.0 * dt} if dt else {}
    simulate(scene, device="cpu", out=tmp_path, usd=False, module=observed, progress=False, **options)
    assert (tmp_path / "picture.png").stat().st_size > 5_000

"""Drawn points, colors, arrows, decimation and camera, without a browser."""

import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import MissingPackageError
from ddg_warp.geometry import meshes
from ddg_warp.io.colors import SCALE
from ddg_warp.io.contact_records import Contacts
from ddg_warp.io.shapes import Curves, Surfaces
from ddg_warp.view import drawing
from ddg_warp.view.drawing import FIELD_OF_VIEW, Drawing, Frame, arrows, colored, simplified, value_range


def curves(counts, closed=None, radius=0.01):
    """Return curves with nodes per rod."""
    counts = np.array(counts, int)
    closed = np.zeros(len(counts), bool) if closed is None else np.array(closed)
    names = np.array(["rod"] * len(counts))
    return Curves(counts, closed, np.full(counts.sum(), radius), names, np.zeros(len(counts), int))


def sheet(n):
    """Return points and surfaces of a unit square of n x n cells."""
    points, triangles = meshes.rectangle(n, n)
    return points, Surfaces(triangles, np.array([0]), np.array(["sheet"]), np.full(len(triangles), 1e-3))


def test_edges_join_nodes_of_one_rod():
    points = np.random.default_rng(1).random((7, 3))
    drawn = Drawing(curves([3, 4], [False, True]), None, 1, points)
    ends = np.concatenate([lines.ends for lines in drawn.lines])
    assert sorted(map(tuple, ends.tolist())) == [(0, 1), (1, 2), (3, 4), (4, 5), (5, 6), (6, 3)]
    assert drawn.note == "2 rods with 6 edges"


def test_worlds_follow_each_other():
    points = np.random.default_rng(1).random((2, 3, 3))
    drawn = Drawing(curves([3]), None, 2, points)
    assert drawn.lines[0].ends.tolist() == [[0, 1], [1, 2], [3, 4], [4, 5]]


def test_rods_of_each_thickness_are_lines_of_their_own():
    rods = curves([2, 2])
    rods.radius[2:] = 0.02
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    assert [lines.width for lines in Drawing(rods, None, 1, points).lines] == [0.02, 0.04]


def test_thin_rods_are_lines_of_some_pixels():
    points = np.array([[0.0, 0, 0], [1, 0, 0]])
    (lines,) = Drawing(curves([2], radius=1e-6), None, 1, points).lines
    assert lines.width == 0.0


def test_many_rods_are_thinned_by_rods():
    """Every 11th of 10,000 rods with 310,000 edges is drawn whole."""
    count, nodes = 10_000, 32
    points = np.zeros((count * nodes, 3))
    points[:, 0] = np.arange(count * nodes)
    drawn = Drawing(curves([nodes] * count), None, 1, points)
    ends = drawn.lines[0].ends
    assert len(ends) <= drawing.EDGES
    assert (np.diff(ends, axis=1) == 1).all()
    assert set(ends[:, 0] // nodes) == set(range(0, count, 11))
    assert "910 of 10000 rods with 28210 of 310000 edges" in drawn.note
    assert "every 11th rod is drawn" in drawn.note


def test_a_long_rod_is_thinned_by_nodes():
    nodes = 100_001
    points = np.zeros((nodes, 3))
    points[:, 0] = np.arange(nodes)
    drawn = Drawing(curves([nodes]), None, 1, points)
    ends = drawn.lines[0].ends
    assert ends[0].tolist() == [0, 4] and ends[-1, 1] == nodes - 1
    assert (ends[1:, 0] == ends[:-1, 1]).all()
    assert "every 4th node of each rod and the last" in drawn.note


def test_a_large_sheet_is_decimated():
    points, surfaces = sheet(256)
    drawn = Drawing(curves([]), surfaces, 1, points)
    (skin,) = drawn.skins
    assert 0.25 * drawing.TRIANGLES < len(skin.triangles) <= drawing.TRIANGLES
    x = points[skin.rows]
    a, b, c = (x[skin.triangles[:, k]] for k in range(3))
    area = 0.5 * np.cross(b - a, c - a)[:, 2]
    full = points[surfaces.triangles]
    sign = np.sign(np.cross(full[0, 1] - full[0, 0], full[0, 2] - full[0, 0])[2])
    assert area.sum() * sign == pytest.approx(1.0, rel=0.02)
    assert f"{len(skin.triangles)} of 131072 triangles" in drawn.note
    assert f"above {drawing.TRIANGLES} triangles" in drawn.note


def test_a_small_surface_is_drawn_whole():
    points, surfaces = sheet(4)
    rows, triangles = simplified(points, surfaces.triangles, 32)
    assert np.array_equal(points[rows][triangles], points[surfaces.triangles])


def test_colors_follow_the_numbers_of_a_field():
    anchors = [[int(color[k : k + 2], 16) for k in (1, 3, 5)] for color in SCALE]
    values = np.array([2.0, 3.0, 4.0, 5.0, 6.0, 9.0, np.nan])
    colors = colored(values, 2.0, 6.0)
    assert colors.dtype == np.uint8
    assert colors[:5].tolist() == anchors
    assert colors[5].tolist() == anchors[-1]
    assert colors[6].tolist() == [184, 184, 184]


def test_the_range_ignores_undefined_values():
    assert value_range([np.array([np.nan, 3.0]), np.array([1.0, 2.0])]) == (1.0, 3.0)
    low, high = value_range([np.full(3, 2.0)])
    assert low == 2.0 < high
    assert value_range([np.array([np.nan])]) == (0.0, 1.0)


def test_values_of_triangles_are_means_at_vertices():
    points, surfaces = sheet(1)
    drawn = Drawing(curves([]), surfaces, 1, points)
    values = drawn.at_points(np.array([1.0, 3.0]))
    for row in range(4):
        adjacent = [k for k in range(2) if row in surfaces.triangles[k]]
        assert values[row] == np.mean([[1.0, 3.0][k] for k in adjacent])


def test_values_of_triangles_are_undefined_on_rods():
    points, surfaces = sheet(1)
    points = np.concatenate([np.zeros((2, 3)), points])
    moved = Surfaces(surfaces.triangles + 2, surfaces.first, surfaces.names, surfaces.thickness)
    values = Drawing(curves([2]), moved, 1, points).at_points(np.array([1.0, 3.0]))
    assert np.isnan(values[:2]).all() and np.isfinite(values[2:]).all()


def pairs(n):
    """Return n contacts with forces 1..n N along z and friction along x."""
    force = np.zeros((n, 3))
    force[:, 2] = np.arange(1, n + 1)
    friction = np.zeros((n, 3))
    friction[:, 0] = 0.5
    point = np.random.default_rng(0).random((n, 3))
    return Contacts(np.zeros(n, int), np.zeros((n, 2), int), ["a"], point, np.zeros(n), force, friction)


def test_arrows_are_forces_at_contact_points():
    contacts = pairs(5)
    ends = arrows(contacts, 0.1)
    assert np.array_equal(ends[:, 0], contacts.point)
    assert np.allclose(ends[:, 1] - ends[:, 0], 0.1 * (contacts.force + contacts.friction))
    assert arrows(None, 1.0).shape == (0, 2, 3)


def test_the_largest_of_many_forces_are_drawn():
    contacts = pairs(drawing.ARROWS + 50)
    assert np.array_equal(arrows(contacts, 1.0)[:, 0], contacts.point[50:])


def test_the_camera_sees_all_points():
    points = np.random.default_rng(2).normal(size=(50, 3)) * [3.0, 1.0, 0.2]
    view = Drawing(curves([50]), None, 1, points).camera(Frame(0.0, points))
    toward = view["position"] - view["look_at"]
    toward /= np.linalg.norm(toward)
    offset = points - view["position"]
    depth = -offset @ toward
    aside = np.linalg.norm(offset + depth[:, None] * toward, axis=1)
    assert (depth > 0).all()
    assert (aside < np.sqrt(2.0) * depth * np.tan(0.5 * FIELD_OF_VIEW)).all()


def test_a_planar_scene_is_seen_along_its_normal():
    points = np.random.default_rng(2).random((5, 3)) * [1.0, 0.0, 1.0]
    view = Drawing(curves([5]), None, 1, points).camera(Frame(0.0, points))
    toward = view["position"] - view["look_at"]
    assert np.allclose(toward / np.linalg.norm(toward), [0.0, -1.0, 0.0])


def test_rounded_coordinates_are_within_the_step():
    points = np.random.default_rng(3).random((100, 3))
    assert np.abs(drawing.rounded(points, 1.0) - points).max() <= 1.0 / drawing.SIZE_STEPS


def test_glb_holds_points_and_colors():
    from ddg_warp.view.stage import glb

    points, surfaces = sheet(2)
    data = glb(points.astype(np.float32), surfaces.triangles, np.full((9, 3), 255, np.uint8))
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    content, text = data[20 + size + 8 :], json.loads(data[20 : 20 + size])
    for view, accessor in zip(text["bufferViews"], text["accessors"], strict=True):
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == accessor["count"] * {"VEC3": 12, "VEC4": 4, "SCALAR": 4}[accessor["type"]]
    assert np.array_equal(np.frombuffer(content[: points.size * 4], "<f4").reshape(-1, 3), points.astype(np.float32))


@pytest.fixture
def rods(device):
    """Return a model of two rods in a grip."""
    base = np.zeros((2, 6, 3))
    base[:, :, 0], base[1, :, 1] = np.linspace(0, 1, 6), 0.1
    scene = ddg.Scene()
    both = scene.add_rods(base, section=ddg.Circle(0.01), material=ddg.Material(young=1e6, density=1000.0))
    scene.clamp(both, edges=[0], motion=ddg.Grip())
    return scene.build(device=device)


def test_a_slider_scales_a_parameter(rods):
    from ddg_warp.view.parameter_slider import ParameterSlider

    before = rods.parameters()["0/rod_bend_twist/stiffness_1"].copy()
    slider = ParameterSlider(rods, "0/rod_bend_twist/stiffness_1")
    version = rods.version
    slider.set(1.0)
    assert np.allclose(rods.parameters()["0/rod_bend_twist/stiffness_1"], 10.0 * before, rtol=1e-12)
    assert rods.version > version
    slider.set(0.0)
    assert np.array_equal(rods.parameters()["0/rod_bend_twist/stiffness_1"], before)


def test_a_slider_sets_a_number(rods):
    from ddg_warp.view.parameter_slider import ParameterSlider

    slider = ParameterSlider(rods, "0/rod_bend_twist/rest_1", -5.0, 5.0)
    slider.set(2.0)
    assert (rods.parameters()["0/rod_bend_twist/rest_1"] == 2.0).all()


def test_every_parameter_of_a_term_has_a_slider(rods):
    from ddg_warp.view.parameter_slider import ParameterSlider, adjustable

    terms = {name for name in rods.parameters() if name.count("/") == 2}
    assert set(adjustable(rods)) == terms
    for name in terms:
        ParameterSlider(rods, name)
    with pytest.raises(ddg.SceneError, match="no parameter '0/mass' can be set"):
        ParameterSlider(rods, "0/mass")
    with pytest.raises(ddg.SceneError, match="not below"):
        ParameterSlider(rods, "0/rod_bend_twist/rest_1", 1.0, 1.0)


def test_a_forbidden_number_changes_nothing(rods):
    from ddg_warp.view.parameter_slider import ParameterSlider

    before = rods.parameters()["0/rod_bend_twist/stiffness_1"].copy()
    ParameterSlider(rods, "0/rod_bend_twist/stiffness_1", -1.0, 1.0).set(-1.0)
    assert np.array_equal(rods.parameters()["0/rod_bend_twist/stiffness_1"], before)


def test_the_point_nearest_to_a_ray_is_in_front():
    from ddg_warp.view.handles import nearest_to_ray

    points = np.array([[0.0, 0.0, -5.0], [0.1, 0.0, 5.0], [1.0, 0.0, 5.0]])
    assert nearest_to_ray(points, (0, 0, 0), (0, 0, 2.0)) == 1


def test_a_missing_package_is_named_with_the_remedy(monkeypatch):
    import sys

    from ddg_warp.view.notebook import state_frame
    from ddg_warp.view.stage import viser_module

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingPackageError, match=r"pip install -e '\.\[view\]'"):
        viser_module()
    assert state_frame(None, None) is None


def test_the_play_speed_keeps_plays_short():
    from ddg_warp.view.player import initial_speed

    assert initial_speed(np.array([0.0, 5.0])) == 1.0
    assert initial_speed(np.array([0.0, 0.02])) == pytest.approx(0.01)
    assert initial_speed(np.array([0.0, 300.0])) == pytest.approx(10.0)
    assert initial_speed(np.array([1.0])) == 1.0


def test_grips_follow_gizmos(rods):
    from ddg_warp.view.handles import Grips

    def add(name, position, **options):
        return SimpleNamespace(position=np.array(position), wxyz=np.array([1.0, 0, 0, 0]))

    stage = SimpleNamespace(
        drawing=SimpleNamespace(size=1.0),
        server=SimpleNamespace(scene=SimpleNamespace(add_transform_controls=add)),
    )
    grips = Grips(stage, rods)
    assert np.array_equal(grips.poses(), np.zeros((1, 6)))
    (gizmo,) = grips._gizmos
    center = gizmo.position.copy()
    assert center == pytest.approx([0.1, 0.05, 0.0])
    gizmo.position = center + [0.0, 0.0, 0.3]
    gizmo.wxyz = np.array([np.cos(0.25), 0.0, 0.0, np.sin(0.25)])
    pose = grips.poses()[0]
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(pose[3:])
    assert pose[3:] == pytest.approx([0.0, 0.0, 0.5])
    assert rotation.apply(center) + pose[:3] == pytest.approx(gizmo.position)

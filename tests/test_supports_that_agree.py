"""Supports of one component conflict only where motions differ."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes

ABOUT_Y = ddg.Motion(angle=lambda t: 0.3 * t, axis=(0.0, 1.0, 0.0))
MATERIAL = ddg.Material(young=1e6, density=1000.0)


def sheet(motion=ABOUT_Y) -> ddg.Scene:
    """Return half a sheet with a plane of symmetry y = 0 and one edge moved by a motion."""
    points, triangles = meshes.rectangle(4, 2)[:2]
    points = np.array(points, float)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    shell = scene.add_shell(points, triangles, thickness=0.01, material=MATERIAL)
    scene.symmetry(shell, np.flatnonzero(points[:, 1] == 0.0), "y")
    scene.hold(shell, np.flatnonzero(points[:, 0] == 0.0), "xyz", motion=motion)
    return scene


def test_rotation_about_the_normal_of_a_symmetry_plane():
    model = sheet().build("cpu")
    state, integrator = model.state(), ddg.Integrator(model)
    moved = np.flatnonzero(state.points()[:, 0] == 0.0)
    plane = np.flatnonzero(state.points()[:, 1] == 0.0)
    for _ in range(5):
        state = integrator.step(state, 0.1)
    assert not state.points()[plane, 1].any()
    points = model.state().points()[moved]
    expected = ABOUT_Y.place(0.5, points)
    np.testing.assert_allclose(state.points()[moved], expected, atol=1e-9)


def test_translation_within_a_symmetry_plane():
    model = sheet(ddg.Motion(translation=lambda t: (0.1 * t, 0.0, np.sin(t)))).build("cpu")
    state = model.state()
    edge = state.points()[:, 0] == 0.0
    expected = state.points()[edge] + [0.01, 0.0, np.sin(0.1)]
    state = ddg.Integrator(model).step(state, 0.1)
    np.testing.assert_allclose(state.points()[edge], expected, atol=1e-12)


@pytest.mark.parametrize(
    "motion",
    [
        ddg.Motion(translation=lambda t: (0.0, 0.1 * t, 0.0)),
        ddg.Motion(angle=lambda t: t, axis=(0.0, 1.0, 1e-3)),
        ddg.Motion(translation=lambda t: (0.0, max(0.0, t - 0.9), 0.0), angle=lambda t: t, axis=(0.0, 1.0, 0.0)),
        ddg.Grip(pivot=(0.0, 0.0, 0.0)),
    ],
)
def test_motion_along_the_normal_is_refused(motion):
    with pytest.raises(ddg.SceneError, match="fixed by one support and moved by another along y"):
        sheet(motion).build("cpu")


def test_two_motions_of_a_rod_agree_where_neither_moves():
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 6)
    scene = ddg.Scene()
    rod = scene.add_rod(points, section=ddg.Circle(0.01), material=MATERIAL)
    scene.fix(rod, [0], "xy", motion=ddg.Motion(translation=lambda t: (t, 0.0, 0.0)))
    scene.fix(rod, [0], "yz", motion=ddg.Motion(translation=lambda t: (0.0, 0.0, t)))
    model = scene.build("cpu")
    state = ddg.Integrator(model).step(model.state(), 0.1)
    np.testing.assert_allclose(state.points()[0], [0.1, 0.0, 0.1], atol=1e-12)

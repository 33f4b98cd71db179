"""Recorded cables: twist and shapes from markers, and the scene that identifies them on a folder of a user."""

import numpy as np
import pytest

from ddg_warp.data.mocap import Recording, recordings
from ddg_warp.errors import DataError
from ddg_warp.run.scene_registry import load_scene
from ddg_warp.run.simulate import simulate

pytest.importorskip("torch")
from ddg_warp.scenes import _cable

COUNT = 13


def straight(directions) -> np.ndarray:
    """Markers (F, 13, 3) of cables that lie straight in directions (F, 3)."""
    return 0.08 * np.arange(COUNT)[:, None] * np.asarray(directions)[:, None]


def test_twist_is_the_rotation_of_returning_frames():
    """A grip's tangent runs around a cone of half angle a, the other grip is fixed: twist 2 pi (1 - cos a)."""
    frames, a = 400, 0.4
    angle = np.linspace(0.0, 2.0 * np.pi, frames)
    cone = np.stack([np.full(frames, np.cos(a)), np.sin(a) * np.cos(angle), np.sin(a) * np.sin(angle)], 1)
    markers = straight(cone)
    still = markers.copy()
    still[:, -2:] = markers[:1, -2:]
    recording = Recording("a", 0.01 * np.arange(frames), still)
    whole = Recording("b", 0.01 * np.arange(frames), markers)
    assert _cable.twist_at(recording, 0) == pytest.approx(0.0, abs=1e-12)
    assert abs(_cable.twist_at(recording, frames - 1)) == pytest.approx(2.0 * np.pi * (1.0 - np.cos(a)), rel=1e-3)
    assert _cable.twist_at(whole, frames - 1) == pytest.approx(0.0, abs=1e-12)  # equal rotation of both ends


def test_shapes_leave_grips_in_their_direction():
    """A cubic between straight grips is met exactly, with its slope, and so is its length."""
    x = np.clip(np.arange(COUNT) - 1.0, 0.0, COUNT - 3.0) / (COUNT - 3.0)
    y = 0.5 * (3.0 * x**2 - 2.0 * x**3)
    markers = np.stack([0.08 * np.arange(COUNT), y, 0.0 * y], 1)
    nodes = _cable.along(markers, 5)
    u = np.clip(np.arange(len(nodes)) / 5.0 - 1.0, 0.0, COUNT - 3.0) / (COUNT - 3.0)
    np.testing.assert_allclose(nodes[:, 1], 0.5 * (3.0 * u**2 - 2.0 * u**3), atol=1e-13)
    np.testing.assert_allclose(nodes[::5], markers, atol=1e-13)


def test_windows_start_where_frames_have_them():
    """Steady acceleration: positions and velocities are exact, from frames on both sides or before alone; lost starts are left out."""
    t = 0.01 * np.arange(70)
    path = straight(np.tile([1.0, 0.0, 0.0], (70, 1))) + np.stack([0.3 * t, 2.0 * t**2, -t], 1)[:, None]
    markers = path.copy()
    markers[32:44, 6] = markers[60:, 0] = (
        np.nan
    )  # too long a gap where a window would start; a grip that is never seen again
    recording = Recording("a", t, markers, (0, 1, COUNT - 2, COUNT - 1))
    for centred in (True, False):
        result = _cable.windows([recording], 15, centred)
        assert [round(100 * (window.points[0, 0] / 0.3)) for window in result] == [8, 23]
        for window, frame in zip(result, (8, 23), strict=True):
            np.testing.assert_allclose(window.points, path[frame], atol=1e-12)
            np.testing.assert_allclose(window.velocities, np.tile([0.3, 4.0 * t[frame], -1.0], (COUNT, 1)), atol=1e-10)
    with pytest.raises(DataError, match="no window of 80 frames"):
        _cable.windows([recording], 80, True)
    with pytest.raises(DataError, match="grips hold markers"):
        _cable.windows([Recording("a", t, markers, ())], 15, True)


@pytest.mark.slow
def test_a_folder_of_the_user(tmp_path):
    """Learning accepts recordings in a user's folder, of which only held-out markers are known."""
    scene = load_scene("identify_from_recording")
    scene.record(tmp_path)
    assert len(recordings("train", root=tmp_path)) == 2
    result = simulate(scene.build(folder=str(tmp_path)), device="cpu", progress=False)
    checks = scene.check(result)
    assert sum(bool(check.skipped) for check in checks) == 3
    assert not any(check.failed for check in checks)
    learned = scene.learn("", scene.MASS, 8)["values"]
    assert result.model.scene.initial.values == learned  # the same recordings
    with pytest.raises(DataError, match="holds no recordings"):
        scene.build(folder=str(tmp_path / "train"))

"""Recordings of cables, in pickles as their authors write them: markers over time, in one frame, and both grips."""

import pickle

import numpy as np
import pytest

from ddg_warp.data.mocap import VARIABLE, Recording, read, recordings
from ddg_warp.data.safe_pickle import UnsafePickleError
from ddg_warp.errors import DataError, SceneError

FRAMES, MARKERS = 50, 13


def swung() -> np.ndarray:
    """A cable that hangs from two grips, one of which swings in the horizontal plane, (F, M, 3) with z up."""
    t, s = 0.01 * np.arange(FRAMES)[:, None], np.linspace(0.0, 1.0, MARKERS)
    y = 0.1 * s * np.sin(4.0 * t)
    return np.stack([s + 0.0 * t, y, 1.0 - 0.4 * s * (1.0 - s) + 0.0 * t], axis=-1)


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """Write a folder as published by the authors, and set the environment variable to it."""
    for split, names in {"train": (2, 10, 1), "eval": (7,)}.items():
        folder = tmp_path / "data_set" / "DLO1" / split
        folder.mkdir(parents=True)
        for name in names:
            frames = list(swung().transpose(0, 2, 1)) if name == 7 else swung().transpose(0, 2, 1)
            (folder / f"{name}.pkl").write_bytes(pickle.dumps(frames, 4))
    (tmp_path / "README.md").write_text("No recording.")
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    return tmp_path


def test_recordings_are_found_and_read(clone):
    paths = recordings("data_set/DLO1/train")
    assert [path.name for path in paths] == ["1.pkl", "2.pkl", "10.pkl"]
    assert len(recordings()) == len(recordings(root=clone)) == 4
    for path in (*paths, "data_set/DLO1/eval/7.pkl"):
        recording = read(path)
        assert recording.name.startswith("DLO1/")
        np.testing.assert_array_equal(recording.markers, swung())
        np.testing.assert_allclose(recording.times, 0.01 * np.arange(FRAMES), rtol=1e-15)
        assert recording.complete
        assert recording.held == (0, 1, 11, 12)
    assert read(paths[0], rate=50.0).times[-1] == 0.02 * (FRAMES - 1)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_up_becomes_z_and_frames_stay_right_handed(tmp_path, up):
    markers = np.random.default_rng(1).random((4, 5, 3))
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(markers.transpose(0, 2, 1)))
    rotated = read(tmp_path / "a.pkl", up=up).markers
    np.testing.assert_array_equal(rotated[..., 2], markers[..., "xyz".index(up)])
    volume = np.linalg.det(markers[0, 1:4] - markers[0, 0])
    assert np.linalg.det(rotated[0, 1:4] - rotated[0, 0]) == pytest.approx(volume, rel=1e-12)


def test_axes_in_any_order(tmp_path):
    path, markers = tmp_path / "a.pkl", swung()
    for axes, content in {
        "fmc": markers,
        "fcm": markers.transpose(0, 2, 1),
        "cfm": markers.transpose(2, 0, 1),
        "cmf": markers.transpose(2, 1, 0),
    }.items():
        path.write_bytes(pickle.dumps(content))
        np.testing.assert_array_equal(read(path, axes=axes).markers, markers)
    path.write_bytes(pickle.dumps(markers.transpose(2, 0, 1).reshape(3, -1)))  # frames and markers on one axis
    np.testing.assert_array_equal(read(path, axes="cfm", markers=MARKERS).markers, markers)
    with pytest.raises(DataError, match="not of 12 markers"):
        read(path, axes="cfm", markers=12)


def test_grips_follow_their_markers_without_twist(clone):
    recording = read("data_set/DLO1/train/1.pkl")
    for grip, outermost, edge in zip(recording.grips(), (0, -1), ((0, 1), (-2, -1)), strict=True):
        np.testing.assert_array_equal(grip.position, recording.markers[:, outermost])
        along = recording.markers[:, edge[1]] - recording.markers[:, edge[0]]
        tangent = along / np.linalg.norm(along, axis=1, keepdims=True)
        np.testing.assert_allclose(grip.frame[..., 0], tangent, atol=1e-14)
        identity = np.broadcast_to(np.eye(3), grip.frame.shape)
        np.testing.assert_allclose(np.swapaxes(grip.frame, 1, 2) @ grip.frame, identity, atol=1e-13)
        np.testing.assert_allclose(np.linalg.det(grip.frame), 1.0, atol=1e-13)
        # The angular velocity in the frame has no component along the tangent.
        step = np.swapaxes(grip.frame[:-1], 1, 2) @ grip.frame[1:]
        assert np.abs(step[:, 2, 1] - step[:, 1, 2]).max() < 1e-4 * np.abs(step[:, 1, 0] - step[:, 0, 1]).max()


def test_resampling(clone):
    recording = read("data_set/DLO1/train/1.pkl")
    np.testing.assert_allclose(recording.resampled(recording.times).markers, recording.markers, atol=1e-14)
    times = np.linspace(0.0, recording.times[-1], 500)
    exact = 0.1 * np.sin(4.0 * times)
    cubic, straight = (recording.resampled(times, degree=d).markers[:, -1, 1] for d in (3, 1))
    assert np.abs(cubic - exact).max() < 1e-8
    # Straight lines fall short by h^2 y'' / 8.
    assert np.abs(straight - exact).max() == pytest.approx(0.01**2 * 1.6 / 8.0, rel=0.1)
    part = recording.between(10, 20)
    assert part.times[0] == 0.0
    np.testing.assert_array_equal(part.markers, recording.markers[10:20])


def test_lost_markers_are_kept_and_named(tmp_path):
    markers = swung()
    markers[3, 5] = markers[7, 0] = np.nan
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(markers.transpose(0, 2, 1)))
    recording = read(tmp_path / "a.pkl")
    assert not recording.complete
    with pytest.raises(DataError, match="frame 3: marker 5"):
        recording.resampled([0.0, 0.1])
    with pytest.raises(DataError, match="frame 7: markers 0 and 1"):
        recording.grips()
    assert recording.between(8, 20).complete
    assert len(recording.between(8, 20).grips()) == 2


def test_short_gaps_are_filled():
    """Short gaps are filled linearly; long gaps and both ends stay lost, and seen markers unchanged."""
    steady = np.linspace(0.0, 1.0, 20)[:, None, None] * np.arange(1.0, 10.0).reshape(3, 3)
    markers = steady.copy()
    markers[3:6, 0], markers[8:14, 1], markers[:2, 2], markers[-1, 2] = np.nan, np.nan, np.nan, np.nan
    recording = Recording("a", 0.01 * np.arange(20), markers, ())
    filled = recording.filled(0.05).markers
    np.testing.assert_allclose(filled[:, 0], steady[:, 0], rtol=1e-14)
    np.testing.assert_array_equal(filled[:, 1:], markers[:, 1:])
    np.testing.assert_allclose(recording.filled(0.07).markers[:, 1], steady[:, 1], rtol=1e-14)
    assert np.isnan(recording.markers[4, 0]).all()  # it is not changed
    with pytest.raises(SceneError, match="longest"):
        recording.filled(0.0)


def test_where_recordings_are_must_be_said(tmp_path, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(DataError, match=VARIABLE):
        recordings()
    with pytest.raises(DataError, match=VARIABLE):
        read("data_set/DLO1/train/1.pkl")
    with pytest.raises(DataError, match="does not exist"):
        recordings(root=tmp_path / "nowhere")
    with pytest.raises(DataError, match="holds no recordings"):
        recordings(root=tmp_path)
    with pytest.raises(DataError, match="does not exist"):
        read("1.pkl", root=tmp_path)


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"axes": "fmx"}, SceneError, "axes"),
        ({"axes": "fmc"}, DataError, "three coordinates nowhere"),
        ({"up": "w"}, SceneError, "up"),
        ({"rate": 0.0}, SceneError, "rate"),
        ({"held": (0, 1)}, DataError, "held"),
        ({"held": (0, 1, 2, 13)}, DataError, "held"),
        ({"held": (0, 1, 12, -1)}, DataError, "held"),
    ],
)
def test_mistakes_are_named(clone, options, error, said):
    with pytest.raises(error, match=said):
        read("data_set/DLO1/train/1.pkl", **options)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"markers": 1}, "dict"),
        ([np.zeros((3, 4)), np.zeros((3, 5))], "one shape"),
        (np.zeros((4, 3)), "three coordinates"),
        (np.zeros((0, 3, 4)), "three coordinates"),
        (np.full((2, 3, 4), np.inf), "frame 0: marker 0 is at infinity"),
        ("text", "str"),
    ],
)
def test_other_contents_are_named(tmp_path, content, said):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(DataError, match=said):
        read(tmp_path / "a.pkl")


def test_other_mistakes(clone):
    recording = read("data_set/DLO1/train/1.pkl")
    with pytest.raises(DataError, match="no markers are held"):
        read("data_set/DLO1/train/1.pkl", held=()).grips()
    with pytest.raises(SceneError, match="degree"):
        recording.resampled([0.0], degree=2)
    for times in ([-0.1, 0.0], [0.0, 9.0], [0.1, 0.1], []):
        with pytest.raises(DataError, match="increasing times within"):
            recording.resampled(times)
    with pytest.raises(DataError, match="fewer than a spline"):
        recording.between(0, 3).resampled([0.0])
    with pytest.raises(DataError, match="no frames"):
        recording.between(60, 70)


class Malicious:
    def __reduce__(self):
        return exec, ("raise SystemExit",)


def test_a_malicious_recording_does_not_run(tmp_path):
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(Malicious()))
    with pytest.raises(UnsafePickleError, match=r"builtins\.exec"):
        read(tmp_path / "evil.pkl")


def test_a_recording_starts_a_rod(clone):
    import ddg_warp as ddg

    recording: Recording = read("data_set/DLO1/train/1.pkl")
    scene = ddg.Scene()
    rod = scene.add_rod(recording.markers[0], section=ddg.Stiffness(EA=1e3, EI1=1e-3, GJ=1e-3, mass_per_length=0.03))
    first, last = recording.grips()
    scene.clamp(rod, edges=[0, MARKERS - 2])
    assert scene.build(device="cpu").state().points()[0] == pytest.approx(first.position[0])
    assert last.position[0] == pytest.approx(recording.markers[0, -1])


def test_indices_of_numpy_are_taken(clone):
    indices = tuple(np.array([0, 1, -2, -1]))
    recording = read("data_set/DLO1/train/1.pkl", held=indices, markers=MARKERS)
    assert recording.held == (0, 1, 11, 12)
    assert all(type(marker) is int for marker in recording.held)
    assert len(recording.between(np.int64(1), np.int32(-1)).times) == FRAMES - 2


def test_links_lead_outside_where_it_is_allowed(clone, tmp_path_factory):
    away = tmp_path_factory.mktemp("away")
    (clone / "data_set" / "DLO1" / "eval" / "7.pkl").rename(away / "7.pkl")
    (clone / "data_set" / "DLO1" / "eval" / "7.pkl").symlink_to(away / "7.pkl")
    with pytest.raises(DataError, match="outside=True"):
        recordings("data_set/DLO1/eval")
    assert [path.name for path in recordings("data_set/DLO1/eval", outside=True)] == ["7.pkl"]
    assert read("data_set/DLO1/eval/7.pkl", outside=True).complete
    (clone / "data_set" / "DLO1" / "train" / "3.pkl").symlink_to("2.pkl")  # within the clone
    assert [path.name for path in recordings("data_set/DLO1/train")] == ["1.pkl", "2.pkl", "3.pkl", "10.pkl"]
    assert read("data_set/DLO1/train/3.pkl").complete

"""Windows of recorded runs: frames, worker processes of both kinds, and errors of unreadable files."""

import pickle
from importlib import import_module

import h5py
import numpy as np
import pytest
from test_episodes import filled, record

import ddg_warp as ddg
from ddg_warp.data.episodes import EpisodeWriter
from ddg_warp.errors import DataError, SceneError
from ddg_warp.io import read
from ddg_warp.io.hdf5 import TrajectoryError, TrajectoryReader
from ddg_warp.run.simulate import simulate

torch = pytest.importorskip("torch", reason="torch, an extra, is not installed")
Recordings = import_module("ddg_warp.data.dataset").Recordings
FIELDS = ["velocities", "directors", "axial_force"]


def scene(surface: bool = False) -> ddg.Scene:
    """A rod, clamped at its first edge, and optionally a sheet next to it."""
    result = ddg.Scene(analysis=ddg.Dynamics(dt=0.01, duration=0.12))
    points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 5)
    rod = result.add_rod(points, section=ddg.Circle(0.01), material=ddg.Material(1e6))
    result.clamp(rod, edges=[0])
    if surface:
        vertices, triangles = ddg.meshes.rectangle(2, 2)
        sheet = result.add_shell(vertices + [0.0, 2.0, 0.0], triangles, thickness=1e-2, material=ddg.Material(1e6))
        result.hold(sheet, [0, 1, 2])
    return result


def observe(model, state):
    return {"tip": float(np.ravel(state.points())[14])}


@pytest.fixture(scope="module")
def run(tmp_path_factory, device):
    """A directory with 13 frames of a rod."""
    out = tmp_path_factory.mktemp("run")
    options = {"device": device, "usd": False, "progress": False, "fields": FIELDS, "observe": observe}
    simulate(scene(), out=out, provenance={"parameters": {"n": 5, "young": 1e6, "kind": "soft"}}, **options)
    return out


@pytest.fixture(scope="module")
def worlds(tmp_path_factory, device):
    """A directory with 13 frames of two worlds of a rod and a sheet, whose rods differ in stiffness."""
    out = tmp_path_factory.mktemp("worlds")
    model = scene(surface=True).build(device=device, worlds=2)
    model.set_parameter("rod_bend_twist", "stiffness_1", [0.01, 0.02])
    model.set_parameter("rod_bend_twist", "stiffness_2", [0.01, 0.02])
    fields = ["axial_force", "shell_energy"]
    integrator, state = ddg.Integrator(model), model.state()
    with ddg.Recorder(model, out, usd=False, fields=fields) as recorder:
        recorder.record(state)
        for _ in range(12):
            state = integrator.step(state, 0.01)
            recorder.record(state)
    return out


def test_windows_are_those_frames(run):
    fields = ["points", *FIELDS, "tip"]
    data = Recordings(run, window=3, stride=2, every=4, fields=fields)
    assert len(data) == 3  # of 13 frames, windows of 9 from 0, 2 and 4
    with TrajectoryReader(run / "trajectory.h5") as reader:
        for index, start in enumerate((0, 2, 4)):
            item, frames = data[index], slice(start, start + 9, 4)
            assert data.place(index) == (0, 0, start)
            assert item["time"].tolist() == reader.time[frames].tolist()
            for name in ("points", "velocities", "directors"):
                assert item[name].dtype == torch.float64
                np.testing.assert_array_equal(item[name], getattr(reader, name)[frames])
            np.testing.assert_array_equal(item["axial_force"], reader.fields["axial_force"][frames])
            np.testing.assert_array_equal(item["tip"], item["points"][:, -1, 2])
    assert item["points"].shape == (3, 5, 3)
    assert item["parameters"] == {"n": 5.0, "young": 1e6}  # numbers only
    assert torch.equal(data[-1]["points"], data[2]["points"])
    with pytest.raises(IndexError, match="3 windows"):
        data[3]


def test_float32_is_an_option(run):
    item = Recordings(run / "trajectory.h5", window=2, dtype="float32")[0]
    assert {item["time"].dtype, item["points"].dtype, item["parameters"]["n"].dtype} == {torch.float32}


def test_each_world_has_its_windows(worlds):
    data = Recordings(worlds, window=13, fields=["points", "axial_force", "shell_energy"])
    assert len(data) == 2
    with TrajectoryReader(worlds / "trajectory.h5") as reader:
        for world in range(2):
            item = data[world]
            assert item["world"] == world
            np.testing.assert_array_equal(item["points"], reader.points[:, world])
            force = reader.fields["axial_force"][:].reshape(13, 2, -1)[:, world]
            np.testing.assert_array_equal(item["axial_force"], force)
            assert item["shell_energy"].shape == (13, 8)
            assert torch.isfinite(item["shell_energy"]).all()
    assert not torch.equal(data[0]["points"], data[1]["points"])
    assert torch.equal(data[0]["shell_energy"], data[1]["shell_energy"])  # only their rods differ


@pytest.mark.parametrize("kind", ["fork", "spawn"])
def test_workers_read_for_themselves(tmp_path, kind):
    torch.set_default_device("cpu")  # workers that are forked have no CUDA
    filled(tmp_path, 6)
    data = Recordings(tmp_path, window=2)
    expected = [data[index] for index in range(len(data))]  # files of this process are open now
    loader = torch.utils.data.DataLoader(data, batch_size=3, num_workers=2, multiprocessing_context=kind)
    batches = list(loader)
    assert sum(len(batch["file"]) for batch in batches) == len(data) == 12
    for name in ("time", "points", "file"):
        values = torch.cat([batch[name] for batch in batches])
        assert torch.equal(values, torch.stack([torch.as_tensor(item[name]) for item in expected]))
    loads = torch.cat([batch["parameters"]["load"] for batch in batches])
    assert loads.tolist() == [0.1 * k for k in range(6) for _ in range(2)]
    assert torch.equal(data[5]["points"], expected[5]["points"])  # and data in this process stay the same
    data.close()
    assert torch.equal(data[5]["points"], expected[5]["points"])


def test_no_open_file_is_pickled(tmp_path):
    filled(tmp_path, 2)
    data = Recordings(tmp_path, window=2)
    assert not data._readers
    item = data[1]
    assert data._readers
    copy = pickle.loads(pickle.dumps(data))
    assert not copy._readers
    assert torch.equal(copy[1]["points"], item["points"])


def test_few_files_are_open_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr("ddg_warp.data.dataset.OPEN_FILES", 3)
    filled(tmp_path, 8)
    data = Recordings(tmp_path, window=3)
    assert [data[index]["file"] for index in range(8)] == list(range(8))
    assert list(data._readers) == [5, 6, 7]
    data[5], data[0]
    assert list(data._readers) == [7, 5, 0]


def test_splits_are_read_apart(tmp_path):
    episodes = filled(tmp_path, 24, fractions=(0.5, 0.25, 0.25))
    parts = {split: Recordings(tmp_path, window=3, split=split) for split in ("train", "validation", "test")}
    for split, data in parts.items():
        assert [source.path.stem for source in data.sources] == [e.name for e in episodes if e.split == split]
    assert sum(map(len, parts.values())) == 24


def test_several_folders_are_one_data_set(tmp_path, run):
    filled(tmp_path / "a", 2)
    filled(tmp_path / "b", 1)
    data = Recordings([tmp_path / "a", str(tmp_path / "b"), run], window=3)
    assert len(data) == 3 + 11
    assert data[2]["file"] == 2
    assert data[3]["points"].shape == (3, 5, 3)
    assert data[0]["parameters"] == {}  # none in common


def test_failed_episodes_are_left_out(tmp_path):
    filled(tmp_path, 1)
    with EpisodeWriter(tmp_path) as writer:
        directory = writer.scratch("cut")
        record(directory, frames=4)
        writer.add("cut", directory / "trajectory.h5", outcome="max_iterations")
    assert len(Recordings(tmp_path, window=3)) == 1
    assert len(Recordings(tmp_path, window=3, failed=True)) == 3


def test_short_files_are_refused_or_skipped(tmp_path, run):
    filled(tmp_path, 2)
    with pytest.raises(DataError, match=r"run_0.h5 has 3 frames, a window spans 5.*2 of 3"):
        Recordings([tmp_path, run], window=3, every=2)
    data = Recordings([tmp_path, run], window=3, every=2, short="skip")
    assert [path.name for path in data.skipped] == ["run_0.h5", "run_1.h5"]
    assert len(data) == 9
    with pytest.raises(DataError, match="no episode with 50 frames"):
        Recordings(run, window=50, short="skip")


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"window": 0}, SceneError, "window"),
        ({"window": 2, "stride": 0}, SceneError, "stride"),
        ({"window": 2, "every": 1.5}, SceneError, "every"),
        ({"window": 2, "dtype": "float16"}, SceneError, "dtype"),
        ({"window": 2, "short": "pad"}, SceneError, "short"),
        ({"window": 2, "fields": "points"}, SceneError, "list of names"),
        ({"window": 2, "fields": ["point"]}, DataError, "'point' was not recorded; there is .*points"),
        ({"window": 2, "split": "train"}, DataError, "no folder of episodes"),
    ],
)
def test_mistakes_are_named(run, options, error, said):
    with pytest.raises(error, match=said):
        Recordings(run, **options)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(DataError, match=r"trajectory.h5 does not exist"):
        Recordings(tmp_path, window=2)
    filled(tmp_path, 1, fractions=(1.0, 0.0, 0.0))
    with pytest.raises(DataError, match="of the split 'test'"):
        Recordings(tmp_path, window=2, split="test")


@pytest.mark.parametrize("index", [slice(2), None, 0.0, "0", [0], True, slice(None)], ids=repr)
def test_items_are_chosen_by_whole_numbers(run, index):
    data = Recordings(run, window=2)
    with pytest.raises(SceneError, match="Recordings: item"):
        data[index]
    assert data[np.int64(-1)]["time"][-1] == data[len(data) - 1]["time"][-1]


def test_files_that_an_index_does_not_fit_are_named(tmp_path):
    episodes = filled(tmp_path)
    index = tmp_path / "index.json"
    index.write_text(index.read_text().replace('"frames": 3', '"frames": 5', 1))
    with pytest.raises(DataError, match=r"run_0\.h5 has 3 frames of 1 worlds, its index says 5 of 1"):
        Recordings(episodes.directory, window=4, short="skip")


@pytest.mark.parametrize("how", ["link", "storage", "virtual"])
def test_data_of_other_files_is_read_where_it_is_allowed(tmp_path, how):
    """External links, external storage and virtual datasets are followed where allowed."""
    record(tmp_path)
    path, external = tmp_path / "trajectory.h5", tmp_path / "other.h5"
    with h5py.File(path, "r+") as file, h5py.File(external, "w") as away:
        points = file["trajectory/points"][:]
        del file["trajectory/points"]
        away["points"] = points
        if how == "link":
            file["trajectory/points"] = h5py.ExternalLink("other.h5", "/points")
        elif how == "storage":
            points.tofile(tmp_path / "raw")
            file.create_dataset(
                "trajectory/points", points.shape, float, external=[(str(tmp_path / "raw"), 0, h5py.h5f.UNLIMITED)]
            )
        else:
            layout = h5py.VirtualLayout(points.shape, float)
            layout[:] = h5py.VirtualSource(str(external), "points", points.shape)
            file.create_virtual_dataset("trajectory/points", layout)
    for reading in (lambda: Recordings(path, window=2), lambda: read(path)):
        with pytest.raises(TrajectoryError, match=r"trajectory\.h5: .*trajectory/points .*outside=True"):
            reading()
    with EpisodeWriter(tmp_path / "folder") as writer, pytest.raises(TrajectoryError, match="data of other files"):
        writer.add("a", path)
    np.testing.assert_array_equal(Recordings(path, window=3, outside=True)[0]["points"], points)
    assert len(read(path, outside=True)) == 1

"""trajectory.h5: round trips, the view for ParaView, and no loss of complete blocks by kill -9."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from stand_in import Model, step

from ddg_warp.io import CurveError, MissingFileError, journal, read
from ddg_warp.io.hdf5 import TrajectoryError, TrajectoryReader, TrajectoryWriter, read_rods
from ddg_warp.io.journal import open_to_read, transaction
from ddg_warp.run.recorder import SCENE, TRAJECTORY, Recorder, export_usd

BLOCK = 4
MODEL = Model()


def states(count, model=None):
    state = (model or MODEL).state()
    for _ in range(count):
        yield state
        state = step(state)


def observed(state):
    return {"tip": float(state.q.flat[0]), "energy": float(np.sum(state.q))}


def recorded(directory, count, **options):
    """Record `count` frames without the scene."""
    with Recorder(MODEL, directory, usd=False, block=BLOCK, **options) as recorder:
        for state in states(count):
            recorder.record(state, observed(state))
    return directory / TRAJECTORY


def test_recorded_data_read_back(tmp_path):
    fields = {"velocities": True, "directors": True}
    path = recorded(tmp_path, 11, **fields, provenance={"scene": "stand_in", "parameters": {"n": 5}})
    expected = list(states(11))
    with TrajectoryReader(path) as reader:
        np.testing.assert_array_equal(reader.time, [state.time for state in expected])
        np.testing.assert_array_equal(reader.points[:], [state.q for state in expected])
        np.testing.assert_array_equal(reader.velocities[7], expected[7].velocities())
        assert reader.directors.shape == (11, 14, 3)
        np.testing.assert_array_equal(reader.series["tip"], [state.q.flat[0] for state in expected])
        np.testing.assert_array_equal(reader.counts, [5, 5, 6])
        assert list(reader.curves.names) == ["strand", "strand", "ring"]
        assert reader.parameters["density"] == 1000.0
        assert reader.provenance["parameters"] == {"n": 5}
        assert reader.provenance["scene"] == "stand_in"
        snapshot = reader.checkpoint()
    for name, value in expected[-1].snapshot().items():
        assert snapshot[name].dtype == value.dtype
        np.testing.assert_array_equal(snapshot[name], value)


def test_worlds_keep_their_axis(tmp_path):
    model = Model(worlds=3)
    with TrajectoryWriter(tmp_path / "t.h5", model, block=2) as writer:
        for state in states(3, model):
            writer.append(state)
    with TrajectoryReader(tmp_path / "t.h5") as reader:
        assert reader.points.shape == (3, 3, 16, 3)
    with h5py.File(tmp_path / "t.h5") as file:
        assert file["VTKHDF/Points"].shape == (3 * 3 * 16, 3)
        assert file["VTKHDF/Lines/NumberOfCells"][0] == 9


def test_frames_must_observe_the_same(tmp_path):
    with pytest.raises(TrajectoryError, match="tip"):
        with TrajectoryWriter(tmp_path / "t.h5", Model(), block=2) as writer:
            writer.append(Model().state(), {"tip": 1.0})
            writer.append(step(Model().state()), {"other": 1.0})


def test_vtk_view_has_no_copies(tmp_path):
    path = recorded(tmp_path, 2 * BLOCK + 1, velocities=True)
    with h5py.File(path) as file:
        view, points = file["VTKHDF"], file["trajectory/points"][:]
        assert view["Points"].is_virtual
        assert view["PointData/velocity"].is_virtual
        np.testing.assert_array_equal(view["Points"][:], points.reshape(-1, 3))
        assert view["Steps"].attrs["NSteps"] == len(points)
        np.testing.assert_array_equal(view["Steps/Values"][:], file["trajectory/time"][:])
        np.testing.assert_array_equal(view["Steps/PointOffsets"][:], 16 * np.arange(len(points)))
        np.testing.assert_array_equal(view["Lines/Offsets"][:], [0, 5, 10, 17])
        assert list(view["Lines/Connectivity"][-2:]) == [15, 10]  # the ring returns to its first point


def test_vtk_reads_the_view(tmp_path):
    """Read the view with VTK itself, if installed."""
    vtk = pytest.importorskip("vtk")
    path = recorded(tmp_path, 2 * BLOCK + 1, velocities=True)
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    with h5py.File(path) as file:
        expected = file["trajectory/points"][:]
    for frame in (0, 5, 8):
        reader.SetStep(frame)
        reader.Update()
        output = reader.GetOutput()
        shown = np.array([output.GetPoint(k) for k in range(output.GetNumberOfPoints())])
        np.testing.assert_allclose(shown, expected[frame], rtol=1e-15)
        assert output.GetNumberOfLines() == 3
        assert output.GetPointData().GetArray("radius").GetValue(15) == 0.02


def test_resumed_equals_straight(tmp_path):
    straight = recorded(tmp_path / "straight", 13)
    recorded(tmp_path / "resumed", 6)
    with TrajectoryReader(tmp_path / "resumed" / TRAJECTORY) as reader:
        state = MODEL.restore(reader.checkpoint())
    with Recorder(MODEL, tmp_path / "resumed", usd=False, block=BLOCK, resume=True) as recorder:
        while recorder_frames(recorder) < 13:
            recorder.record(state, observed(state))
            state = step(state)
    with TrajectoryReader(straight) as uninterrupted, TrajectoryReader(tmp_path / "resumed" / TRAJECTORY) as resumed:
        assert uninterrupted.points[:].tobytes() == resumed.points[:].tobytes()
        assert uninterrupted.time.tobytes() == resumed.time.tobytes()
        assert uninterrupted.series["energy"].tobytes() == resumed.series["energy"].tobytes()
        assert uninterrupted.checkpoint()["0/q"].tobytes() == resumed.checkpoint()["0/q"].tobytes()


def recorder_frames(recorder):
    recorder._trajectory.flush()
    return recorder._trajectory.frame_count


def test_every_continues_counting_after_resume(tmp_path):
    with Recorder(MODEL, tmp_path, usd=False, every=3) as recorder:
        for state in states(8):
            recorder.record(state)  # records steps 0, 3, 6
    with TrajectoryReader(tmp_path / TRAJECTORY) as reader:
        state = MODEL.restore(reader.checkpoint())
    with Recorder(MODEL, tmp_path, usd=False, every=3, resume=True) as recorder:
        for _ in range(4):
            recorder.record(state)  # step 6 again, 7, 8, 9
            state = step(state)
    with TrajectoryReader(tmp_path / TRAJECTORY) as reader:
        np.testing.assert_allclose(reader.time, [0.0, 0.03, 0.06, 0.09], rtol=1e-12)


def test_resume_drops_frames_past_the_checkpoint(tmp_path):
    path = recorded(tmp_path, 8)
    with transaction(path) as file:
        checkpoint = file["checkpoint"]
        checkpoint[checkpoint.attrs["current"]].attrs["frame"] = 5
    with TrajectoryWriter.resume(path, Model()) as writer:
        assert writer.frame_count == 5
    with TrajectoryReader(path) as reader:
        assert len(reader.series["tip"]) == len(reader) == 5


def test_resume_refuses_other_rods(tmp_path):
    path = recorded(tmp_path, 4)
    model = Model()
    model.curves.counts[:2] = [4, 6]
    with pytest.raises(TrajectoryError, match="other rods"):
        TrajectoryWriter.resume(path, model)


def test_resumed_scene_shows_all_frames(tmp_path):
    from pxr import Usd, UsdGeom

    with Recorder(MODEL, tmp_path, block=BLOCK) as recorder:
        for state in states(6):
            recorder.record(state)
    with Recorder(MODEL, tmp_path, block=BLOCK, resume=True) as recorder:
        recorder.record(step(state))
    export_usd(tmp_path / TRAJECTORY, tmp_path / "export.usdc", tube=True)
    for name, kind in ((SCENE, UsdGeom.BasisCurves), ("export.usdc", UsdGeom.Mesh)):
        stage = Usd.Stage.Open(str(tmp_path / name))
        prim = stage.GetPrimAtPath("/World/ring")
        assert prim.IsA(kind)
        assert UsdGeom.PointBased(prim).GetPointsAttr().GetNumTimeSamples() == 7


def test_exceptions_leave_the_old_content(tmp_path):
    path = recorded(tmp_path, 4)
    before = path.read_bytes()
    with pytest.raises(RuntimeError), transaction(path) as file:
        file["trajectory/time"][0] = 99.0
        raise RuntimeError
    assert path.read_bytes() == before


def test_complete_journals_count_as_written(tmp_path, monkeypatch):
    """A process killed between journal and file update loses nothing."""
    path = recorded(tmp_path, 4)
    old = path.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr("ddg_warp.io.journal.recover", lambda path: None)
        with transaction(path) as file:
            file["trajectory/time"][0] = 99.0
    assert path.read_bytes() == old
    with open_to_read(path) as file:
        assert file["trajectory/time"][0] == 99.0
    log = path.with_name(path.name + ".journal")
    content = log.read_bytes()
    log.write_bytes(content[:-1])  # truncated journals are ignored
    with open_to_read(path) as file:
        assert file["trajectory/time"][0] == 0.0
    log.write_bytes(content)
    with transaction(path):
        pass
    assert not log.exists()
    with h5py.File(path) as file:
        assert file["trajectory/time"][0] == 99.0


def test_reads_are_repeated_if_the_writer_changed_the_file(tmp_path, monkeypatch):
    """A read between two blocks meets metadata of both, which HDF5 reports as "addr overflow"."""
    path, model = tmp_path / TRAJECTORY, Model()
    state = model.state()
    with TrajectoryWriter(path, model, block=1) as writer:
        writer.append(state)
        with TrajectoryReader(path) as reader:
            writer.append(step(state))
            failures = iter([OSError("Can't open object (addr overflow)")])
            original = h5py.Dataset.__getitem__

            def fails_once(dataset, chosen):
                for failure in failures:
                    raise failure
                return original(dataset, chosen)

            monkeypatch.setattr(h5py.Dataset, "__getitem__", fails_once)
            np.testing.assert_array_equal(reader.points[0], state.points())
            failures = iter([OSError("Can't open object (addr overflow)")])
            with pytest.raises(TrajectoryError, match="damaged"):  # the file is the one that the read opened
                reader.points[0]
    with pytest.raises(TrajectoryError, match="the reader is closed"):
        reader.points[0]


def test_checkpoints_alternate_outside_the_journal(tmp_path, monkeypatch):
    """The journal holds only metadata, for checkpoints of any size; the old checkpoint stays until the switch."""
    journals = []
    monkeypatch.setattr(
        "ddg_warp.io.journal._write_journal",
        lambda path, size, pages, write=journal._write_journal: (journals.append(len(pages)), write(path, size, pages)),
    )
    model, big = Model(), np.arange(1e6)
    with TrajectoryWriter(tmp_path / "t.h5", model, block=1) as writer:
        for state in states(6):
            snapshot = state.snapshot() | {"0/big": big + state.time}
            monkeypatch.setattr(type(state), "snapshot", lambda self, snapshot=snapshot: snapshot)
            writer.append(state)
    assert max(journals) < 40  # pages of 4 KiB; the checkpoint has 2000
    with TrajectoryReader(tmp_path / "t.h5") as reader:
        np.testing.assert_array_equal(reader.checkpoint()["0/big"], big + reader.time[-1])
    assert (tmp_path / "t.h5").stat().st_size < 2.1 * big.nbytes


CHILD = """
import sys
from stand_in import Model, step
from ddg_warp.run.recorder import Recorder
from ddg_warp.io.hdf5 import TrajectoryReader
directory, resume = sys.argv[1], sys.argv[2] == "True"
model = Model()
with Recorder(model, directory, block=4, resume=resume) as recorder:
    if resume:
        with TrajectoryReader(directory + "/trajectory.h5") as reader:
            state = model.restore(reader.checkpoint())
    else:
        state = model.state()
    print("recording", flush=True)
    while True:
        recorder.record(state, {"tip": float(state.q.flat[0])})
        state = step(state)
"""


def killed_run(directory: Path, resume: bool, seconds: float) -> None:
    """Start a recording in another process, and kill that process some time after the first frame."""
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(root), str(Path(__file__).parent)])}
    command = [sys.executable, "-c", CHILD, str(directory), str(resume)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE) as child:
        assert child.stdout.readline() == b"recording\n"
        time.sleep(seconds)
        child.send_signal(signal.SIGKILL)


def test_kill_loses_no_complete_block(tmp_path):
    """Kill a recording at random times, resume it, and compare all frames with the exact ones."""
    from ddg_warp.io.usd import validate

    rng = np.random.default_rng(int(os.environ.get("KILL_SEED", "1")))
    frames = 0
    for attempt in range(int(os.environ.get("KILLS", "4"))):
        killed_run(tmp_path, resume=frames > 0, seconds=0.15 + 0.2 * rng.random())
        with TrajectoryReader(tmp_path / TRAJECTORY) as reader:
            assert len(reader) > frames, f"kill {attempt} cost recorded frames"
            frames = len(reader)
            assert reader.checkpoint_frame == frames
            # A resumed run begins with the second frame of a block, so that all blocks are complete.
            expected = list(states(frames))
            np.testing.assert_array_equal(reader.points[:], [state.q for state in expected])
            np.testing.assert_array_equal(reader.series["tip"], [state.q.flat[0] for state in expected])
            np.testing.assert_array_equal(reader.checkpoint()["0/q"], expected[-1].q)
        with h5py.File(tmp_path / TRAJECTORY) as file:  # with h5py alone
            assert len(file["VTKHDF/Points"]) % 16 == 0
        if (tmp_path / SCENE).exists():
            assert validate(tmp_path / SCENE) == []


def test_rods_are_read_from_files(tmp_path):
    path = recorded(tmp_path, 5)
    strands, ring = read(path)
    assert (strands.path, ring.path) == ("strand", "ring")
    assert ring.closed.all() and list(strands.counts) == [5, 5]
    np.testing.assert_array_equal(ring.points, list(states(5))[-1].q[10:])
    np.testing.assert_array_equal(read_rods(path, frame=0)[1].points, Model().state().q[10:])
    with h5py.File(tmp_path / "grid.h5", "w") as file:
        file["points"] = np.arange(24.0).reshape(2, 4, 3)
        file["radius"] = 0.1
        file["colors"] = np.zeros(3)
    (grid,) = read_rods(tmp_path / "grid.h5")
    assert list(grid.counts) == [4, 4] and grid.radius.shape == (8,)
    assert (strands.unread, grid.unread) == (("4 other frames",), ("colors",))


def test_bad_files_are_named(tmp_path):
    with pytest.raises(MissingFileError, match=r"no such file"):
        read_rods(tmp_path / "none.h5")
    with h5py.File(tmp_path / "bad.h5", "w") as file:
        file["points"], file["counts"] = np.zeros((5, 3)), [2, 2]
    with pytest.raises(CurveError, match="sum to 4, but there are 5"):
        read_rods(tmp_path / "bad.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["something"] = 1
    with pytest.raises(TrajectoryError, match="no group /trajectory"):
        TrajectoryReader(tmp_path / "other.h5")


def test_control_is_stored(tmp_path):
    path = recorded(tmp_path, 1, control={"dt": 0.01, "gravity": np.array([0.0, 0.0, -9.81]), "loads": [1, 2]})
    with h5py.File(path) as file:
        control = file["control"]
        assert control.attrs["dt"] == 0.01 and control["gravity"][2] == -9.81
        assert json.loads(control.attrs["loads"]) == [1, 2]

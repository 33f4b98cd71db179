"""Full disks and truncated files: one named error, no loss of complete data, no crash."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from stand_in import Model, step, surfaces

from ddg_warp.io import CurveError, MeshError, journal, read
from ddg_warp.io.hdf5 import TrajectoryError, TrajectoryReader, read_rods
from ddg_warp.io.journal import transaction
from ddg_warp.io.mesh_read import read_mesh
from ddg_warp.io.usd import validate
from ddg_warp.run.recorder import SCENE, TRAJECTORY, Recorder, export_usd
from ddg_warp.run.run_directory import LOCK

BLOCK = 4
FULL = """
import resource, sys
from stand_in import Model, step, surfaces
from ddg_warp.run.recorder import Recorder, RecordError

model = Model(surfaces=surfaces())
for size in map(int, sys.argv[2:]):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    state = model.state()
    try:
        with Recorder(model, f"{sys.argv[1]}/{size}", block=4, velocities=True) as recorder:
            for _ in range(200):
                recorder.record(state, {"tip": float(state.q.flat[0])})
                state = step(state)
        raise SystemExit("there was room")
    except RecordError as error:
        print(size, str(error).replace("\\n", "|"), flush=True)
"""
SIZES = (0, 1000, 20_000, 40_000, 80_000, 150_000, 250_000, 400_000)


def run_in_process(code: str, *arguments) -> subprocess.CompletedProcess:
    """Run code in a separate process, so that crashes, also at exit, are seen."""
    root = Path(__file__).resolve().parents[2]
    path = os.pathsep.join([str(root), str(Path(__file__).parent)])
    environment = os.environ | {"PYTHONPATH": path, "PYTHONWARNINGS": "ignore::FutureWarning"}  # Warp on Python 3.10
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], env=environment, capture_output=True, text=True, check=False
    )


def test_full_disk_loses_no_complete_block(tmp_path):
    """Files limited in size, as on a full disk: the error reports it; frames and scene up to a block are complete."""
    run = run_in_process(FULL, tmp_path, *SIZES)
    assert (run.returncode, run.stderr) == (0, "")
    assert len(run.stdout.splitlines()) == len(SIZES)
    frames = []
    for size, line in zip(SIZES, run.stdout.splitlines(), strict=True):
        assert line.startswith(f"{size} {tmp_path}/{size}") and "File too large" in line and "free" in line
        trajectory, scene = tmp_path / str(size) / TRAJECTORY, tmp_path / str(size) / SCENE
        frames.append(0)
        if trajectory.exists():
            with TrajectoryReader(trajectory) as reader:
                frames[-1] = len(reader)
                state = Model().state()
                for points in reader.points[:]:
                    np.testing.assert_array_equal(points[:16], state.q)
                    state = step(state)
                assert not frames[-1] or reader.checkpoint_frame == frames[-1]
        assert frames[-1] % BLOCK == 0
        if scene.exists():
            assert validate(scene) == []
        assert {path.name for path in trajectory.parent.iterdir()} <= {TRAJECTORY, SCENE, "trajectory.vtkhdf"}
    assert frames == sorted(frames) and frames[0] == 0 and frames[-1] > 0


@pytest.fixture
def run(tmp_path) -> Path:
    """Return a directory with a run of ten frames."""
    model = Model(surfaces=surfaces())
    with Recorder(model, tmp_path / "run", block=BLOCK) as recorder:
        state = model.state()
        for _ in range(10):
            recorder.record(state)
            state = step(state)
    return tmp_path / "run"


def resumed(path: Path) -> None:
    with Recorder(Model(surfaces=surfaces()), path.parent, usd=False, resume=True):
        pass


def exported(path: Path) -> None:
    export_usd(path, path.with_name("export.usdc"))


@pytest.mark.parametrize("fraction", [0.0, 0.03, 0.5, 0.99])
@pytest.mark.parametrize(
    ("name", "read_it", "error"),
    [
        (TRAJECTORY, read, TrajectoryError),
        (TRAJECTORY, exported, TrajectoryError),
        (TRAJECTORY, resumed, TrajectoryError),
        (SCENE, read, CurveError),
        (SCENE, lambda path: read_mesh(path, "/World/sail"), MeshError),
    ],
)
def test_truncated_files_are_refused_by_name(run, name, read_it, error, fraction):
    """A truncated copy is refused with the file, the fault and the remedy."""
    path = run / name
    path.write_bytes(path.read_bytes()[: int(fraction * path.stat().st_size)])
    with pytest.raises(error, match=rf"{path}.*cut short or damaged.*(export it again|record the run again)") as caught:
        read_it(path)
    assert "\n" not in str(caught.value)


def test_random_damage_is_refused_by_name(run):
    """Random bytes are overwritten: data read are complete or refused by name, without other errors."""
    path, refused = run / TRAJECTORY, 0
    content = path.read_bytes()
    for seed in range(30):
        random = np.random.default_rng(seed)
        damaged = bytearray(content)
        for offset in random.integers(0, len(content), 20):
            damaged[offset] = random.integers(256)
        path.write_bytes(damaged)
        for read_it in (read, exported, resumed):
            try:
                with np.errstate(over="ignore", invalid="ignore"):  # damaged numbers may have any value
                    read_it(path)
            except (TrajectoryError, CurveError) as error:
                assert str(path) in str(error)
                refused += 1
            path.write_bytes(damaged)
    assert refused > 10


def all_data(path: Path) -> dict:
    """Return all data of a trajectory but the provenance, as text."""
    with TrajectoryReader(path) as reader:
        data = {
            "time": reader.time,
            "points": reader.points[:],
            **reader.series,
            **reader.parameters,
            **reader.checkpoint(),
        }
        data |= {"counts": reader.curves.counts, "radius": reader.curves.radius, "names": reader.curves.names}
        data |= {"triangles": reader.surfaces.triangles, "run": np.array(sorted(reader.run_counts()))}
    return {name: str(value.tolist()) for name, value in data.items()}


def test_no_flipped_bit_changes_data(run):
    """A bit flip anywhere in the file: data read equal the data written, or are refused by name."""
    path, refused = run / TRAJECTORY, 0
    content, written = path.read_bytes(), all_data(path)
    random = np.random.default_rng(1)
    for offset in random.choice(len(content), 60, replace=False):
        damaged = bytearray(content)
        damaged[offset] ^= 1 << random.integers(8)
        path.write_bytes(damaged)
        try:
            assert all_data(path) == written
        except (TrajectoryError, CurveError) as error:
            assert str(path) in str(error)
            refused += 1
    assert refused > 20


def test_run_without_a_block_is_restarted(tmp_path):
    """A run killed before the first block cannot be resumed, and a new run may replace it."""
    model = Model()
    recorder = Recorder(model, tmp_path, usd=False)
    recorder.record(model.state())
    recorder._abandon()  # like a kill: nothing is written
    with pytest.raises(TrajectoryError, match="ended before its first block was written; start it again"):
        Recorder(model, tmp_path, usd=False, resume=True)
    Recorder(model, tmp_path, usd=False).close()


def test_runs_are_replaced_only_by_force(run):
    """The message names both remedies; `force` deletes the frames, otherwise they stay."""
    before = (run / TRAJECTORY).read_bytes()
    with pytest.raises(FileExistsError, match=r"10 frames up to 0.09 s: force \(--force\).*another directory"):
        Recorder(Model(), run)
    assert (run / TRAJECTORY).read_bytes() == before
    Recorder(Model(), run, force=True).close()
    with TrajectoryReader(run / TRAJECTORY) as reader:
        assert len(reader) == 0


def test_directories_are_locked_by_one_recorder(tmp_path):
    """The second recorder is refused with the process of the first; a lock left by a killed process is ignored."""
    (tmp_path / LOCK).write_text("1")
    with Recorder(Model(), tmp_path, usd=False):
        for options in ({"force": True}, {"resume": True}):
            with pytest.raises(FileExistsError, match=f"process {os.getpid()} is recording a run there; wait"):
                Recorder(Model(), tmp_path, usd=False, **options)
    assert not (tmp_path / LOCK).exists()
    Recorder(Model(), tmp_path, usd=False).close()


def test_recording_errors_are_named(tmp_path):
    model = Model()
    for option, value in {"every": 0, "block": -1, "fps": 0.0}.items():
        with pytest.raises(ValueError, match=f"{option} (is|=) {value}"):
            Recorder(model, tmp_path, **{option: value})
    with Recorder(model, tmp_path, usd=False) as recorder:
        with pytest.raises(ValueError, match="is no state of the recorded model"):
            recorder.record(Model().state())
        recorder.record(model.state())
    with pytest.raises(ValueError, match=r"is closed: record before close\(\), or open another with resume=True"):
        recorder.record(step(model.state()))


def with_pending_journal(path: Path, monkeypatch, value: float) -> Path:
    """Leave a complete journal next to a file, as a killed process does; it sets the time of frame 0 to `value`."""
    with monkeypatch.context() as patch:
        patch.setattr("ddg_warp.io.journal.recover", lambda path: None)
        with transaction(path) as file:
            file["trajectory/time"][0] = value
    return path.with_name(path.name + ".journal")


def first_time(path: Path) -> float:
    with TrajectoryReader(path) as reader:
        return reader.time[0]


@pytest.mark.parametrize("kind", ["another run", "an older copy", "a newer version"])
def test_foreign_journals_are_not_applied(run, tmp_path, monkeypatch, kind):
    """Readers ignore the foreign journal, writers refuse it by name; file and journal stay."""
    path = run / TRAJECTORY
    whole = path.read_bytes()
    if kind == "an older copy":
        with transaction(path) as file:
            file.attrs["note"] = "newer"
    log = with_pending_journal(path, monkeypatch, -1.0)
    if kind == "another run":
        with Recorder(Model(surfaces=surfaces()), tmp_path / "b", usd=False) as recorder:
            recorder.record(recorder._model.state())
        whole = (tmp_path / "b" / TRAJECTORY).read_bytes()
    elif kind == "a newer version":
        content = log.read_bytes()
        for _ in range(2):
            with transaction(path) as file:
                file.attrs["note"] = "newer"
        whole = path.read_bytes()
        log.write_bytes(content)
    path.write_bytes(whole)
    kept = log.read_bytes()
    assert first_time(path) == (-1.0 if kind == "a newer version" else 0.0)
    with pytest.raises(TrajectoryError, match=r"trajectory.h5.journal belongs to another file, or to another version"):
        resumed(path)
    assert (path.read_bytes(), log.read_bytes()) == (whole, kept)


def test_copied_journals_apply_to_copied_files(run, tmp_path, monkeypatch):
    """A journal copied with the file applies, also to a partly updated file."""
    path = run / TRAJECTORY
    log = with_pending_journal(path, monkeypatch, -1.0)
    (tmp_path / "copy").mkdir()
    copy = tmp_path / "copy" / TRAJECTORY
    version, pages = journal._read_journal(log)
    for applied in range(len(pages) + 1):
        copy.write_bytes(path.read_bytes())
        copy.with_name(log.name).write_bytes(log.read_bytes())
        with open(copy, "r+b") as file:
            for number in list(pages)[:applied]:
                file.seek(number * journal.PAGE)
                file.write(pages[number])
        assert first_time(copy) == -1.0
        journal.recover(copy)
        assert not copy.with_name(log.name).exists() and copy.stat().st_size == version.size
        assert first_time(copy) == -1.0


def test_flipped_bytes_name_damaged_frames(run):
    """The damaged frames of a field are named, and the other frames can be read."""
    path = run / TRAJECTORY
    with h5py.File(path) as file:
        chunks = file["trajectory/points"].id
        offsets = [chunks.get_chunk_info(k).byte_offset for k in range(chunks.get_num_chunks())]
    content = path.read_bytes()
    for block, offset in enumerate(offsets):
        damaged = bytearray(content)
        damaged[offset + 100] ^= 1
        path.write_bytes(damaged)
        with TrajectoryReader(path) as reader:
            with pytest.raises(TrajectoryError, match=rf"{path}: /trajectory/points is damaged.*can be read") as caught:
                reader.points[:]
            first, last = 4 * block, min(9, 4 * block + 3)
            assert f"the checksum of frames {first} to {last} differs" in str(caught.value)
            for frame in set(range(10)) - set(range(first, last + 1)):
                reader.points[frame]
    with h5py.File(path) as file:
        (offset,) = (file["trajectory/time"].id.get_chunk_info(k).byte_offset for k in range(1, 2))
    damaged = bytearray(content)
    damaged[offset + 3] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(
        TrajectoryError, match=r"/trajectory/time is damaged: the checksum of frames 4 to 7.*0 to 3, 8 to 9 can"
    ):
        TrajectoryReader(path)


@pytest.mark.parametrize("name", ["model/curves/radius", "model/parameters/density", "checkpoint/a/0/q"])
def test_flipped_bytes_of_model_and_checkpoint_are_named(run, name):
    """Damage of model data, or of the checkpoint, is named."""
    path = run / TRAJECTORY
    with h5py.File(path) as file:
        assert file["checkpoint"].attrs["current"] == "a"
        offset = file[name].id.get_offset()
    with open(path, "r+b") as file:
        file.seek(offset + 6)
        value = file.read(1)
        file.seek(offset + 6)
        file.write(bytes([value[0] ^ 1]))
    with pytest.raises(TrajectoryError, match=rf"{path}: /(model|checkpoint/a) is damaged: its checksum"):
        resumed(path)


def test_frames_are_indexed_as_an_array(run):
    with TrajectoryReader(run / TRAJECTORY) as reader:
        assert len(list(reader.points)) == 10
        for frame in (10, -11):
            with pytest.raises(IndexError, match=f"no frame {frame}; it has 10"):
                reader.points[frame]
        with pytest.raises(TrajectoryError, match="choose frames by a number"):
            reader.points["first"]


def write_external_points(path: Path, kind: str) -> None:
    """Write a file with points stored in another file."""
    with h5py.File(path.with_name("other.h5"), "w") as file:
        file["points"] = np.arange(18.0).reshape(2, 3, 3)
    with h5py.File(path, "w") as file:
        if kind == "an external link":
            file["points"] = h5py.ExternalLink("other.h5", "points")
        elif kind == "external storage":
            path.with_name("raw").write_bytes(np.arange(18.0).tobytes())
            file.create_dataset("points", (2, 3, 3), "f8", external=[("raw", 0, h5py.h5f.UNLIMITED)])
        else:
            layout = h5py.VirtualLayout((2, 3, 3), "f8")
            layout[...] = h5py.VirtualSource("other.h5", "points", (2, 3, 3))
            file.create_virtual_dataset("points", layout)


@pytest.mark.parametrize("kind", ["an external link", "external storage", "a virtual dataset"])
def test_external_data_are_not_read(tmp_path, monkeypatch, kind):
    """Data of other files need `outside=True`."""
    monkeypatch.chdir(tmp_path)
    write_external_points(tmp_path / "a.h5", kind)
    with pytest.raises(TrajectoryError, match=r"a.h5: .*points.*(other.h5|raw): data of other files are not read"):
        read(tmp_path / "a.h5")
    (rods,) = read_rods(tmp_path / "a.h5", outside=True)
    np.testing.assert_array_equal(rods.points, np.arange(18.0).reshape(6, 3))

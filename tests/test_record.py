"""Recorder and resumed runs: recorded data are exact, and a resumed run equals an uninterrupted one."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from ddg_warp.geometry import meshes
from ddg_warp.io.hdf5 import TrajectoryError, TrajectoryReader
from ddg_warp.io.journal import transaction
from ddg_warp.run import simulate as simulate_module
from ddg_warp.run.recorder import Recorder
from ddg_warp.run.run_directory import RunDirectory
from ddg_warp.run.scene_registry import InputError
from ddg_warp.run.simulate import simulate
from ddg_warp.run.summary import summary
from tests.pairwise import covering

RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
CLOCKS = ("wall_time", "compile_time", "ms_per_step")
TERMS = {"curvature_1", "twist", "axial_force"}


def rods(scene, height: float = 0.0) -> None:
    """Add two open rods and a ring."""
    line = np.linspace((0.0, 0.0, height), (1.0, 0.0, height + 0.1), 5)
    for y in (0.0, 0.3):
        scene.add_rod(line + [0.0, y, 0.0], section=ddg.Circle(0.02), material=RUBBER, name="strand")
    angle = np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False)
    ring = np.stack([0.3 * np.cos(angle), 1.0 + 0.3 * np.sin(angle), np.full(6, height)], axis=1)
    scene.add_rod(ring, section=ddg.Circle(0.02), material=RUBBER, closed=True, name="ring")


def scene_of(kind: str, dt: float = 0.004, duration: float = 0.08, **analysis) -> ddg.Scene:
    """Return a small scene of "rods", coupled rods ("net"), a "shell", or rods on a floor with friction ("contact")."""
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=dt, duration=duration, **analysis))
    if kind == "shell":
        scene.add_shell(*meshes.rectangle(3, 2), thickness=0.01, material=RUBBER, name="sheet")
        scene.hold(0, [0, 1])
        return scene
    rods(scene, 0.021 if kind == "contact" else 0.0)
    if kind == "net":
        scene.add_rod([[1.0, 0.0, 0.1], [1.0, 0.2, 0.2], [1.0, 0.4, 0.3]], section=ddg.Circle(0.02), material=RUBBER)
        scene.join([(0, 4), (3, 0)])
    if kind == "contact":
        scene.contact(friction=0.3, range=0.01)
        scene.add_obstacle(ddg.Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), name="floor")
    else:
        scene.clamp(0, [0])
    return scene


def stepped(model, count: int):
    """Return copies of the first states of a model."""
    integrator, state = ddg.Integrator(model), model.state()
    states = [state.copy()]
    for _ in range(count - 1):
        state = integrator.step(state, 0.004)
        states.append(state.copy())
    return states


@covering(1, kind=("rods", "net", "shell", "contact"), worlds=(1, 3))
def test_recorded_data_equal_the_states(kind, worlds, device, tmp_path):
    """Recorded data are bitwise equal with every option, over several blocks, the last of them partial."""
    model = scene_of(kind).build(device, worlds=worlds)
    states = stepped(model, 7)
    names = ["shell_strain", "shell_energy"] if kind == "shell" else sorted(TERMS)
    count = len(model.curves.counts)
    attributes = (
        {}
        if kind == "shell"
        else {
            "id": np.arange(count),
            "group": np.array(["a", "bc", "d", "e"][:count]),
            "w": np.linspace(0, 1, count),
        }
    )
    observed = [{"a": float(state.points().flat[-1]), "b c": k} for k, state in enumerate(states)]
    options = {"velocities": True, "directors": kind != "shell", "fields": names, "contacts": kind == "contact"}
    notes = {"provenance": {"by": "test", "n": 3, "list": [1, {"x": None}]}, "control": {"field": np.eye(3), "dt": 0.1}}
    with Recorder(model, tmp_path, block=3, attributes=attributes, **options, **notes) as recorder:
        for state, values_observed in zip(states, observed, strict=True):
            recorder.record(state, values_observed)
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        assert len(reader) == 7
        assert reader.time.tolist() == [state.time for state in states]
        for frame, state in enumerate(states):
            np.testing.assert_array_equal(reader.points[frame], state.points())
            np.testing.assert_array_equal(reader.velocities[frame], state.velocities())
            if options["directors"]:
                np.testing.assert_array_equal(reader.directors[frame], state.directors())
            for name in names:
                values = (ddg.postprocess.fields.point_fields if name in TERMS else ddg.postprocess.fields.cell_fields)(
                    model, state, [name]
                )[name]
                np.testing.assert_array_equal(reader.fields[name][frame][-values.size :], values.ravel())
            if options["contacts"]:
                for name, wanted in vars(model.contacts(state)).items():
                    np.testing.assert_array_equal(getattr(reader.contacts[frame], name), wanted)
        for name in observed[0]:
            assert reader.series[name].tolist() == [values_observed[name] for values_observed in observed]
        for name, values in attributes.items():
            np.testing.assert_array_equal(reader.attributes[name], values)
        for name, value in notes["provenance"].items():
            assert reader.provenance[name] == value
        restored = model.restore(reader.checkpoint()).snapshot()
        for name, value in states[-1].snapshot().items():
            assert np.asarray(restored[name]).tobytes() == np.asarray(value).tobytes()
    with h5py.File(tmp_path / "trajectory.h5") as file:
        np.testing.assert_array_equal(file["control/field"][:], np.eye(3))
        assert file["control"].attrs["dt"] == 0.1


def summary_without_clocks(result) -> dict:
    """Return the summary of a run as written, without measured times."""
    content = json.loads(json.dumps(summary("scene", {}, result, []), default=lambda value: np.asarray(value).tolist()))
    return {name: value for name, value in content.items() if name not in CLOCKS}


def observe(model, state) -> dict:
    return {"x": state.points().flat[0]}


@covering(1, kind=("rods", "net", "shell", "contact"), worlds=(1, 3))
def test_resumed_equals_straight_in_every_number(kind, worlds, device, tmp_path):
    """Summary and trajectory agree for runs in two segments and in three, one of them a single step."""
    scene, options = (
        scene_of(kind),
        {"device": device, "worlds": worlds, "observe": observe, "progress": False, "usd": False},
    )
    options["fields"] = ["contacts"] if kind == "contact" else ["velocities"]
    straight = simulate(scene, out=tmp_path / "straight", **options)
    for name, ends in {"two": (0.04, 0.08), "three": (0.02, 0.024, 0.08)}.items():
        simulate(scene, out=tmp_path / name, duration=ends[0], **options)
        for end in ends[1:]:
            resumed = simulate(scene, resume=tmp_path / name, duration=end, **options)
        assert summary_without_clocks(resumed) == summary_without_clocks(straight)
        np.testing.assert_equal(resumed.series, straight.series)
        np.testing.assert_array_equal(resumed.times, straight.times)
        assert resumed.wall_time > resumed.compile_time > 0.0
        with TrajectoryReader(tmp_path / name / "trajectory.h5") as resumed_file:
            with TrajectoryReader(tmp_path / "straight" / "trajectory.h5") as straight_file:
                assert resumed_file.recorded == straight_file.recorded
                for field in resumed_file.recorded:
                    name_in_file = f"/trajectory/{field}"
                    with h5py.File(resumed_file.path) as one, h5py.File(straight_file.path) as two:
                        assert one[name_in_file][:].tobytes() == two[name_in_file][:].tobytes()
                counts = resumed_file.run_counts(), straight_file.run_counts()
        for key in counts[0]:
            if not key.startswith(("clock/", "search/")):
                np.testing.assert_array_equal(*(each[key] for each in counts), err_msg=key)


class Killed(BaseException):
    """Stand in for the end of the process."""


@pytest.mark.parametrize("kind", ["rods", "contact"])
def test_resume_after_kill_counts_steps_once(kind, device, tmp_path, monkeypatch):
    """Repeated steps after the last block are counted once."""
    scene, options = scene_of(kind, duration=0.32), {"device": device, "progress": False, "usd": False}
    straight = simulate(scene, out=tmp_path / "straight", **options)

    def record(self, state, observed=None, record=Recorder.record):
        if state.time > 0.29:
            self._abandon()
            raise Killed
        record(self, state, observed)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Recorder, "record", record)
        simulate(scene, out=tmp_path / "killed", **options)
    with TrajectoryReader(tmp_path / "killed" / "trajectory.h5") as reader:
        assert len(reader) == 64
    assert summary_without_clocks(simulate(scene, resume=tmp_path / "killed", **options)) == summary_without_clocks(
        straight
    )


def test_a_failed_step_is_counted_once(device, tmp_path, monkeypatch):
    """A failed run that is resumed without the cause counts like an uninterrupted one."""
    scene, options = scene_of("rods"), {"device": device, "progress": False, "usd": False}
    straight = simulate(scene, out=tmp_path / "straight", **options)

    def step(self, state, dt, controls, step=ddg.Integrator.step):
        if state.time > 0.03:
            step(self, state, dt)
            raise ddg.SolverError("no more", state=state)
        return step(self, state, dt)

    with monkeypatch.context() as patch:
        patch.setattr(ddg.Integrator, "step", step)
        assert simulate(scene, out=tmp_path / "failed", **options).failure
    assert summary_without_clocks(simulate(scene, resume=tmp_path / "failed", **options)) == summary_without_clocks(
        straight
    )


def test_resume_of_a_file_without_counts_starts_counting(device, tmp_path):
    """Files of an older version have no counts: earlier counts stay unknown."""
    scene, options = scene_of("rods"), {"device": device, "progress": False, "usd": False}
    simulate(scene, out=tmp_path, duration=0.04, **options)
    with transaction(tmp_path / "trajectory.h5") as file:
        for slot in ("a", "b"):
            if slot in file["checkpoint"]:
                del file[f"checkpoint/{slot}/run"]
                file[f"checkpoint/{slot}"].attrs.pop("crc32")
    for end in (0.06, 0.08):
        result = simulate(scene, resume=tmp_path, duration=end, **options)
        content = summary_without_clocks(result)
    assert content["counted_from"] == pytest.approx(0.06)
    assert content["energy"]["start"] is None and content["energy"]["end"]
    assert content["steps"] == 20 and content["outcomes"] == {"converged": 5 * 3}


def test_a_finished_run_stays_as_it_is(device, tmp_path):
    """The result is returned again, and no file changes."""
    scene, options = scene_of("contact"), {"device": device, "progress": False}
    first = simulate(scene, out=tmp_path, **options)
    before = {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in tmp_path.iterdir()}
    again = simulate(scene, resume=tmp_path, **options)
    assert summary_without_clocks(again) == summary_without_clocks(first) and (again.times == first.times).all()
    with pytest.raises(
        InputError, match=r"recorded up to 0.08 s; a duration of 0.04 s would cut it: give a longer one"
    ):
        simulate(scene, resume=tmp_path, duration=0.04, **options)
    assert before == {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in tmp_path.iterdir()}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"dt": 0.002}, "has dt = 0.004"),
        ({"worlds": 2}, "has worlds = 1"),
        ({"precision": "float32"}, "has precision = float64"),
        ({"fields": ["velocities"]}, "has fields = none"),
        ({"fields": ["twist"]}, "has fields = none"),
        ({"force": True}, "replaces nothing"),
        ({"out": "elsewhere"}, "goes on in its directory"),
    ],
)
def test_a_run_resumes_with_its_own_settings(changed, message, tmp_path):
    scene, options = scene_of("rods"), {"device": "cpu", "progress": False, "usd": False}
    simulate(scene, out=tmp_path, duration=0.004, **options)
    before = (tmp_path / "trajectory.h5").read_bytes()
    with pytest.raises(InputError, match=message):
        simulate(scene, resume=tmp_path, **options, **changed)
    assert (tmp_path / "trajectory.h5").read_bytes() == before


def test_parameters_set_by_callbacks_do_not_block_a_resume(device, tmp_path):
    """Resumed runs start with parameters of the scene and of the first state; callbacks set them by time."""
    scene, options = scene_of("rods"), {"device": device, "progress": False, "usd": False}

    def soften(model, time: float) -> None:
        model.set_parameter("rod_stretch", "stiffness", 1000.0 * (1.0 - time))

    scene.initial = lambda model: soften(model, 0.0) or model.state()
    scene.callbacks.append(lambda state: soften(state.model, state.time))

    straight = simulate(scene, out=tmp_path / "straight", **options)
    simulate(scene, out=tmp_path / "parts", duration=0.04, **options)
    assert summary_without_clocks(
        simulate(scene, resume=tmp_path / "parts", duration=0.08, **options)
    ) == summary_without_clocks(straight)


def build(kind: str = "rods", change=None, worlds: int = 1):
    scene = scene_of(kind)
    if change:
        change(scene)
    return scene.build("cpu", worlds=worlds)


OTHERS = {
    "worlds": (lambda: build(worlds=2), "shape"),
    "another rod": (lambda: build(change=rods), "rods"),
    "radius": (lambda: build(change=lambda s: s.batches[0].section.__dict__.update(radius=0.03)), "(rods|parameters)"),
    "stiffness": (lambda: _stiffer(build()), "parameters"),
    "a net": (lambda: build("net"), "parameters|rods|snapshot"),
    "contact": (lambda: build(change=lambda s: s.contact()), "contact"),
    "a shell beside": (lambda: build(change=_add_sheet), "surfaces|shape"),
}


def _stiffer(model):
    model.set_parameter("rod_stretch", "stiffness", 5.0)
    return model


def _add_sheet(scene) -> None:
    scene.add_shell(*meshes.rectangle(1, 1), thickness=0.01, material=RUBBER)


@pytest.mark.parametrize("change", OTHERS)
def test_resume_with_another_model_is_refused(change, tmp_path):
    """The refusal comes when the recorder is opened, and the file stays."""
    model = build()
    with Recorder(model, tmp_path, usd=False) as recorder:
        recorder.record(model.state())
    before = (tmp_path / "trajectory.h5").read_bytes()
    make, message = OTHERS[change]
    with pytest.raises(TrajectoryError, match=message):
        Recorder(make(), tmp_path, usd=False, resume=True)
    assert (tmp_path / "trajectory.h5").read_bytes() == before


def test_states_are_recorded_in_order(device, tmp_path):
    """States that are not later than the last are refused; a resumed run skips only its own checkpoint."""
    model = build()
    states = stepped(model, 4)
    with Recorder(model, tmp_path, usd=False) as recorder:
        recorder.record(states[0])
        recorder.record(states[2])
        for state in states[:3]:
            with pytest.raises(SceneError, match=r"follows one at 0.008 s.*Recorder\(..., time=\"frame\"\)"):
                recorder.record(state)
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        restored = model.restore(reader.checkpoint())
    for first in (states[1], _moved(model, restored)):
        with Recorder(model, tmp_path, usd=False, resume=True) as recorder:
            with pytest.raises(SceneError, match=r"follows one at|but not the state of its checkpoint"):
                recorder.record(first)
    with Recorder(model, tmp_path, usd=False, resume=True) as recorder:
        recorder.record(restored)
        with pytest.raises(SceneError, match="follows one at"):
            recorder.record(restored)
        recorder.record(states[3])
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        assert reader.time.tolist() == [states[k].time for k in (0, 2, 3)]


def _moved(model, state):
    moved = model.state(np.asarray(state.points()) + 1e-9)
    moved.time = state.time
    return moved


def test_frames_may_be_numbered(tmp_path):
    """Designs or equilibria in sequence may have any time; resumed recordings continue the numbering."""
    from pxr import Usd

    model = build()
    states = stepped(model, 3)
    with Recorder(model, tmp_path, time="frame", block=2) as recorder:
        for state in (states[2], states[0], states[0]):
            recorder.record(state, {"design": 1})
    with Recorder(model, tmp_path, resume=True) as recorder:
        recorder.record(states[0], {"design": 2})
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        assert (reader.time_is, reader.time.tolist()) == ("frame", [0.0, 1.0, 2.0, 3.0])
        for frame, k in enumerate((2, 0, 0, 0)):
            np.testing.assert_array_equal(reader.points[frame], states[k].points())
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 3.0)
    with pytest.raises(ValueError, match="has time='frame', not 'state'"):
        Recorder(model, tmp_path, resume=True, time="state")


def test_refused_frames_leave_the_recording_whole(tmp_path):
    """Frames before and after each refusal of `record` are all present."""
    model = build()
    states = stepped(model, 8)
    refused = [{"a/b": 1.0}, {"": 1.0}, {3: 1.0}, {"a": "1"}, {"a": np.nan}, {"b": 1.0}, {}]
    with Recorder(model, tmp_path, block=2) as recorder:
        recorder.record(states[0], {"a": 0.0})
        for k, observed in enumerate(refused):
            with pytest.raises(SceneError, match="observed"):
                recorder.record(states[k + 1], observed)
            recorder.record(states[k + 1], {"a": k + 1})
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        assert reader.series["a"].tolist() == list(range(8))
    with Recorder(model, tmp_path, usd=False, resume=True) as recorder:
        with pytest.raises(SceneError, match=r"observed \['b'\], before \['a'\]"):
            recorder.record(_later(model, states[-1]), {"b": 1.0})


def _later(model, state):
    return ddg.Integrator(model).step(state, 0.004)


def test_locked_directory_stays_locked(tmp_path):
    """The lock outlasts the recorder."""
    model = build()
    with RunDirectory(tmp_path / "a") as directory:
        with Recorder(model, directory, usd=False) as recorder:
            recorder.record(model.state())
        with pytest.raises(FileExistsError, match="is recording a run there"):
            Recorder(model, tmp_path / "a", usd=False, force=True)
    Recorder(model, tmp_path / "a", usd=False, force=True).close()
    with RunDirectory(tmp_path / "b"):
        pass
    assert not (tmp_path / "b").exists()


def test_force_replaces_all_of_a_run(tmp_path):
    """Files that the new run does not write are removed too, such as the scene."""
    model = build()
    for name in ("summary.json", "picture.png", "notes.txt"):
        (tmp_path / name).write_text("{}")
    for options, left in (({}, {"scene.usdc"}), ({"usd": False}, set())):
        with Recorder(model, tmp_path, force=True, **options) as recorder:
            recorder.record(model.state())
        assert {path.name for path in tmp_path.iterdir()} == {"trajectory.h5", "trajectory.vtkhdf", "notes.txt"} | left


@pytest.mark.parametrize("name", ["run.lock", "trajectory.h5", "scene.usdc", "trajectory.h5.partial", "scene.partial.usdc",
                                  "scene.room.usdc", "trajectory.h5.journal", "scene.copy.usdc"])  # fmt: skip
def test_links_are_not_written_through(name, tmp_path):
    """The target of a link in the directory stays, whether the run is recorded or refused."""
    model, target, folder = build(), tmp_path / "other", tmp_path / "run"
    target.write_bytes(b"precious" * 100)
    folder.mkdir()
    (folder / name).symlink_to(target)
    for options in ({"force": True}, {"resume": True}):
        try:
            with Recorder(model, folder, block=1, **options) as recorder:
                for state in stepped(model, 3)[2 * ("resume" in options) :]:
                    recorder.record(state)
        except (FileExistsError, ValueError) as error:
            assert "link" in str(error) or "cut short" in str(error) or "later" in str(error) or "follows" in str(error)
    assert target.read_bytes() == b"precious" * 100


def test_a_trajectory_that_is_a_link_is_read_but_not_resumed(tmp_path):
    model = build()
    with Recorder(model, tmp_path / "a", usd=False) as recorder:
        recorder.record(model.state())
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "trajectory.h5").symlink_to(tmp_path / "a" / "trajectory.h5")
    before = (tmp_path / "a" / "trajectory.h5").read_bytes()
    with pytest.raises(TrajectoryError, match=r"is a link to .*links are not written through"):
        Recorder(model, tmp_path / "b", usd=False, resume=True)
    assert (tmp_path / "a" / "trajectory.h5").read_bytes() == before


@pytest.mark.parametrize("dt", [1e8, 1e-9])
def test_time_codes_of_any_step(dt, tmp_path):
    """One time code a frame."""
    from pxr import Usd

    scene = ddg.Scene(analysis=ddg.Dynamics(dt=dt, duration=3 * dt))
    rods(scene)
    model = scene.build("cpu")
    with Recorder(model, tmp_path) as recorder:
        for frame in range(4):
            state = model.state()
            state.time = frame * dt
            recorder.record(state)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 3.0)


def test_unwritable_paths_are_named(tmp_path, monkeypatch):
    """The path is stated as given, with a remedy that fits the cause."""
    model = build()
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(FileExistsError, match=rf"{path}: .*file is a file.*give another one"):
            Recorder(model, path)
    with pytest.raises(OSError, match=r"/proc/x: .*give another path") as caught:
        Recorder(model, "/proc/x")
    assert "free some space" not in str(caught.value)
    with pytest.raises(OSError, match="give a shorter name"):
        Recorder(model, tmp_path / ("a" * 300))
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with pytest.raises(OSError, match=r"the working directory was removed: .*change to one that exists"):
        Recorder(model, Path("out"))


def test_steps_of_simulate_are_few_enough(tmp_path):
    with pytest.raises(InputError, match="take longer steps"):
        simulate_module.step_count(1e-300, 1.0)

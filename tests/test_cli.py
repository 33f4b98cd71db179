"""Commands: written files, exit codes, and messages about mistakes."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from ddg_warp.errors import SolverError
from ddg_warp.io.hdf5 import TrajectoryReader
from ddg_warp.run.cli import main

SCENE = '''"""A rod that falls freely."""

import numpy as np

import ddg_warp as ddg


def build(n: int = 4, shift: float = 0.0, label: str = "rod", level: bool = True) -> ddg.Scene:
    """A rod along x.

    Args:
        n: nodes, 100 % of them free
        shift: spoils the check [m]
    """
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=0.01, duration=0.05))
    points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0 if level else 1.0], n)
    scene.add_rod(points, section=ddg.Circle(0.01), material=ddg.Material(1e6), name=label)
    build.shift = shift
    return scene


def observe(model, state):
    return {"z": state.points()[..., 0, 2].flat[0]}


def check(result):
    # Implicit Euler falls by g h^2 k (k + 1) / 2 in k steps.
    k = len(result.times) - 1
    fall = 9.81 * result.dt**2 * k * (k + 1) / 2
    return [ddg.Check("fall [m]", -result.series["z"][-1] + build.shift, fall, 1e-6, "implicit Euler", relative=True)]


def benchmark():
    return ddg.bench.Study(
        grid={"dt": (0.01, 0.005), "precision": ("float64",)},
        measure=lambda result: result.series["z"][-1],
        reference=-9.81 * 0.02**2 / 2,
        fixed={"duration": 0.02},
    )
'''
SUMMARY = (
    "scene parameters device precision dt steps sim_time wall_time compile_time ms_per_step newton_iterations "
    "pcg_iterations outcomes energy checks"
).split()


@pytest.fixture
def fall(tmp_path, monkeypatch, device):
    """Return a runner of commands on the falling rod, in a temporary directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fall.py").write_text(SCENE)
    return lambda command, *flags: main([command, "fall.py", *flags, "--device", device])


def summary(directory="out/fall"):
    with open(f"{directory}/summary.json") as file:
        return json.load(file)


def points(directory):
    with TrajectoryReader(f"{directory}/trajectory.h5") as reader:
        return reader.points[:]


def test_run_writes_everything(fall, tmp_path, capsys):
    assert fall("run", "--json", "copy/summary.json") == 0
    content = summary()
    assert list(content) == SUMMARY
    assert content == json.loads((tmp_path / "copy/summary.json").read_text())
    assert content["scene"] == "fall"
    assert content["parameters"] == {"n": 4, "shift": 0.0, "label": "rod", "level": True}
    assert content["steps"] == 5
    assert content["sim_time"] == pytest.approx(0.05)
    assert content["outcomes"]["converged"] == 5
    assert set(content["energy"]) == {"start", "end"}
    assert [check["passed"] for check in content["checks"]] == [True]
    files = {path.name for path in (tmp_path / "out/fall").iterdir()}
    assert files == {"scene.usdc", "trajectory.h5", "trajectory.vtkhdf", "summary.json", "picture.png"}
    assert "fall [m]" in capsys.readouterr().out


def test_parameters_and_settings_become_flags(fall):
    flags = "--n 6 --label x --no-level --dt 0.005 --duration 0.01 --out o".split()
    assert fall("run", *flags) == 0
    content = summary("o")
    assert content["parameters"] == {"n": 6, "shift": 0.0, "label": "x", "level": False}
    assert (content["dt"], content["steps"]) == (0.005, 2)
    assert points("o").shape == (3, 6, 3)


def test_worlds_are_recorded_side_by_side(fall):
    assert fall("run", "--worlds", "2") == 0
    assert points("out/fall").shape == (6, 2, 4, 3)


def test_failed_check_fails_the_run(fall):
    assert fall("run", "--shift", "0.1") == 1
    assert summary()["checks"][0]["passed"] is False


def test_failed_solver_keeps_complete_frames(fall, monkeypatch, capsys):
    from ddg_warp.solve.stepping.integrator import Integrator

    step = Integrator.step

    def fail(self, state, dt, controls):
        if state.time > 0.015:
            raise SolverError("rod 0 could not be stepped", state=state)
        return step(self, state, dt)

    monkeypatch.setattr(Integrator, "step", fail)
    assert fall("run") == 1
    content = summary()
    assert (content["failure"], content["steps"], content["checks"]) == ("rod 0 could not be stepped", 2, [])
    assert len(points("out/fall")) == 3
    assert "rod 0 could not be stepped" in capsys.readouterr().err


def test_resumed_equals_straight(fall):
    settings = ("--n", "5", "--dt", "0.005", "--worlds", "2")
    assert fall("run", *settings, "--out", "straight") == 0
    assert fall("run", *settings, "--out", "parts", "--duration", "0.02") == 0
    assert fall("run", "--resume", "parts", "--duration", "0.05") == 0
    np.testing.assert_array_equal(points("parts"), points("straight"))
    assert summary("parts")["parameters"] == summary("straight")["parameters"]
    assert summary("parts")["steps"] == 10


def test_resumed_runs_end_at_the_requested_duration(fall, monkeypatch):
    """The duration of a killed run applies when resumed; a new duration applies to later resumes."""
    from ddg_warp.run.recorder import Recorder

    record = Recorder.record

    def killed(self, state, observed=None):
        if state.time > 0.015:
            raise KeyboardInterrupt
        record(self, state, observed)

    with monkeypatch.context() as patch:
        patch.setattr(Recorder, "record", killed)
        assert fall("run", "--duration", "0.03", "--out", "o") == 130
    assert len(points("o")) == 2
    assert fall("run", "--resume", "o") == 0
    assert len(points("o")) == 4
    assert fall("run", "--resume", "o", "--duration", "0.04") == 0
    assert fall("run", "--resume", "o") == 0
    assert len(points("o")) == 5


def test_existing_run_is_replaced_only_by_force(fall, capsys):
    """A second run of the same name is refused; the message says how to replace and how to keep the first."""
    assert fall("run", "--duration", "0.02") == 0
    assert fall("run") == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert all(word in message for word in ("out/fall holds 3 frames", "--force", "--out", "--resume"))
    assert len(points("out/fall")) == 3
    assert fall("run", "--force") == 0
    assert len(points("out/fall")) == 6


def without_clocks(directory) -> dict:
    clocks = ("wall_time", "compile_time", "ms_per_step")
    return {name: value for name, value in summary(directory).items() if name not in clocks}


def test_resumed_summary_covers_the_whole_run(fall):
    """All numbers but measured times equal an uninterrupted run."""
    assert fall("run", "--out", "straight") == 0
    assert fall("run", "--out", "parts", "--duration", "0.02") == 0
    assert fall("run", "--resume", "parts", "--duration", "0.05") == 0
    assert without_clocks("parts") == without_clocks("straight")


def test_a_finished_run_is_left_as_it_is(fall, tmp_path, capsys):
    """The message names the state and how to continue; a shorter duration changes nothing."""
    assert fall("run", "--duration", "0.03") == 0
    before = {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in (tmp_path / "out/fall").iterdir()}
    capsys.readouterr()
    assert fall("run", "--resume", "out/fall") == 0
    assert (
        "is finished, at 0.03 s, and stays as it is; to go on with it give a longer --duration"
        in capsys.readouterr().out
    )
    assert fall("run", "--resume", "out/fall", "--duration", "0.02") == 2
    assert "a duration of 0.02 s would cut it: give a longer one" in capsys.readouterr().err
    assert before == {
        path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in (tmp_path / "out/fall").iterdir()
    }


def test_a_run_killed_before_its_summary_gets_one(fall, tmp_path, monkeypatch):
    """All frames are complete: the resumed run is checked, summarised and drawn without a step."""
    import ddg_warp.run.outputs

    def killed(*_):
        raise KeyboardInterrupt

    assert fall("run", "--out", "straight") == 0
    with monkeypatch.context() as patch:
        patch.setattr(ddg_warp.run.outputs, "run_checks", killed)
        assert fall("run") == 130
    assert not (tmp_path / "out/fall/summary.json").exists()
    assert fall("run", "--resume", "out/fall") == 0
    assert without_clocks("out/fall") == without_clocks("straight")
    assert (tmp_path / "out/fall/picture.png").exists()


def test_run_is_locked_until_it_is_drawn(fall, tmp_path, monkeypatch, capsys):
    """A second run with --force during drawing is refused, and the first ends well."""
    import ddg_warp.run.outputs

    draw, codes = ddg_warp.run.outputs.draw, []

    def meanwhile(*arguments):
        if not codes:
            codes.append(fall("run", "--force", "--n", "5"))
        draw(*arguments)

    monkeypatch.setattr(ddg_warp.run.outputs, "draw", meanwhile)
    assert fall("run") == 0
    assert codes == [2] and "is recording a run there; wait for its end" in capsys.readouterr().err
    assert points("out/fall").shape == (6, 4, 3) and summary()["parameters"]["n"] == 4
    assert not (tmp_path / "out/fall/run.lock").exists()


def test_force_removes_files_of_the_previous_run(fall, tmp_path, monkeypatch):
    """A killed new run leaves no summary and no picture of the previous one."""
    import ddg_warp.run.simulate

    assert fall("run") == 0

    def killed(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(ddg_warp.run.simulate, "advance", killed)
    assert fall("run", "--force") == 130
    assert {path.name for path in (tmp_path / "out/fall").iterdir()} == {
        "trajectory.h5",
        "trajectory.vtkhdf",
        "scene.usdc",
    }


def test_pictures_and_summary_do_not_follow_links(fall, tmp_path):
    (tmp_path / "other").write_text("precious")
    (tmp_path / "out/fall").mkdir(parents=True)
    for name in ("summary.json", "picture.png"):
        (tmp_path / "out/fall" / name).symlink_to(tmp_path / "other")
    assert fall("run") == 0
    assert (tmp_path / "other").read_text() == "precious"
    assert summary()["steps"] == 5


def test_a_cache_that_cannot_be_written_to_is_named(fall, monkeypatch, capsys):
    """The message proposes another directory for compiled kernels."""
    import ddg_warp.run.cli

    def read_only(_):
        raise OSError(30, "Read-only file system", "/somewhere/.cache")

    monkeypatch.setenv("HOME", "/somewhere")
    monkeypatch.delenv("WARP_CACHE_PATH", raising=False)
    monkeypatch.setattr(ddg_warp.run.cli, "require_device", read_only)
    assert fall("run") == 2
    assert (
        "/somewhere/.cache: Read-only file system: " in (said := capsys.readouterr().err) and "WARP_CACHE_PATH" in said
    )


@pytest.mark.parametrize("path", ["/proc/x.usda", "file/x.usda", "{}/x.usda".format("a" * 300)])
def test_unwritable_path_is_named(path, fall, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert fall("run") == 0
    assert main(["export", "out/fall", "--to", path]) == 2
    (message,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ddg-warp: ")]
    assert (
        message.startswith(f"ddg-warp: {path}: ")
        and "give" in message
        and "room" not in message
        and "Errno" not in message
    )
    assert fall("run", "--out", "file") == 2
    assert "file is a file" in capsys.readouterr().err
    assert fall("run", "--force", "--json", "file/x.json") == 2
    assert "file/x.json: " in capsys.readouterr().err
    assert summary()["steps"] == 5


def test_run_in_progress_is_not_touched(fall, capsys):
    """The message names the other process that records there."""
    import ddg_warp as ddg
    from ddg_warp.run.recorder import Recorder

    scene = ddg.Scene()
    scene.add_rod(np.eye(3), section=ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0, mass_per_length=1.0, radius=0.1))
    with Recorder(scene.build("cpu"), "out/fall", usd=False):
        for flags in ([], ["--force"]):
            assert fall("run", *flags) == 2
            assert f"process {os.getpid()} is recording a run there" in capsys.readouterr().err


def test_a_full_disk_ends_a_run_in_one_line(fall, capfd):
    """Exit code 1, complete frames stay, and the run resumes once there is space."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, before[1]))
        assert fall("run", "--n", "40", "--duration", "3", "--dt", "0.005") == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    (message,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("ddg-warp: ")]
    assert "out/fall: File too large" in message and "free some space and resume" in message
    kept = len(points("out/fall"))
    assert kept and kept % 64 == 0
    assert fall("run", "--resume", "out/fall") == 0
    assert len(points("out/fall")) == 601


def test_damaged_files_are_reported_in_one_line(fall, tmp_path, capfd):
    """Resume, export and scenes name the damaged file, the defect and the remedy."""
    assert fall("run") == 0
    path = tmp_path / "out/fall/trajectory.h5"
    path.write_bytes(path.read_bytes()[:1000])
    (tmp_path / "groom.usdc").write_bytes((tmp_path / "out/fall/scene.usdc").read_bytes()[:500])
    for arguments in (
        ["run", "fall.py", "--resume", "out/fall"],
        ["export", "out/fall"],
        ["run", "strands", "--path", "groom.usdc"],
    ):
        capfd.readouterr()
        assert main(arguments) == 2
        (message,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("ddg-warp: ")]
        assert "cut short or damaged" in message


def test_a_check_that_fails_to_solve_fails_the_run(tmp_path, monkeypatch, capsys, device):
    monkeypatch.chdir(tmp_path)
    code = SCENE.partition("def check")[0] + "def check(result):\n    raise ddg.SolverError('no equilibrium')\n"
    (tmp_path / "fall.py").write_text(code)
    assert main(["run", "fall.py", "--device", device]) == 1
    assert "a check could not be computed: no equilibrium" in capsys.readouterr().err


def test_progress_of_a_piped_run(fall, capsys, monkeypatch):
    """Piped stderr gets whole lines with steps, time and time left, at most one an interval; short runs print none."""
    import ddg_warp.progress

    assert fall("run") == 0
    assert "steps" not in capsys.readouterr().err
    monkeypatch.setattr(ddg_warp.progress, "LINE_EVERY", 1e-9)
    assert fall("run", "--force") == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "steps" in line]
    assert 3 <= len(lines) <= 7
    assert lines[-1].startswith("5 of 5 steps, 00:0") and lines[-1].endswith("elapsed, 00:00 remaining")
    monkeypatch.setattr(ddg_warp.progress, "LINE_EVERY", 1e9)
    assert fall("run", "--force") == 0
    assert "steps" not in capsys.readouterr().err


@pytest.mark.parametrize("failure", ["initial", "first point"])
def test_a_run_that_fails_before_its_first_state_says_so(failure, tmp_path, monkeypatch, capsys, device):
    """One line, exit code 1 and a summary; no trajectory or picture."""
    monkeypatch.chdir(tmp_path)
    code = SCENE.replace("    build.shift = shift", "    scene.initial = lost")
    code = code.replace("def build", "def lost(model):\n    raise ddg.SolverError('no equilibrium')\n\n\ndef build", 1)
    if failure == "first point":
        from ddg_warp.solve.equilibrium import continuation

        def lost(self, state, stop, **_options):
            raise SolverError("no equilibrium", state=state)

        monkeypatch.setattr(continuation.Continuation, "trace", lost)
        trace = "ddg.PathAnalysis({'u': ddg.Displacement.of(-1, 'y')}, ddg.StopCriterion(steps=3))"
        code = SCENE.replace("ddg.Dynamics(dt=0.01, duration=0.05)", trace).replace(
            "    build.shift = shift", "    scene.clamp(0)"
        )
    (tmp_path / "fall.py").write_text(code)
    assert main(["run", "fall.py", "--device", device]) == 1
    (message,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ddg-warp: ")]
    assert "no equilibrium" in message
    assert "no equilibrium" in summary()["failure"]


def test_static_scene_records_every_load_step(tmp_path, monkeypatch, device):
    monkeypatch.chdir(tmp_path)
    code = SCENE.replace("ddg.Dynamics(dt=0.01, duration=0.05)", "ddg.Statics(load_steps=3)")
    code = code.replace("    build.shift = shift", "    scene.clamp(0)")
    (tmp_path / "sag.py").write_text(code.partition("def check")[0] + "def check(result):\n    return []\n")
    assert main(["run", "sag.py", "--device", device]) == 0
    content = summary("out/sag")
    assert (content["steps"], content["sim_time"], content["dt"]) == (3, 1.0, None)
    assert content["newton_iterations"]["max"] > 0
    assert len(points("out/sag")) == 4
    assert main(["run", "sag.py", "--dt", "0.1"]) == 2


def test_path_of_equilibria_is_recorded_and_drawn(tmp_path, device):
    assert main(["run", "right_angle_frame", "--n", "6", "--device", device, "--out", str(tmp_path)]) == 0
    content = summary(tmp_path)
    assert content["outcomes"]["bifurcation"] == 1
    assert {path.name for path in tmp_path.iterdir()} >= {"trajectory.h5", "picture.png", "path.png"}
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        load, time = reader.series["load"][:], reader.time[:]
        assert set(reader.series) == {"load", "deflection"}
    assert len(load) == sum(content["outcomes"].values())
    assert (np.diff(time) > 0.0).all()  # arc length
    assert load[-1] == pytest.approx(1.3 * 1.086757492, rel=1e-9)


MISTAKES = {
    "parameter": (["run", "fall.py", "--m", "3"], "unrecognized arguments: --m 3"),
    "abbreviation": (["run", "fall.py", "--dura", "3"], "unrecognized arguments"),
    "value": (["run", "fall.py", "--n", "few"], "invalid int value: 'few'"),
    "scene": (["run", "cantileve"], "did you mean cantilever?"),
    "file": (["run", "nowhere.py"], "no scene file nowhere.py"),
    "points": (["run", "fall.py", "--n", "1", "--device", "cpu"], "rod"),
    "device": (["run", "fall.py", "--device", "cuda:99"], "no device 'cuda:99'"),
    "steps": (["run", "fall.py", "--dt", "0.03", "--device", "cpu"], "no whole number of steps"),
    "step": (["run", "fall.py", "--dt", "-1", "--device", "cpu"], "must be positive"),
    "worlds": (["run", "fall.py", "--worlds", "0"], "at least one"),
    "nothing to resume": (["run", "fall.py", "--resume", "nowhere"], "no run to resume in nowhere"),
    "both directories": (["run", "fall.py", "--resume", "a", "--out", "b"], "--resume or --out"),
    "term": (["check", "spring"], "no term 'spring'"),
    "benchmark": (["bench", "spring"], "no scene 'spring'"),
    "export": (["export", "nowhere"], "no run in nowhere"),
    "command": (["walk"], "invalid choice: 'walk'"),
    "no command": ([], "required: COMMAND"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_reported_in_one_line(name, fall, capfd):
    arguments, message = MISTAKES[name]
    assert main(arguments) == 2
    errors = [line for line in capfd.readouterr().err.splitlines() if line.startswith("ddg-warp: ")]
    assert len(errors) == 1
    assert message in errors[0]


@pytest.mark.parametrize(("flag", "stored"), [("--n", "n = 4"), ("--dt", "dt = 0.01"), ("--worlds", "worlds = 1")])
def test_resume_with_another_setting_is_a_mistake(fall, capsys, flag, stored):
    assert fall("run") == 0
    assert fall("run", "--resume", "out/fall", flag, "9") == 2
    assert f"has {stored}; resume it without {flag}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("def build(n):\n    pass\n", "needs a default"),
        ("def build(n: list = ()):\n    pass\n", "type of int, float, str or bool"),
        ("def build(device: str = ''):\n    pass\n", "name of an option of `run`"),
        ("def build(scene: str = ''):\n    pass\n", "name of an option of `run`"),
        ("def make():\n    pass\n", "has no build"),
    ],
)
def test_scene_that_cannot_become_flags(tmp_path, capsys, code, message):
    (tmp_path / "odd.py").write_text(code)
    assert main(["run", str(tmp_path / "odd.py")]) == 2
    assert message in capsys.readouterr().err


def test_help_shows_the_parameters_of_the_scene(fall, capsys):
    with pytest.raises(SystemExit) as exit_info:
        fall("run", "--help")
    assert exit_info.value.code == 0
    assert "100 % of them free (default: 4)" in " ".join(capsys.readouterr().out.split())


def test_list_names_scenes_and_terms(capsys):
    assert main(["list"]) == 0
    shown = capsys.readouterr().out
    assert "cantilever  " in shown
    assert "rod_bend_twist  " in shown


def test_info_names_versions(capsys):
    assert main(["info"]) == 0
    assert "warp-lang 1." in capsys.readouterr().out


def test_docs_opens_the_built_site(monkeypatch, capsys, tmp_path):
    import ddg_warp

    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(ddg_warp, "__file__", str(tmp_path / "ddg_warp" / "__init__.py"))
    assert main(["docs"]) == 2
    assert "bash tools/site" in capsys.readouterr().err
    page = tmp_path / "out" / "site" / "index.html"
    page.parent.mkdir(parents=True)
    page.touch()
    assert main(["docs"]) == 0
    assert opened == [page.as_uri()]


@pytest.mark.parametrize("passed", [True, False])
def test_check_prints_the_derivative_table(monkeypatch, capsys, device, passed):
    from ddg_warp.run import derivative_checks

    calls = []

    def table(*arguments):
        calls.append(arguments)
        return [{"term": "rod_bend", "check": "gradient", "error": 1e-9, "tolerance": 1e-7, "passed": passed}]

    monkeypatch.setattr(derivative_checks, "table", table)
    assert main(["check", "rod_bend", "--precision", "float32", "--device", device]) == (0 if passed else 1)
    assert calls == [("rod_bend", "float32", device)]
    assert ("passed" if passed else "FAILED") in capsys.readouterr().out.splitlines()[1]


@pytest.mark.parametrize("flags", [[], ["--tube"]])
def test_export(fall, tmp_path, flags):
    from pxr import Usd, UsdGeom

    assert fall("run") == 0
    assert main(["export", "out/fall", "--to", "again.usda", *flags]) == 0
    kind = UsdGeom.Mesh if flags else UsdGeom.BasisCurves
    stage = Usd.Stage.Open("again.usda")
    shapes = [prim for prim in stage.Traverse() if prim.IsA(kind)]
    assert len(shapes) == 1
    assert kind(shapes[0]).GetPointsAttr().GetNumTimeSamples() == 6


def test_every_and_fps_of_runs_and_exports(fall, capsys):
    """Every second of 10 steps is recorded, also after a resume; time codes are seconds times frames per second."""
    from pxr import Usd, UsdGeom

    def times(path):
        stage = Usd.Stage.Open(path)
        (rods,) = (UsdGeom.BasisCurves(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.BasisCurves))
        return [round(code / stage.GetTimeCodesPerSecond(), 9) for code in rods.GetPointsAttr().GetTimeSamples()]

    settings = ("--dt", "0.005", "--every", "2", "--fps", "24")
    assert fall("run", "--dt", "0.005", "--out", "all") == 0
    assert fall("run", *settings, "--out", "straight") == 0
    assert fall("run", *settings, "--out", "parts", "--duration", "0.02") == 0
    fall("run", "--resume", "parts", "--duration", "0.05")  # the check of the scene counts recorded states
    for directory in ("straight", "parts"):
        np.testing.assert_array_equal(points(directory), points("all")[::2])
        assert summary(directory)["steps"] == 10
    assert times("straight/scene.usdc") == [0.0, 0.01, 0.02, 0.03, 0.04, 0.05]
    assert Usd.Stage.Open("straight/scene.usdc").GetTimeCodesPerSecond() == 24.0
    assert main(["export", "all", "--to", "some.usda", "--every", "5", "--fps", "60"]) == 0
    assert times("some.usda") == [0.0, 0.025, 0.05] and Usd.Stage.Open("some.usda").GetTimeCodesPerSecond() == 60.0
    assert fall("run", "--every", "3", "--out", "odd") == 2
    assert "the run has 5 steps; give a divisor" in capsys.readouterr().err
    assert main(["export", "all", "--to", "some.mp4", "--fps", "60"]) == 2
    assert "--every and --fps are for USD" in capsys.readouterr().err


def test_bench_gives_error_and_time_together(fall, tmp_path):
    assert fall("bench") == 0
    with open("out/bench/fall.json") as file:
        rows = json.load(file)["rows"]
    rows = [
        row for row in rows if row["precision"] == "float64"
    ]  # on CUDA the defaults are a separate case, in mixed precision
    assert [row["dt"] for row in rows] == [0.01, 0.005]
    # Implicit Euler falls too far by g h T / 2.
    assert [row["error"] for row in rows] == pytest.approx([9.81 * dt * 0.02 / 2 for dt in (0.01, 0.005)], rel=1e-6)
    assert all(row["ms_per_step"] > 0 for row in rows)
    assert (
        (tmp_path / "out/bench/fall.csv")
        .read_text()
        .startswith("dt,precision,error,relative_error,ms_per_step,seconds")
    )
    assert (tmp_path / "out/bench/fall.png").is_file()


def test_bench_at_another_size(fall, tmp_path, capsys):
    """Scene parameters apply to every case and to file names; parameters varied by the study are refused."""
    assert fall("bench", "--n", "9", "--label", "long") == 0
    with open("out/bench/fall_n_9_label_long.json") as file:
        content = json.load(file)
    assert content["fixed"] == {"duration": 0.02, "n": 9, "label": "long"}
    assert "--n 9 --label long" in content["command"]
    assert main(["bench", "cantilever", "--n", "9"]) == 2
    assert "the study of cantilever varies it" in capsys.readouterr().err


def test_cantilever_swings_as_published(tmp_path, device):
    assert main(["run", "cantilever", "--device", device, "--out", str(tmp_path)]) == 0
    assert len(summary(tmp_path)["checks"]) == 6


def test_import_is_light():
    code = "import sys, ddg_warp.run.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {"warp", "torch", "pxr", "h5py", "scipy", "matplotlib", "numpy"}.isdisjoint(loaded)


def test_module_is_the_command():
    run = subprocess.run([sys.executable, "-m", "ddg_warp"], capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert run.stderr.startswith("ddg-warp: ")


def test_closed_output_pipe_ends_quietly():
    """`ddg-warp list | head` prints no message and returns the code of a process ended by a closed pipe."""
    ends, into = os.pipe()
    os.close(ends)
    quiet = os.environ | {"PYTHONWARNINGS": "ignore::FutureWarning"}  # of Warp on Python 3.10
    command = [sys.executable, "-m", "ddg_warp", "list"]
    run = subprocess.run(command, env=quiet, stdout=into, stderr=subprocess.PIPE, check=False)
    os.close(into)
    assert run.returncode == 141
    assert not run.stderr

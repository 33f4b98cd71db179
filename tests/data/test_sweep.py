"""Sweeps: the same episodes however and how often they are run, failures kept, and a clear word about mistakes."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from test_episodes import record

from ddg_warp.data.episodes import Episodes
from ddg_warp.data.executors import in_processes
from ddg_warp.data.parameter_ranges import Choice, LogUniform, Uniform
from ddg_warp.data.sweep import SweepError, sweep
from ddg_warp.errors import DataError, SceneError, SolverError
from ddg_warp.io.hdf5 import TrajectoryReader
from ddg_warp.run.cli import main
from ddg_warp.run.scene_registry import InputError

SCENE = '''"""A rod that falls freely, thrown at random."""

import numpy as np

import ddg_warp as ddg


def build(n: int = 4, radius: float = 0.01, throw: bool = False, seed: int = 0, duration: float = 0.03) -> ddg.Scene:
    """A rod along x."""
    scene = ddg.Scene(analysis=ddg.Dynamics(dt=0.01, duration=duration))
    points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], n)
    points[:, 1] += np.random.default_rng(seed).random() if throw else 0.0
    scene.add_rod(points, section=ddg.Circle(radius), material=ddg.Material(1e6))
    return scene


def observe(model, state):
    return {"z": state.points()[0, 2]}
'''
RANGES = {"radius": LogUniform(0.005, 0.02), "n": Choice([4, 5])}


@pytest.fixture
def scene(tmp_path, monkeypatch) -> str:
    """The file of a scene, in a directory of its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thrown.py").write_text(SCENE)
    return "thrown.py"


def noted(directory, load: float, seed: int) -> None:
    record(directory)
    if load > 0.9:
        raise SolverError("rod 0 folds; take a smaller load", outcome="line_search_failed")
    if load > 0.8:
        raise SceneError("load: too much; give less than 0.8")


def bare(folder) -> list[tuple]:
    """Return episodes without their run times."""
    return [(e.name, e.split, e.outcome, e.seed, e.parameters, e.frames) for e in Episodes(folder)]


def contents(folder) -> dict:
    """Recorded points by episode."""
    result = {}
    for episode in Episodes(folder):
        with TrajectoryReader(Episodes(folder).path(episode)) as reader:
            result[episode.name] = reader.points[:]
    return result


def test_a_scene_is_swept(scene, device):
    options = {"device": device, "fields": ["velocities"]}
    episodes = sweep(scene, RANGES | {"throw": True}, 6, out="out", seed=4, options=options, progress=False)
    assert len(episodes) == 6
    assert not any(episode.failed for episode in episodes)
    assert all(0.005 <= episode.parameters["radius"] <= 0.02 and episode.parameters["throw"] for episode in episodes)
    episode = episodes["000003"]
    with TrajectoryReader(episodes.path(episode)) as reader:
        assert len(reader) == episode.frames == 4
        assert reader.points.shape[1] == episode.parameters["n"]
        # The scene draws its numbers from the sample's seed.
        assert reader.points[0][0, 1] == np.random.default_rng(episode.seed).random()
        assert reader.velocities is not None
        assert reader.series["z"][-1] < 0.0
        assert reader.provenance["parameters"]["radius"] == episode.parameters["radius"]
    assert {*os.listdir("out")} == {"index.json", "sweep.json", *(f"00000{k}.h5" for k in range(6))}


def test_times_come_from_options_or_ranges(scene, device):
    ranges = {"duration": Choice([0.02, 0.04]), "dt": 0.005}
    episodes = sweep(scene, ranges, 1, design="grid", out="out", options={"device": device}, progress=False)
    assert [episode.frames for episode in episodes] == [5, 9]


def test_resumed_equals_straight(scene, device, monkeypatch):
    options = {"device": device}
    sweep(scene, RANGES, 6, out="straight", options=options, progress=False)
    sweep(scene, RANGES, 2, out="resumed", options=options, progress=False)
    written = os.stat("resumed/000001.h5").st_mtime_ns
    sweep(scene, RANGES, 6, out="resumed", options=options, progress=False)
    assert os.stat("resumed/000001.h5").st_mtime_ns == written  # not run again
    assert bare("resumed") == bare("straight")
    first, second = contents("straight"), contents("resumed")
    assert all(np.array_equal(first[name], second[name]) for name in first)


def test_processes_make_the_same(scene, device):
    options = {"device": device}
    sweep(scene, RANGES, 4, out="here", options=options, progress=False)
    sweep(scene, RANGES, 4, out="there", options=options, workers=2, progress=False)
    assert bare("there") == bare("here")
    first, second = contents("here"), contents("there")
    assert all(np.array_equal(first[name], second[name]) for name in first)


@pytest.mark.slow  # starts Ray twice
def test_ray_makes_the_same(scene, device):
    ray = pytest.importorskip("ray", reason="Ray, an extra, is not installed")
    options = {"device": device}
    sweep(scene, RANGES, 3, out="here", options=options, progress=False)
    sweep(scene, RANGES, 3, out="there", options=options, ray=True, workers=2, progress=False)
    assert bare("there") == bare("here")
    assert not ray.is_initialized()

    def run(directory, load):  # sent as it is
        if load == 2:
            raise SolverError("too much", outcome="line_search_failed")
        if load == 3:
            raise ZeroDivisionError("of nothing")

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        (episode,) = sweep(run, {"load": 2}, 1, out="function", ray=True, progress=False)
        assert episode.outcome == "line_search_failed"
        with pytest.raises(SweepError, match=r"sample 000000 .*ZeroDivisionError"):
            sweep(run, {"load": 3}, 1, out="wrong", ray=True, progress=False)
        with pytest.raises(SweepError, match="No module named 'test_sweep'"):
            sweep(noted, {"load": 1.0}, 1, out="elsewhere", ray=True, progress=False)
        assert ray.is_initialized()
    finally:
        ray.shutdown()


def test_a_killed_worker_is_named(tmp_path):
    with pytest.raises(SweepError, match="was killed"):
        sweep(dying, {}, 1, out=tmp_path, workers=2, progress=False)


def dying(directory):
    os.kill(os.getpid(), signal.SIGKILL)


def test_without_ray_the_remedy_is_named(scene, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ModuleNotFoundError, match=r"ddg-warp\[ray\]"):
        sweep(scene, RANGES, 2, out="out", ray=True)
    assert not os.path.exists("out")
    assert main(["sweep", scene, "--ray", "--out", "out"]) == 2
    assert "ddg-warp[ray]" in capsys.readouterr().err


def test_a_function_is_swept_and_failures_are_kept(tmp_path):
    loads = {"load": Choice([0.5, 0.85, 0.95])}
    episodes = sweep(noted, loads, 1, design="grid", out=tmp_path, progress=False)
    assert [episode.outcome for episode in episodes] == ["converged", "refused", "line_search_failed"]
    assert "smaller load" in episodes["000002"].failure
    assert episodes["000002"].frames == 3  # recorded until then
    assert [episode.name for episode in episodes.select()] == ["000000"]


def test_an_error_ends_the_sweep_and_keeps_finished_runs(tmp_path):
    def run(directory, load):
        if load == 2 and not (tmp_path / "mended").exists():
            return {}["missing"]
        return noted(directory, 0.0, 0)

    ranges = {"load": Choice([1, 2, 3])}
    with pytest.raises(SweepError, match=r"sample 000001 of \{'load': 2\}: KeyError"):
        sweep(run, ranges, 1, design="grid", out=tmp_path / "out", progress=False)
    assert [episode.name for episode in Episodes(tmp_path / "out")] == ["000000"]
    (tmp_path / "mended").touch()
    assert len(sweep(run, ranges, 1, design="grid", out=tmp_path / "out", progress=False)) == 3


def test_a_run_that_fails_by_itself_has_its_outcome(scene, device):
    hasty = {"device": device, "duration": 0.05, "options": {"max_iterations": 1, "retry_limit": 1}}
    (episode,) = sweep("cantilever", {"n": 20}, 1, out="out", options=hasty, progress=False)
    assert episode.outcome == "max_iterations"
    assert episode.failure


@pytest.mark.parametrize(
    ("ranges", "options", "error", "said"),
    [
        ({"radios": 1.0}, {}, SceneError, "no parameter 'radios'"),
        ({"n": Uniform(4, 8)}, {}, SceneError, "whole number"),
        ({}, {"design": "magic"}, SceneError, "design"),
        ({}, {"workers": 0}, SceneError, "workers"),
        ({}, {"gpus": 1.0}, SceneError, "Ray hands out GPUs"),
        ({}, {"options": {"out": "x"}}, SceneError, "options: out"),
        ({}, {"options": {"fields": ["twists"]}}, ValueError, "twists"),
    ],
)
def test_mistakes_are_named(scene, ranges, options, error, said):
    with pytest.raises(error, match=said):
        sweep(scene, ranges, 1, out="out", progress=False, **options)
    assert not os.path.exists("out")


def test_other_mistakes(scene):
    with pytest.raises(InputError, match="did you mean cantilever"):
        sweep("cantilevers", {}, 1, out="out")
    with pytest.raises(SceneError, match="for scenes"):
        sweep(noted, {"load": 0.0}, 1, out="out", options={"dt": 0.1})
    with pytest.raises(SceneError, match="no parameter 'loads'"):
        sweep(noted, {"loads": 0.0}, 1, out="out")
    with pytest.raises(SceneError, match="top of a module"):
        sweep(lambda directory: None, {}, 1, out="out", workers=2, progress=False)


def test_a_folder_of_another_sweep_is_refused(scene, device):
    options = {"device": device}
    sweep(scene, RANGES, 2, out="out", options=options, progress=False)
    with pytest.raises(DataError, match="ranges"):
        sweep(scene, RANGES | {"n": 5}, 2, out="out", options=options, progress=False)
    with pytest.raises(DataError, match="seed"):
        sweep(scene, RANGES, 2, out="out", seed=1, options=options, progress=False)
    assert len(sweep(scene, RANGES, 1, out="out", options=options, progress=False)) == 2
    os.remove("out/sweep.json")
    with pytest.raises(DataError, match="2 episodes of no sweep"):
        sweep(scene, RANGES, 2, out="out", options=options, progress=False)


def test_the_command(scene, device, capsys):
    flags = ["--samples", "2", "--range", "radius=5e-3:2e-2:log", "--range", "seed=1,2", "--n", "5", "--throw"]
    assert main(["sweep", scene, *flags, "--out", "out", "--duration", "0.02", "--device", device]) == 0
    assert "2 episodes: 2 converged" in capsys.readouterr().out
    episodes = Episodes("out")
    assert all(e.parameters["n"] == 5 and e.parameters["seed"] in (1, 2) and e.frames == 3 for e in episodes)
    assert json.loads(open("out/sweep.json").read())["what"] == "thrown"
    assert main(["sweep", scene, "--range", "radius", "--out", "out"]) == 2
    assert "NAME=LOW:HIGH" in capsys.readouterr().err
    assert main(["sweep", scene, "--range", "radios=1,2", "--out", "out"]) == 2
    assert "radios" in capsys.readouterr().err
    assert main(["sweep", scene, "--radius", "-1", "--out", "none", "--device", device]) == 1
    assert "1 refused" in capsys.readouterr().out


KILLED = """
import sys
sys.path.insert(0, {here!r})
from ddg_warp.data.parameter_ranges import Uniform
from ddg_warp.data.sweep import sweep
from test_sweep import noted
sweep(noted, {{"load": Uniform(0.0, 1.0)}}, 40, out={out!r})
"""


def test_a_killed_sweep_goes_on(tmp_path):
    script = KILLED.format(here=os.path.dirname(__file__), out=str(tmp_path / "killed"))
    process = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.DEVNULL)
    while not (tmp_path / "killed" / "index.json").is_file() or not len(Episodes(tmp_path / "killed")):
        assert process.poll() is None
        time.sleep(0.001)  # an index that takes long to write has less than there are files
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert 0 < len(Episodes(tmp_path / "killed")) <= 40
    sweep(noted, {"load": Uniform(0.0, 1.0)}, 40, out=tmp_path / "killed", progress=False)
    sweep(noted, {"load": Uniform(0.0, 1.0)}, 40, out=tmp_path / "straight", progress=False)
    assert bare(tmp_path / "killed") == bare(tmp_path / "straight")
    assert not (tmp_path / "killed" / ".partial").exists()


def test_tasks_are_handed_out_a_few_at_a_time():
    handed = []

    def tasks():
        for number in range(20):
            handed.append(number)
            yield number

    finished = in_processes(abs, tasks(), 2)
    done = [next(finished)]
    assert len(handed) < 10
    done += finished
    assert sorted(done) == [(number, number) for number in range(20)]

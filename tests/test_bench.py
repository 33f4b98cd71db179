"""Benchmarks: error and time of every case; `tools/bench_rods.py` runs and reproduces the published tip."""

import csv
import json
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.run import bench, bench_overview, scene_registry
from ddg_warp.run.cli import main
from ddg_warp.run.scene_registry import InputError, load_scene

ROOT = Path(__file__).parents[1]
COLUMNS = "study rods nodes precision rtol ms_per_step newton_mean newton_max outcomes residual error".split()


@pytest.fixture
def cantilever() -> ModuleType:
    return load_scene("cantilever")


@pytest.fixture
def study(cantilever) -> bench.Study:
    """Return the cantilever's study on a small grid."""
    grid = {"dt": (0.02, 0.01), "n": (8,), "scheme": ("implicit_euler", "implicit_midpoint"), "rtol": (1e-6,)}
    reference = {"dt": 0.0025, "n": 8, "scheme": "implicit_midpoint", "rtol": 1e-8}
    fixed = {"duration": 0.1, "precision": "float64"}
    return replace(cantilever.benchmark(), grid=grid, reference=reference, fixed=fixed, series=("scheme",))


def test_every_case_has_its_error_and_its_time(cantilever, study, device):
    rows, unit = bench.measure(cantilever, study, device=device)
    assert unit == "m"
    *rows, usual = rows
    assert usual["default"]
    assert usual["dt"] == 0.01
    assert usual["n"] == 50
    assert [{name: row[name] for name in study.grid} for row in rows] == study.cases()
    assert all(row["error"] > 0.0 and row["ms_per_step"] > 0.0 and row["seconds"] > 0.0 for row in rows)
    assert all(row["newton_iterations"] >= 1.0 and not row["failure"] for row in rows)
    assert usual["relative_time"] == 1.0
    assert all(row["relative_time"] == row["seconds"] / usual["seconds"] for row in rows)
    assert not any(row["default"] for row in rows)
    assert [row["steps"] for row in rows] == [5, 5, 10, 10]
    euler, midpoint = ([row["error"] for row in rows if row["scheme"] == scheme] for scheme in study.grid["scheme"])
    assert euler[1] < euler[0]  # the step dominates the error: nodes equal the reference
    assert max(midpoint) < min(euler)


def test_reference_is_run_once(cantilever, study, device, monkeypatch):
    cases = []
    run = bench.run
    monkeypatch.setattr(bench, "run", lambda module, case, place: cases.append(case) or run(module, case, place))
    bench.measure(cantilever, study, device=device)
    # plus the defaults, and the first case of each scheme twice, since its first run loads kernels
    assert len(cases) == len(study.cases()) + 2 + len(study.grid["scheme"])
    assert [case["dt"] for case in cases].count(study.reference["dt"]) == 1


def test_failed_case_has_no_error(cantilever, study, device, monkeypatch):
    def fail(self, state, dt, controls):
        raise ddg.SolverError("rod 0 could not be stepped", state=state)

    monkeypatch.setattr(ddg.Integrator, "step", fail)
    rows, _ = bench.measure(cantilever, study, device=device)
    assert all(np.isnan(row["error"]) and np.isnan(row["relative_time"]) for row in rows)
    assert {row["failure"] for row in rows} == {"rod 0 could not be stepped"}
    assert bench.best(study, rows) == []


def test_best_cases_are_the_pareto_front_of_a_series(study):
    def row(scheme, seconds, error):
        return {"scheme": scheme, "seconds": seconds, "error": error}

    rows = [row("a", 2.0, 0.1), row("b", 1.0, 0.5), row("a", 1.0, 0.2), row("a", 3.0, 0.15), row("a", 4.0, np.nan)]
    assert bench.best(study, rows) == [row("a", 1.0, 0.2), row("a", 2.0, 0.1), row("b", 1.0, 0.5)]
    assert bench.best(replace(study, series=()), rows) == rows


def test_unknown_setting_is_refused(cantilever, device):
    with pytest.raises(InputError, match="sets 'color'"):
        bench.run(cantilever, {"color": 1}, device)


@pytest.mark.slow
def test_many_rods(tmp_path):
    command = [sys.executable, str(ROOT / "tools/bench_rods.py"), "--cpu", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with open(tmp_path / "rods_cpu.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["study"] for row in rows} == {"published", "rods", "nodes", "island"}
    assert set(COLUMNS) <= set(rows[0])
    header = next(line for line in done.stdout.splitlines() if line.startswith("study "))
    assert set(COLUMNS) <= set(header.split())
    content = json.loads((tmp_path / "rods_cpu.json").read_text())
    assert {"commit", "versions", "processor"} <= set(content["machine"])
    assert "--cpu --quick" in content["command"]
    for row in content["rows"]:
        assert row["ms_per_step"] > 0.0
        assert row["error"] <= 1e-5
        assert (row["retries"], row["lost_pivots"], row["failure"], row["passed"]) == (0, 0, "", True)
    assert (tmp_path / "rods_cpu.png").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tool", "options", "rows"), [("nets", ["--edges", "4"], 10), ("sheets", ["--quick", "--bending", "hinge"], 1)]
)
def test_coupled_rods_and_sheets_are_timed(tmp_path, tool, options, rows):
    command = [
        sys.executable,
        str(ROOT / f"tools/bench_{tool}.py"),
        "--device",
        "cpu",
        *options,
        "--out",
        str(tmp_path),
    ]
    subprocess.run(command, capture_output=True, text=True, check=True)
    with open(tmp_path / f"{tool}_cpu.csv", newline="") as file:
        measured = list(csv.DictReader(file))
    assert len(measured) == rows
    for row in measured:
        assert float(row["ms_per_step"]) > 0.0
        assert row["outcomes"].endswith("converged")
        assert tool == "sheets" or 0.0 < float(row["error"]) < 1e-6


@pytest.mark.slow
def test_iterations_of_the_multilevel_preconditioner_are_counted(tmp_path):
    command = [sys.executable, str(ROOT / "tools/bench_sheets.py"), "--iterations", "--quick", "--device", "cpu"]
    command += ["--bending", "hinge", "--shapes", "flat", "--linear", "multilevel", "--out", str(tmp_path)]
    subprocess.run(command, capture_output=True, text=True, check=True)
    with open(tmp_path / "iterations_cpu.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["cells"] for row in rows] == ["16", "32", "16", "32"]
    for row in rows:
        assert float(row["pcg_a_step"]) > 0.0
        assert row["outcomes"] == "12 converged"
        hats = [int(count) for count in row["hats"].split()]
        assert len(hats) > 1 and hats == sorted(hats, reverse=True)


@pytest.mark.slow
def test_builds_are_timed(tmp_path):
    command = [sys.executable, str(ROOT / "tools/bench_rods.py"), "--build", "--quick", "--out", str(tmp_path)]
    subprocess.run(command, capture_output=True, text=True, check=True)
    with open(tmp_path / "builds_cpu.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3
    assert all(float(row["model_s"]) >= float(row["build_s"]) > 0.0 for row in rows)


def test_convergence_orders():
    """error = c n^-2 over edges and c dt over steps, at the smallest error of the other settings."""
    study = bench.Study({"n": (10, 20, 40), "dt": (0.1, 0.05, 0.025)}, "tip", 0.0)
    rows = [{"n": n, "dt": dt, "error": 3.0 * n**-2.0 + 1e-9 * dt} for n in (10, 20, 40) for dt in (0.1, 0.05, 0.025)]
    assert bench.orders(study, rows)["n"] == pytest.approx(2.0, abs=1e-4)
    rows = [{"n": n, "dt": dt, "error": 0.5 * dt} for n in (10, 20, 40) for dt in (0.1, 0.05, 0.025)]
    assert bench.orders(study, rows)["dt"] == pytest.approx(1.0, abs=1e-6)


def test_settings_are_varied_one_by_one(cantilever, study, device, tmp_path):
    """Each setting varies from the defaults, which are run once; orders and lines include them."""
    grid = {"dt": (0.02, 0.01, 0.005), "n": (25, 50), "rtol": (1e-4,)}
    single_study = replace(study, grid=grid, reference={"dt": 0.0003125}, series=(), one_by_one=True)
    rows, unit = bench.measure(cantilever, single_study, device=device)
    usual = {"dt": 0.01, "n": 50, "rtol": 1e-6}
    differ = [{name: row[name] for name in grid if row[name] != usual[name]} for row in rows]
    assert differ == [{"dt": 0.02}, {"dt": 0.005}, {"n": 25}, {"rtol": 1e-4}, {}]
    assert [row["default"] for row in rows] == [False] * 4 + [True]
    assert bench.orders(single_study, rows)["dt"] == pytest.approx(1.0, abs=0.1)
    assert set(bench.orders(single_study, rows)) == {"dt"}
    bench.plot(single_study, rows, tmp_path / "one.png", "cantilever", unit)
    assert {path.name for path in tmp_path.iterdir()} == {"one.png", "one_settings.png"}
    with pytest.raises(InputError, match="varies 'scheme' one by one; it varies numbers"):
        replace(single_study, grid={"scheme": ("implicit_euler",)})
    with pytest.raises(InputError, match="names of the grid are its series; leave series out"):
        replace(single_study, series=("dt",))


def scenes() -> list:
    """Return names of all scenes; scenes that learn at build are slow and need torch."""
    marks = (pytest.mark.slow, pytest.mark.skipif(find_spec("torch") is None, reason="needs torch"))
    learned = {name: "require_torch" in path.read_text() for name, path in scene_registry.scene_files().items()}
    return [pytest.param(name, marks=marks) if is_learned else name for name, is_learned in learned.items()]


@pytest.mark.parametrize("name", scenes())
def test_every_scene_has_a_study(name):
    """The grid names settings of a run; the scene's defaults are in it or a separate case."""
    module = load_scene(name)
    study = bench.study_of(module)
    usual = bench.defaults(module, study, "cpu")
    assert set(usual) == set(study.grid)
    assert study.cases()
    assert isinstance(study.measure, str) or study.reference is not None


def test_a_scene_without_benchmark_gets_a_study(tmp_path, device):
    """The study measures the first check over resolution: a hanging chain of springs, L = m g / k (n + 1) / 2n over n edges."""
    path = tmp_path / "springs.py"
    path.write_text(
        """
import numpy as np
import ddg_warp as ddg

def build(n: int = 16) -> ddg.Scene:
    scene = ddg.Scene(analysis=ddg.Statics())
    points = np.outer(np.linspace(0.0, -1.0, n + 1), [0.0, 0.0, 1.0])
    scene.fix(scene.add_rod(points, section=ddg.Stiffness(EA=1e3, mass_per_length=1.0), bend=False), [0])
    return scene

def check(result):
    found = -1.0 - result.state.points()[-1, 2]
    return [ddg.Check("sag [m]", found, 0.5 * 9.81 / 1e3, 1e-6, "EA u'' = -rho A g")]
"""
    )
    assert main(["bench", str(path), "--device", device, "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "springs.json").read_text())
    assert [row["n"] for row in content["rows"]] == [4, 8, 16]
    assert [row["default"] for row in content["rows"]] == [False, False, True]
    assert content["unit"] == "m"
    # consistent nodal loads: ends of straight springs are exact at any n
    assert all(row["error"] < 1e-9 for row in content["rows"])
    assert (tmp_path / "springs.png").stat().st_size > 0


def test_overview_of_scenes(tmp_path, device):
    assert main(["bench", "tip_load", "--device", device, "--out", str(tmp_path)]) == 0
    (row,) = bench_overview.overview(tmp_path)
    assert row["scene"] == "tip_load"
    assert row["relative_error"] < 1e-3
    assert row["to_1_percent"] <= row["to_0.1_percent"]
    order = json.loads((tmp_path / "tip_load.json").read_text())["orders"]["n"]
    assert order == pytest.approx(2.0, abs=0.1)
    assert f"n {order:.1f}" in row["orders"]
    assert (tmp_path / "overview.png").stat().st_size > 0


def test_all_excludes_a_scene_name(capsys):
    assert main(["bench", "cantilever", "--all"]) != 0
    assert "leave out 'cantilever'" in capsys.readouterr().err

"""Runs from Python by `ddg.simulate`, loops over an integrator, and progress of long solves."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import progress
from ddg_warp.solve.equilibrium import statics

FALL = -0.5 * 9.81 * 0.05 * 0.06  # implicit Euler: g dt^2 n (n + 1) / 2, n = 5


def cable(analysis=None, clamped: bool = False) -> ddg.Scene:
    scene = ddg.Scene(analysis=analysis or ddg.Dynamics(dt=0.01, duration=0.05))
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5)
    rod = scene.add_rod(
        points, section=ddg.Circle(0.02), material=ddg.Material(young=1e7, density=1000.0), name="cable"
    )
    if clamped:
        scene.clamp(rod)
    return scene


def observe(model, state) -> dict:
    return {"z": state.points("cable")[-1, 2]}


def check(result) -> list:
    return [ddg.Check("fall [m]", result.series["z"][-1], FALL, 1e-6, "free fall", relative=True)]


def test_simulate_records_checks_and_draws(device, tmp_path):
    result = ddg.simulate(
        cable(),
        device=device,
        out=tmp_path / "run",
        observe=observe,
        check=check,
        progress=False,
        usd=False,
    )
    assert isinstance(result.series["z"], np.ndarray)
    np.testing.assert_allclose(result.times, 0.01 * np.arange(6), atol=1e-12)
    n = np.arange(6)
    np.testing.assert_allclose(result.series["z"], -9.81e-4 * n * (n + 1) / 2, rtol=1e-6, atol=1e-12)
    assert [each.failed for each in result.checks] == [False]
    assert {"trajectory.h5", "summary.json", "picture.png"} <= {path.name for path in (tmp_path / "run").iterdir()}
    written = json.loads((tmp_path / "run/summary.json").read_text())
    assert written["checks"][0]["measured"] == pytest.approx(FALL, rel=1e-6)


def test_without_a_directory_nothing_is_written_and_checks_run(device, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = ddg.simulate(cable(), device=device, check=lambda result: [], progress=False)
    assert not list(tmp_path.iterdir())
    assert result.checks == []
    with pytest.raises(RuntimeError, match="the check of the scene fails: no value"):
        ddg.simulate(cable(), device=device, check=_fails, progress=False)


def _fails(result):
    raise ValueError("no value")


def test_to_pandas_has_a_row_a_state(device):
    """Columns equal the series; the index has the axis of the analysis."""
    pytest.importorskip("pandas")
    path = ddg.PathAnalysis(stop=ddg.StopCriterion(load=(-1.0, 1.0), steps=20), watch={"d": (0, 4)})
    for analysis, axis in ((None, "time"), (ddg.Statics(load_steps=3), "load parameter"), (path, "arc length")):
        scene = cable(analysis, clamped=True)
        scene.add_force(0, 4, (0.0, 0.0, -1e-3))
        result = ddg.simulate(scene, device=device, observe=observe, progress=False)
        table = result.to_pandas()
        assert table.index.name == axis
        np.testing.assert_array_equal(table.index, result.times)
        assert list(table.columns) == list(result.series)
        for name, values in result.series.items():
            np.testing.assert_array_equal(table[name], values)


def test_to_pandas_names_the_remedy(device, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match="pip install pandas"):
        ddg.simulate(cable(), device=device, progress=False).to_pandas()


def test_run_yields_the_states_of_step(device):
    model = cable(clamped=True).build(device)
    integrator, second = ddg.Integrator(model), ddg.Integrator(model)
    stepped = model.state()
    for state in integrator.run(0.05, 0.01):
        stepped = second.step(stepped, 0.01)
        np.testing.assert_array_equal(state.points(), stepped.points())
    assert state.time == pytest.approx(0.05)
    with pytest.raises(ddg.SceneError, match=r"a duration of 0.05 s is no whole number of steps of 0.02 s"):
        integrator.run(0.05, 0.02)
    (last,) = integrator.run(0.01, 0.01, state=stepped)
    assert last.time == pytest.approx(0.06)


def test_long_solves_report_load_and_time_left(device, monkeypatch, capsys):
    beat = progress.Heartbeat("statics", lambda: (0.25, "load parameter 0.25 of 1, 7 Newton iterations"))
    assert beat.line(30.0) == "statics: load parameter 0.25 of 1, 7 Newton iterations; 30 s so far, about 90 s left"
    assert progress.Heartbeat("path", lambda: (None, "3 points")).line(5.0) == "path: 3 points; 5 s so far"
    monkeypatch.setattr(progress, "LINE_EVERY", 0.01)
    model = cable(ddg.Statics(), clamped=True).build(device)
    assert statics.solve(model, load_steps=2).outcome == "converged"
    capsys.readouterr()
    with progress.Heartbeat("statics", lambda: (0.5, "half")):
        time.sleep(0.1)
    assert capsys.readouterr().err.startswith("statics: half; 0 s so far, about 0 s left\n")
    assert statics.solve(model, load_steps=2, progress=False).outcome == "converged"
    assert capsys.readouterr().err == ""


def test_short_names_of_readers_and_the_simulator():
    code = "import ddg_warp as ddg; from ddg_warp.io.mesh_read import read_mesh; assert ddg.read_mesh is read_mesh; "
    code += "assert ddg.read_curves is ddg.io.read"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def gripped() -> ddg.Scene:
    scene = cable()
    scene.clamp(0, motion=ddg.Grip(), name="grip")
    return scene


def rising(t: float) -> ddg.Controls:
    return ddg.Controls(poses=[[0.0, 0.0, t * t, 0.0, 0.0, 0.0]])


def test_simulate_and_run_follow_controls_of_time(device):
    """Runs with controls as a function of time equal a loop, bit for bit, with its wrenches."""
    result = ddg.simulate(gripped(), device=device, controls=rising, wrenches=True, progress=False)
    model = gripped().build(device)
    integrator, state, forces = ddg.Integrator(model), model.state(), []
    integrator.watch_wrenches()
    for _ in range(5):
        state = integrator.step(state, 0.01, rising(state.time + 0.01))
        forces.append(integrator.wrenches()["grip"].force)
    np.testing.assert_array_equal(result.state.points(), state.points())
    np.testing.assert_array_equal(result.wrenches["grip"].force[1:], forces)
    (*_, state) = ddg.Integrator(model).run(0.05, dt=0.01, controls=rising)
    np.testing.assert_array_equal(result.state.points(), state.points())


def test_static_wrenches_carry_the_weight_at_every_load_step(device):
    """The clamp carries the load parameter times the weight; a path has no wrenches."""
    result = ddg.simulate(cable(ddg.Statics(load_steps=4), clamped=True), device=device, wrenches=True, progress=False)
    weight = 1000.0 * np.pi * 0.02**2 * 9.81
    np.testing.assert_allclose(result.times, [0.0, 0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(result.wrenches[0].force[:, 2], weight * result.times, rtol=1e-6, atol=1e-9)
    with pytest.raises(ValueError, match="a path takes no controls and no wrenches"):
        ddg.simulate(cable(ddg.PathAnalysis(), clamped=True), device=device, wrenches=True)
    with pytest.raises(ValueError, match="the run kept none"):
        _ = ddg.simulate(cable(), device=device, progress=False).wrenches


def test_controls_scale_with_the_load_parameter(device):
    """Poses as a function of the load parameter hold at every load step."""
    scene = cable(ddg.Statics(load_steps=3))
    scene.clamp(0, motion=ddg.Grip())
    result = ddg.simulate(
        scene, device=device, controls=rising, observe=lambda model, state: {"z": state.poses()[0, 2]}, progress=False
    )
    np.testing.assert_allclose(result.series["z"], result.times**2, atol=1e-12)

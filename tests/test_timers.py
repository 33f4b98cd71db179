"""Timers of a step: the tree of phases, and equal results with and without them.

A second process has the timers on, since they are chosen when the package is imported.
"""

import os
import subprocess
import sys

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp import timers

STEPS, DT = 5, 0.005
SOLVE = ("predictor", "loads", "newton/evaluate", "finish", "frames", "retry test")
SWEEP = ("newton/block LDL^T sweep", "newton/edge rotation")
CONTACT = ("CCD filter/additive CCD", "friction lag", "interpenetration check")
NEWTON = ("evaluate/contact", "line search", "assemble/contact", "step length", "update", "CCD filter")
PCG = ("factorise", "preconditioner", "product", "reductions")
EXPECTED = {
    "rods": [f"rod group/{name}" for name in (*SOLVE, *SWEEP, "warm start")],
    "midpoint": [f"rod group/{name}" for name in (*SOLVE, *SWEEP, "energy")],
    "contact": [
        *(f"coupled system/{name}" for name in (*SOLVE, "newton/residual", *CONTACT, "warm start")),
        *(f"coupled system/decoupled rods/{name}" for name in (*SOLVE[:-2], *SWEEP)),
        *(f"coupled system/newton/{name}" for name in NEWTON),
        *(f"coupled system/newton/direction/pcg/{name}" for name in PCG),
    ],
}


def scene(name: str) -> ddg.Scene:
    """Return a cantilever; for "contact" a rod that falls onto a fixed one."""
    options = {"section": ddg.Circle(0.01), "material": ddg.Material(young=1e6, poisson=0.3, density=1000.0)}
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 11)
    result = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    result.clamp(result.add_rod(points, **options), edges=range(10) if name == "contact" else [0])
    if name == "contact":
        result.add_rod(points[:, [1, 0, 2]] + [0.5, -0.5, 0.0225], **options)
        result.contact(stiffness=2e4, friction=0.3, range=2e-3)
    return result


def run(name: str, device: str) -> tuple[dict[str, np.ndarray], int]:
    """Return the state after `STEPS` steps, and the number of launches of another step."""
    model = scene(name).build(device=device)
    integrator = ddg.Integrator(model, "implicit_midpoint" if name == "midpoint" else "implicit_euler")
    state = model.state()
    for _ in range(STEPS):
        state = integrator.step(state, DT)
    snapshot, launches, launch = state.snapshot(), [], wp.launch
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wp, "launch", lambda *args, **kwargs: (launches.append(1), launch(*args, **kwargs)))
        integrator._launch(integrator._own(state))
    return snapshot, len(launches)


@pytest.fixture(scope="module")
def timed(device, tmp_path_factory):
    """Return, by scene, the state, launches and times by path of a process with timers; and its error output."""
    path = tmp_path_factory.mktemp("timers") / "timed.npz"
    done = subprocess.run(
        [sys.executable, __file__, str(path), device],
        env=os.environ | {"DDG_WARP_TIMERS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return dict(np.load(path)), done.stderr


def times_of(timed, name: str) -> dict[str, np.ndarray]:
    """Return calls, CPU and GPU time by path in the tree of a scene; the root has the path ""."""
    prefix = f"{name}/times/"
    return {key.removeprefix(prefix): values for key, values in timed[0].items() if key.startswith(prefix)}


@pytest.mark.parametrize("name", EXPECTED)
def test_phases(timed, name, device):
    times = times_of(timed, name)
    assert not set(EXPECTED[name]) - times.keys()
    assert times[""][0] == STEPS
    for path, (calls, cpu, gpu) in times.items():
        assert calls > 0
        assert (gpu > 0.0) == device.startswith("cuda")
        below = [values for key, values in times.items() if key and key != path and key.rpartition("/")[0] == path]
        assert sum(values[1] for values in below) <= cpu + 1e-9


@pytest.mark.parametrize("name", EXPECTED)
def test_results_and_launches_are_equal(timed, name, device):
    snapshot, launches = run(name, device)
    for key, values in snapshot.items():
        np.testing.assert_array_equal(values, timed[0][f"{name}/state/{key}"], err_msg=key)
    assert launches == timed[0][f"{name}/launches"]


def test_table_is_printed_at_exit(timed):
    table = timed[1]
    assert f"step on cpu ({STEPS} steps)" in table or "step on cuda" in table
    assert "coupled system" in table
    assert "captured graphs" in table


def test_nothing_is_timed_without_the_variable():
    def phase():
        """Do nothing."""

    assert not timers.ON
    assert not timers.times()
    assert timers.report() == ""
    assert timers.timer("phase")(phase) is phase
    assert timers.root("step")(phase) is phase


def main(path: str, device: str) -> None:
    """Write states, launches and times of all scenes to a file."""
    arrays = {}
    for name in EXPECTED:
        timers.clear()
        snapshot, launches = run(name, device)
        arrays |= {f"{name}/state/{key}": values for key, values in snapshot.items()}
        phases = {path: values for path, values in timers.times().items() if path != (timers.LOADING,)}
        arrays |= {f"{name}/times/{'/'.join(path[1:])}": values for path, values in phases.items()}
        arrays[f"{name}/launches"] = np.array(launches)
    np.savez(path, **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])

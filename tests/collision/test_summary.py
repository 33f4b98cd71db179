"""Contact statistics of a run: counts and friction work, against values from the states."""

import json
import math

import numpy as np

import ddg_warp as ddg
from ddg_warp.run.cli import main

RADIUS, MU = 2e-3, 0.3


def rod_above_floor(height: float = 5e-4, friction: float = MU) -> ddg.Scene:
    """Return a rod at a height above a floor [m]."""
    scene = ddg.Scene()
    y = np.linspace(-0.05, 0.05, 11)
    material = ddg.Material(young=1e6, density=1000.0, poisson=0.5)
    scene.add_rod(np.stack([0 * y, y, 0 * y + RADIUS + height], 1), section=ddg.Circle(RADIUS), material=material)
    scene.add_obstacle(ddg.Plane(), name="floor")
    scene.contact(friction=friction)
    return scene


def test_friction_work_equals_lost_kinetic_energy(device):
    """Implicit Euler friction F = m (v1 - v0) / h acts along h v1, so that the work is the sum of -m v1 . (v1 - v0)."""
    model = rod_above_floor().build(device=device, worlds=2)
    integrator, state = ddg.Integrator(model, rtol=1e-10), model.state()
    for _ in range(40):
        state = integrator.step(state, 0.02)
    speed = np.zeros_like(state.points())
    speed[0, :, 0] = 0.3  # in the first of both worlds
    state = model.state(points=state.points(), velocities=speed)
    integrator, taken, counts = ddg.Integrator(model, rtol=1e-10), 0.0, []
    mass = model.coupled.host.mass[: model.points_count, :1]
    for _ in range(10):
        before, state = state.velocities(), integrator.step(state, 2e-3)
        after = state.velocities()
        taken -= (mass * after * (after - before))[..., :2].sum()
        counts.append(len(model.contacts(state)))
    statistics = integrator.statistics()["contact"]
    np.testing.assert_allclose(statistics["friction_work"], taken, rtol=1e-4)
    np.testing.assert_allclose(
        taken, MU * mass.sum() * 9.81 * np.ptp(state.points()[..., 0].mean(1)), rtol=1e-3
    )  # mu m g times the path length
    assert statistics["contacts"] == {"mean": np.mean(counts), "last": counts[-1]}
    assert statistics["contacts"]["last"] > 0


def test_gap_is_infinite_without_contact(device):
    model = rod_above_floor(height=1.0, friction=0.0).build(device=device)
    integrator = ddg.Integrator(model)
    integrator.step(model.state(), 1e-3)
    statistics = integrator.statistics()["contact"]
    assert statistics["contacts"] == {"mean": 0.0, "last": 0}
    assert statistics["smallest_gap"] == math.inf
    assert "friction_work" not in statistics


def test_repeated_steps_count_once(device):
    """An overflowing step is undone and counted once."""
    scene, counts = rod_above_floor(), []
    for room in (None, 1):
        model = scene.build(device=device)
        integrator, state = ddg.Integrator(model), model.state()
        contact = integrator._coupled.newton.contact
        for pairs in contact.search.lists if room else ():
            pairs.reserve(room)
        if room:
            contact.search.version += 1
            contact.terms.fit()
        for _ in range(20):
            state = integrator.step(state, 0.01)
        counts.append(integrator.statistics()["contact"]["contacts"])
    assert counts[0] == counts[1]
    assert counts[0]["last"] > 0


def test_summary_reports_contact(device, tmp_path, capsys):
    assert main(["run", "crossed_beams", "--n", "20", "--device", device, "--out", str(tmp_path / "out")]) == 0
    content = json.loads((tmp_path / "out" / "summary.json").read_text())["contact"]
    assert (content["law"], content["refused_crossings"], content["contacts"]["last"]) == ("barrier", 0, 4)
    assert 0.0 < content["smallest_gap"] < 2e-5
    assert "contact by barrier: 4 pairs at the end" in capsys.readouterr().out

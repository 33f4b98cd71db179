"""Energy of the implicit midpoint rule: bounded drift, or a failure by name.

Without loads, supports and damping, K + E of an elastic body stays at its initial value E0. The rule may create at most
the fraction b of the largest energy, so that |K + E - E0| <= b max(K + E).
"""

import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.scenes import flying_beam

sys.path.append(str(Path(__file__).parent / "contracts"))

from objects import OBJECTS

BOUND = 0.1
ALONE = ("rod", "rod without twist", "planar rod", "closed rod")
JOINED = ("rods joined rigidly", "rods joined by a hinge", "planar rods joined rigidly")
SHELLS = ("shell, midedge_dof", "shell, hinge", "rod on a shell", "shell of revolution")
RATE = 20.0  # rad/s, or 1/s


def energies(model, state) -> np.ndarray:
    """Return kinetic plus elastic energy of every world [J]."""
    return sum(np.atleast_1d(value) for name, value in model.energies(state).items() if name != "gravity")


def free(name: str, device, precision: str = "float64", worlds: int = 1, rates=(RATE,), **options):
    """Return a free body at rest, spun at `rates` [rad/s] per world.

    A shell of revolution is stretched at that rate.
    """
    kind = OBJECTS[name]
    scene, _ = kind.scene(held=False, gravity=(0.0, 0.0, 0.0), **options)
    model = scene.build(device, precision, worlds=worlds)
    points = model.state().points().reshape(worlds, -1, 3)
    axis = (0.0, 1.0, 0.0) if name == "rod without twist" or kind.dimension == 2 else (0.0, 0.6, 0.8)
    speed = np.cross(axis, points - points.mean(1, keepdims=True))
    if name == "shell of revolution":
        speed = points * [1.0, 0.0, 0.0]
    speed *= np.reshape(rates, (-1, 1, 1))
    return model, model.state(velocities=speed if worlds > 1 else speed[0])


def advance(model, state, dt: float, steps: int, **options):
    """Step by the midpoint rule; return energies after each step, the last state and the integrator."""
    integrator, values = ddg.Integrator(model, "implicit_midpoint", **options), [energies(model, state)]
    for _ in range(steps):
        state = integrator.step(state, dt)
        values.append(energies(model, state))
    return np.array(values), state, integrator


DAILY = ("rod", "planar rod", "rods joined by a hinge", "shell, midedge_dof", "shell of revolution")
CASES = [
    pytest.param(name, "float64", marks=() if name in DAILY else pytest.mark.slow)
    for name in (*ALONE, *JOINED, *SHELLS)
]
CASES += [
    pytest.param(name, "mixed", marks=pytest.mark.slow) for name in ("rod", "rods joined rigidly", "shell, midedge_dof")
]


@pytest.mark.parametrize(("name", "precision"), CASES)
def test_a_spin_of_half_a_radian_a_step(device, name, precision):
    """Unbounded energy grows a thousandfold in steps that converge; the bound keeps it."""
    model, state = free(name, device, precision)
    integrator, start, end = (
        ddg.Integrator(model, "implicit_midpoint", energy_bound=None),
        energies(model, state),
        state,
    )
    for _ in range(20):
        end = integrator.step(end, 0.5 / RATE)
        if energies(model, end)[0] > 2.0 * start[0]:
            break
    else:
        pytest.fail("nothing to watch: the energy stays by itself")
    assert set(integrator.statistics()["outcomes"]) <= {"converged", "converged_to_rounding"}
    values, _, integrator = advance(model, state, 0.5 / RATE, 20)
    statistics = integrator.statistics()
    assert np.abs(values - start).max() <= BOUND * values.max() * (1.0 + 1e-6)
    assert statistics["outcomes"]["energy_drift"] > 0
    assert statistics["energy"]["fraction"] <= BOUND * (1.0 + 1e-6)


@pytest.mark.parametrize(
    "name",
    [
        "rod",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("shell, midedge_dof", "rods joined rigidly", "shell of revolution")
        ),
    ],
)
def test_energy_account_balances(device, name):
    """K + E - E0 = made - dissipated with viscosity and mass damping: an identity up to the residual."""
    for damping in ({}, {"viscosity": 2e-4, "mass_damping": 2.0}):
        model, state = free(name, device, **damping)
        values, _, integrator = advance(model, state, 0.2 / RATE, 12, rtol=1e-12)
        account = integrator.statistics()["energy"]
        change = (values[-1] - values[0])[0]
        print(f"{name} {damping}: {values[0][0]:.4g} J, changed {change:.4g}, {account}")
        assert change == pytest.approx(account["made"] - account["dissipated"], abs=1e-7 * values.max())
        assert abs(account["made"]) > 1e-5 * values[0]  # the account is not trivial
        assert (account["dissipated"] > 0.05 * values[0][0]) == bool(damping)


@pytest.mark.parametrize("name", ["rod", "rods joined rigidly", "shell of revolution"])
def test_unbounded_drift_fails_by_name(device, name):
    """Without retries the step fails with outcome, energy and remedy, and keeps the last good state."""
    model, state = free(name, device)
    start, kept = energies(model, state), []
    with pytest.raises(ddg.SolverError) as raised:
        integrator = ddg.Integrator(model, "implicit_midpoint", retry_limit=0, check_every=1)
        for _ in range(20):
            state = integrator.step(state, 1.0 / RATE)
            kept.append(energies(model, state))
    message, object_named = str(raised.value), "rod 0" if name == "rod" else "the coupled system (world 0)"
    for phrase in (object_named, "energy_drift", "J of", "t =", "smaller dt", "implicit_euler", "energy_bound"):
        assert phrase in message
    assert raised.value.outcome == "energy_drift"
    last = energies(model, raised.value.state)
    assert np.abs(last - start).max() <= BOUND * max(last.max(), start.max()) * (1.0 + 1e-6)


def test_retries_that_do_not_help_end_by_name(device):
    model, state = free("shell of revolution", device)
    with pytest.raises(ddg.SolverError, match=r"the coupled system \(world 0\).*energy_drift"):
        advance(model, state, 1.0 / RATE, 20, check_every=1, rtol=1e-8)


@pytest.mark.parametrize("name", ["rod", "shell, hinge"])
def test_failed_world_leaves_other_worlds(device, name):
    """The middle of three worlds spins too fast: it stops at its last good state, the others step as single builds."""
    rates = (0.01 * RATE, RATE, 0.0)
    options = {"retry_limit": 0, "check_every": 10**9}
    model, state = free(name, device, worlds=3, rates=rates)
    values, state, integrator = advance(model, state, 1.0 / RATE, 8, **options)
    spun = values[:, :2]  # rounding alone moves the last world, which keeps its energy to a fraction of a rounding unit
    assert (np.abs(spun - spun[0]) <= BOUND * spun.max(0) * (1.0 + 1e-6)).all()
    with pytest.raises(ddg.SolverError, match="energy_drift"):
        integrator.check(state)
    for world in (0, 2):
        single, start = free(name, device, rates=rates[world : world + 1])
        _, single_state, _ = advance(single, start, 1.0 / RATE, 8, **options)
        np.testing.assert_array_equal(state.points()[world], single_state.points())


def joined_beam() -> ddg.Scene:
    """Return the flying beam as two rods joined rigidly in the middle."""
    whole, scene = flying_beam.build(40), ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    points = whole.batches[0].points[0]
    section = ddg.Stiffness(
        EA=flying_beam.EA, EI1=flying_beam.EI, mass_per_length=flying_beam.MASS_PER_LENGTH, radius=0.05
    )
    first, second = (scene.add_rod(part, section=section) for part in (points[:21], points[20:]))
    scene.join([(first, -1), (second, 0)], rigid=True)
    scene.add_force(first, 0, (1.0, 0.0, 0.0), amplitude=flying_beam.force)
    scene.add_couple(first, 0, (0.0, flying_beam.ARM, 0.0), amplitude=flying_beam.force)
    return scene


@pytest.mark.parametrize("joined", [False, True])
def test_couple_does_not_feed_an_instability(device, joined):
    """The energy does not exceed the work of loads by more than the bound.

    The beam of `flying_beam` in steps of 0.02 s, at which the rule is unstable. Work of loads: force times path, couple
    times rotation.

    Measured: a couple at the predicted edge fed 12,000 J into an instability by 260 J of work.
    """
    scene = joined_beam() if joined else flying_beam.build(40)
    model, work, dt = scene.build(device, "float64"), 0.0, 0.02
    integrator, state = ddg.Integrator(model, "implicit_midpoint"), model.state()
    for _ in range(150):
        push, before = flying_beam.force(state.time + 0.5 * dt), state.points()[:2]
        state = integrator.step(state, dt)
        after = state.points()[:2]
        edge, edge_end = before[1] - before[0], after[1] - after[0]
        angle = np.arctan2(np.cross(edge, edge_end)[1], edge @ edge_end)
        work += push * (after[0, 0] - before[0, 0] + flying_beam.ARM * angle)
    energy, statistics = energies(model, state)[0], integrator.statistics()
    print(f"{energy:.5g} J by {work:.5g} J of work, {statistics}")
    assert statistics["outcomes"]["energy_drift"] > 0
    assert energy - work == pytest.approx(
        statistics["energy"]["made"], abs=2e-3 * work
    )  # loads are those in the middle of steps
    assert abs(energy - work) < BOUND * energy


@pytest.mark.parametrize("name", ["rod", "rods joined rigidly", "shell, midedge_dof"])
def test_work_of_supports_is_no_drift(device, name):
    """A shaken support does work, which does not count as energy created by the rule."""
    motion = ddg.Motion(translation=lambda t: (0.0, 0.0, 0.02 * np.sin(60.0 * t) ** 2))
    scene, _ = OBJECTS[name].scene(motion=motion, gravity=(0.0, 0.0, 0.0))
    model = scene.build(device, "float64")
    values, _, integrator = advance(model, model.state(), 2e-3, 30)
    statistics = integrator.statistics()
    assert values.max() > 1e-3
    assert "energy_drift" not in statistics["outcomes"]
    assert abs(statistics["energy"]["made"]) < 1e-2 * values.max()


@pytest.mark.parametrize(
    "precision", ["float64", *(pytest.param(precision, marks=pytest.mark.slow) for precision in ("mixed", "float32"))]
)
def test_rounding_is_no_drift(device, precision):
    """A body at rest, unstrained or strained, moves by rounding alone: no step fails at long steps."""
    for strained in (False, True):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        points = np.linspace([0.3, 0.0, 0.0], [1.3, 0.0, 0.0], 9)
        rod = scene.add_rod(points, section=ddg.Rectangle(0.04, 0.02), material=ddg.Material(1e7, 0.35, 1000.0))
        scene.fix(rod, [0])
        scene.fix(rod, [-1])
        model = scene.build(device, precision)
        start = points + [0.01, 0.0, 0.0] * np.linspace(0.0, 1.0, 9)[:, None] * strained
        _, _, integrator = advance(model, model.state(points=start), 0.05, 40)
        assert "energy_drift" not in integrator.statistics()["outcomes"]


@pytest.mark.parametrize("name", ["rod", "rods joined rigidly"])
def test_energy_bound_does_not_change_accepted_steps(device, name):
    """The bound keeps accepted steps bitwise; a run with retries repeats bitwise."""
    model, state = free(name, device)
    (_, bounded, _), (_, bare, _) = (
        advance(model, state, 0.1 / RATE, 5, energy_bound=bound) for bound in (BOUND, None)
    )
    np.testing.assert_array_equal(bounded.points(), bare.points())
    np.testing.assert_array_equal(bounded.velocities(), bare.velocities())
    (first, first_state, _), (second, second_state, _) = (advance(model, state, 0.5 / RATE, 12) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first_state.points(), second_state.points())


def test_sums_over_ranges(device):
    """Summing over ranges of nodes, as on CUDA, gives the same account to rounding and stops a drifting run alike."""
    model, state = free("rod", device)
    accounts = []
    for ranges in (1, 3):
        integrator, end = ddg.Integrator(model, "implicit_midpoint"), state
        drift = integrator._rod_steps[0].energy
        drift.ranges, drift.sums = ranges, wp.zeros((2 * ranges, 4, 1), dtype=wp.float64, device=device)
        drift.rows = drift.sums.transpose((1, 0, 2))
        for _ in range(5):
            end = integrator.step(end, 0.3 / RATE)
        accounts.append(drift.account.numpy())
    np.testing.assert_allclose(accounts[1], accounts[0], rtol=1e-9)
    assert accounts[0][0, 0] > 1e-2


def test_new_state_resets_the_energy_account(device):
    model, state = free("rod", device)
    _, _, integrator = advance(model, state, 0.2 / RATE, 5)
    assert abs(integrator.statistics()["energy"]["made"]) > 1e-3
    start = model.state(velocities=1e-4 * state.velocities())
    integrator.step(start, 0.2 / RATE)
    assert abs(integrator.statistics()["energy"]["made"]) < BOUND * energies(model, start)[0]


def test_a_failed_step_leaves_the_state_as_it_was(device):
    """Points and directors stay: frames that the failed solve updated rotate back about the rod."""
    model, state = free("rod", device)
    integrator = ddg.Integrator(model, max_iterations=3, retry_limit=0, check_every=10**9)
    after = integrator.step(state, 3.0 / RATE)
    assert integrator.statistics()["outcomes"] == {"max_iterations": 1}
    np.testing.assert_array_equal(after.points(), state.points())
    np.testing.assert_array_equal(after.directors(), state.directors())


def test_implicit_euler_takes_no_bound(device):
    model, _ = free("rod", device)
    assert "energy" not in ddg.Integrator(model).statistics()
    with pytest.raises(ddg.SceneError, match=r"energy_bound = 0\.2 is of the implicit midpoint rule"):
        ddg.Integrator(model, energy_bound=0.2)

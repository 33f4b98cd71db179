"""Failed and reset worlds leave other worlds unchanged."""

import numpy as np
import pytest
from test_controls import DT, PIVOT, SCHEMES, everything, joined, model_of, one_rod, poses, run, sheet, some_rods

import ddg_warp as ddg
from tests.pairwise import covering

GRAVITY = np.array([(0.0, 0.0, -9.81), (0.0, 0.0, -1.0), (1.0, 2.0, -3.0)])


def controls(k: int, worlds=(0, 1, 2), whip: int | None = None) -> ddg.Controls:
    """Return controls of step k for some worlds; `whip` moves one world so far that squares overflow."""
    poses_given = poses(k * DT)
    if whip is not None:
        poses_given[whip, 0, 0] = 1e200
    poses_given, gravity = (
        (poses_given[worlds], GRAVITY[worlds])
        if isinstance(worlds, int)
        else (poses_given[[*worlds]], GRAVITY[[*worlds]])
    )
    return ddg.Controls(poses_given, gravity=gravity)


def same(state, world: int, expected) -> None:
    """Check that a world of a state equals a state of one world, bit for bit."""
    np.testing.assert_array_equal(state.points()[world], expected.points())
    np.testing.assert_array_equal(state.velocities()[world], expected.velocities())
    np.testing.assert_array_equal(state.poses()[world], expected.poses())
    if state.angles() is not None:
        np.testing.assert_array_equal(state.angles()[world], expected.angles())
        np.testing.assert_array_equal(state.directors()[world], expected.directors())


@covering(1, build=(some_rods, joined, sheet, everything), scheme=("implicit_euler", "implicit_midpoint"))
def test_failed_world_is_frozen_until_reset(device, build, scheme):
    """World 1 fails in step 3 and keeps all rods as before; other worlds equal single builds bit for bit.

    After a reset the world steps like a new one.
    """
    model, single = model_of(build, ddg.Grip(PIVOT), device, worlds=3), model_of(build, ddg.Grip(PIVOT), device)
    integrator, state = ddg.Integrator(model, scheme, failures="flag"), model.state()
    for k in range(1, 5):
        state = integrator.step(state, DT, controls(k, whip=1 if k == 3 else None))
    assert integrator.outcomes().tolist() == ["converged", "non_finite", "converged"]
    text = integrator.failure(state, 1)
    assert all(word in text for word in ("world 1", "non_finite", "20 retries"))
    assert integrator.failure(state, 0) == ""
    for world, steps in ((0, 4), (1, 2), (2, 4)):
        single_state, _ = run(single, steps, scheme, lambda k, w=world: controls(k, w))
        same(state, world, single_state)

    before = state.snapshot()
    reset = integrator.reset(state, [False, True, False])
    assert integrator.outcomes().tolist() == ["converged"] * 3
    assert reset.time == state.time
    same(reset, 1, single.state())
    for world in (0, 2):
        np.testing.assert_array_equal(reset.points()[world], state.points()[world])
    for name, values in before.items():
        np.testing.assert_array_equal(state.snapshot()[name], values, err_msg=name)

    straight = ddg.Integrator(model, scheme)
    expected, fresh = model.state(), ddg.Integrator(single, scheme)
    single_state = single.state()
    for k in range(1, 5):
        expected = straight.step(expected, DT, controls(k))
    state = reset
    for k in range(1, 4):
        expected = straight.step(expected, DT, controls(4 + k))
        poses_given = np.array([poses((4 + k) * DT)[0], poses(k * DT)[1], poses((4 + k) * DT)[2]])
        state = integrator.step(state, DT, ddg.Controls(poses_given, gravity=GRAVITY))
        single_state = fresh.step(single_state, DT, controls(k, 1))
        same(state, 1, single_state)
        for world in (0, 2):
            np.testing.assert_array_equal(state.points()[world], expected.points()[world])
    assert integrator.outcomes().tolist() == ["converged"] * 3


@pytest.mark.parametrize("build", [some_rods, joined], ids=lambda build: build.__name__)
def test_external_state_clears_failures(device, build):
    """Failure flags do not carry over to a state of other origin: the step depends on its inputs alone."""
    model = model_of(build, ddg.Grip(PIVOT), device, worlds=3)
    state, integrator = run(model, 2, controls=controls, failures="flag")
    kept = state.copy()
    state = integrator.step(state, DT, controls(3, whip=1))
    assert integrator.outcomes()[1] == "non_finite"
    again = integrator.step(kept, DT, controls(3)).snapshot()
    assert integrator.outcomes().tolist() == ["converged"] * 3
    for name, values in ddg.Integrator(model).step(kept, DT, controls(3)).snapshot().items():
        np.testing.assert_array_equal(again[name], values, err_msg=name)


@SCHEMES
def test_energy_account_is_reset_per_world(device, scheme):
    """The account of a reset world equals a new one; other accounts continue."""
    model = model_of(some_rods, ddg.Grip(PIVOT), device, worlds=2, gravity=(0.0, 0.0, -3.0))
    state, integrator = run(model, 5, scheme)
    state = integrator.reset(state, [True, False])
    for _ in range(3):
        state = integrator.step(state, DT)
    if scheme == "implicit_euler":
        return
    for world, steps in ((0, 3), (1, 8)):
        _, single = run(model, steps, scheme)
        for stepper, expected in zip(integrator._parts, single._parts, strict=True):
            account, wanted = (p.energy.account.numpy().reshape(4, 2, -1)[:, world] for p in (stepper, expected))
            np.testing.assert_array_equal(account, wanted)


def test_worlds_start_from_any_state(device):
    """Worlds start from the same world of a state, or all from a state of one world, including viscous rods and frames."""

    def viscous(scene, moved):
        one_rod(scene, moved)
        soft = ddg.Material(1e6, 0.3, 1000.0, viscosity=0.05)
        points = np.linspace((0.0, 1.0, 0.0), (0.5, 1.0, 0.2), 7)
        scene.clamp(scene.add_rod(points, section=ddg.Circle(0.02), material=soft), motion=moved)

    model, single = model_of(viscous, ddg.Grip(PIVOT), device, 3), model_of(viscous, ddg.Grip(PIVOT), device)
    early, _ = run(model, 2, controls=controls)
    one, _ = run(single, 4, controls=lambda k: controls(k, 2))
    state, integrator = run(model, 5, controls=controls)
    mask = np.array([True, False, True])
    back = integrator.reset(state, mask, early)
    for world, source in ((0, early), (1, state), (2, early)):
        np.testing.assert_array_equal(back.points()[world], source.points()[world])
        np.testing.assert_array_equal(back.poses()[world], source.poses()[world])
    alike = integrator.reset(state, mask, one)
    same(alike, 0, one)
    same(alike, 2, one)
    after = integrator.step(alike, DT, controls(5))
    same(after, 2, ddg.Integrator(single).step(one, DT, controls(5, 2)))
    nothing = integrator.reset(after, [False] * 3)
    np.testing.assert_array_equal(nothing.points(), after.points())


def test_time_continues_after_a_reset(device):
    """Functions of time are not reset: a load continues, and a support moved by a Motion is refused."""
    single, model = (
        model_of(one_rod, None, device, worlds, load=lambda s: s.add_force(0, -1, (0.0, 1.0, 0.0), lambda t: t))
        for worlds in (1, 2)
    )
    state, integrator = run(model, 3)
    state = integrator.step(integrator.reset(state, [True, False]), DT)
    first = single.state()
    first.time = 3 * DT
    np.testing.assert_array_equal(state.points()[0], ddg.Integrator(single).step(first, DT).points())

    moving = model_of(one_rod, ddg.Motion(lambda t: (t, 0.0, 0.0)), device, 2)
    state, integrator = run(moving, 2)
    kept = state.copy()
    with pytest.raises(ddg.SceneError, match=r"t = 0 s.*0.02 s.*Grip"):
        integrator.reset(state, [True, False])
    np.testing.assert_array_equal(integrator.reset(state, [True, False], kept).points(), kept.points())


def test_raised_failure_names_its_world(device):
    model = model_of(one_rod, ddg.Grip(PIVOT), device, 3)
    integrator = ddg.Integrator(model, retry_limit=4, check_every=1)
    with pytest.raises(ddg.SolverError, match=r"rod 0 \('rod'\) of world 1 could not"):
        integrator.step(model.state(), DT, controls(1, whip=1))
    assert integrator.outcomes().tolist() == ["converged", "non_finite", "converged"]


def test_flagged_steps_do_not_synchronise(device, monkeypatch):
    """Flagging failures, with controls, neither copies from the device nor waits for it."""
    import warp as wp

    model = model_of(everything, ddg.Grip(PIVOT), device, 3)
    state, integrator = run(model, 2, controls=controls, failures="flag")

    def forbidden(*_, **__):
        raise AssertionError("the host waits for the device inside a step")

    with monkeypatch.context() as patched:
        patched.setattr(wp.array, "numpy", forbidden)
        for name in ("synchronize", "synchronize_device", "synchronize_stream", "synchronize_event"):
            patched.setattr(wp, name, forbidden)
        for k in range(3, 6):
            state = integrator.step(state, DT, controls(k))
            state = integrator.reset(state, [True, False, False], state)
    assert integrator.outcomes().tolist() == ["converged"] * 3

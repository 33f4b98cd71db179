"""Rods of a net that touch nothing are stepped as rods on their own: the same motion, and what touches is the net's."""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.solve.net.alone import Alone

RADIUS, DT = 2e-3, 1 / 240
SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5, viscosity=1e-3)
STRAIGHT = np.linspace(-0.05, 0.05, 11)


def rods(count: int = 4, contact: bool = True, material=SOFT, apart: float = 0.03, **scene) -> ddg.Scene:
    """Curved rods beside each other, each held at an end."""
    result = ddg.Scene(**scene)
    points = np.stack([STRAIGHT, 5e-3 * np.sin(60.0 * STRAIGHT), 0.01 * np.cos(40.0 * STRAIGHT)], axis=1)
    for i in range(count):
        result.add_rod(points + [0.0, apart * i, 0.0], section=ddg.Circle(RADIUS), material=material, name=f"rod {i}")
    result.clamp(range(count), edges=[0])
    if contact:
        result.contact(friction=0.3)
    return result


def falling(height: float = 0.02, speed: float = 0.0, **contact) -> tuple[ddg.Scene, np.ndarray]:
    """A rod that falls across a beam, and velocities."""
    scene = ddg.Scene()
    scene.add_rod(np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=SOFT)
    points = np.stack([0 * STRAIGHT, STRAIGHT, 0 * STRAIGHT + height], 1)
    scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT, name="upper")
    scene.clamp(0, edges=[0, -1])
    scene.contact(friction=0.3, **contact)
    velocities = np.zeros((22, 3))
    velocities[11:, 2] = -speed
    return scene, velocities


def run(device, scene, steps: int, dt: float = DT, velocities=None, worlds: int = 1, **options):
    model = scene.build(device=device, worlds=worlds)
    integrator, state = ddg.Integrator(model, **options), model.state(velocities=velocities)
    alone = []
    for _ in range(steps):
        state = integrator.step(state, dt)
        own = integrator._net.alone if integrator._net else None
        alone.append(own is not None and (own.left.numpy() == 0))
    return state, integrator, np.array(alone)


@pytest.mark.parametrize(
    ("material", "scene"),
    [
        (SOFT, {}),
        (ddg.Material(young=1e6, density=1000.0, poisson=0.5), {"mass_damping": 2.0}),
    ],
)
def test_what_never_touches_moves_as_without_contact(device, material, scene):
    """The same solver from the same arrays: only strains of the last step and frames may round otherwise."""
    states = [run(device, rods(contact=contact, material=material, **scene), 30)[0] for contact in (False, True)]
    for values in (ddg.State.points, ddg.State.velocities, ddg.State.angles, ddg.State.directors):
        expected, found = map(values, states)
        assert np.ptp(expected) > 0.0
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


def test_a_rod_that_falls_on_another(device):
    """As the net alone has it: alone until they are near, together while they touch, alone again when apart."""
    scene, velocities = falling(speed=0.5)
    options = {"rtol": 1e-10, "dt": 1 / 480, "velocities": velocities}
    found, integrator, alone = run(device, scene, 90, **options)
    expected, _, _ = run(device, scene, 90, linear="chain", **options)
    assert alone[0] and alone[-1] and not alone.all()
    assert integrator.statistics()["contact"]["smallest_gap"] < np.inf
    np.testing.assert_allclose(found.points(), expected.points(), rtol=0.0, atol=1e-7 * 0.1)
    np.testing.assert_allclose(found.velocities(), expected.velocities(), rtol=0.0, atol=1e-5)


def test_what_would_pass_through_within_a_step_is_caught(device):
    """A fast rod is far from the other at both ends of the step."""
    scene, velocities = falling(height=0.02, speed=20.0)
    options = {"dt": 2e-3, "velocities": velocities, "rtol": 1e-10}
    found, _, alone = run(device, scene, 1, **options)
    expected, _, _ = run(device, scene, 1, linear="chain", **options)
    assert not alone.any()
    z = found.points()[:, 2]
    assert z[16] - z[5] > 2.0 * RADIUS
    np.testing.assert_allclose(found.points(), expected.points(), rtol=0.0, atol=1e-7 * 0.1)


def test_worlds_are_judged_one_by_one(device):
    """One touches, the other does not: each moves as it does by itself."""
    scene, velocities = falling(height=0.012)
    given = np.stack([velocities, velocities])
    given[0, 11:, 2] = -0.5
    found, _, alone = run(device, scene, 24, velocities=given, worlds=2, rtol=1e-10)
    assert alone[:, 1].sum() > alone[:, 0].sum() > 0 and not alone[:, 0].all()
    for world in range(2):
        expected, _, _ = run(device, scene, 24, velocities=given[world], rtol=1e-10)
        np.testing.assert_allclose(found.points()[world], expected.points(), rtol=0.0, atol=1e-8 * 0.1)


def test_obstacles_that_move_push_rods_and_are_where_they_have_to_be(device):
    scene = rods(2)
    lift = ddg.Motion(translation=lambda t: (0.0, 0.0, 0.5 * t))
    scene.add_obstacle(ddg.Sphere((0.0, 0.0, -0.04), 0.01), motion=lift, name="ball")
    scene.add_obstacle(ddg.Plane((0.0, 0.0, -1.0), (0.0, 0.0, 1.0)))
    options = {"rtol": 1e-10, "steps": 40, "dt": 1 / 480}
    found, _, alone = run(device, scene, **options)
    expected, _, _ = run(device, scene, linear="chain", **options)
    assert alone[0] and not alone.all()
    np.testing.assert_allclose(found.points(), expected.points(), rtol=0.0, atol=1e-7 * 0.1)
    np.testing.assert_allclose(found.obstacle_points(), expected.obstacle_points(), rtol=0.0, atol=1e-15)
    first, _, alone = run(device, scene, **(options | {"steps": 3}))
    np.testing.assert_allclose(first.net.v.numpy()[:, 2].max(), 0.5, rtol=1e-12)
    assert alone.all()


def test_drag_supports_that_move_and_loads(device):
    """Whatever else acts on rods acts on them alone."""

    def scene(contact: bool) -> ddg.Scene:
        result = rods(3, contact=contact)
        result.add_rod(
            np.stack([STRAIGHT, 0 * STRAIGHT + 0.2, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=SOFT
        )
        result.drag([1], tangential=0.02, normal=0.05, rotational=1e-6)
        result.add_force(2, 10, (0.0, 0.0, 2e-3), amplitude=lambda t: np.sin(50.0 * t))
        result.add_couple(0, -1, (1e-5, 0.0, 0.0))
        turn = ddg.Motion(angle=lambda t: 3.0 * t, axis=(1.0, 0.0, 0.0), translation=lambda t: (0.0, 0.2 * t, 0.0))
        result.clamp(3, edges=[0], motion=turn)
        return result

    expected, found = (run(device, scene(contact), 30)[0] for contact in (False, True))
    np.testing.assert_allclose(found.points(), expected.points(), rtol=0.0, atol=1e-12)


def test_rods_with_damping_and_without_in_one_set(device):
    def scene(contact: bool) -> ddg.Scene:
        result = rods(2, contact=contact)
        stiff = ddg.Material(young=1e6, density=1000.0, poisson=0.5)
        result.add_rod(
            np.stack([STRAIGHT, 0 * STRAIGHT + 0.2, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=stiff
        )
        result.clamp(2, edges=[0])
        return result

    expected, (found, _, alone) = run(device, scene(False), 20)[0], run(device, scene(True), 20)
    assert alone.all()
    np.testing.assert_allclose(found.points(), expected.points(), rtol=0.0, atol=1e-12)
    model = found.model  # what damping reads next
    strains = [values.numpy().copy() for values in found.net.last]
    model.net.update_strains(found.net)
    for kept, now in zip(strains, found.net.last, strict=True):
        np.testing.assert_allclose(kept, now.numpy(), rtol=0.0, atol=1e-12 * np.abs(kept).max())


def test_grips_take_rods_along(device):
    """In two worlds, each its own way."""
    states = []
    for contact in (False, True):
        scene = rods(1, contact=contact)
        scene.add_rod(
            np.stack([STRAIGHT, 0 * STRAIGHT + 0.2, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=SOFT
        )
        scene.clamp(1, edges=[0], motion=ddg.Grip())
        integrator = ddg.Integrator(scene.build(device=device, worlds=2))
        state = integrator.model.state()
        for step in range(1, 20):
            poses = np.zeros((2, 1, 6))
            poses[:, 0, 1], poses[:, 0, 3] = 1e-3 * step * np.array([1.0, -0.5]), 0.02 * step
            state = integrator.step(state, DT, ddg.Controls(poses=poses))
        states.append(state)
    assert (integrator._net.alone.left.numpy() == 0).all()
    np.testing.assert_allclose(states[1].points(), states[0].points(), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(states[1].angles(), states[0].angles(), rtol=0.0, atol=1e-10)


def test_a_run_that_is_resumed_takes_the_same_steps(device):
    """Bitwise, from whatever step: what decides is not what was searched for before."""
    scene, velocities = falling(height=0.012, speed=0.5)
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model), model.state(velocities=velocities)
    snapshots, ways = [], []
    for _ in range(24):
        snapshots.append(state.snapshot())
        state = integrator.step(state, DT)
        ways.append(bool(integrator._net.alone.left.numpy()[0]))
    assert len(set(ways)) == 2
    for start in (3, 6, 12, 20):
        other, again = ddg.Integrator(model), model.restore(snapshots[start])
        for _ in range(start, 24):
            again = other.step(again, DT)
        for name, values in again.snapshot().items():
            np.testing.assert_array_equal(values, state.snapshot()[name], err_msg=name)


def shot(kick: float = 0.0, rods: int = 1, gap: float = 0.15, **contact) -> tuple[ddg.Scene, np.ndarray]:
    """Rods above a beam that creep towards it, each at its own pace, without gravity, until at 0.2 s they are driven; velocities."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_rod(np.stack([STRAIGHT, 0 * STRAIGHT, 0 * STRAIGHT], 1), section=ddg.Circle(RADIUS), material=SOFT)
    velocities = np.zeros((11 * (rods + 1), 3))
    for r in range(rods):
        x = 0.02 * (r - 0.5 * (rods - 1))
        points = np.stack([0 * STRAIGHT + x, STRAIGHT, 0 * STRAIGHT + gap], 1)
        scene.add_rod(points, section=ddg.Circle(RADIUS), material=SOFT, name=f"shot {r}")
        velocities[11 * (r + 1) : 11 * (r + 2), 2] = -0.02 * (r + 1)
        if kick:
            for node in range(11):
                # a little aside, so that the beam, which its hits press, gives way to that side
                scene.add_force(r + 1, node, (0.0, 0.05 * kick, -kick), amplitude=lambda t: float(0.2 < t < 0.25))
    scene.clamp(0, edges=[0, -1])
    scene.contact(friction=0.3, **contact)
    return scene, velocities


def looks(integrator) -> int:
    return int(integrator._net.alone.runs.looks.numpy()[0])


def test_what_was_quiet_for_long_is_seen_when_it_is_driven_at_another(device):
    """Boxes made for a slow motion serve for long; then rods are driven out of them, by centimetres in a step, into the beam."""
    scene, velocities = shot(kick=0.01, rods=2)
    options = {"rtol": 1e-10, "dt": 1 / 480, "velocities": velocities}
    found, integrator, alone = run(device, scene, 150, **options)
    expected, other, _ = run(device, scene, 150, linear="chain", **options)
    first = int(np.argmin(alone[:, 0]))
    assert alone[:first].all() and first > 96 and looks(integrator) < 40
    gaps = [each.statistics()["contact"]["smallest_gap"] for each in (integrator, other)]
    assert 0.0 < gaps[1] < np.inf and gaps[0] == pytest.approx(gaps[1], rel=1e-3)
    np.testing.assert_allclose(found.points(), expected.points(), rtol=0.0, atol=1e-6 * 0.1)


def test_worlds_share_no_boxes(device):
    """Of three worlds one touches from early on, one late, one never: each moves as it does by itself."""
    scene, velocities = falling(height=0.03)
    scene.gravity = (0.0, 0.0, 0.0)
    speeds, steps = (0.5, 0.2, 0.0), 60
    given = np.stack([velocities] * 3)
    given[:, 11:, 2] = -np.array(speeds)[:, None]
    found, _, alone = run(device, scene, steps, velocities=given, worlds=3, rtol=1e-10)
    first = [int(np.argmin(alone[:, world])) if not alone[:, world].all() else steps for world in range(3)]
    assert 0 < first[0] < first[1] < first[2] == steps
    for world in range(3):
        expected, _, own = run(device, scene, steps, velocities=given[world], rtol=1e-10)
        np.testing.assert_array_equal(alone[:, world], own[:, 0])
        np.testing.assert_allclose(found.points()[world], expected.points(), rtol=0.0, atol=1e-8 * 0.1)


def test_a_capsule_that_is_swung_at_rods_is_seen(device):
    """It rests for long, then comes by centimetres in a step, as the net alone has it."""
    scene = rods(3, gravity=(0.0, 0.0, 0.0))
    swing = ddg.Motion(translation=lambda t: (0.0, 0.0, 3.0 * max(0.0, t - 0.1)))
    scene.add_obstacle(ddg.Capsule((0.04, -0.1, -0.15), (0.04, 0.2, -0.15), 0.005), motion=swing, name="bat")
    options = {"rtol": 1e-10, "dt": 1 / 480}
    found, integrator, alone = run(device, scene, 78, **options)
    expected, _, _ = run(device, scene, 78, linear="chain", **options)
    first = int(np.argmin(alone[:, 0]))
    assert 60 < first < 78 and looks(integrator) < 24
    np.testing.assert_allclose(found.points(), expected.points(), rtol=0.0, atol=1e-6 * 0.1)
    np.testing.assert_allclose(found.obstacle_points(), expected.obstacle_points(), rtol=0.0, atol=1e-15)


def test_worlds_that_start_anew_within_reach_are_seen(device):
    """A reset puts rods where boxes of the same world did not see them."""
    scene, _ = falling(height=0.05)
    scene.gravity = (0.0, 0.0, 0.0)
    model, near = scene.build(device=device, worlds=2), falling(height=2.2 * RADIUS, speed=0.5)
    integrator, state = ddg.Integrator(model, rtol=1e-10), model.state()
    for _ in range(5):
        state = integrator.step(state, DT)
    to = state.points()
    to[:, 11:, 2] = 2.2 * RADIUS
    state = integrator.reset(state, np.array([True, False]), model.state(points=to, velocities=np.stack([near[1]] * 2)))
    state = integrator.step(state, DT)
    assert integrator._net.alone.left.numpy().tolist() == [1, 0]
    assert state.points()[0, 16, 2] - state.points()[0, 5, 2] > 2.0 * RADIUS
    assert 0.0 < integrator.statistics()["contact"]["smallest_gap"] < 1e-3


def test_a_quiet_run_that_is_resumed_takes_the_same_steps(device):
    """Bitwise, whatever boxes it had: from within their time, from when they are left, and until something touches."""
    scene, velocities = shot(kick=0.01, rods=2)
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model), model.state(velocities=velocities)
    snapshots, ways, seen = [], [], []
    for _ in range(130):
        snapshots.append(state.snapshot())
        state = integrator.step(state, 1 / 480)
        ways.append(bool(integrator._net.alone.left.numpy()[0]))
        seen.append(looks(integrator))
    assert len(set(ways)) == 2
    left = int(np.flatnonzero(np.diff(seen))[2])
    for start in (left - 1, left, left + 1, left + 2, 90, ways.index(True) - 1, ways.index(True) + 1):
        other, again = ddg.Integrator(model), model.restore(snapshots[start])
        for _ in range(start, 130):
            again = other.step(again, 1 / 480)
        for name, values in again.snapshot().items():
            np.testing.assert_array_equal(values, state.snapshot()[name], err_msg=name)


def test_a_quiet_step_launches_little_more_than_one_without_contact(device, monkeypatch):
    """Five kernels of its own, the states of rods there and back among them, and no condition but those of any step."""
    counts = {}
    for contact in (False, True):
        state, integrator, _ = run(device, rods(contact=contact), 10)
        source, log = integrator._own(state), []

        def logged(name: str, launch, log: list = log):
            return lambda *given, **named: (log.append(name), launch(*given, **named))[1]

        with monkeypatch.context() as patch:
            for where, names in ((wp, ("launch", "capture_if", "capture_while")), (wp.array, ("zero_", "fill_"))):
                for name in names:
                    patch.setattr(where, name, logged(name, getattr(where, name)))
            integrator._launch(source)
        counts[contact] = {name: log.count(name) for name in set(log)}
    own, other = counts[True], counts[False]
    assert own["capture_while"] == 1 and own["capture_if"] == 1 and other["capture_while"] == 2
    assert own["launch"] - other["launch"] <= 5 and own["zero_"] == 1 and "fill_" not in own


def test_statistics_count_a_step_as_any_other(device):
    state, integrator, alone = run(device, rods(3), 10)
    assert alone.all()
    found = integrator.statistics()
    assert found["outcomes"] == {"converged": 10} and found["retries"] == 0 and found["pcg_iterations"] == 0
    _, plain, _ = run(device, rods(3, contact=False), 10)
    assert found["newton_iterations"]["max"] == plain.statistics()["newton_iterations"]["max"]
    assert found["contact"]["contacts"] == {"mean": 0.0, "last": 0}
    assert found["contact"]["smallest_gap"] == np.inf
    model = state.model
    assert "rods on their own" in model.report()
    assert len(model.contacts(state)) == 0 and model.energies(state)["kinetic"] > 0.0


def closed() -> ddg.Scene:
    scene = ddg.Scene()
    turn = np.linspace(0.0, 2 * np.pi, 17)[:-1]
    scene.add_rod(
        np.stack([0.05 * np.cos(turn), 0.05 * np.sin(turn), 0 * turn], 1),
        section=ddg.Circle(RADIUS),
        material=SOFT,
        closed=True,
    )
    scene.contact()
    return scene


@pytest.mark.parametrize(
    ("scene", "options"),
    [(closed, {}), (rods, {"linear": "chain"}), (lambda: rods(contact=False), {})],
)
def test_where_it_does_not_apply_nothing_of_it_is_made(device, scene, options, monkeypatch):
    def refuse(*_):
        raise AssertionError("made")

    monkeypatch.setattr(Alone, "__init__", refuse)
    run(device, scene(), 2, **options)


def test_what_gradients_and_controls_need_is_solved_with_the_net(device):
    scene, _ = falling()
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model), model.state()
    state = integrator.step(state, DT)
    assert integrator._net.alone is not None
    state = integrator.step(state, DT, ddg.Controls(gravity=(0.0, 0.0, -1.0)))
    assert integrator._net.alone is None


def test_parameters_that_change_go_to_rods_on_their_own(device):
    """Which stay that: the step is what the net would make of it, and no longer what it was."""
    points = []
    for whole, stiffness in ((False, None), (False, 10.0), (True, 10.0)):
        scene, _ = falling()
        model = scene.build(device=device, precision="float64")
        integrator, state = ddg.Integrator(model, rtol=1e-10), model.state()
        if whole:
            integrator.step_whole()
        state = integrator.step(state, DT)
        if stiffness:
            model.set_parameter("rod_stretch", "stiffness", stiffness)
        for _ in range(3):
            state = integrator.step(state, DT)
        assert (integrator._net.alone is None) == whole
        points.append(state.points())
    usual, alone, together = points
    np.testing.assert_allclose(alone, together, atol=1e-10)
    assert np.abs(alone - usual).max() > 1e-6
